//! The listeners of one topic on one arbiter.
//!
//! A hub gives each listener a few events in turn. What it gives belongs to the listener: its
//! condition runs under its name, guard and activity record as its handler does, and where either
//! takes long, the hub ends its turn and goes on from there in the next.

use super::batch_position::BatchPosition;
use super::hub_queue::{HubBatch, HubQueue, Posted};
use super::{EventFilter, Hubs, Latch, Latched, Topic, lock};
use crate::arbiter::heartbeat::ArbiterHeartbeat;
use crate::arbiter::turn_budget::TurnBudget;
use crate::liveness::activity::ActivitySlotRef;
use crate::liveness::label::CONDITION;
use crate::messaging::queue::{BoundedQueue, Popped, WhenFull};
use crate::platform;
use crate::platform::panics::{self, PanicGuard};
use blastema_core::sorted::SortedMap;
use blastema_core::{DeliveryError, Event, Incarnation};
use std::any::Any;
use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::future::poll_fn;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, Weak};
use std::task::{self, Poll};

/// Events that may wait for a hub's turn: a burst of several hundred from a publisher that does not
/// yield, and still under 100 KiB of small events.
const CAPACITY: usize = 1024;
/// Events per poll; then the arbiter's other tasks have their turn. Each listener gets all of them
/// in turn, so that what it consists of is fetched from memory once for all.
const BUDGET: usize = 32;
/// A hub's queue has one owner for ever.
const OWNER: Incarnation = Incarnation::FIRST;

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
pub(super) trait EventListener<E: Event> {
    /// Gives it the events that it wants, from the next one on: it serves them, or queues them
    /// where it is busy.
    fn take(&self, hub: &Hub<E>, entry: &ListenerEntry<E>, batch: &Batch<E>) -> HubProgress;
    /// Brings what it consists of nearer to the processor, while the one before it is served.
    fn call_up(&self);
    /// Its handler panicked.
    fn die_in_service(&self, payload: Box<dyn Any + Send>);
    /// Its condition panicked, and the event is lost to it.
    fn die_of_condition(&self, payload: Box<dyn Any + Send>);
    fn record_dead_letter(&self, why: &DeliveryError);
}

/// A hub on its own arbiter.
pub(super) struct Hub<E: Event> {
    pub(super) shared: Arc<HubQueue<E>>,
    /// For what its events do when they are copied and dropped.
    pub(super) topic: Weak<Topic<E>>,
    entries: RefCell<Vec<ListenerEntry<E>>>,
    /// Those that came since the last event.
    pub(super) newcomers: RefCell<Vec<ListenerEntry<E>>>,
    /// How many had gone when they were last taken out.
    gone: Cell<u64>,
    pub(super) heartbeat: Arc<ArbiterHeartbeat>,
    budget: TurnBudget,
    /// What is handed out now, and which entry has its turn.
    batch: RefCell<Option<Batch<E>>>,
    turn_of: Cell<usize>,
    /// Whose code runs.
    pub(super) runs: Cell<Runs>,
}

pub(super) struct Batch<E> {
    events: Arc<Vec<Posted<E>>>,
    only: Option<u64>,
    /// There may be more in the queue.
    full: bool,
}

/// Whose code a hub runs.
#[derive(Clone, Copy)]
pub(super) enum Runs {
    /// The condition of the entry that has its turn, while the component was serving something or
    /// not.
    Condition { beside: bool },
    /// The component's handler of the event.
    Handler,
    /// What the publisher wrote of the event, or the middleware.
    Other,
}

/// How far a hub came in a turn.
#[derive(PartialEq, Eq)]
pub(super) enum HubProgress {
    Done,
    /// Something took long.
    Slow,
    /// The arbiter was given up; the listeners go elsewhere, with their events.
    Lost,
}

thread_local! {
    /// The hubs of this arbiter, by topic.
    static HUBS: RefCell<SortedMap<u64, Rc<dyn Any>>> = const { RefCell::new(SortedMap::new()) };
}

impl<E: Event> Topic<E> {
    /// The hub of this arbiter, known to publishers.
    pub(super) fn hub_here(self: &Arc<Self>, hubs: &mut Hubs<E>) -> Rc<Hub<E>> {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        let known = HUBS.with_borrow(|hubs| hubs.get(&self.id).cloned());
        let known = known.and_then(|hub| hub.downcast::<Hub<E>>().ok());
        if let Some(hub) = known.filter(|hub| !hub.shared.retired.load(Relaxed)) {
            return hub;
        }
        let queue = BoundedQueue::new(CAPACITY, WhenFull::DropOldest);
        queue.begin(OWNER);
        let serving = HubBatch {
            events: Arc::default(),
            only: None,
            left: Vec::new(),
            brought: VecDeque::new(),
        };
        let shared = Arc::new(HubQueue {
            queue,
            id: NEXT.fetch_add(1, Relaxed),
            listeners: AtomicU64::new(0),
            retired: AtomicBool::new(false),
            serving: Mutex::new(serving),
            position: BatchPosition::default(),
            gone: AtomicU64::new(0),
        });
        let hub = Rc::new(Hub {
            shared: shared.clone(),
            topic: Arc::downgrade(self),
            entries: RefCell::default(),
            newcomers: RefCell::default(),
            gone: Cell::new(0),
            heartbeat: ArbiterHeartbeat::register_here(),
            budget: TurnBudget::default(),
            batch: RefCell::new(None),
            turn_of: Cell::new(0),
            runs: Cell::new(Runs::Other),
        });
        HUBS.with_borrow_mut(|hubs| hubs.insert(self.id, hub.clone()));
        hubs.list = hubs.list.iter().cloned().chain([shared]).collect();
        actix_rt::spawn(run(hub.clone(), Leave { topic: self.id, hub: hub.clone() }));
        hub
    }

    /// One of the hub's entries is not served any more. A hub without any is released.
    pub(super) fn leave(&self, hub: &Arc<HubQueue<E>>) {
        let mut hubs = lock(&self.hubs);
        hub.gone.fetch_add(1, Relaxed);
        if hub.listeners.fetch_sub(1, Relaxed) > 1 {
            return;
        }
        hub.retired.store(true, Relaxed);
        hubs.list = hubs.list.iter().filter(|known| known.id != hub.id).cloned().collect();
        drop(hubs);
        self.discard(hub.queue.stop());
        let mut serving = lock(&hub.serving);
        let (events, brought) =
            (std::mem::take(&mut serving.events), std::mem::take(&mut serving.brought));
        drop(serving);
        self.discard(Arc::into_inner(events).unwrap_or_default());
        self.discard(brought.into_iter().flat_map(|(_, events)| events));
    }
}

impl<E: Event> Topic<E> {
    /// What the topic keeps, for a listener that joins.
    pub(super) fn kept(&self, latch: &Latch<E>) -> Vec<Posted<E>> {
        let posted = |kept: &Latched<E>| Posted {
            event: kept.event.clone(),
            at: kept.at,
            number: 0, // It is for one entry, which is asked no number.
        };
        self.guarded(|| latch.iter().map(posted).collect()).unwrap_or_default()
    }
}

impl<E: Event> Drop for Topic<E> {
    fn drop(&mut self) {
        // The hubs' tasks end, each on its own arbiter.
        let hubs = lock(&self.hubs).list.clone();
        hubs.iter().for_each(|hub| self.discard(hub.queue.stop()));
    }
}

/// Takes a hub out of its arbiter's table when its task ends.
struct Leave {
    topic: u64,
    hub: Rc<dyn Any>,
}

impl Drop for Leave {
    fn drop(&mut self) {
        let hub = HUBS.try_with(|hubs| {
            let mut hubs = hubs.borrow_mut();
            // Another may have taken its place.
            let mine = hubs.get(&self.topic).is_some_and(|hub| Rc::ptr_eq(hub, &self.hub));
            mine.then(|| hubs.remove(&self.topic))
        });
        drop(hub);
    }
}

async fn run<E: Event>(hub: Rc<Hub<E>>, _leave: Leave) {
    poll_fn(|cx| {
        if hub.budget.is_resting() {
            return Poll::Pending;
        }
        hub.budget.begin();
        let polled = hub.turn(cx);
        hub.heartbeat.run(None);
        hub.budget.end(cx.waker());
        polled
    })
    .await;
}

impl<E: Event> Hub<E> {
    fn turn(&self, cx: &task::Context<'_>) -> Poll<()> {
        let resumed = self.batch.borrow().is_some();
        if !resumed {
            match self.next_batch(cx) {
                Popped::Got(batch) => drop(self.batch.replace(Some(batch))),
                Popped::Empty => return Poll::Pending,
                Popped::Retired => return Poll::Ready(()),
            }
        }
        match self.distribute() {
            HubProgress::Done => {}
            HubProgress::Slow => return Poll::Pending,
            HubProgress::Lost => return Poll::Ready(()),
        }
        // What came while it rested has used up the waker that the queue keeps.
        let more = self.finish() || resumed;
        if more && !self.budget.is_spent() {
            self.budget.pause(cx.waker());
        }
        Poll::Pending
    }

    /// What an entry brought along, or some events from the queue.
    fn next_batch(&self, cx: &task::Context<'_>) -> Popped<Batch<E>> {
        let mut entries = self.entries.borrow_mut();
        entries.append(&mut self.newcomers.borrow_mut());
        let HubQueue { queue, serving, position, .. } = &*self.shared;
        let mut serving = lock(serving);
        let (mut events, mut only, mut full) = (Vec::new(), None, true);
        if let Some((entry, brought)) = serving.brought.pop_front() {
            (events, only) = (brought, Some(entry));
        }
        while only.is_none() && events.len() < BUDGET {
            match queue.take(OWNER, cx.waker()) {
                Popped::Got(posted) => events.push(posted),
                Popped::Empty if events.is_empty() => return Popped::Empty,
                Popped::Empty => {
                    full = false;
                    break;
                }
                Popped::Retired if events.is_empty() => return Popped::Retired,
                // The events go to no entry, and are dropped under the guard.
                Popped::Retired => break,
            }
        }
        let mut stale = Vec::new();
        if let Some(limit) = E::MAX_AGE {
            let now = platform::now();
            stale.extend(events.extract_if(.., |posted| now - posted.at.captured_at() > limit));
        }
        let events = Arc::new(events);
        position.begin(0);
        (serving.events, serving.only) = (events.clone(), only);
        serving.left.clear();
        drop(serving);
        for _ in &stale {
            let concerned =
                entries.iter().filter(|entry| only.is_none_or(|only| only == entry.number));
            concerned.for_each(|entry| entry.listener.record_dead_letter(&DeliveryError::Expired));
        }
        self.discard(stale);
        self.turn_of.set(0);
        Popped::Got(Batch { events, only, full })
    }

    /// Gives every entry the events that it wants, until something takes long.
    fn distribute(&self) -> HubProgress {
        let (entries, batch) = (self.entries.borrow(), self.batch.borrow());
        let Some(batch) = &*batch else { return HubProgress::Done };
        loop {
            let guarded = PanicGuard::enter();
            let offered = catch_unwind(AssertUnwindSafe(|| self.offer_to_all(&entries, batch)));
            drop(guarded);
            match offered {
                Ok(progress) => return progress,
                Err(payload) => self.blame(&entries[self.turn_of.get()], payload),
            }
            let progress = self.progress();
            if progress != HubProgress::Done {
                return progress;
            }
        }
    }

    fn offer_to_all(&self, entries: &[ListenerEntry<E>], batch: &Batch<E>) -> HubProgress {
        while let Some(entry) = entries.get(self.turn_of.get()) {
            if let Some(after) = entries.get(self.turn_of.get() + 1)
                && after.only_if.is_none()
            {
                after.listener.call_up();
            }
            let progress = self.offer(entry, batch);
            if progress != HubProgress::Done {
                return progress;
            }
            self.turn_of.set(self.turn_of.get() + 1);
        }
        HubProgress::Done
    }

    /// Gives an entry the events that it wants, from the next one on.
    #[inline]
    fn offer(&self, entry: &ListenerEntry<E>, batch: &Batch<E>) -> HubProgress {
        let HubQueue { position, gone, .. } = &*self.shared;
        if gone.load(Relaxed) != self.gone.get() && !entry.is_present() {
            return HubProgress::Done;
        }
        if batch.only.is_some_and(|only| only != entry.number) {
            return HubProgress::Done;
        }
        if position.read().entry != entry.number {
            position.begin(entry.number);
        }
        entry.listener.take(self, entry, batch)
    }

    /// The next event for the entry that has its turn.
    #[inline]
    pub(super) fn next<'a>(&self, batch: &'a Batch<E>) -> Option<&'a Posted<E>> {
        let position = &self.shared.position;
        let posted = batch.events.get(position.read().begun)?;
        position.step();
        Some(posted)
    }

    /// Whether the event that was begun last is for this entry still.
    pub(super) fn still_gets(&self, entry: &ListenerEntry<E>) -> bool {
        self.shared.still_gets(entry.number, || entry.is_present())
    }

    /// Whether the entry gets this event here.
    #[inline]
    pub(super) fn is_for(
        &self,
        entry: &ListenerEntry<E>,
        batch: &Batch<E>,
        posted: &Posted<E>,
    ) -> bool {
        // It gets the earlier ones from the hub that it left.
        (posted.number >= entry.since || batch.only.is_some())
            && entry.only_if.as_ref().is_none_or(|wanted| self.is_wanted(entry, wanted, posted))
    }

    /// Whether the entry that has its turn may go on.
    #[inline]
    pub(super) fn progress(&self) -> HubProgress {
        if self.heartbeat.is_fenced() {
            // The handler that kept the thread has returned.
            self.heartbeat.lift();
            if self.heartbeat.is_lost() {
                return HubProgress::Lost;
            }
        }
        if self.budget.lasts() { HubProgress::Done } else { HubProgress::Slow }
    }

    /// Asks the listener's condition, which is the component's code as its handlers are.
    fn is_wanted(
        &self,
        entry: &ListenerEntry<E>,
        wanted: &EventFilter<E>,
        posted: &Posted<E>,
    ) -> bool {
        let activity = entry.activity_slot.get().map(|activity_slot| activity_slot.activity);
        let beside = activity.is_some_and(|activity| activity.is_busy());
        match activity {
            Some(activity) if beside => activity.run_condition(true),
            Some(activity) => activity.begin(CONDITION.number()),
            None => {}
        }
        self.runs.set(Runs::Condition { beside });
        self.shared.position.set_undecided(true);
        let wants = wanted(&posted.event);
        self.condition_ends(entry, beside);
        wants
    }

    fn condition_ends(&self, entry: &ListenerEntry<E>, beside: bool) {
        self.shared.position.set_undecided(false);
        self.runs.set(Runs::Other);
        match entry.activity_slot.get().map(|activity_slot| activity_slot.activity) {
            Some(activity) if beside => activity.run_condition(false),
            Some(activity) => activity.step(),
            None => {}
        }
    }

    /// Something panicked. Where a condition or a handler does, the listener is dead, and the event
    /// goes on to the next.
    #[cold]
    fn blame(&self, entry: &ListenerEntry<E>, payload: Box<dyn Any + Send>) {
        match self.runs.replace(Runs::Other) {
            Runs::Condition { beside } => {
                self.condition_ends(entry, beside);
                entry.listener.die_of_condition(payload);
            }
            Runs::Handler => entry.listener.die_in_service(payload),
            Runs::Other => {
                if let Some(topic) = self.topic.upgrade() {
                    topic.complain(&panics::shown(payload));
                }
            }
        }
    }

    /// All have got what is handed out. Says whether there may be more.
    fn finish(&self) -> bool {
        let Some(batch) = self.batch.take() else { return false };
        let mut serving = lock(&self.shared.serving);
        (serving.events, serving.only) = (Arc::default(), None);
        drop(serving);
        let gone = self.shared.gone.load(Relaxed);
        if self.gone.replace(gone) != gone {
            self.entries.borrow_mut().retain(ListenerEntry::is_present);
        }
        self.discard(Arc::into_inner(batch.events).unwrap_or_default());
        batch.full
    }

    /// Drops what is the publisher's.
    fn discard(&self, events: Vec<Posted<E>>) {
        if let Some(topic) = self.topic.upgrade() {
            topic.discard(events);
        }
    }
}
