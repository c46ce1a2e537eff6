//! The topics of one node by their names, and what other nodes want of them.

use super::erased::AnyTopic;
use super::shared_list::SharedList;
use super::traffic::{TopicRow, Traffic};
use super::{
    Hubs, InterestObserver, NodeTopics, Publisher, RemoteForward, Topic, TopicKey, TopicTap, lock,
};
use crate::messaging::dead_letters::DeadLetterLog;
use crate::platform;
use crate::registry::difference;
use crate::runtime::reports::FaultReports;
use blastema_core::sorted::SortedMap;
use blastema_core::{ContractIdentity, DeliveryError, Event, NodeName, ObjectName, PeerIdentity};
use bytes::Bytes;
use std::any::{Any, type_name};
use std::collections::BTreeSet;
use std::fmt;
use std::panic::Location;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::sync::watch;

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

struct TopicEntry {
    naming: Naming,
    /// A `Topic<E>` of the topic's contract `E`.
    typed: Arc<dyn Any + Send + Sync>,
    erased: Arc<dyn AnyTopic>,
}

impl TopicEntry {
    /// Names the contract that the topic carries and the one that another party means by it.
    fn difference(&self, topic: &str, naming: Naming, wanted: &ContractIdentity) -> String {
        let (known, first) = (self.erased.identity(), self.naming);
        let what = if known.name == wanted.name {
            difference(&known, wanted)
        } else {
            let (one, other) = (described(&known.brief()), described(&wanted.brief()));
            format!("{one} and {other} are two contracts: give one of them another topic")
        };
        let users = match self.erased.traffic().users().join(", ") {
            users if users.is_empty() => users,
            users => format!("; the first is used by {users}"),
        };
        format!("the topic {topic:?} carries {first} and {naming}: {what}{users}")
    }
}

/// A contract, as texts name it.
pub(crate) fn described(contract: &PeerIdentity) -> String {
    format!("`{}` version {}", contract.name, contract.version)
}

/// A forward, and the versions of a contract that its receiver understands. It counts, and gets
/// events, only where the topic carries one of them.
struct WantedForward {
    node: NodeName,
    wanted: Vec<PeerIdentity>,
    forward: RemoteForward,
}

/// The topics by name.
#[derive(Default)]
struct TopicTable {
    /// As many as the program has publishers and listeners.
    topics: SortedMap<ObjectName, TopicEntry>,
    /// Kept for topics that no object of this node has named yet.
    forwards: SortedMap<ObjectName, SortedMap<u64, WantedForward>>,
    next_forward: u64,
}

/// The topics of one node. Clones share them.
#[derive(Clone)]
pub(crate) struct Topics {
    inner: Arc<Mutex<TopicTable>>,
    node: Arc<NodeTopics>,
}

/// A tap of a topic, which ends when this is dropped.
pub(crate) struct Tapped<E: Event> {
    topic: Arc<Topic<E>>,
    tap: TopicTap<E>,
    listener: ObjectName,
}

impl<E: Event> Drop for Tapped<E> {
    fn drop(&mut self) {
        let others = |known: &&TopicTap<E>| !Arc::ptr_eq(known, &self.tap);
        self.topic.taps.change(|all| all.iter().filter(others).cloned().collect());
        let is_last = self.topic.remove_listener();
        self.topic.listener_changed(&self.listener, false, is_last);
    }
}

impl Topics {
    pub(crate) fn new(dead_letters: DeadLetterLog, reports: FaultReports) -> Self {
        let (inner, interest, publishing, ended) = Default::default();
        let node = Arc::new(NodeTopics { dead_letters, reports, interest, publishing, ended });
        Topics { inner, node }
    }

    /// This node was shut down: publishers outside of its components get an error.
    pub(crate) fn shut_down(&self, node: &NodeName) {
        // It is reported once.
        let _ = self.node.ended.set(node.clone());
    }

    /// The topic of this name that carries `E`, as it is said to here. A topic carries one
    /// contract: that of its first publisher or listener, for as long as the node runs.
    ///
    /// # Errors
    /// [`DeliveryError::InvalidName`]; [`DeliveryError::ContractDiffers`] if it carries another
    /// one.
    pub(crate) fn topic<E: Event>(
        &self,
        name: &str,
        at: &'static Location<'static>,
    ) -> Result<Arc<Topic<E>>, DeliveryError> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let key = TopicKey::new(name, E::NAME)?;
        let naming = Naming { named: type_name::<E>(), at };
        let mut inner = lock(&self.inner);
        if let Some(known) = inner.topics.get(&key.topic) {
            return known.typed.clone().downcast().map_err(|_| {
                let difference = known.difference(name, naming, &ContractIdentity::of::<E>());
                DeliveryError::ContractDiffers { difference }
            });
        }
        let topic = Arc::new(Topic::<E> {
            key: key.clone(),
            id: NEXT.fetch_add(1, Relaxed),
            hubs: Mutex::new(Hubs { list: Arc::new([]), next: 0 }),
            forwards: SharedList::default(),
            listeners: AtomicU64::new(0),
            latch: Mutex::default(),
            traffic: Traffic::new(platform::now(), self.node.clone()),
            taps: SharedList::default(),
            matched: watch::Sender::new(0),
            node: self.node.clone(),
            complained: AtomicBool::new(false),
            former: E::previous_versions(),
        });
        let known = TopicEntry { naming, typed: topic.clone(), erased: topic.clone() };
        inner.topics.insert(key.topic.clone(), known);
        let is_awaited = inner.renew_forwards(&key.topic, None);
        drop(inner);
        let interest = lock(&self.node.interest).clone();
        if let Some(interest) = interest.filter(|_| is_awaited) {
            // What other nodes listen to can be compared from now on.
            interest(&key);
        }
        Ok(topic)
    }

    /// Tells this tap of every event of the topic until what is returned is dropped. It counts as a
    /// listener of this name, so that other nodes send their events.
    ///
    /// # Errors
    /// As [`topic`](Self::topic).
    #[track_caller]
    pub(crate) fn tap<E: Event>(
        &self,
        name: &str,
        listener: &ObjectName,
        tap: TopicTap<E>,
    ) -> Result<Tapped<E>, DeliveryError> {
        let topic: Arc<Topic<E>> = self.topic(name, Location::caller())?;
        topic.taps.change(|all| all.iter().cloned().chain([tap.clone()]).collect());
        let is_first = topic.add_listener(&lock(&topic.latch));
        topic.listener_changed(listener, true, is_first);
        Ok(Tapped { topic, tap, listener: listener.clone() })
    }

    /// On how many arbiters a topic has listeners.
    #[cfg(test)]
    #[track_caller]
    pub(crate) fn hubs<E: Event>(&self, topic: &str) -> usize {
        let topic = self.topic::<E>(topic, Location::caller());
        topic.map_or(0, |topic| lock(&topic.hubs).list.len())
    }

    /// A way to publish on the topic of this name.
    #[track_caller]
    #[cfg(test)]
    pub(crate) fn publisher<E: Event>(&self, topic: &str) -> Result<Publisher<E>, DeliveryError> {
        self.publisher_of(topic, "")
    }

    /// The same, for the object of this name.
    #[track_caller]
    pub(crate) fn publisher_of<E: Event>(
        &self,
        topic: &str,
        object: &str,
    ) -> Result<Publisher<E>, DeliveryError> {
        let topic = self.topic(topic, Location::caller())?;
        match topic.shut_down() {
            Some(why) => Err(why),
            None => Ok(Publisher::new(topic, object)),
        }
    }

    /// The topics that objects of this node have named.
    pub(crate) fn rows(&self) -> Vec<TopicRow> {
        let inner = lock(&self.inner);
        let topic = |known: &TopicEntry| (known.erased.clone(), inner.listening_nodes(known));
        let topics: Vec<(Arc<dyn AnyTopic>, _)> = inner.topics.values().map(topic).collect();
        drop(inner);
        let now = platform::now();
        let row = |(topic, listening_nodes): (Arc<dyn AnyTopic>, Vec<NodeName>)| TopicRow {
            listening_nodes,
            ..topic.row(now)
        };
        topics.into_iter().map(row).collect()
    }

    /// Of each topic, the events since the last call, and how many times one of them found no
    /// capacity.
    pub(crate) fn take_losses(&self) -> Vec<(ObjectName, [u64; 2])> {
        let known = lock(&self.inner);
        let topics: Vec<_> = known.topics.values().map(|known| known.erased.clone()).collect();
        drop(known);
        topics
            .iter()
            .map(|topic| (topic.key().topic.clone(), topic.traffic().take_losses()))
            .collect()
    }

    /// Ships every event that is published here on this topic to this node, from now on, also if
    /// the topic does not exist yet; none if it carries no version that is `wanted`. Events that
    /// came in by [`inject`](Self::inject) are not shipped. Ends the forward `before` in the same
    /// step.
    pub(crate) fn forward(
        &self,
        key: &TopicKey,
        node: NodeName,
        wanted: Vec<PeerIdentity>,
        forward: RemoteForward,
        before: Option<&ForwardId>,
    ) -> ForwardId {
        let mut inner = lock(&self.inner);
        before.into_iter().for_each(|before| inner.remove_forward(before));
        let id = inner.next_forward;
        inner.next_forward += 1;
        let kept = WantedForward { node, wanted, forward };
        inner.forwards.entry(key.topic.clone()).or_default().insert(id, kept);
        inner.renew_forwards(&key.topic, Some(id));
        ForwardId { topic: key.topic.clone(), id }
    }

    /// Ends a forward.
    pub(crate) fn end_forward(&self, forward: &ForwardId) {
        let mut inner = lock(&self.inner);
        inner.remove_forward(forward);
        inner.renew_forwards(&forward.topic, None);
    }

    /// How many topics other nodes listen to.
    #[cfg(test)]
    pub(super) fn forwarded(&self) -> usize {
        lock(&self.inner).forwards.len()
    }

    /// A forward of this topic has ended, and is kept: its listener is matched no more.
    pub(crate) fn renew_forwards(&self, topic: &ObjectName) {
        lock(&self.inner).renew_forwards(topic, None);
    }

    /// Gives an event that came from another node to the listeners here, read by this version of
    /// its contract, 0 for the present one; it took so long.
    pub(crate) fn inject(
        &self,
        topic: &ObjectName,
        form: usize,
        event: &Bytes,
        age: Duration,
    ) -> Result<(), DeliveryError> {
        let known = lock(&self.inner).topics.get(topic).map(|known| known.erased.clone());
        match known {
            Some(known) => known.publish_remote(form, event, age),
            None => Err(DeliveryError::Unknown { name: topic.to_string() }),
        }
    }

    /// What this node listens to on a topic now: the contract that it carries and the earlier
    /// versions that are understood, or nothing where it has no listener.
    ///
    /// Without a listener the topic forgets the event of another node that it keeps. So the caller,
    /// which is what listens to other nodes, must end that, or find a listener the next time: other
    /// nodes send their last event when it listens again.
    pub(crate) fn settle_interest(&self, topic: &ObjectName) -> Vec<ContractIdentity> {
        let known = lock(&self.inner).topics.get(topic).map(|known| known.erased.clone());
        let listened = known.filter(|known| known.settle_interest());
        listened.map_or(Vec::new(), |known| known.identities())
    }

    /// The contract that a topic carries, if an object here has named it, and the earlier versions
    /// of it that are understood.
    pub(crate) fn identities(&self, topic: &ObjectName) -> Vec<ContractIdentity> {
        let inner = lock(&self.inner);
        inner.topics.get(topic).map_or(Vec::new(), |known| known.erased.identities())
    }

    /// Whether an object listens to a topic, here or on another node.
    pub(crate) fn is_heard(&self, topic: &str) -> bool {
        let Ok(topic) = ObjectName::new(topic) else { return false };
        let inner = lock(&self.inner);
        let here = inner.topics.get(&topic).is_some_and(|known| known.erased.has_listeners());
        let is_open = |kept: &WantedForward| !kept.forward.has_ended();
        here || inner.forwards.get(&topic).is_some_and(|all| all.values().any(is_open))
    }

    /// Tells by another number that a publisher came or went.
    pub(crate) fn revision(&self) -> u64 {
        self.node.publishing.load(Relaxed)
    }

    /// All topics that have publishers here.
    pub(crate) fn published(&self) -> Vec<TopicKey> {
        let inner = lock(&self.inner);
        let published =
            inner.topics.values().filter(|known| known.erased.traffic().has_publishers());
        published.map(|known| known.erased.key().clone()).collect()
    }

    /// All topics that have listeners here, and what they carry.
    pub(crate) fn listened(&self) -> Vec<(TopicKey, Vec<ContractIdentity>)> {
        let inner = lock(&self.inner);
        let listened = inner.topics.iter().filter(|(_, known)| known.erased.has_listeners());
        let carried = |known: &TopicEntry| (known.erased.key().clone(), known.erased.identities());
        listened.map(|(_, known)| carried(known)).collect()
    }

    /// Calls `interest` from now on.
    pub(crate) fn on_interest(&self, interest: InterestObserver) {
        *lock(&self.node.interest) = Some(interest);
    }
}

impl TopicTable {
    /// The other nodes whose listeners get what is published on this topic.
    fn listening_nodes(&self, known: &TopicEntry) -> Vec<NodeName> {
        let identity = known.erased.identity();
        let forwards = self.forwards.get(&known.erased.key().topic);
        let forwards = forwards.into_iter().flat_map(SortedMap::values);
        let understood =
            forwards.filter(|kept| kept.is_understood_of(&identity) && !kept.forward.has_ended());
        let nodes: BTreeSet<NodeName> = understood.map(|kept| kept.node.clone()).collect();
        nodes.into_iter().collect()
    }

    fn remove_forward(&mut self, forward: &ForwardId) {
        if let Some(forwards) = self.forwards.get_mut(&forward.topic) {
            forwards.remove(&forward.id);
            if forwards.is_empty() {
                self.forwards.remove(&forward.topic);
            }
        }
    }

    /// Tells a topic which forwards it has, and which of them joins. Says whether there are some.
    fn renew_forwards(&self, topic: &ObjectName, joins: Option<u64>) -> bool {
        let (Some(known), forwards) = (self.topics.get(topic), self.forwards.get(topic)) else {
            return false;
        };
        let identity = known.erased.identity();
        let all = forwards.into_iter().flat_map(|forwards| forwards.iter());
        let understood = all.filter(|(_, kept)| kept.is_understood_of(&identity));
        let joins = understood.clone().find(|(id, _)| Some(**id) == joins);
        let joins = joins.map(|(_, kept)| &kept.forward);
        let all = understood.map(|(_, kept)| kept.forward.clone()).collect();
        known.erased.forward_to(all, joins);
        forwards.is_some()
    }
}

impl WantedForward {
    fn is_understood_of(&self, carried: &ContractIdentity) -> bool {
        self.wanted.iter().any(|wanted| carried.check(wanted).is_ok())
    }
}

/// Names one forward.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ForwardId {
    topic: ObjectName,
    id: u64,
}
