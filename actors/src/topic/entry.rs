//! One listener of a hub, and the component behind it.

use super::EventFilter;
use crate::arbiter::heartbeat::ArbiterHeartbeat;
use crate::component::cell::ComponentCell;
use crate::component::envelope::Times;
use crate::component::{Component, Handle, envelope};
use crate::host::executor;
use crate::host::executor::ComponentExecutor;
use crate::liveness::activity::ActivitySlotRef;
use crate::liveness::label::CONDITION;
use crate::platform::panics;
use blastema_core::{DeliveryError, Event, FaultKind};
use std::any::Any;
use std::cell::{Cell, RefCell};
use std::hint::black_box;
use std::rc::Weak;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;

/// One listener, as its hub sees it: what is looked at for every event, side by side with the
/// others.
pub(super) struct ListenerEntry<E> {
    pub(super) only_if: Option<EventFilter<E>>,
    /// Which entry of the subscription is served now, and which this one is.
    pub(super) present: Arc<AtomicU64>,
    pub(super) number: u64,
    /// The number of the first event that it gets here.
    pub(super) since: u64,
    /// Names the component to the watch while its condition and its handler run.
    pub(super) activity_slot: Cell<Option<ActivitySlotRef>>,
    pub(super) listener: Box<dyn EventListener<E>>,
}

impl<E> ListenerEntry<E> {
    pub(super) fn is_present(&self) -> bool {
        self.present.load(Relaxed) == self.number
    }
}

/// The component behind an entry.
pub(super) trait EventListener<E> {
    /// Serves the event, or queues it where the component is busy. Answers where the component is.
    fn take(
        &self,
        event: E,
        at: Times,
        heartbeat: &ArbiterHeartbeat,
        entry: &ListenerEntry<E>,
    ) -> Option<ActivitySlotRef>;
    /// Where the component is.
    fn activity_slot(&self) -> Option<ActivitySlotRef>;
    /// Brings what it consists of nearer to the processor, while the one before it is served.
    fn call_up(&self);
    /// It took long over an event.
    fn overdraw(&self);
    /// Its condition panicked, and the event is lost to it.
    fn die(&self, payload: Box<dyn Any + Send>);
    fn record_dead_letter(&self, why: &DeliveryError);
}

pub(super) struct Resident<C: Component> {
    pub(super) cell: Arc<ComponentCell<C>>,
    pub(super) executor: RefCell<Weak<RefCell<ComponentExecutor<C>>>>,
}

impl<C: Component> Resident<C> {
    #[inline]
    fn with_executor<R>(&self, then: impl FnOnce(&mut ComponentExecutor<C>) -> R) -> Option<R> {
        let mut known = self.executor.borrow_mut();
        if known.strong_count() == 0 {
            *known = executor::executor_here(&self.cell)?; // It was born again.
        }
        let executor = known.upgrade()?;
        drop(known);
        let mut executor = executor.try_borrow_mut().ok()?;
        Some(then(&mut executor))
    }
}

impl<C: Handle<E>, E: Event> EventListener<E> for Resident<C> {
    #[inline]
    fn take(
        &self,
        event: E,
        at: Times,
        heartbeat: &ArbiterHeartbeat,
        entry: &ListenerEntry<E>,
    ) -> Option<ActivitySlotRef> {
        let mut event = Some(event);
        let activity_slot = self.with_executor(|executor| {
            let activity_slot = executor.activity_slot();
            heartbeat.run(Some(activity_slot.index));
            if executor.is_free()
                && let Some(event) = event.take()
            {
                executor.serve_at_once(&mut envelope::seal_event(event, at));
            }
            activity_slot
        });
        // One that has gone meanwhile has brought along what is not served here.
        if let Some(event) = event.filter(|_| entry.is_present()) {
            self.cell.queue_event(event, at);
        }
        activity_slot
    }

    fn activity_slot(&self) -> Option<ActivitySlotRef> {
        self.with_executor(|executor| executor.activity_slot())
    }

    #[inline]
    fn call_up(&self) {
        black_box(self.executor.borrow().strong_count());
    }

    fn overdraw(&self) {
        self.with_executor(|executor| executor.overdraw());
    }

    fn die(&self, payload: Box<dyn Any + Send>) {
        self.record_dead_letter(&DeliveryError::PeerDied {
            incarnation: self.cell.record.incarnation(),
        });
        let mut payload = Some(payload);
        self.with_executor(|executor| {
            payload = payload.take().and_then(|payload| executor.die_of(payload, CONDITION));
        });
        // After one incarnation and before the next there is none that dies of it.
        if let Some(payload) = payload {
            let panics::PanicRecord { text, at } = panics::read(payload);
            let detail = format!("{CONDITION} panicked at {at}: {text}");
            self.cell.record.declare(FaultKind::CheckFailed, detail);
        }
    }

    fn record_dead_letter(&self, why: &DeliveryError) {
        self.cell.record.record_dead_letter(E::NAME, why);
    }
}
