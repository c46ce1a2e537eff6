//! What an executor has to tell, kept until its poll is over.

use super::ComponentExecutor;
use crate::component::Component;
use actix::Recipient;
use blastema_contract::child::{ChildEvent, ChildReport};
use blastema_contract::reports::{FaultDeclared, StateReported};
use blastema_core::Incarnation;

/// Reported when the poll is over, so that the replacement's first message does not wait for it.
pub(super) enum DeferredReport {
    Exited(Incarnation),
    State(StateReported),
    Declared(FaultDeclared),
    Child(ChildEvent, Incarnation),
}

impl<C: Component> ComponentExecutor<C> {
    pub(super) fn flush(&mut self) {
        if self.outbox.is_empty() {
            return;
        }
        self.arbiter.heartbeat.owe_exits(false);
        let record = &self.cell.record;
        let reports = &record.environment.reports;
        // Taken, not drained: one that has nothing to tell keeps no room for it.
        for notice in std::mem::take(&mut self.outbox) {
            match notice {
                DeferredReport::Exited(incarnation) => record.tell_exits(incarnation),
                DeferredReport::State(state) => tell(reports.states.as_ref(), state),
                DeferredReport::Declared(declared) => tell(reports.faults.as_ref(), declared),
                DeferredReport::Child(event, incarnation) => {
                    let object = record.name.clone();
                    self.supervisor.do_send(ChildReport { object, incarnation, event });
                }
            }
        }
    }
}

impl DeferredReport {
    pub(super) fn is_of_after(&self, incarnation: Incarnation) -> bool {
        match self {
            DeferredReport::Exited(of) => *of > incarnation,
            DeferredReport::State(state) => state.incarnation > incarnation,
            DeferredReport::Declared(declared) => declared.incarnation > incarnation,
            DeferredReport::Child(_, of) => *of > incarnation,
        }
    }

    /// An incarnation before this one ended by itself.
    pub(super) fn is_death_before(&self, incarnation: Incarnation) -> bool {
        matches!(self, DeferredReport::Exited(of) if *of < incarnation)
    }
}

fn tell<M>(recipient: Option<&Recipient<M>>, message: M)
where
    M: actix::Message + Send + 'static,
    M::Result: Send,
{
    if let Some(recipient) = recipient {
        recipient.do_send(message);
    }
}
