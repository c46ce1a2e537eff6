//! The component behind one listener of a hub.

use super::hub::{Batch, EventListener, Hub, HubProgress, ListenerEntry, Runs};
use crate::component::cell::ComponentCell;
use crate::component::{Component, Handle};
use crate::host::executor;
use crate::host::executor::ComponentExecutor;
use crate::liveness::label::CONDITION;
use crate::platform::panics;
use crate::settings::FAULT_HOLD;
use blastema_core::{DeliveryError, Event, FaultKind};
use std::any::Any;
use std::cell::RefCell;
use std::hint::black_box;
use std::rc::{Rc, Weak};
use std::sync::Arc;

/// The component behind a listener of a hub.
pub(super) struct Resident<C: Component> {
    pub(super) cell: Arc<ComponentCell<C>>,
    /// Where events wait while it is busy.
    pub(super) port: usize,
    pub(super) executor: RefCell<Weak<RefCell<ComponentExecutor<C>>>>,
}

impl<C: Component> Resident<C> {
    #[inline]
    fn executor(&self) -> Option<Rc<RefCell<ComponentExecutor<C>>>> {
        let mut known = self.executor.borrow_mut();
        if known.strong_count() == 0 {
            *known = executor::executor_here(&self.cell)?; // It was born again.
        }
        known.upgrade()
    }

    fn with_executor<R>(&self, then: impl FnOnce(&mut ComponentExecutor<C>) -> R) -> Option<R> {
        let executor = self.executor()?;
        let mut executor = executor.try_borrow_mut().ok()?;
        Some(then(&mut executor))
    }
}

impl<C: Handle<E>, E: Event> EventListener<E> for Resident<C> {
    fn take(&self, hub: &Hub<E>, entry: &ListenerEntry<E>, batch: &Batch<E>) -> HubProgress {
        let executor = self.executor();
        let mut executor = executor.as_ref().and_then(|executor| executor.try_borrow_mut().ok());
        let activity_slot = executor.as_ref().map(|executor| executor.activity_slot());
        entry.activity_slot.set(activity_slot);
        hub.heartbeat.run(activity_slot.map(|activity_slot| activity_slot.index));
        let mut at_once = executor.as_mut().and_then(|executor| executor.event_service::<E>());
        let mut progress = HubProgress::Done;
        while let Some(posted) = hub.next(batch) {
            if hub.is_for(entry, batch, posted) {
                let free = at_once.as_mut().filter(|service| service.is_free());
                let event = posted.event.clone();
                match free {
                    Some(service) => {
                        hub.runs.set(Runs::Handler);
                        service.serve(event, posted.at);
                        hub.runs.set(Runs::Other);
                    }
                    None if hub.still_gets(entry) => {
                        let is_taken = self.cell.queue_event(self.port, event, posted.at);
                        if let (false, Some(topic)) = (is_taken, hub.topic.upgrade()) {
                            topic.traffic.lose();
                        }
                    }
                    None => drop(event),
                }
            }
            progress = hub.progress();
            if progress != HubProgress::Done {
                break;
            }
        }
        if let Some(executor) = &mut executor {
            if progress == HubProgress::Slow {
                executor.overdraw();
            }
            executor.end_events();
        }
        progress
    }

    #[inline]
    fn call_up(&self) {
        black_box(self.executor.borrow().strong_count());
    }

    fn die_in_service(&self, payload: Box<dyn Any + Send>) {
        self.with_executor(|executor| {
            let during = executor.in_service();
            executor.die_of(payload, during)
        });
    }

    fn die_of_condition(&self, payload: Box<dyn Any + Send>) {
        self.record_dead_letter(&DeliveryError::PeerDied {
            incarnation: self.cell.record.incarnation(),
        });
        let mut payload = Some(payload);
        self.with_executor(|executor| {
            payload = payload.take().and_then(|payload| executor.die_of(payload, CONDITION.name));
        });
        // After one incarnation and before the next there is none that dies of it.
        if let Some(payload) = payload {
            let panics::PanicRecord { text, at } = panics::read(payload);
            let detail = format!("{} panicked at {at}: {text}", CONDITION.name);
            self.cell.record.declare_for(Some(FAULT_HOLD), FaultKind::CheckFailed, detail);
        }
    }

    fn record_dead_letter(&self, why: &DeliveryError) {
        self.cell.record.record_dead_letter(E::NAME, why);
    }
}
