//! Messages that are not going to be served: they are returned to their senders, or dropped and
//! counted.
//!
//! Their `Drop` is the user's. A supervisor that closes a queue has it run on a thread that is
//! started for it and [observed](crate::runtime::callbacks); a `Drop` that blocks there is a fault
//! of the component, under its name.

use super::Component;
use super::cell::{CellCore, ComponentCell};
use super::envelope::{BoxedEnvelope, EnvelopeHeader};
use crate::messaging::message_log::{self, LogId};
use crate::runtime::callbacks::{CallKind, CallOutcome};
use blastema_core::{DeliveryError, FaultKind, Incarnation};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use tracing::warn;

impl<C: Component> ComponentCell<C> {
    /// Closes the queue until the next incarnation; what was in it is returned or counted. Its
    /// `Drop` is the user's and may block, and the caller is a supervisor.
    pub(crate) fn close(self: &Arc<Self>, why: &DeliveryError) {
        let record = &self.record;
        for envelope in self.queue.stop() {
            let contract = envelope.header().name;
            let (cell, why) = (self.clone(), why.clone());
            let give_back = move || cell.return_envelope(envelope, why);
            let (cell, declared) = (self.clone(), AtomicBool::new(false));
            let outcome = move |outcome| cell.record.handle_returned(contract, outcome, &declared);
            record.environment.callbacks.call(CallKind::Return, &record.name, give_back, outcome);
        }
    }

    /// The same, by the incarnation that ends; without effect when it was given up and another has
    /// begun.
    pub(crate) fn close_by(&self, incarnation: Incarnation) {
        let left = self.queue.stop_by(incarnation);
        left.into_iter()
            .for_each(|envelope| self.return_envelope(envelope, DeliveryError::Stopped));
    }

    /// A message that is not going to be served.
    pub(crate) fn return_envelope(&self, mut envelope: BoxedEnvelope<C>, why: DeliveryError) {
        let EnvelopeHeader { name: contract, logged, .. } = envelope.header();
        self.record.record_dead_letter(contract, &why);
        if let Some(id) = logged {
            message_log::lost(id, contract, &self.record.name, &why);
        }
        let give_back = move || {
            envelope.give_back(why);
            drop(envelope);
        };
        let _ = self.record.guard(|| format!("the Drop of a message of {contract}"), give_back);
    }
}

impl CellCore {
    /// A message is sent to the component: its id in the log, where one is kept.
    #[inline]
    pub(crate) fn log_sent(&self, contract: &'static str) -> Option<LogId> {
        let from = || self.environment.watch_list.name_here();
        message_log::sent(contract, &self.name, from)
    }

    /// It was not let in.
    pub(crate) fn log_refused(&self, id: Option<LogId>, contract: &str, why: &DeliveryError) {
        if let Some(id) = id {
            message_log::refused(id, contract, &self.name, why);
        }
    }

    /// What became of the call that returns a message of this contract. `declared`: that it is
    /// late stands as a fault.
    fn handle_returned(&self, contract: &str, outcome: CallOutcome, declared: &AtomicBool) {
        let detail = match outcome {
            // A panic is declared where it is caught.
            CallOutcome::Done | CallOutcome::Panicked(_) | CallOutcome::ReturnedLate => {
                if declared.load(Relaxed) {
                    self.clear(FaultKind::CheckFailed);
                }
                return;
            }
            CallOutcome::Blocked(limit) => format!(
                "the Drop of a message of {contract} has blocked its thread for {limit:?}: the \
                 thread is abandoned"
            ),
            CallOutcome::NotMade => format!(
                "a message of {contract} is not returned yet: the system has no thread left"
            ),
        };
        declared.store(true, Relaxed);
        warn!(object = %self.name, "{detail}");
        self.declare(FaultKind::CheckFailed, detail);
    }
}
