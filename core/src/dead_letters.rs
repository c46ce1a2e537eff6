//! What was not delivered, counted by receiver, contract and reason, and the latest of it.

use crate::{Instant, ObjectName, Why};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::{BTreeMap, VecDeque};
use std::fmt;

/// Why a message became a dead letter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[non_exhaustive]
pub enum DeadReason {
    /// The queue was full, and its policy chose this message.
    Full,
    /// The receiver was stopped while the message waited.
    Stopped,
    /// The receiver died while it served the message.
    PeerDied,
    /// The message was older than its contract allows when its turn came.
    Expired,
    /// Nobody waited for the answer any more when its turn came.
    DeadlinePassed,
    /// It had killed too many lives of the receiver.
    Quarantined,
    /// The receiver was isolated.
    Isolated,
    /// It came from outside and could not be given to the object, for another reason.
    Refused,
}

impl DeadReason {
    /// The reason in words.
    pub fn text(self) -> &'static str {
        match self {
            DeadReason::Full => "queue full",
            DeadReason::Stopped => "receiver stopped",
            DeadReason::PeerDied => "receiver died",
            DeadReason::Expired => "too old",
            DeadReason::DeadlinePassed => "deadline passed",
            DeadReason::Quarantined => "quarantined",
            DeadReason::Isolated => "receiver isolated",
            DeadReason::Refused => "refused",
        }
    }
}

impl fmt::Display for DeadReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.text())
    }
}

impl From<&Why> for DeadReason {
    fn from(why: &Why) -> Self {
        match why {
            Why::Full | Why::Restarting => DeadReason::Full,
            Why::Stopped => DeadReason::Stopped,
            Why::PeerDied { .. } => DeadReason::PeerDied,
            Why::Expired => DeadReason::Expired,
            Why::DeadlinePassed => DeadReason::DeadlinePassed,
            Why::Quarantined { .. } => DeadReason::Quarantined,
            Why::Isolated => DeadReason::Isolated,
            _ => DeadReason::Refused,
        }
    }
}

/// One message that was not delivered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeadLetter {
    /// To whom it went.
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
    /// To whom they went.
    pub object: ObjectName,
    /// The name of their contract.
    pub contract: Cow<'static, str>,
    /// Why they did not arrive.
    pub reason: DeadReason,
    /// How many.
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

/// The record of all that was not delivered.
#[derive(Debug, Default)]
pub struct DeadLetters {
    limits: DeadLetterLimits,
    counts: BTreeMap<(ObjectName, Cow<'static, str>, DeadReason), u64>,
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
        let key = (letter.object.clone(), letter.contract.clone(), letter.reason);
        let room = self.counts.len() < self.limits.counts;
        match self.counts.get_mut(&key) {
            Some(count) => *count += 1,
            None if room => {
                self.counts.insert(key, 1);
            }
            None => self.beyond += 1,
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

    /// The counts, by object, contract and reason.
    pub fn counts(&self) -> impl Iterator<Item = DeadLetterCount> + '_ {
        self.counts.iter().map(|((object, contract, reason), count)| DeadLetterCount {
            object: object.clone(),
            contract: contract.clone(),
            reason: *reason,
            count: *count,
        })
    }

    /// How many messages to `object` were not delivered for this reason.
    pub fn count(&self, object: &ObjectName, reason: DeadReason) -> u64 {
        let of = |key: &(ObjectName, _, DeadReason)| key.0 == *object && key.2 == reason;
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
        let object = ObjectName::new("arm").unwrap();
        DeadLetter { object, contract: contract.into(), reason, at: Instant::from_millis(millis) }
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
    fn every_reason_has_a_text_of_its_own() {
        let whys = [
            (Why::Full, DeadReason::Full),
            (Why::Restarting, DeadReason::Full),
            (Why::Stopped, DeadReason::Stopped),
            (Why::PeerDied { incarnation: crate::Incarnation(1) }, DeadReason::PeerDied),
            (Why::Expired, DeadReason::Expired),
            (Why::DeadlinePassed, DeadReason::DeadlinePassed),
            (Why::Quarantined { kills: 3 }, DeadReason::Quarantined),
            (Why::Isolated, DeadReason::Isolated),
            (Why::Fenced, DeadReason::Refused),
        ];
        for (why, reason) in whys {
            assert_eq!(DeadReason::from(&why), reason);
        }
    }
}
