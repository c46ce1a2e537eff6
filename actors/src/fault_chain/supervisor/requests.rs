//! What others have a supervisor do with one child.

use super::{RecoveryResult, SupervisorActor};
use crate::runtime::pending_answer::PendingAnswer;
use actix::prelude::*;
use blastema_contract::supervisor::{ChildAction, ChildRequest, GaveUp};
use blastema_core::recovery::{GiveUpReason, ReplacementCause, Supervisor};
use blastema_core::{Fault, Incarnation};

impl Handler<ChildRequest> for SupervisorActor {
    type Result = PendingAnswer<RecoveryResult>;

    fn handle(&mut self, message: ChildRequest, context: &mut Context<Self>) -> Self::Result {
        let ChildRequest { object, action } = message;
        match action {
            ChildAction::Restart(fault) => {
                let cause = fault.as_ref().map_or(ReplacementCause::Asked, ReplacementCause::of);
                let faulty = fault.map(|fault| fault.incarnation);
                self.ask(context, object, |machine, object, call, now| {
                    machine.handle_restart(object, call, cause, faulty, now);
                })
            }
            // No restart that a budget counts, because nothing has failed.
            ChildAction::Move(fault) => {
                if let Some(child) = self.children.get_mut(&object)
                    && let Err(reason) = child.move_to_own_thread()
                {
                    let why = GiveUpReason::StartFailed { reason: reason.to_owned() };
                    return PendingAnswer::new(std::future::ready(Err(GaveUp { object, why })));
                }
                let (cause, faulty) =
                    (ReplacementCause::Asked, fault.map(|fault| fault.incarnation));
                self.ask(context, object, |machine, object, call, now| {
                    machine.handle_restart(object, call, cause, faulty, now);
                })
            }
            ChildAction::Reset => self.ask(context, object, Supervisor::handle_reset),
            ChildAction::Isolate { faulty, isolated, reason } => {
                self.with(&object, |child| child.explain_isolation(&reason));
                self.ask(context, object, |machine, object, call, now| {
                    machine.handle_isolate(object, faulty, isolated, call, now);
                })
            }
            ChildAction::SafeStop(fault) => {
                if let Some(fault) = &fault {
                    self.with(&object, |child| child.explain_isolation(&fault.as_reason()));
                }
                let present = self.machine.incarnation_of(&object);
                let asked = ReplacementCause::Asked;
                let cause = fault.map_or(asked, |fault| cause_of_rest(&fault, present));
                self.ask(context, object, |machine, object, call, now| {
                    machine.handle_rest(object, call, cause, now);
                })
            }
            ChildAction::Remove => self.ask(context, object, Supervisor::handle_remove),
        }
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
