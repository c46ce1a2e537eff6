//! What a topic carries, with its publishers and listeners: for display only.

use super::{NodeTopics, TopicKey, lock};
use blastema_core::sorted::SortedMap;
use blastema_core::{Instant, NodeName, ObjectName};
use serde::Serialize;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A rate over less than this would tell of bursts, not of the topic.
const RATE_WINDOW: Duration = Duration::from_secs(1);

/// One topic of a node, in its [snapshot](crate::Node::snapshot).
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct TopicRow {
    /// The name of the topic.
    pub topic: String,
    /// The contract of its events.
    pub contract: String,
    /// The last event is kept for listeners that join.
    pub latched: bool,
    /// The objects of this node that publish on it, and the node itself where its program does.
    pub publishers: Vec<String>,
    /// The objects of this node that listen to it.
    pub listeners: Vec<ObjectName>,
    /// The other nodes that have publishers of this contract on it.
    pub publishing_nodes: Vec<NodeName>,
    /// The other nodes that have listeners.
    pub listening_nodes: Vec<NodeName>,
    /// The events that were published here, or came from other nodes.
    pub events: u64,
    /// How many of them in a second, since the row was read last, or over a second at least.
    pub rate_hz: f64,
    /// The encoded size of a recent event, in bytes.
    pub bytes: Option<usize>,
}

pub(super) struct Traffic {
    events: AtomicU64,
    /// Events for which there was no capacity: with one listener, on one thread's list, or on the
    /// way to one node.
    lost: AtomicU64,
    bytes: AtomicUsize,
    /// The next event is to be measured.
    unmeasured: AtomicBool,
    node: Arc<NodeTopics>,
    shown: Mutex<Shown>,
}

struct Shown {
    /// How many publishers of this name there are.
    publishers: SortedMap<Box<str>, usize>,
    /// How many subscriptions of this name there are.
    listeners: SortedMap<ObjectName, usize>,
    /// The window that began last: when, and after how many events.
    window: (Instant, u64),
    rate_hz: f64,
    /// The events, and those that were lost, as they were sampled last.
    sampled: [u64; 2],
}

fn count<K: Ord>(counts: &mut SortedMap<K, usize>, key: K, more: bool) {
    let counted = counts.get(&key).copied().unwrap_or(0);
    match if more { counted + 1 } else { counted.saturating_sub(1) } {
        0 => counts.remove(&key),
        counted => counts.insert(key, counted),
    };
}

impl Traffic {
    pub(super) fn new(now: Instant, node: Arc<NodeTopics>) -> Self {
        Traffic {
            events: AtomicU64::new(0),
            lost: AtomicU64::new(0),
            bytes: AtomicUsize::new(0),
            unmeasured: AtomicBool::new(true),
            node,
            shown: Mutex::new(Shown {
                publishers: SortedMap::new(),
                listeners: SortedMap::new(),
                window: (now, 0),
                rate_hz: 0.0,
                sampled: [0; 2],
            }),
        }
    }

    /// One more event.
    #[inline]
    pub(super) fn count(&self) {
        self.events.fetch_add(1, Relaxed);
    }

    /// There was no capacity for an event somewhere.
    pub(super) fn lose(&self) {
        self.lost.fetch_add(1, Relaxed);
    }

    /// The events since the last call, and how many times one of them was lost.
    pub(super) fn take_losses(&self) -> [u64; 2] {
        let counts = [&self.events, &self.lost].map(|count| count.load(Relaxed));
        let before = std::mem::replace(&mut lock(&self.shown).sampled, counts);
        [counts[0] - before[0], counts[1] - before[1]]
    }

    #[inline]
    pub(super) fn is_to_be_measured(&self) -> bool {
        self.unmeasured.load(Relaxed)
    }

    pub(super) fn measured(&self, bytes: usize) {
        self.bytes.store(bytes, Relaxed);
        self.unmeasured.store(false, Relaxed);
    }

    /// One publisher more or less.
    pub(super) fn publishes(&self, by: &str, more: bool) {
        count(&mut lock(&self.shown).publishers, by.into(), more);
        self.node.publishing.fetch_add(1, Relaxed);
    }

    pub(super) fn has_publishers(&self) -> bool {
        !lock(&self.shown).publishers.is_empty()
    }

    /// One subscription more or less.
    pub(super) fn listens(&self, name: &ObjectName, more: bool) {
        count(&mut lock(&self.shown).listeners, name.clone(), more);
    }

    /// The names of its publishers and listeners.
    pub(super) fn users(&self) -> Vec<String> {
        let shown = lock(&self.shown);
        let publishers = shown.publishers.keys().map(|name| name.to_string());
        let listeners = shown.listeners.keys().map(ObjectName::to_string);
        publishers.chain(listeners).collect()
    }

    pub(super) fn row(&self, key: &TopicKey, latched: bool, now: Instant) -> TopicRow {
        let events = self.events.load(Relaxed);
        let measured = (events > 0 && !self.is_to_be_measured()).then(|| self.bytes.load(Relaxed));
        self.unmeasured.store(true, Relaxed);
        let mut shown = lock(&self.shown);
        let (from, before) = shown.window;
        let span = now - from;
        if span >= RATE_WINDOW {
            shown.rate_hz = events.saturating_sub(before) as f64 / span.as_secs_f64();
            shown.window = (now, events);
        }
        TopicRow {
            topic: key.topic.to_string(),
            contract: key.contract.to_string(),
            latched,
            publishers: shown.publishers.keys().map(|name| name.to_string()).collect(),
            listeners: shown.listeners.keys().cloned().collect(),
            publishing_nodes: Vec::new(),
            listening_nodes: Vec::new(),
            events,
            rate_hz: shown.rate_hz,
            bytes: measured,
        }
    }
}
