//! What did not arrive at other nodes, as dead letters.

use crate::messaging::dead_letters::DeadLetterLog;
use crate::topic::TopicKey;
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::{NodeName, ObjectName};
use std::sync::OnceLock;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;

/// Why an event is not sent at all, to a peer that listens.
const REASONS: [DeadReason; 6] = [
    DeadReason::WayFull,
    DeadReason::Restarting,
    DeadReason::Unreachable,
    DeadReason::PeerDied,
    DeadReason::Left,
    DeadReason::Isolated,
];

/// Counts the events of one topic that do not go to one peer.
pub(in crate::net) struct UndeliveredEvents {
    dead_letters: DeadLetterLog,
    pub(super) node: NodeName,
    contract: String,
    topic: ObjectName,
    /// Losses that are not in the dead-letter log yet, by reason: a publisher only counts here,
    /// however many events are lost.
    counts: [AtomicU64; REASONS.len()],
    /// Why the subscription has ended with its session, once it has.
    ended: OnceLock<DeadReason>,
}

impl UndeliveredEvents {
    pub(super) fn new(dead_letters: DeadLetterLog, node: &NodeName, key: &TopicKey) -> Self {
        UndeliveredEvents {
            dead_letters,
            node: node.clone(),
            contract: key.contract.to_string(),
            topic: key.topic.clone(),
            counts: Default::default(),
            ended: OnceLock::new(),
        }
    }

    /// The subscription has ended with its session. The first reason stays.
    pub(super) fn end(&self, why: DeadReason) {
        let _ = self.ended.set(why);
    }

    /// One event more that is not sent.
    pub(super) fn take(&self, reason: DeadReason) {
        match REASONS.iter().position(|known| *known == reason) {
            Some(place) => drop(self.counts[place].fetch_add(1, Relaxed)),
            None => self.write_down(reason, 1),
        }
    }

    pub(super) fn have_ended(&self) -> bool {
        self.ended.get().is_some()
    }

    /// One event more whose subscription may have ended. If the peer has ended it, the event is not
    /// missed. Returns whether it is counted.
    pub(super) fn take_late(&self) -> bool {
        self.ended.get().inspect(|why| self.take(**why)).is_some()
    }

    /// Records the counted losses in the dead-letter log.
    pub(super) fn collect(&self) {
        for (reason, count) in REASONS.into_iter().zip(&self.counts) {
            match count.swap(0, Relaxed) {
                0 => {}
                many => self.write_down(reason, many),
            }
        }
    }

    pub(super) fn write_down(&self, reason: DeadReason, many: u64) {
        let (node, contract) = (Some(self.node.clone()), self.contract.clone());
        self.dead_letters.take_many(node, &self.topic, contract, reason, many);
    }
}

impl Drop for UndeliveredEvents {
    /// A publisher may have counted one more since the last look.
    fn drop(&mut self) {
        self.collect();
    }
}
