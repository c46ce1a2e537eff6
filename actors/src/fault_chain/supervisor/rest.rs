//! A child is put in the safe state.

use super::{RecoveryResult, SupervisorActor};
use crate::runtime::pending_answer::PendingAnswer;
use actix::prelude::*;
use blastema_contract::supervisor::SafeStop;
use blastema_core::recovery::ReplacementCause;
use blastema_core::{Fault, Incarnation};

impl Handler<SafeStop> for SupervisorActor {
    type Result = PendingAnswer<RecoveryResult>;

    fn handle(&mut self, message: SafeStop, context: &mut Context<Self>) -> Self::Result {
        let SafeStop { object, fault } = message;
        if let Some(fault) = &fault {
            self.with(&object, |child| child.explain_isolation(&fault.as_reason()));
        }
        let present = self.machine.incarnation_of(&object);
        let cause = fault.map_or(ReplacementCause::Asked, |fault| cause_of_rest(&fault, present));
        self.ask(context, object, |machine, object, call, now| {
            machine.handle_rest(object, call, cause, now);
        })
    }
}

/// Several actions may have been tried since a panic: whether the present incarnation, if there is
/// one, ends is found out by asking it. Only one that does not answer is not asked.
fn cause_of_rest(fault: &Fault, present: Option<Incarnation>) -> ReplacementCause {
    match ReplacementCause::of(fault) {
        stuck @ (ReplacementCause::Stuck | ReplacementCause::Behind)
            if present <= Some(fault.incarnation) =>
        {
            stuck
        }
        _ => ReplacementCause::Faulty,
    }
}
