//! A child goes on on a thread of its own.

use super::{RecoveryResult, SupervisorActor};
use crate::runtime::pending_answer::PendingAnswer;
use actix::prelude::*;
use blastema_contract::supervisor::{GaveUp, MoveChild};
use blastema_core::recovery::{GiveUpReason, ReplacementCause};

impl Handler<MoveChild> for SupervisorActor {
    type Result = PendingAnswer<RecoveryResult>;

    /// The next incarnation begins elsewhere: no restart that a budget counts, because nothing has
    /// failed.
    fn handle(&mut self, message: MoveChild, context: &mut Context<Self>) -> Self::Result {
        let MoveChild { object, fault } = message;
        let faulty = fault.map(|fault| fault.incarnation);
        if let Some(child) = self.child(&object)
            && let Err(reason) = child.move_to_own_thread()
        {
            let why = GiveUpReason::StartFailed { reason: reason.to_owned() };
            return PendingAnswer::new(async move { Err(GaveUp { object, why }) });
        }
        self.ask(context, object, |machine, object, call, now| {
            machine.handle_restart(object, call, ReplacementCause::Asked, faulty, now);
        })
    }
}
