//! Messages that are not going to be served: they are returned to their senders, or dropped and
//! counted.
//!
//! Their `Drop` is the user's. A supervisor that closes a queue runs it on the fault chain's thread:
//! a `Drop` that blocks there stalls the chain, which the
//! [thread outside](crate::fault_chain::outside) finds.

use super::Component;
use super::cell::ComponentCell;
use super::envelope::BoxedEnvelope;
use blastema_core::{DeliveryError, Incarnation};

impl<C: Component> ComponentCell<C> {
    /// Closes the queue until the next incarnation; what was in it is returned or counted.
    pub(crate) fn close(&self, why: &DeliveryError) {
        self.queue.stop().into_iter().for_each(|left| self.return_envelope(left, why.clone()));
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
        let contract = envelope.header().name;
        self.record.record_dead_letter(contract, &why);
        let give_back = move || {
            envelope.give_back(why);
            drop(envelope);
        };
        let _ = self.record.guard(|| format!("the Drop of a message of {contract}"), give_back);
    }
}
