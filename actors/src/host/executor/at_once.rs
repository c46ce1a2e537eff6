//! Events straight from the arbiter's hub to the handler, without the queue.

use super::ComponentExecutor;
use super::service::{CurrentService, Service, SlotInUse};
use crate::component::cell::ComponentCell;
use crate::component::envelope::{self, EventFutureSlot, Times};
use crate::component::incarnation::IncarnationState;
use crate::component::slot::ComponentSlot;
use crate::component::{Component, Handle};
use crate::liveness::activity::ActivityRecord;
use crate::messaging::message_log;
use blastema_core::Contract;
use std::any::TypeId;
use std::rc::Rc;
use std::task;

/// Serves the events of one contract, one after another: what they have in common is looked up
/// once.
pub(crate) struct EventService<'a, C: Component, S> {
    cell: &'a ComponentCell<C>,
    state: &'a IncarnationState<C>,
    component: &'a Rc<ComponentSlot<C>>,
    activity: &'static ActivityRecord,
    service: &'a mut Service,
    cx: task::Context<'a>,
    at: usize,
    label: u32,
    future_slot: &'a mut S,
}

impl<C: Component, S> EventService<'_, C, S> {
    /// Nothing is before an event that comes now.
    #[inline]
    pub(crate) fn is_free(&self) -> bool {
        matches!(self.service, Service::Idle)
            && self.cell.queue.is_empty()
            && !self.state.has_wishes()
            && !self.state.token.has_ended()
            && !self.state.token.is_muted()
    }

    /// An event straight to the handler, without the queue: only while the component is free. It
    /// runs on the arbiter's hub, which has named the component to the heartbeat, under the hub's
    /// guard and the component's activity record. Where the handler awaits something, the executor
    /// goes on with it in its own polls.
    #[inline]
    pub(crate) fn serve<M: Contract>(&mut self, event: M, times: Times)
    where
        S: EventFutureSlot<C, M>,
    {
        self.state.captured_at.set(Some(times.captured_at()));
        message_log::begun(M::NAME, &self.cell.record.name, self.state.incarnation);
        self.activity.begin(self.label);
        *self.service = Service::Message { at: self.at, is_followed: false };
        if self.future_slot.begin(event, self.component, &mut self.cx).is_pending() {
            return;
        }
        *self.service = Service::Idle;
        self.activity.step();
    }
}

impl<C: Component> ComponentExecutor<C> {
    /// Serves the events of one contract while the component is free for them; `None` where it
    /// does not serve events of a hub at once now. Nothing that it serves so changes that, unless
    /// it ends the incarnation.
    #[inline]
    pub(crate) fn event_service<M: Contract>(
        &mut self,
    ) -> Option<EventService<'_, C, impl EventFutureSlot<C, M>>>
    where
        C: Handle<M>,
    {
        if !self.service.is_idle()
            || !self.lifecycle.is_serving()
            || self.over
            || !self.budget.is_trusted()
        {
            return None;
        }
        let at = self.service.slot_for(TypeId::of::<M>(), M::NAME, envelope::future_slot::<C, M>);
        let CurrentService { current, slots_in_use, slot } = &mut self.service;
        let SlotInUse { label, future_slot, .. } = &mut slots_in_use[at];
        Some(EventService {
            cell: &self.cell,
            state: &self.state,
            component: self.component.as_ref()?,
            activity: slot.activity,
            service: current,
            cx: task::Context::from_waker(self.control.waker.as_ref()?),
            at,
            label: *label,
            future_slot: envelope::event_future_slot::<C, M>(&mut **future_slot)?,
        })
    }

    /// The hub has found that this component took long over an event.
    pub(crate) fn overdraw(&self) {
        if let Some(waker) = &self.control.waker {
            self.budget.overdraw(waker);
        }
    }

    /// The hub goes on to the next component.
    #[inline]
    pub(crate) fn end_events(&mut self) {
        if self.is_abandoned() {
            self.leave(); // Its neighbours must not stand behind this fence.
        }
        if self.over || self.state.has_wishes() || !self.outbox.is_empty() {
            // The executor's own poll fulfils what was asked for, reports, and ends what is to end.
            self.control.wake();
        }
    }
}
