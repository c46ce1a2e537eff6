//! The listeners of one topic on one arbiter.

use super::{Condition, Subscription, Topic, lock};
use crate::component::{Component, Handle};
use crate::host::anchor::Anchor;
use crate::host::pulse::Pulse;
use crate::host::pump::{self, Pump};
use crate::lane::{Lane, Taken, WhenFull};
use crate::letter::{self, Times};
use crate::panics::Guarded;
use crate::platform;
use blastema_core::{Event, Incarnation, Why};
use std::any::Any;
use std::cell::{Cell, RefCell};
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::future::poll_fn;
use std::hint::black_box;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::{Rc, Weak};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::task::Poll;

/// Events that may wait for a hub's turn: a burst of several hundred from a publisher that does not
/// yield, and still under 100 KiB of small events.
const CAPACITY: usize = 1024;
/// Events per poll; then the arbiter's other tasks have their turn. Each listener gets all of them in
/// turn, so that what it consists of is fetched from memory once for all.
const BUDGET: usize = 8;
/// A hub's lane has one owner for ever.
const OWNER: Incarnation = Incarnation::FIRST;

/// What publishers know of a hub.
pub(crate) struct HubLane<E> {
    lane: Lane<Posted<E>>,
    id: u64,
    listeners: AtomicU64,
    /// The events that are being handed out, for listeners that leave a hub that is stuck.
    serving: Mutex<Arc<[Posted<E>]>>,
    /// The number of the last ear that was offered them; ears have their turn by rising numbers.
    reached: AtomicU64,
    /// Which event that ear is looking at, or serves.
    next: AtomicUsize,
    /// The number of the last event of a latched topic that was put there.
    pub(super) newest: AtomicU64,
    /// How often an ear has gone from here, so that the hub need not ask each whether it is still here.
    gone: AtomicU64,
}

#[derive(Clone)]
struct Posted<E> {
    event: E,
    at: Times,
}

impl<E> HubLane<E> {
    #[inline]
    pub(super) fn has_listeners(&self) -> bool {
        self.listeners.load(Relaxed) > 0
    }

    /// One of its ears is not served any more.
    fn leave(&self) {
        self.listeners.fetch_sub(1, Relaxed);
        self.gone.fetch_add(1, Relaxed);
    }

    /// Says whether nothing was lost.
    #[inline]
    pub(super) fn push(&self, event: E, at: Times) -> bool {
        matches!(self.lane.push_with(event, |event| Posted { event, at }), Ok(None))
    }
}

/// A hub on its own arbiter.
struct Hub<E: Event> {
    shared: Arc<HubLane<E>>,
    ears: RefCell<Vec<Ear<E>>>,
    /// Those that came since the last event.
    newcomers: RefCell<Vec<Ear<E>>>,
    /// How many had gone when they were last taken out.
    gone: Cell<u64>,
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
        let shared = Arc::new(HubLane {
            lane,
            id,
            listeners: AtomicU64::new(0),
            serving: Mutex::default(),
            reached: AtomicU64::new(0),
            next: AtomicUsize::new(0),
            newest: AtomicU64::new(0),
            gone: AtomicU64::new(0),
        });
        let hub = Rc::new(Hub {
            shared: shared.clone(),
            ears: RefCell::default(),
            newcomers: RefCell::default(),
            gone: Cell::new(0),
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
        let mut events = Vec::new();
        while events.len() < BUDGET {
            match hub.shared.lane.take(OWNER, cx.waker()) {
                Taken::Got(posted) => events.push(posted),
                Taken::Empty => break,
                Taken::Retired => return Poll::Ready(()),
            }
        }
        if events.is_empty() {
            return Poll::Pending;
        }
        if events.len() == BUDGET {
            cx.waker().wake_by_ref();
        }
        hub.distribute(events);
        Poll::Pending
    })
    .await;
}

impl<E: Event> Hub<E> {
    fn distribute(&self, mut events: Vec<Posted<E>>) {
        let mut ears = self.ears.borrow_mut();
        ears.append(&mut self.newcomers.borrow_mut());
        if let Some(limit) = E::MAX_AGE {
            let now = platform::now();
            events.retain(|posted| {
                let valid = now - posted.at.captured_at() <= limit;
                if !valid {
                    ears.iter().for_each(|ear| ear.listener.bury(&Why::Expired));
                }
                valid
            });
        }
        let events: Arc<[Posted<E>]> = events.into();
        let HubLane { next, reached, serving, gone, .. } = &*self.shared;
        reached.store(0, Relaxed);
        next.store(0, Relaxed);
        lock(serving).clone_from(&events);
        // A condition is the listener's code: where one panics, the listener is dead, and the event
        // goes on to the next.
        let at = Cell::new(0);
        while at.get() < ears.len() {
            let guarded = Guarded::enter();
            let offered = catch_unwind(AssertUnwindSafe(|| {
                for (ear, after) in
                    (at.get()..).map_while(|at| Some((ears.get(at)?, ears.get(at + 1))))
                {
                    if let Some(after) = after.filter(|after| after.only_if.is_none()) {
                        after.listener.call_up();
                    }
                    self.offer(ear, &events);
                    next.store(0, Relaxed);
                    at.set(at.get() + 1);
                }
            }));
            drop(guarded);
            if let Err(payload) = offered {
                ears[at.get()].listener.die(payload);
                step(next);
            }
        }
        *lock(serving) = Arc::default();
        self.pulse.run(None);
        let gone = gone.load(Relaxed);
        if self.gone.replace(gone) != gone {
            ears.retain(Ear::is_present);
        }
    }

    /// Gives an ear the events that it wants, from the next one on.
    #[inline]
    fn offer(&self, ear: &Ear<E>, events: &[Posted<E>]) {
        let HubLane { next, reached, gone, .. } = &*self.shared;
        if gone.load(Relaxed) != self.gone.get() && !ear.is_present() {
            return;
        }
        reached.store(ear.number, Relaxed);
        self.pulse.run(ear.slot.get());
        while let Some(posted) = events.get(next.load(Relaxed)) {
            if ear.only_if.as_ref().is_none_or(|wanted| wanted(&posted.event)) {
                ear.slot.set(ear.listener.take(posted, &self.pulse));
            }
            step(next);
        }
    }
}

/// One writer only, so a plain store does.
#[inline]
fn step(next: &AtomicUsize) {
    next.store(next.load(Relaxed) + 1, Relaxed);
}

/// One listener, as its hub sees it: what is looked at for every event, side by side with the others.
struct Ear<E> {
    only_if: Option<Condition<E>>,
    /// Which ear of the subscription is served now, and which this one is.
    present: Arc<AtomicU64>,
    number: u64,
    /// Names the component to the watch while its condition runs.
    slot: Cell<Option<u32>>,
    listener: Box<dyn Listener<E>>,
}

impl<E> Ear<E> {
    fn is_present(&self) -> bool {
        self.present.load(Relaxed) == self.number
    }
}

/// The component behind an ear.
trait Listener<E> {
    /// Serves the event, or queues it where the component is busy. Answers the component's slot.
    fn take(&self, posted: &Posted<E>, pulse: &Pulse) -> Option<u32>;
    /// Brings what it consists of nearer to the processor, while the one before it is served.
    fn call_up(&self);
    fn die(&self, payload: Box<dyn Any + Send>);
    fn bury(&self, why: &Why);
}

struct Resident<C: Component> {
    anchor: Arc<Anchor<C>>,
    pump: RefCell<Weak<RefCell<Pump<C>>>>,
}

impl<C: Component> Resident<C> {
    #[inline]
    fn with_pump<R>(&self, then: impl FnOnce(&mut Pump<C>) -> R) -> Option<R> {
        let mut known = self.pump.borrow_mut();
        if known.strong_count() == 0 {
            *known = pump::local(&self.anchor)?; // It was born again.
        }
        let pump = known.upgrade()?;
        drop(known);
        let mut pump = pump.try_borrow_mut().ok()?;
        Some(then(&mut pump))
    }
}

impl<C: Handle<E>, E: Event> Listener<E> for Resident<C> {
    #[inline]
    fn take(&self, posted: &Posted<E>, pulse: &Pulse) -> Option<u32> {
        let mut event = Some(posted.event.clone());
        let slot = self.with_pump(|pump| {
            pulse.run(Some(pump.slot()));
            if pump.is_free()
                && let Some(event) = event.take()
            {
                letter::pass(pump, event, posted.at);
            }
            pump.slot()
        });
        if let Some(event) = event {
            self.anchor.queue_event(event, posted.at);
        }
        slot
    }

    #[inline]
    fn call_up(&self) {
        black_box(self.pump.borrow().strong_count());
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
        // No event passes between what it finds and what it is given.
        let latch = lock(&self.topic.latch);
        let mut lane = lock(&self.lane);
        if lane.as_ref().is_some_and(|lane| lane.id == hub.shared.id) {
            return;
        }
        if let Some(old) = &*lane {
            self.bring_along(anchor, old, self.present.load(Relaxed));
        }
        let number = NEXT.fetch_add(1, Relaxed);
        hub.newcomers.borrow_mut().push(Ear {
            only_if: self.only_if.clone(),
            present: self.present.clone(),
            number,
            slot: Cell::new(None),
            listener: Box::new(Resident { anchor: anchor.clone(), pump: RefCell::default() }),
        });
        let kept = latch.last.as_ref().filter(|_| lane.is_none());
        let mut given = None;
        if let Some(kept) = kept {
            if !hub.shared.has_listeners() && hub.shared.newest.load(Relaxed) != kept.number {
                // After what still waits there from the time of an earlier listener.
                hub.shared.push(kept.event.clone(), kept.at);
            } else if hub.shared.lane.depth() == 0 {
                given = Some((kept.event.clone(), kept.at));
            }
        }
        hub.shared.listeners.fetch_add(1, Relaxed);
        self.present.store(number, Relaxed);
        match lane.replace(hub.shared.clone()) {
            None => self.topic.count_listener(&anchor.record.name, true),
            Some(old) => {
                old.leave();
            }
        }
        drop(latch);
        // The hub's turn comes after this, on this thread.
        if let Some((event, at)) = given {
            self.give(anchor, event, at);
        }
    }

    fn catch_up(&self, anchor: &Arc<Anchor<C>>) {
        let kept = lock(&self.topic.latch).last.as_ref().map(|kept| (kept.event.clone(), kept.at));
        if let Some((event, at)) = kept {
            self.give(anchor, event, at);
        }
    }

    fn end(&self, anchor: &Anchor<C>) {
        if let Some(lane) = lock(&self.lane).take() {
            self.present.store(0, Relaxed);
            lane.leave();
            self.topic.count_listener(&anchor.record.name, false);
        }
    }
}

impl<E: Event> Listening<E> {
    /// The last event of a latched topic, if it is wanted.
    fn give<C: Handle<E>>(&self, anchor: &Arc<Anchor<C>>, event: E, at: Times) {
        let wanted = || self.only_if.as_ref().is_none_or(|wanted| wanted(&event));
        let guarded = Guarded::enter();
        // A condition that panics does not want it: it is called again, under the guard, for the next.
        let wanted = catch_unwind(AssertUnwindSafe(wanted)).unwrap_or(false);
        drop(guarded);
        if wanted {
            anchor.queue_event(event, at);
        }
    }

    /// What still waits at the hub that the listener leaves: its arbiter is lost, or the listener
    /// moves and would miss it. `ear` is its number there.
    fn bring_along<C: Handle<E>>(&self, anchor: &Arc<Anchor<C>>, old: &HubLane<E>, ear: u64) {
        let wanted = |event: &E| self.only_if.as_ref().is_none_or(|wanted| wanted(event));
        let serving = lock(&old.serving).clone();
        let past = match ear.cmp(&old.reached.load(Relaxed)) {
            Ordering::Less => serving.len(),
            // What it served when it was given up is not served again.
            Ordering::Equal => old.next.load(Relaxed) + 1,
            Ordering::Greater => 0,
        };
        let serving = serving.iter().skip(past).cloned();
        for Posted { event, at } in serving.chain(old.lane.snapshot()) {
            // A condition that panics now will do so again under the guard.
            if catch_unwind(AssertUnwindSafe(|| wanted(&event))).unwrap_or(true) {
                anchor.queue_event(event, at);
            }
        }
    }
}
