//! Typed publish and subscribe.
//!
//! A topic has a name and carries events of one contract. On each arbiter that has listeners a hub
//! takes every event once and hands it to those listeners whose condition holds: an idle listener is
//! called at once, under its own guard and stamp; a busy one gets the event into its queue.
//!
//! ```text
//!  publisher ─┬─► hub of work-0 ─ condition ─┬─► idle listener: called
//!             │                              └─► busy listener: queued
//!             ├─► hub of work-1 ─ …
//!             └─► forward ─► other nodes
//! ```
//!
//! Events of one publisher on one topic arrive in order. Between an event and a direct message of the
//! same sender no order is promised. Publishing never waits: a hub that falls behind drops its oldest
//! events, which are counted among the dead letters under the topic's name.

mod hub;

pub(crate) use hub::Listening;

use crate::component::Component;
use crate::host::anchor::Anchor;
use crate::host::office::DeadLetterOffice;
use crate::host::pulse;
use crate::letter::{arrived_posting_time, posting_time};
use crate::registry::difference;
use crate::sender::SendError;
use blastema_core::{ContractIdentity, Event, Former, ObjectName, Parcel, Why, codec};
use bytes::Bytes;
use hub::HubLane;
use std::any::{Any, type_name};
use std::collections::BTreeMap;
use std::fmt;
use std::panic::Location;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Says whether a listener wants an event.
pub(crate) type Condition<E> = Arc<dyn Fn(&E) -> bool + Send + Sync>;
/// Ships an encoded event out of the process. Must not wait.
pub(crate) type Forward = Arc<dyn Fn(&Parcel) + Send + Sync>;
/// Hears which topics this node listens to.
pub(crate) type Interest = Arc<dyn Fn(&TopicKey, bool) + Send + Sync>;

/// A component's subscription to one topic, for all its lives.
pub(crate) trait Subscription<C: Component>: Send + Sync {
    /// From now on events are delivered by the hub of the present arbiter.
    fn attach(&self, anchor: &Arc<Anchor<C>>);
    /// From now on none are.
    fn end(&self);
}

/// A component's subscriptions.
pub(crate) type Subscriptions<C> = Arc<[Arc<dyn Subscription<C>>]>;

/// Which topic: its own name, and that of its contract.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct TopicKey {
    pub(crate) topic: Arc<str>,
    pub(crate) contract: Arc<str>,
}

impl TopicKey {
    pub(crate) fn new(topic: &str, contract: &str) -> Self {
        TopicKey { topic: topic.into(), contract: contract.into() }
    }

    /// What is lost of it concerns no listener in particular, so that it is counted under its own name.
    pub(crate) fn lost_to(&self) -> Option<ObjectName> {
        ObjectName::new(&self.topic).or_else(|_| ObjectName::new("topic")).ok()
    }
}

/// One topic of this node.
pub(crate) struct Topic<E: Event> {
    key: TopicKey,
    id: u64,
    /// One for each arbiter that has, or had, listeners. Copied when it changes, so that publishing
    /// holds no lock.
    hubs: Mutex<Arc<[Arc<HubLane<E>>]>>,
    forwards: Mutex<Arc<[Forward]>>,
    is_forwarded: AtomicBool,
    listeners: AtomicU64,
    dead_letters: DeadLetterOffice,
    interest: Arc<Mutex<Option<Interest>>>,
    /// The earlier versions that are understood.
    former: Vec<Former<E>>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<E: Event> Topic<E> {
    fn publish(&self, event: E) {
        let posted_at = posting_time::<E>();
        if self.is_forwarded.load(Relaxed) {
            self.forward(&event);
        }
        self.spread(event, posted_at);
    }

    /// To the listeners of this node.
    fn spread(&self, event: E, posted_at: blastema_core::Instant) {
        let hubs = lock(&self.hubs).clone();
        let mut wanted = hubs.iter().filter(|hub| hub.has_listeners());
        let Some(mut hub) = wanted.next() else { return };
        for next in wanted {
            self.hand_to(hub, event.clone(), posted_at);
            hub = next;
        }
        self.hand_to(hub, event, posted_at);
    }

    #[inline]
    fn hand_to(&self, hub: &HubLane<E>, event: E, posted_at: blastema_core::Instant) {
        if !hub.push(event, posted_at) {
            self.bury(&Why::Full);
        }
    }

    fn forward(&self, event: &E) {
        let forwards = lock(&self.forwards).clone();
        match codec::encode_parcel(event) {
            Ok(parcel) => forwards.iter().for_each(|forward| forward(&parcel)),
            Err(_) => self.bury(&Why::TooLarge { limit: E::MAX_SIZE }),
        }
    }

    /// Counts an event that a hub lost.
    fn bury(&self, why: &Why) {
        if let Some(name) = self.key.lost_to() {
            self.dead_letters.take(&name, E::NAME, why);
        }
    }

    /// One listener more or less.
    fn count_listener(&self, more: bool) {
        let first_or_last = if more {
            self.listeners.fetch_add(1, Relaxed) == 0
        } else {
            self.listeners.fetch_sub(1, Relaxed) == 1
        };
        let interest = lock(&self.interest).clone();
        if let Some(interest) = interest.filter(|_| first_or_last) {
            interest(&self.key, more);
        }
    }
}

/// A topic whose type is not known.
trait AnyTopic: Send + Sync {
    fn identity(&self) -> ContractIdentity;
    /// The present version and the earlier ones that listeners here understand.
    fn identities(&self) -> Vec<ContractIdentity>;
    fn forward_to(&self, forwards: Arc<[Forward]>);
    fn inject(&self, form: usize, event: &Bytes, age: Duration) -> Result<(), Why>;
    fn has_listeners(&self) -> bool;
}

impl<E: Event> AnyTopic for Topic<E> {
    fn identity(&self) -> ContractIdentity {
        ContractIdentity::of::<E>()
    }

    fn identities(&self) -> Vec<ContractIdentity> {
        let former = self.former.iter().map(|former| former.identity().clone());
        std::iter::once(self.identity()).chain(former).collect()
    }

    fn forward_to(&self, forwards: Arc<[Forward]>) {
        self.is_forwarded.store(!forwards.is_empty(), Relaxed);
        *lock(&self.forwards) = forwards;
    }

    fn inject(&self, form: usize, event: &Bytes, age: Duration) -> Result<(), Why> {
        let former = form.checked_sub(1).and_then(|place| self.former.get(place));
        let read = match former {
            None => codec::decode_shared::<E>(event),
            Some(former) => former.read(event),
        };
        match read {
            Ok(event) => {
                self.spread(event, arrived_posting_time::<E>(age));
                Ok(())
            }
            Err(error) => {
                let why = Why::Undecodable { reason: error.to_string() };
                self.bury(&why);
                Err(why)
            }
        }
    }

    fn has_listeners(&self) -> bool {
        self.listeners.load(Relaxed) > 0
    }
}

/// Which type a topic was to carry, and where the program says so.
#[derive(Clone, Copy)]
struct Naming {
    named: &'static str,
    at: &'static Location<'static>,
}

impl fmt::Display for Naming {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (by {}:{})", self.named, self.at.file(), self.at.line())
    }
}

struct Known {
    naming: Naming,
    /// A `Topic<E>`.
    typed: Arc<dyn Any + Send + Sync>,
    erased: Arc<dyn AnyTopic>,
}

#[derive(Default)]
struct Inner {
    /// As many as the program has publishers and listeners.
    topics: BTreeMap<TopicKey, Known>,
    /// Kept for topics that nobody here has named yet.
    forwards: BTreeMap<TopicKey, BTreeMap<u64, Forward>>,
    next_forward: u64,
}

/// The topics of one node. Clones share them.
#[derive(Clone)]
pub(crate) struct Topics {
    inner: Arc<Mutex<Inner>>,
    interest: Arc<Mutex<Option<Interest>>>,
    dead_letters: DeadLetterOffice,
}

impl Topics {
    pub(crate) fn new(dead_letters: DeadLetterOffice) -> Self {
        Topics { inner: Arc::default(), interest: Arc::default(), dead_letters }
    }

    /// The topic of this name that carries `E`, as it is said to here.
    pub(crate) fn topic<E: Event>(
        &self,
        name: &str,
        at: &'static Location<'static>,
    ) -> Result<Arc<Topic<E>>, Why> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let key = TopicKey::new(name, E::NAME);
        let naming = Naming { named: type_name::<E>(), at };
        let mut inner = lock(&self.inner);
        if let Some(known) = inner.topics.get(&key) {
            return known.typed.clone().downcast().map_err(|_| {
                let difference = difference(&known.erased.identity(), &ContractIdentity::of::<E>());
                let first = known.naming;
                let difference =
                    format!("the topic {name:?} carries {first} and {naming}: {difference}");
                Why::ContractDiffers { difference }
            });
        }
        let topic = Arc::new(Topic::<E> {
            key: key.clone(),
            id: NEXT.fetch_add(1, Relaxed),
            hubs: Mutex::new(Arc::new([])),
            forwards: Mutex::new(Arc::new([])),
            is_forwarded: AtomicBool::new(false),
            listeners: AtomicU64::new(0),
            dead_letters: self.dead_letters.clone(),
            interest: self.interest.clone(),
            former: E::former(),
        });
        if let Some(forwards) = inner.forwards.get(&key) {
            topic.forward_to(forwards.values().cloned().collect());
        }
        inner.topics.insert(key, Known { naming, typed: topic.clone(), erased: topic.clone() });
        Ok(topic)
    }

    /// A way to publish on the topic of this name.
    #[track_caller]
    pub(crate) fn publisher<E: Event>(&self, topic: &str) -> Result<Publisher<E>, Why> {
        Ok(Publisher { topic: self.topic(topic, Location::caller())? })
    }

    /// Ships every event that is published here on this topic, from now on, also if the topic does
    /// not exist yet. Events that came in by [`inject`](Self::inject) are not shipped.
    pub(crate) fn forward(&self, key: &TopicKey, forward: Forward) -> ForwardId {
        let mut inner = lock(&self.inner);
        let id = inner.next_forward;
        inner.next_forward += 1;
        inner.forwards.entry(key.clone()).or_default().insert(id, forward);
        inner.renew_forwards(key);
        ForwardId { key: key.clone(), id }
    }

    /// Ends a forward.
    pub(crate) fn end_forward(&self, forward: &ForwardId) {
        let mut inner = lock(&self.inner);
        if let Some(forwards) = inner.forwards.get_mut(&forward.key) {
            forwards.remove(&forward.id);
        }
        inner.renew_forwards(&forward.key);
    }

    /// Gives an event that came from another node to the listeners here, read by this version of its
    /// contract, 0 for the present one; it took so long.
    pub(crate) fn inject(
        &self,
        key: &TopicKey,
        form: usize,
        event: &Bytes,
        age: Duration,
    ) -> Result<(), Why> {
        let topic = lock(&self.inner).topics.get(key).map(|known| known.erased.clone());
        match topic {
            Some(topic) => topic.inject(form, event, age),
            None => Err(Why::Unknown { name: key.topic.to_string() }),
        }
    }

    /// What a topic carries, if anybody here has named it, and the earlier versions of that which are
    /// understood.
    pub(crate) fn identities(&self, key: &TopicKey) -> Vec<ContractIdentity> {
        let inner = lock(&self.inner);
        inner.topics.get(key).map_or(Vec::new(), |known| known.erased.identities())
    }

    /// All topics that have listeners here, and what they carry.
    pub(crate) fn listened(&self) -> Vec<(TopicKey, Vec<ContractIdentity>)> {
        let inner = lock(&self.inner);
        let listened = inner.topics.iter().filter(|(_, known)| known.erased.has_listeners());
        listened.map(|(key, known)| (key.clone(), known.erased.identities())).collect()
    }

    /// From now on tells when a topic gets its first listener here, or loses its last.
    pub(crate) fn on_interest(&self, interest: Interest) {
        *lock(&self.interest) = Some(interest);
    }
}

impl Inner {
    fn renew_forwards(&self, key: &TopicKey) {
        if let (Some(known), Some(forwards)) = (self.topics.get(key), self.forwards.get(key)) {
            known.erased.forward_to(forwards.values().cloned().collect());
        }
    }
}

/// Names one forward.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ForwardId {
    key: TopicKey,
    id: u64,
}

/// A way to publish events on one topic.
pub struct Publisher<E: Event> {
    topic: Arc<Topic<E>>,
}

impl<E: Event> Clone for Publisher<E> {
    fn clone(&self) -> Self {
        Publisher { topic: self.topic.clone() }
    }
}

impl<E: Event> fmt::Debug for Publisher<E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Publisher of {} on {}", E::NAME, self.topic.key.topic)
    }
}

impl<E: Event> Publisher<E> {
    /// Hands the event to everyone who listens and wants it. Never waits.
    ///
    /// # Errors
    /// [`Why::Fenced`] or [`Why::Isolated`] if the component that publishes must not speak; the event
    /// comes back.
    #[inline]
    pub fn publish(&self, event: E) -> Result<(), SendError<E>> {
        match pulse::forbidden() {
            Some(why) => Err(SendError::new(why, event)),
            None => {
                self.topic.publish(event);
                Ok(())
            }
        }
    }
}
