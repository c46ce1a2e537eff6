//! The listeners of one topic on one arbiter.

use super::{Condition, Subscription, Topic, lock};
use crate::component::Handle;
use crate::host::anchor::Anchor;
use crate::host::pulse::Pulse;
use crate::host::pump::{self, Pump};
use crate::lane::{Lane, Taken, WhenFull};
use crate::letter;
use crate::panics::Guarded;
use crate::platform;
use blastema_core::{Event, Incarnation, Instant, Why};
use std::any::Any;
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::future::poll_fn;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::{Rc, Weak};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::task::Poll;

/// Events that may wait for a hub's turn: a burst of several hundred from a publisher that does not
/// yield, and still under 100 KiB of small events.
const CAPACITY: usize = 1024;
/// Events per poll; then the arbiter's other tasks have their turn.
const BUDGET: usize = 8;
/// A hub's lane has one owner for ever.
const OWNER: Incarnation = Incarnation::FIRST;

/// What publishers know of a hub.
pub(crate) struct HubLane<E> {
    lane: Lane<Posted<E>>,
    id: u64,
    listeners: AtomicU64,
}

#[derive(Clone)]
struct Posted<E> {
    event: E,
    at: Instant,
}

impl<E> HubLane<E> {
    #[inline]
    pub(super) fn has_listeners(&self) -> bool {
        self.listeners.load(Relaxed) > 0
    }

    /// Says whether nothing was lost.
    #[inline]
    pub(super) fn push(&self, event: E, at: Instant) -> bool {
        matches!(self.lane.push_with(event, |event| Posted { event, at }), Ok(None))
    }
}

/// A hub on its own arbiter.
struct Hub<E: Event> {
    shared: Arc<HubLane<E>>,
    locals: RefCell<Vec<Box<dyn Local<E>>>>,
    /// Listeners that came since the last event.
    newcomers: RefCell<Vec<Box<dyn Local<E>>>>,
    pulse: Arc<Pulse>,
}

thread_local! {
    /// The hubs of this arbiter, by topic.
    static HUBS: RefCell<BTreeMap<u64, Rc<dyn Any>>> = const { RefCell::new(BTreeMap::new()) };
}

impl<E: Event> Topic<E> {
    /// The hub of this arbiter.
    fn hub_here(self: &Arc<Self>) -> Rc<Hub<E>> {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        let known = HUBS.with_borrow(|hubs| hubs.get(&self.id).cloned());
        if let Some(hub) = known.and_then(|hub| hub.downcast::<Hub<E>>().ok()) {
            return hub;
        }
        let lane = Lane::new(CAPACITY, WhenFull::DropOldest);
        lane.give_to(Some(OWNER));
        let id = NEXT.fetch_add(1, Relaxed);
        let shared = Arc::new(HubLane { lane, id, listeners: AtomicU64::new(0) });
        let hub = Rc::new(Hub {
            shared: shared.clone(),
            locals: RefCell::default(),
            newcomers: RefCell::default(),
            pulse: Pulse::enrol_here(),
        });
        HUBS.with_borrow_mut(|hubs| hubs.insert(self.id, hub.clone()));
        let mut hubs = lock(&self.hubs);
        *hubs = hubs.iter().cloned().chain([shared]).collect();
        drop(hubs);
        actix_rt::spawn(run(hub.clone(), Leave { topic: self.id }));
        hub
    }
}

impl<E: Event> Drop for Topic<E> {
    fn drop(&mut self) {
        // The hubs' tasks end, each on its own arbiter.
        lock(&self.hubs).iter().for_each(|hub| drop(hub.lane.stop()));
    }
}

/// Takes a hub out of its arbiter's table when its task ends.
struct Leave {
    topic: u64,
}

impl Drop for Leave {
    fn drop(&mut self) {
        let hub = HUBS.try_with(|hubs| hubs.borrow_mut().remove(&self.topic));
        drop(hub);
    }
}

async fn run<E: Event>(hub: Rc<Hub<E>>, _leave: Leave) {
    poll_fn(|cx| {
        for _ in 0..BUDGET {
            match hub.shared.lane.take(OWNER, cx.waker()) {
                Taken::Got(posted) => hub.distribute(&posted),
                Taken::Empty => return Poll::Pending,
                Taken::Retired => return Poll::Ready(()),
            }
        }
        cx.waker().wake_by_ref();
        Poll::Pending
    })
    .await;
}

impl<E: Event> Hub<E> {
    fn distribute(&self, posted: &Posted<E>) {
        let mut locals = self.locals.borrow_mut();
        locals.append(&mut self.newcomers.borrow_mut());
        if E::MAX_AGE.is_some_and(|limit| platform::now() - posted.at > limit) {
            locals.iter().for_each(|local| local.bury(&Why::Expired));
            return;
        }
        // A condition is the listener's code: where one panics, the listener is dead, and the event
        // goes on to the next.
        let (at, gone) = (Cell::new(0), Cell::new(false));
        while at.get() < locals.len() {
            let guarded = Guarded::enter();
            let offered = catch_unwind(AssertUnwindSafe(|| {
                for local in &locals[at.get()..] {
                    gone.set(gone.get() | !local.offer(&posted.event, posted.at, self));
                    at.set(at.get() + 1);
                }
            }));
            drop(guarded);
            if let Err(payload) = offered {
                locals[at.get()].die(payload);
                at.set(at.get() + 1);
            }
        }
        self.pulse.run(None);
        if gone.get() {
            locals.retain(|local| local.is_present());
        }
    }
}

/// One listener, as its hub sees it.
trait Local<E: Event> {
    /// Gives it the event if it wants it. Says whether it still listens here.
    fn offer(&self, event: &E, at: Instant, hub: &Hub<E>) -> bool;
    fn is_present(&self) -> bool;
    fn die(&self, payload: Box<dyn Any + Send>);
    fn bury(&self, why: &Why);
}

struct Ear<C: Handle<E>, E: Event> {
    anchor: Arc<Anchor<C>>,
    only_if: Option<Condition<E>>,
    /// Which ear of the subscription is served now, and which this one is.
    present: Arc<AtomicU64>,
    number: u64,
    pump: RefCell<Weak<RefCell<Pump<C>>>>,
    /// Names the component to the watch while its condition runs.
    slot: Cell<Option<u32>>,
}

impl<C: Handle<E>, E: Event> Ear<C, E> {
    #[inline]
    fn with_pump<R>(&self, then: impl FnOnce(&mut Pump<C>) -> R) -> Option<R> {
        let mut known = self.pump.borrow_mut();
        if known.strong_count() == 0 {
            *known = pump::local(&self.anchor)?; // It was born again.
        }
        let pump = known.upgrade()?;
        drop(known);
        let mut pump = pump.try_borrow_mut().ok()?;
        self.slot.set(Some(pump.slot()));
        Some(then(&mut pump))
    }
}

impl<C: Handle<E>, E: Event> Local<E> for Ear<C, E> {
    #[inline]
    fn offer(&self, event: &E, at: Instant, hub: &Hub<E>) -> bool {
        if !self.is_present() {
            return false;
        }
        hub.pulse.run(self.slot.get());
        if let Some(wanted) = &self.only_if
            && !wanted(event)
        {
            return true;
        }
        let event = event.clone();
        let mut event = Some(event);
        self.with_pump(|pump| {
            if pump.is_free()
                && let Some(event) = event.take()
            {
                letter::pass(pump, event, at);
            }
        });
        if let Some(event) = event {
            self.anchor.queue_event(event, at);
        }
        true
    }

    #[inline]
    fn is_present(&self) -> bool {
        self.present.load(Relaxed) == self.number
    }

    fn die(&self, payload: Box<dyn Any + Send>) {
        self.with_pump(|pump| pump.die_of(payload, "a condition of a subscription"));
    }

    fn bury(&self, why: &Why) {
        self.anchor.record.bury(E::NAME, why);
    }
}

/// A component's subscription to one topic.
pub(crate) struct Listening<E: Event> {
    topic: Arc<Topic<E>>,
    only_if: Option<Condition<E>>,
    /// The number of the ear that is served now; 0 for none.
    present: Arc<AtomicU64>,
    /// The lane of its hub.
    lane: Mutex<Option<Arc<HubLane<E>>>>,
}

impl<E: Event> Listening<E> {
    pub(crate) fn new(topic: Arc<Topic<E>>, only_if: Option<Condition<E>>) -> Self {
        Listening { topic, only_if, present: Arc::default(), lane: Mutex::default() }
    }
}

impl<C: Handle<E>, E: Event> Subscription<C> for Listening<E> {
    fn attach(&self, anchor: &Arc<Anchor<C>>) {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        let hub = self.topic.hub_here();
        let mut lane = lock(&self.lane);
        if lane.as_ref().is_some_and(|lane| lane.id == hub.shared.id) {
            return;
        }
        if let Some(old) = &*lane {
            self.bring_along(anchor, old);
        }
        let number = NEXT.fetch_add(1, Relaxed);
        hub.newcomers.borrow_mut().push(Box::new(Ear {
            anchor: anchor.clone(),
            only_if: self.only_if.clone(),
            present: self.present.clone(),
            number,
            pump: RefCell::default(),
            slot: Cell::new(None),
        }));
        hub.shared.listeners.fetch_add(1, Relaxed);
        self.present.store(number, Relaxed);
        match lane.replace(hub.shared.clone()) {
            None => self.topic.count_listener(true),
            Some(old) => {
                old.listeners.fetch_sub(1, Relaxed);
            }
        }
    }

    fn end(&self) {
        if let Some(lane) = lock(&self.lane).take() {
            self.present.store(0, Relaxed);
            lane.listeners.fetch_sub(1, Relaxed);
            self.topic.count_listener(false);
        }
    }
}

impl<E: Event> Listening<E> {
    /// What still waits at the hub that the listener leaves: its arbiter is lost, or the listener
    /// moves and would miss it.
    fn bring_along<C: Handle<E>>(&self, anchor: &Arc<Anchor<C>>, old: &HubLane<E>) {
        let wanted = |event: &E| self.only_if.as_ref().is_none_or(|wanted| wanted(event));
        for Posted { event, at } in old.lane.snapshot() {
            // A condition that panics now will do so again under the guard.
            if catch_unwind(AssertUnwindSafe(|| wanted(&event))).unwrap_or(true) {
                anchor.queue_event(event, at);
            }
        }
    }
}
