//! Events straight from the arbiter's hub to the handler, without the queue.

use super::{ComponentExecutor, Service};
use crate::component::Component;
use crate::component::envelope::Envelope;
use std::task::{self, Poll};

impl<C: Component> ComponentExecutor<C> {
    /// Whether the component serves events of a hub at once while it is free. Nothing that it
    /// serves so changes that, unless it ends the incarnation.
    #[inline]
    pub(crate) fn serves_at_once(&self) -> bool {
        self.lifecycle.is_serving()
            && !self.over
            && self.component.is_some()
            && self.waker.is_some()
            && self.budget.is_trusted()
    }

    /// Nothing is before an event that comes now.
    #[inline]
    pub(crate) fn is_free(&self) -> bool {
        matches!(self.service, Service::Idle)
            && self.cell.queue.is_empty()
            && !self.state.has_wishes()
            && !self.state.token.has_ended()
            && !self.state.token.is_muted()
    }

    /// An event straight to the handler, without the queue: only for an executor that serves at
    /// once and is free. It runs on the arbiter's hub, which has named the component to the
    /// heartbeat, under the hub's guard and the component's activity record.
    #[inline]
    pub(crate) fn serve_at_once(&mut self, envelope: &mut impl Envelope<C>) {
        let at = self.note_message(&envelope.header(), envelope);
        self.service = Service::Message(at);
        let (Some(waker), Some(component)) = (&self.waker, &self.component) else { return };
        let mut cx = task::Context::from_waker(waker);
        match self.slots_in_use[at].future_slot.as_mut().begin(
            envelope.contents(),
            component,
            &mut cx,
        ) {
            Poll::Ready(()) => self.end_message(),
            Poll::Pending => drop(self.wait()),
        }
    }

    /// The hub has found that this component took long over an event.
    pub(crate) fn overdraw(&self) {
        if let Some(waker) = &self.waker {
            self.budget.overdraw(waker);
        }
    }

    /// The hub goes on to the next component.
    #[inline]
    pub(crate) fn end_events(&mut self) {
        if self.is_abandoned() {
            self.leave(); // Its neighbours must not stand behind this fence.
        }
        if (self.over || self.state.has_wishes() || !self.outbox.is_empty())
            && let Some(waker) = &self.waker
        {
            waker.wake_by_ref(); // The executor's own poll reports, and ends what is to end.
        }
    }
}
