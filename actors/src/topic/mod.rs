//! Typed publish and subscribe.
//!
//! A topic has a name and carries events of one contract. On each arbiter that has listeners a hub
//! takes every event once and hands it to those listeners whose condition holds: an idle listener
//! is called at once, under its own guard and activity record; a busy one gets the event into its
//! queue.
//!
//! ```text
//!  publisher ─┬─► hub of work-0 ─ condition ─┬─► idle listener: called
//!             │                              └─► busy listener: queued
//!             ├─► hub of work-1 ─ …
//!             └─► forward ─► other nodes
//! ```
//!
//! Events of one publisher on one topic arrive in order. Between an event and a direct message of
//! the same sender no order is promised. Publishing never waits: a hub that falls behind drops its
//! oldest events, which are counted among the dead letters under the topic's name.

mod batch_position;
mod entry;
mod erased;
mod hub;
mod hub_queue;
pub(crate) mod ports;
mod publisher;
mod shared_list;
mod subscription;
mod table;
#[cfg(test)]
mod tests;
mod traffic;

pub use publisher::Publisher;
use shared_list::SharedList;
use subscription::TopicSubscription;
pub(crate) use table::Topics;
pub(crate) use table::{ForwardId, described};
pub use traffic::TopicRow;

use crate::component::envelope::{Times, enqueue_time};
use crate::messaging::dead_letters::DeadLetterLog;
use crate::messaging::message_log;
use crate::messaging::queue::Pushed;
use crate::platform::{self, lock, panics};
use crate::runtime::reports::FaultReports;
use blastema_core::contract::codec;
use blastema_core::{
    DeliveryError, Event, GatherBuffer, Instant, NodeName, ObjectName, PreviousVersion,
};
use hub_queue::HubQueue;
use std::pin::Pin;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};
use std::time::Duration;
use tokio::sync::watch;
use traffic::Traffic;

/// Says whether a listener wants an event.
pub(crate) type EventFilter<E> = Arc<dyn Fn(&E) -> bool + Send + Sync>;
/// Takes a topic's events out of the process, to the listeners of another node.
pub(crate) trait EventForward: Send + Sync {
    /// Whether its session has ended: no listener is matched, and each event is counted as lost.
    fn has_ended(&self) -> bool;

    /// Sends an encoded event, with the time by which its age is judged. Does not wait: an event for
    /// which there is no capacity is lost, and counted: false then.
    fn forward(&self, event: &GatherBuffer, sent: Instant) -> bool;

    /// Takes capacity for an event of so many bytes. A publisher that does not wait where there is
    /// none leaves half of it to those that do.
    fn reserve(&self, bytes: usize, waits: bool) -> Reservation;

    /// What a publisher is told for whom there is no capacity.
    fn full(&self) -> DeliveryError;

    /// Completes when there may be capacity. It holds none.
    fn capacity(&self) -> Pin<Box<dyn Future<Output = ()> + Send>>;
}

/// What became of the wish for capacity.
pub(crate) enum Reservation {
    /// One event has it.
    Taken(EventCapacity),
    /// There is none now.
    Full,
    /// There is nothing to wait for.
    Needless,
}

/// Sends one event by the capacity that was reserved for it.
pub(crate) type EventCapacity = Box<dyn FnOnce(&GatherBuffer, Instant) + Send>;
pub(crate) type RemoteForward = Arc<dyn EventForward>;
/// Is called when a topic got its first listener of this node, or lost its last, and when an object
/// of this node names a topic that other nodes listen to. Calls of several threads come in any
/// order, so that they do not say which: that is what [`settle_interest`](Topics::settle_interest)
/// answers.
pub(crate) type InterestObserver = Arc<dyn Fn(&TopicKey) + Send + Sync>;

/// What all topics of a node share.
pub(crate) struct NodeTopics {
    dead_letters: DeadLetterLog,
    reports: FaultReports,
    interest: Mutex<Option<InterestObserver>>,
    /// How often a publisher came or went.
    publishing: AtomicU64,
    /// The node's name, once the node was shut down.
    ended: OnceLock<NodeName>,
}

/// Which topic: its own name, and that of its contract.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct TopicKey {
    /// Lost events concern no listener in particular, so that they are counted under this name.
    pub(crate) topic: ObjectName,
    pub(crate) contract: Arc<str>,
}

impl TopicKey {
    /// # Errors
    /// The name of the topic does not obey the rule for names of objects.
    pub(crate) fn new(topic: &str, contract: &str) -> Result<Self, DeliveryError> {
        let topic = ObjectName::new(topic).map_err(|error| {
            let reason = format!("the name of a topic: {error}");
            DeliveryError::InvalidName { reason }
        })?;
        Ok(TopicKey { topic, contract: contract.into() })
    }
}

/// The last event of a topic that keeps it.
struct Latched<E> {
    event: E,
    at: Times,
    /// It came from another node.
    is_foreign: bool,
}

/// Is told of an event and its times. It must not wait.
pub(crate) type TopicTap<E> = Arc<dyn Fn(&E, Times) + Send + Sync>;

type Latch<E> = Option<Latched<E>>;

/// One topic of this node.
pub(crate) struct Topic<E: Event> {
    key: TopicKey,
    id: u64,
    hubs: Mutex<Hubs<E>>,
    /// The ways of its events to other nodes.
    forwards: SharedList<RemoteForward>,
    listeners: AtomicU64,
    /// Held while an event of a latched topic is handed out, so that a listener that joins gets it
    /// once.
    latch: Mutex<Latch<E>>,
    traffic: Traffic,
    /// As many as conditions over it.
    taps: SharedList<TopicTap<E>>,
    /// Listeners here, and other nodes that have some.
    matched: watch::Sender<usize>,
    node: Arc<NodeTopics>,
    /// It is known that its events panic.
    complained: AtomicBool,
    /// The earlier versions that are understood.
    former: Vec<PreviousVersion<E>>,
}

/// The capacity that waits for one event on the way to other nodes.
#[derive(Default)]
struct ReservedForwards(Vec<(RemoteForward, EventCapacity)>);

impl ReservedForwards {
    /// Takes capacity for an event of so many bytes of each of these.
    ///
    /// # Errors
    /// One that has none.
    fn take_all(
        &mut self,
        forwards: &[RemoteForward],
        bytes: usize,
        waits: bool,
    ) -> Result<(), RemoteForward> {
        for forward in forwards {
            match forward.reserve(bytes, waits) {
                Reservation::Taken(capacity) => self.0.push((forward.clone(), capacity)),
                Reservation::Full => return Err(forward.clone()),
                Reservation::Needless => {}
            }
        }
        Ok(())
    }

    fn take(&mut self, forward: &RemoteForward) -> Option<EventCapacity> {
        let place = self.0.iter().position(|(of, _)| Arc::ptr_eq(of, forward))?;
        Some(self.0.swap_remove(place).1)
    }
}

/// Where a topic's events go.
struct Hubs<E> {
    /// One for each arbiter that has listeners. Copied when it changes.
    list: Arc<[Arc<HubQueue<E>>]>,
    /// The number of the next event. It is taken, and the event handed to the hubs, under one lock:
    /// a listener that moves from one hub to another gets all events before a number from the
    /// first, and all others from the second.
    next: u64,
}

impl<E: Event> Topic<E> {
    /// Why nothing is published on a topic of a node that was shut down.
    fn shut_down(&self) -> Option<DeliveryError> {
        self.node.ended.get().map(|node| DeliveryError::ShutDown { node: node.to_string() })
    }

    /// Waits until there is capacity for this event to each other node that listens.
    async fn reserve(&self, event: &E) -> ReservedForwards {
        let mut reserved = ReservedForwards::default();
        let forwards = self.forwards.all();
        // What cannot be encoded is counted when it is published.
        let Ok(parcel) = codec::encode_parcel(event) else { return reserved };
        // Who waits holds nothing: two that want the same, in whatever order, do not block each other.
        while let Err(full) = reserved.take_all(&forwards, parcel.len(), true) {
            reserved.0.clear();
            full.capacity().await;
        }
        reserved
    }

    /// Takes capacity for this event to each other node that listens.
    ///
    /// # Errors
    /// One of them has none.
    fn reserve_now(&self, event: &E) -> Result<ReservedForwards, DeliveryError> {
        let mut reserved = ReservedForwards::default();
        let forwards = self.forwards.all();
        if forwards.is_empty() {
            return Ok(reserved);
        }
        let Ok(parcel) = codec::encode_parcel(event) else { return Ok(reserved) };
        let taken = reserved.take_all(&forwards, parcel.len(), false);
        taken.map(|()| reserved).map_err(|full| full.full())
    }

    fn publish(
        &self,
        event: E,
        captured_at: Option<Instant>,
        by: &str,
        reserved: ReservedForwards,
    ) {
        let posted_at = enqueue_time::<E>();
        // What is still to come was captured now at the latest.
        let captured_at = captured_at.map(|at| at.min(platform::now()));
        message_log::sent(E::NAME, &self.key.topic, || by.to_owned());
        let times = Times { posted_at, captured_at };
        self.traffic.count();
        if self.traffic.is_to_be_measured() {
            self.measure(&event);
        }
        let is_forwarded = self.forwards.any();
        // A node that begins to listen meanwhile gets this event, and gets it once.
        let latch = self.lock_latch();
        if is_forwarded || latch.is_some() {
            self.forward(&event, captured_at.unwrap_or_else(platform::now), reserved);
        }
        self.hand_out(event, times, false, latch);
    }

    /// While this is held, no listener joins a topic that keeps its last event.
    fn lock_latch(&self) -> Option<MutexGuard<'_, Latch<E>>> {
        E::LATCHED.then(|| lock(&self.latch))
    }

    /// To the listeners of this node, now and later.
    fn hand_out(
        &self,
        event: E,
        times: Times,
        is_foreign: bool,
        latch: Option<MutexGuard<'_, Latch<E>>>,
    ) {
        if self.taps.any() {
            self.taps.all().iter().for_each(|tap| tap(&event, times));
        }
        let Some(mut latch) = latch else {
            return self.fan_out(event, times);
        };
        let mut copies = Vec::new();
        let kept = self.copy(&event, 1, &mut copies).then(|| copies.pop()).flatten();
        let kept = kept.map(|event| Latched { event, at: times, is_foreign });
        let earlier = std::mem::replace(&mut *latch, kept).map(|earlier| earlier.event);
        self.fan_out(event, times);
        drop(latch);
        self.discard(earlier);
    }

    /// Adds copies of an event, or says that it panics. To copy it is the publisher's code.
    fn copy(&self, event: &E, wanted: usize, copies: &mut Vec<E>) -> bool {
        let copy = || copies.extend(std::iter::repeat_n(event, wanted).cloned());
        self.guarded(copy).is_some()
    }

    /// Measures the size of an event, for the topic's row.
    fn measure(&self, event: &E) {
        let mut bytes = Vec::new();
        if codec::encode(event, &mut bytes).is_ok() {
            self.traffic.measured(bytes.len());
        }
    }

    /// To the listeners of this node.
    fn fan_out(&self, event: E, times: Times) {
        let mut copies = Vec::new();
        loop {
            let mut hubs = lock(&self.hubs);
            let Some((last, others)) = hubs.list.split_last() else {
                drop(hubs);
                return self.discard(copies.into_iter().chain([event]));
            };
            if others.len() > copies.len() {
                let wanted = others.len() - copies.len();
                drop(hubs);
                if !self.copy(&event, wanted, &mut copies) {
                    // As where all listeners share a hub, none of them gets it.
                    return self.discard(copies.into_iter().chain([event]));
                }
                continue;
            }
            let mut pushed = Vec::new();
            for (hub, copy) in others.iter().zip(copies.drain(..others.len())) {
                pushed.push(hub.push(copy, times, hubs.next));
            }
            let last = last.push(event, times, hubs.next);
            hubs.next += 1;
            drop(hubs);
            pushed.into_iter().chain([last]).for_each(|pushed| self.pushed(pushed));
            // Copies for hubs that have retired meanwhile.
            return self.discard(copies);
        }
    }

    /// To wake across threads is a system call, and what a hub had no room for is the user's: both
    /// are dealt with outside of the lock.
    #[inline]
    fn pushed(&self, Pushed { displaced, parked }: Pushed<hub_queue::Posted<E>>) {
        if let Some(waker) = parked {
            waker.wake();
        }
        if let Some(displaced) = displaced {
            self.traffic.lose();
            self.record_dead_letter(&DeliveryError::Full);
            self.discard([displaced]);
        }
    }

    /// Drops the publisher's events one by one: a `Drop` that panics affects no listener.
    fn discard<T>(&self, events: impl IntoIterator<Item = T>) {
        if !std::mem::needs_drop::<T>() {
            return;
        }
        for event in events {
            let _ = self.guarded(|| drop(event));
        }
    }

    /// Runs what copies or drops events of this topic: code of the user's.
    fn guarded<T>(&self, run: impl FnOnce() -> T) -> Option<T> {
        panics::caught(run).map_err(|why| self.complain(&why)).ok()
    }

    /// An event of this topic panicked where it was copied or dropped. Said once.
    #[cold]
    fn complain(&self, why: &str) {
        if !self.complained.swap(true, Relaxed) {
            let detail = format!("an event {} panics in its Clone or Drop: it {why}", E::NAME);
            self.node.reports.declare(self.key.topic.as_str(), detail);
        }
    }

    fn forward(&self, event: &E, sent: Instant, mut reserved: ReservedForwards) {
        let forwards = self.forwards.all();
        if forwards.is_empty() {
            return;
        }
        let Ok(parcel) = codec::encode_parcel(event) else {
            return self.record_dead_letter(&DeliveryError::TooLarge { limit: E::MAX_SIZE });
        };
        for forward in forwards.iter() {
            match reserved.take(forward) {
                Some(capacity) => capacity(&parcel, sent),
                None if forward.forward(&parcel, sent) => {}
                None => self.traffic.lose(),
            }
        }
    }

    /// Counts an event that a hub lost.
    fn record_dead_letter(&self, why: &DeliveryError) {
        self.node.dead_letters.record(&self.key.topic, E::NAME, why);
    }

    /// Counts a listener that joins, while the caller holds the latch: see
    /// [`settle_interest`](AnyTopic::settle_interest). Says whether it is the first.
    fn add_listener(&self, _: &Latch<E>) -> bool {
        self.listeners.fetch_add(1, Relaxed) == 0
    }

    /// Counts a listener less. Says whether it was the last.
    fn remove_listener(&self) -> bool {
        self.listeners.fetch_sub(1, Relaxed) == 1
    }

    /// Reports a listener that was counted or is counted no more.
    fn listener_changed(&self, name: &ObjectName, more: bool, first_or_last: bool) {
        self.traffic.listens(name, more);
        self.renew_matched();
        let interest = lock(&self.node.interest).clone();
        if let Some(interest) = interest.filter(|_| first_or_last) {
            interest(&self.key);
        }
    }

    fn renew_matched(&self) {
        self.matched.send_modify(|matched| {
            let here = self.listeners.load(Relaxed);
            let forwards = self.forwards.all();
            let elsewhere = forwards.iter().filter(|forward| !forward.has_ended()).count();
            *matched = usize::try_from(here).unwrap_or(usize::MAX).saturating_add(elsewhere);
        });
    }
}

fn nanos(span: Duration) -> u64 {
    u64::try_from(span.as_nanos()).unwrap_or(u64::MAX)
}
