//! Events straight from the arbiter's hub to the handler, without the queue.

use super::{ComponentExecutor, Service};
use crate::component::Component;
use crate::component::envelope::Envelope;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::task;

impl<C: Component> ComponentExecutor<C> {
    /// Nothing is before a message that comes now.
    #[inline]
    pub(crate) fn is_free(&self) -> bool {
        matches!(self.service, Service::Idle)
            && self.cell.queue.is_empty()
            && self.lifecycle.is_serving()
            && !self.over
            && self.component.is_some()
            && self.waker.is_some()
            && !self.state.has_wishes()
            && !self.state.token.has_ended()
            && !self.state.token.is_muted()
            && self.budget.is_trusted()
    }

    /// The hub has found that this component took long over an event.
    pub(crate) fn overdraw(&self) {
        if let Some(waker) = &self.waker {
            self.budget.overdraw(waker);
        }
    }

    /// An event straight to the handler, without the queue: only for an executor that is free. It
    /// runs on the arbiter's hub, which has named the component to the heartbeat, under its guard
    /// and activity record.
    #[inline]
    pub(crate) fn serve_at_once(&mut self, envelope: &mut impl Envelope<C>) {
        let Some(waker) = self.waker.take() else { return };
        let mut cx = task::Context::from_waker(&waker);
        let served = catch_unwind(AssertUnwindSafe(|| {
            self.begin_message(&envelope.header(), envelope);
            self.advance(&mut cx)
        }));
        if let Err(payload) = served {
            self.died_in_service(payload);
            // The hub's turn may be long: what follows in it is another's.
            self.flush();
            waker.wake_by_ref(); // The replacement begins in the executor's own poll.
        }
        if self.is_abandoned() {
            self.leave(); // The hub goes on to neighbours, who must not stand behind this fence.
        }
        if self.over || self.state.has_wishes() || !self.outbox.is_empty() {
            waker.wake_by_ref(); // The executor's own poll reports, and ends what is to end.
        }
        self.waker = Some(waker);
    }
}
