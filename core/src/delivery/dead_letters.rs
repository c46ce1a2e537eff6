//! What was not delivered, counted by receiver, contract and reason.

use crate::sorted::SortedMap;
use crate::{DeliveryError, NodeName, ObjectName};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
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

/// How many of one kind were not delivered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeadLetterCount {
    /// The node of the object, where it is another one.
    pub node: Option<NodeName>,
    /// The object that they were for.
    pub object: ObjectName,
    /// Their contract.
    pub contract: Cow<'static, str>,
    /// Why they were not delivered.
    pub reason: DeadReason,
    /// How many there were.
    pub count: u64,
}

/// The kinds that are counted apart: those of some hundred objects, with several contracts each.
pub const KINDS_MAX: usize = 4096;

/// What is counted apart: the node of the object where it is another one, the object, the contract
/// and the reason.
pub type DeadLetterKind = (Option<NodeName>, ObjectName, Cow<'static, str>, DeadReason);

/// Counts the messages that a node did not deliver.
#[derive(Debug, Default)]
pub struct DeadLetters {
    counts: SortedMap<DeadLetterKind, u64>,
    beyond: u64,
}

impl DeadLetters {
    /// So many messages of one kind were not delivered.
    pub fn handle(&mut self, kind: DeadLetterKind, many: u64) {
        let has_capacity = self.counts.len() < KINDS_MAX;
        match self.counts.get_mut(&kind) {
            Some(count) => *count += many,
            None if has_capacity => {
                self.counts.insert(kind, many);
            }
            None => self.beyond += many,
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
        let of = |key: &DeadLetterKind| key.1 == *object && key.3 == reason;
        self.counts.iter().filter(|(key, _)| of(key)).map(|(_, count)| count).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kind(contract: &'static str, reason: DeadReason) -> DeadLetterKind {
        (None, ObjectName::new("arm").unwrap(), contract.into(), reason)
    }

    #[test]
    fn letters_are_counted_by_object_contract_and_reason() {
        let mut letters = DeadLetters::default();
        letters.handle(kind("a", DeadReason::Full), 1);
        letters.handle(kind("a", DeadReason::Full), 1);
        letters.handle(kind("a", DeadReason::Expired), 1);
        letters.handle(kind("b", DeadReason::Full), 1);

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
        let (_, object, contract, reason) = kind("a", DeadReason::Full);
        letters.handle(kind("a", DeadReason::Full), 1);
        letters.handle((node.clone(), object.clone(), contract, reason), 2);

        let counts: Vec<_> = letters.counts().map(|count| (count.node, count.count)).collect();
        assert_eq!(counts, [(None, 1), (node, 2)]);
        assert_eq!(letters.count(&object, DeadReason::Full), 3);
    }

    #[test]
    fn beyond_the_limit_letters_are_counted_together() {
        let mut letters = DeadLetters::default();
        for n in 0..=KINDS_MAX {
            let (_, object, _, reason) = kind("a", DeadReason::Full);
            letters.handle((None, object, n.to_string().into(), reason), 1);
        }
        letters.handle(kind("0", DeadReason::Full), 1);

        assert_eq!((letters.total(), letters.beyond()), (KINDS_MAX as u64 + 2, 1));
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
