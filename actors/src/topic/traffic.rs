//! What a topic carries, with its publishers and listeners: for display only.

use super::{TopicKey, lock};
use crate::platform;
use blastema_core::sorted::SortedMap;
use blastema_core::{Instant, NodeName, ObjectName};
use serde::Serialize;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A rate over less than this would tell of bursts, not of the topic.
const RATE_WINDOW: Duration = Duration::from_secs(1);
/// Listeners of a node that starts, and of its neighbours, have joined by then.
const JOINED_WITHIN: Duration = Duration::from_secs(5);

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
    /// If this topic is published on and has no listeners after 5 s: the topic of a similar name
    /// that has listeners and no publishers.
    pub similar: Option<String>,
}

pub(super) struct Traffic {
    events: AtomicU64,
    /// Events for which there was no capacity: with one listener, on one thread's list, or on the
    /// way to one node.
    lost: AtomicU64,
    bytes: AtomicUsize,
    /// The next event is to be measured.
    unmeasured: AtomicBool,
    /// When a listener joined some topic of the node last, in nanoseconds.
    joined: Arc<AtomicU64>,
    /// How often a publisher of some topic of the node came or went.
    publishing: Arc<AtomicU64>,
    /// When its name was compared with those of other topics last, in nanoseconds.
    judged: AtomicU64,
    since: Instant,
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
    pub(super) fn new(now: Instant, joined: Arc<AtomicU64>, publishing: Arc<AtomicU64>) -> Self {
        Traffic {
            events: AtomicU64::new(0),
            lost: AtomicU64::new(0),
            bytes: AtomicUsize::new(0),
            unmeasured: AtomicBool::new(true),
            joined,
            publishing,
            judged: AtomicU64::new(0),
            since: now,
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

    /// Since the last listener joined.
    #[inline]
    pub(super) fn was_judged(&self) -> bool {
        self.judged.load(Relaxed) > self.joined.load(Relaxed)
    }

    /// Says once that listeners have had the time to join, and again after another has joined.
    pub(super) fn is_time_to_judge(&self, now: Instant) -> bool {
        let joined = self.joined.load(Relaxed);
        // A publisher for the listener that has joined may still come.
        now - self.since.max(Instant::from_nanos(joined)) >= JOINED_WITHIN
            && self.judged.swap(now.as_nanos(), Relaxed) <= joined
    }

    /// Says whether events are published, or may be, and listeners have had the time to join.
    pub(super) fn expects_listeners(&self, now: Instant) -> bool {
        let is_used = self.events.load(Relaxed) > 0 || self.has_publishers();
        now - self.since >= JOINED_WITHIN && is_used
    }

    /// One publisher more or less.
    pub(super) fn publishes(&self, by: &str, more: bool) {
        count(&mut lock(&self.shown).publishers, by.into(), more);
        self.publishing.fetch_add(1, Relaxed);
    }

    pub(super) fn has_publishers(&self) -> bool {
        !lock(&self.shown).publishers.is_empty()
    }

    /// One subscription more or less.
    pub(super) fn listens(&self, name: &ObjectName, more: bool) {
        count(&mut lock(&self.shown).listeners, name.clone(), more);
        if more {
            self.joined.store(platform::now().as_nanos(), Relaxed);
        }
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
            similar: None,
        }
    }
}
