//! What was not delivered, counted by receiver, contract and reason, and the latest of it.

use crate::sorted::SortedMap;
use crate::{DeliveryError, Instant, NodeName, ObjectName};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::VecDeque;
use std::fmt;

/// Why a message became a dead letter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[non_exhaustive]
pub enum DeadReason {
    /// The receiver's queue was full, and its policy chose this message.
    Full,
    /// The receiver's queue was full while it was between two incarnations; or the session with its
    /// node was about to begin.
    Restarting,
    /// As much was on its way to the receiver's node as may be.
    WayFull,
    /// No path led to the receiver's node any more, or the session was restarted: it may have
    /// arrived.
    Unreachable,
    /// The receiver's node had ended in order.
    Left,
    /// The receiver was stopped while the message waited.
    Stopped,
    /// The receiver died while it served the message, or its node did before that had acknowledged
    /// it.
    PeerDied,
    /// The message was older than its contract allows when its turn came.
    Expired,
    /// No caller waited for the answer any more when its turn came.
    DeadlinePassed,
    /// The message had ended too many incarnations of the receiver.
    Quarantined,
    /// The receiver was isolated.
    Isolated,
    /// The two nodes, or the publisher and the listener, hold different contracts.
    ContractDiffers,
    /// There was no such object, or it took no such contract.
    Unknown,
    /// The message was larger than its contract, or the path to another node, allows.
    TooLarge,
    /// Bytes from another node did not decode as a message of the contract.
    Undecodable,
    /// The message could not be delivered, for another reason.
    Refused,
    /// The sender's node did not have the right to send it.
    Forbidden,
}

impl DeadReason {
    /// The reason in words.
    pub fn text(self) -> &'static str {
        match self {
            DeadReason::Full => "queue full",
            DeadReason::Restarting => "receiver restarting",
            DeadReason::WayFull => "way full",
            DeadReason::Unreachable => "no way",
            DeadReason::Left => "node left",
            DeadReason::Stopped => "receiver stopped",
            DeadReason::PeerDied => "receiver died",
            DeadReason::Expired => "too old",
            DeadReason::DeadlinePassed => "deadline passed",
            DeadReason::Quarantined => "quarantined",
            DeadReason::Isolated => "receiver isolated",
            DeadReason::ContractDiffers => "contract differs",
            DeadReason::Unknown => "receiver unknown",
            DeadReason::TooLarge => "too large",
            DeadReason::Undecodable => "undecodable",
            DeadReason::Refused => "refused",
            DeadReason::Forbidden => "forbidden",
        }
    }
}

impl fmt::Display for DeadReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.text())
    }
}

impl From<&DeliveryError> for DeadReason {
    fn from(why: &DeliveryError) -> Self {
        match why {
            DeliveryError::Full => DeadReason::Full,
            DeliveryError::Restarting => DeadReason::Restarting,
            DeliveryError::WayFull { .. } => DeadReason::WayFull,
            DeliveryError::Unreachable { .. }
            | DeliveryError::Undelivered { .. }
            | DeliveryError::OutcomeUnknown { .. } => DeadReason::Unreachable,
            DeliveryError::Left { .. } => DeadReason::Left,
            DeliveryError::Stopped | DeliveryError::ShutDown { .. } => DeadReason::Stopped,
            DeliveryError::PeerDied { .. } => DeadReason::PeerDied,
            DeliveryError::Expired => DeadReason::Expired,
            DeliveryError::DeadlinePassed => DeadReason::DeadlinePassed,
            DeliveryError::Quarantined { .. } => DeadReason::Quarantined,
            DeliveryError::Isolated { .. } | DeliveryError::SenderIsolated => DeadReason::Isolated,
            DeliveryError::ContractDiffers { .. } => DeadReason::ContractDiffers,
            DeliveryError::Unknown { .. }
            | DeliveryError::Misspelt { .. }
            | DeliveryError::NotServed { .. }
            | DeliveryError::InvalidName { .. }
            | DeliveryError::OtherType { .. }
            | DeliveryError::NoVariable { .. } => DeadReason::Unknown,
            DeliveryError::TooLarge { .. } | DeliveryError::TooLargeForSession { .. } => {
                DeadReason::TooLarge
            }
            DeliveryError::Undecodable { .. } => DeadReason::Undecodable,
            DeliveryError::Forbidden { .. } => DeadReason::Forbidden,
            _ => DeadReason::Refused,
        }
    }
}

/// A message that was not delivered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeadLetter {
    /// On which other node its receiver is; `None` for one of this node.
    pub node: Option<NodeName>,
    /// The receiver, or, for an event, the name of its topic.
    pub object: ObjectName,
    /// The name of its contract.
    pub contract: Cow<'static, str>,
    /// Why it did not arrive.
    pub reason: DeadReason,
    /// When it was given up.
    pub at: Instant,
}

/// How many messages of one contract were not delivered to one object for one reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeadLetterCount {
    /// On which other node their receiver is; `None` for one of this node.
    pub node: Option<NodeName>,
    /// The receiver, or, for events, the name of their topic.
    pub object: ObjectName,
    /// The name of their contract.
    pub contract: Cow<'static, str>,
    /// Why they did not arrive.
    pub reason: DeadReason,
    /// The number of messages.
    pub count: u64,
}

/// How much is remembered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeadLetterLimits {
    /// Different counts; what would be one more is counted together. A hundred bytes each.
    pub counts: usize,
    /// The latest letters; a hundred bytes each.
    pub latest: usize,
}

impl Default for DeadLetterLimits {
    /// Ten contracts for each of 400 objects, and the latest screenful or two.
    fn default() -> Self {
        DeadLetterLimits { counts: 4096, latest: 128 }
    }
}

type Key = (Option<NodeName>, ObjectName, Cow<'static, str>, DeadReason);

/// The record of all that was not delivered.
#[derive(Debug, Default)]
pub struct DeadLetters {
    limits: DeadLetterLimits,
    counts: SortedMap<Key, u64>,
    beyond: u64,
    latest: VecDeque<DeadLetter>,
}

impl DeadLetters {
    /// An empty record.
    pub fn new(limits: DeadLetterLimits) -> Self {
        DeadLetters { limits, ..DeadLetters::default() }
    }

    /// Takes note of one message that was not delivered.
    pub fn handle(&mut self, letter: DeadLetter) {
        self.handle_many(letter, 1);
    }

    /// Takes note of so many that were not delivered, all alike, of which one is remembered among
    /// the latest.
    pub fn handle_many(&mut self, letter: DeadLetter, many: u64) {
        let DeadLetter { node, object, contract, reason, .. } = letter.clone();
        let key = (node, object, contract, reason);
        let has_capacity = self.counts.len() < self.limits.counts;
        match self.counts.get_mut(&key) {
            Some(count) => *count += many,
            None if has_capacity => {
                self.counts.insert(key, many);
            }
            None => self.beyond += many,
        }
        if self.latest.len() >= self.limits.latest {
            self.latest.pop_front();
        }
        if self.limits.latest > 0 {
            self.latest.push_back(letter);
        }
    }

    /// All that was not delivered.
    pub fn total(&self) -> u64 {
        self.counts.values().sum::<u64>() + self.beyond
    }

    /// How many were counted together because there were too many kinds of them.
    pub fn beyond(&self) -> u64 {
        self.beyond
    }

    /// The counts, by node, object, contract and reason.
    pub fn counts(&self) -> impl Iterator<Item = DeadLetterCount> + '_ {
        self.counts.iter().map(|((node, object, contract, reason), count)| DeadLetterCount {
            node: node.clone(),
            object: object.clone(),
            contract: contract.clone(),
            reason: *reason,
            count: *count,
        })
    }

    /// How many messages to objects of this name, on whichever node, were not delivered for this
    /// reason.
    pub fn count(&self, object: &ObjectName, reason: DeadReason) -> u64 {
        let of = |key: &Key| key.1 == *object && key.3 == reason;
        self.counts.iter().filter(|(key, _)| of(key)).map(|(_, count)| count).sum()
    }

    /// The latest letters, the oldest of them first.
    pub fn latest(&self) -> impl Iterator<Item = &DeadLetter> {
        self.latest.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn letter(contract: &'static str, reason: DeadReason, millis: u64) -> DeadLetter {
        let (node, object) = (None, ObjectName::new("arm").unwrap());
        let (contract, at) = (contract.into(), Instant::from_millis(millis));
        DeadLetter { node, object, contract, reason, at }
    }

    #[test]
    fn letters_are_counted_by_object_contract_and_reason() {
        let mut letters = DeadLetters::default();
        letters.handle(letter("a", DeadReason::Full, 1));
        letters.handle(letter("a", DeadReason::Full, 2));
        letters.handle(letter("a", DeadReason::Expired, 3));
        letters.handle(letter("b", DeadReason::Full, 4));

        let counts: Vec<_> = letters.counts().map(|c| (c.contract, c.reason, c.count)).collect();

        let expected = [
            ("a".into(), DeadReason::Full, 2),
            ("a".into(), DeadReason::Expired, 1),
            ("b".into(), DeadReason::Full, 1),
        ];
        assert_eq!(counts, expected);
        assert_eq!(letters.count(&ObjectName::new("arm").unwrap(), DeadReason::Full), 3);
        assert_eq!(letters.total(), 4);
    }

    #[test]
    fn objects_of_one_name_on_several_nodes_are_counted_apart() {
        let mut letters = DeadLetters::default();
        let node = NodeName::new("module2").ok();
        letters.handle(letter("a", DeadReason::Full, 1));
        letters.handle(DeadLetter { node: node.clone(), ..letter("a", DeadReason::Full, 2) });
        letters.handle(DeadLetter { node: node.clone(), ..letter("a", DeadReason::Full, 3) });

        let counts: Vec<_> = letters.counts().map(|count| (count.node, count.count)).collect();
        assert_eq!(counts, [(None, 1), (node, 2)]);
        assert_eq!(letters.count(&ObjectName::new("arm").unwrap(), DeadReason::Full), 3);
    }

    #[test]
    fn beyond_the_limits_letters_are_counted_together_and_the_oldest_is_forgotten() {
        let mut letters = DeadLetters::new(DeadLetterLimits { counts: 1, latest: 2 });
        letters.handle(letter("a", DeadReason::Full, 1));
        letters.handle(letter("b", DeadReason::Full, 2));
        letters.handle(letter("a", DeadReason::Full, 3));

        assert_eq!((letters.total(), letters.beyond()), (3, 1));
        let latest: Vec<_> = letters.latest().map(|letter| letter.at).collect();
        assert_eq!(latest, [Instant::from_millis(2), Instant::from_millis(3)]);
    }

    #[test]
    fn whatever_keeps_a_message_from_arriving_is_a_reason_of_its_own() {
        let (node, name, reason) = (|| "far".to_owned(), || "arm".to_owned(), || "x".to_owned());
        let whys = [
            (DeliveryError::Full, DeadReason::Full),
            (DeliveryError::Restarting, DeadReason::Restarting),
            (
                DeliveryError::WayFull { node: node(), class: crate::TrafficClass::Bulk },
                DeadReason::WayFull,
            ),
            (DeliveryError::Unreachable { node: node() }, DeadReason::Unreachable),
            (
                DeliveryError::Undelivered { node: node(), reason: reason() },
                DeadReason::Unreachable,
            ),
            (DeliveryError::OutcomeUnknown { reason: reason() }, DeadReason::Unreachable),
            (DeliveryError::Left { node: node() }, DeadReason::Left),
            (DeliveryError::ContractDiffers { difference: reason() }, DeadReason::ContractDiffers),
            (DeliveryError::Unknown { name: name() }, DeadReason::Unknown),
            (DeliveryError::TooLarge { limit: 1 }, DeadReason::TooLarge),
            (DeliveryError::TooLargeForSession { limit: 1 }, DeadReason::TooLarge),
            (DeliveryError::Undecodable { reason: reason() }, DeadReason::Undecodable),
            (DeliveryError::Stopped, DeadReason::Stopped),
            (DeliveryError::PeerDied { incarnation: crate::Incarnation(1) }, DeadReason::PeerDied),
            (DeliveryError::Expired, DeadReason::Expired),
            (DeliveryError::DeadlinePassed, DeadReason::DeadlinePassed),
            (DeliveryError::Quarantined { kills: 3 }, DeadReason::Quarantined),
            (DeliveryError::isolated("arm"), DeadReason::Isolated),
            (DeliveryError::SenderIsolated, DeadReason::Isolated),
            (DeliveryError::Fenced, DeadReason::Refused),
        ];
        for (why, reason) in whys {
            assert_eq!(DeadReason::from(&why), reason, "{why}");
        }
    }
}
