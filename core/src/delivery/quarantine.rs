//! Which messages kill their receivers.
//!
//! A message dies with the incarnation that it kills, so only one that is sent again can kill
//! again. It is known by its sender and its number there: other messages of the same contract are
//! not blamed.

use crate::Incarnation;
use crate::sorted::SortedMap;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::fmt;

/// Which message it is, however often it is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct MessageId {
    /// The first sender; unique in the robot.
    pub sender: u64,
    /// Its number among that sender's messages.
    pub sequence: u64,
}

impl fmt::Display for MessageId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:x}/{}", self.sender, self.sequence)
    }
}

/// When a message is quarantined, and how many are remembered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QuarantineConfig {
    /// Incarnations that a message may end before it is no longer let in. Two may be chance; a
    /// higher number costs more restarts.
    pub kills: u32,
    /// Messages remembered for one receiver; the one whose last kill is longest ago is forgotten
    /// first. Each costs about a hundred bytes.
    pub remembered: usize,
}

impl Default for QuarantineConfig {
    fn default() -> Self {
        QuarantineConfig { kills: 3, remembered: 256 }
    }
}

/// The messages that have killed incarnations of one receiver.
#[derive(Debug, Default)]
pub struct Quarantine {
    config: QuarantineConfig,
    kills: SortedMap<MessageId, Kills>,
    /// From the longest ago to the latest.
    order: VecDeque<MessageId>,
}

#[derive(Debug)]
struct Kills {
    count: u32,
    last: Incarnation,
}

impl Quarantine {
    /// Remembers nothing yet.
    pub fn new(config: QuarantineConfig) -> Self {
        Quarantine { config, ..Quarantine::default() }
    }

    /// This incarnation ended while it served this message. Says how many incarnations the message
    /// has ended.
    pub fn handle_kill(&mut self, message: MessageId, incarnation: Incarnation) -> u32 {
        let kills = self.kills.entry(message).or_insert(Kills { count: 0, last: Incarnation(0) });
        // An incarnation ends once, whichever object reports it.
        if kills.last != incarnation {
            *kills = Kills { count: kills.count + 1, last: incarnation };
        }
        let count = kills.count;
        self.order.retain(|known| *known != message);
        self.order.push_back(message);
        while self.order.len() > self.config.remembered {
            if let Some(forgotten) = self.order.pop_front() {
                self.kills.remove(&forgotten);
            }
        }
        count
    }

    /// How many incarnations this message has ended, if it is too many.
    pub fn refuses(&self, message: MessageId) -> Option<u32> {
        let kills = self.kills.get(&message)?;
        (kills.count >= self.config.kills).then_some(kills.count)
    }

    /// Whether any message is refused.
    pub fn is_active(&self) -> bool {
        self.kills.values().any(|kills| kills.count >= self.config.kills)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(sequence: u64) -> MessageId {
        MessageId { sender: 1, sequence }
    }

    #[test]
    fn a_message_that_killed_three_incarnations_is_refused_and_no_other() {
        let mut quarantine = Quarantine::default();
        assert_eq!(quarantine.handle_kill(message(1), Incarnation(1)), 1);
        assert_eq!(quarantine.handle_kill(message(2), Incarnation(2)), 1);
        assert_eq!(quarantine.handle_kill(message(1), Incarnation(3)), 2);
        assert!(!quarantine.is_active());
        assert_eq!(quarantine.refuses(message(1)), None);

        assert_eq!(quarantine.handle_kill(message(1), Incarnation(4)), 3);

        assert!(quarantine.is_active());
        assert_eq!(quarantine.refuses(message(1)), Some(3));
        assert_eq!(quarantine.refuses(message(2)), None);
        assert_eq!(quarantine.refuses(message(3)), None);
    }

    #[test]
    fn a_death_that_is_reported_twice_counts_once() {
        let mut quarantine = Quarantine::default();
        quarantine.handle_kill(message(1), Incarnation(1));
        assert_eq!(quarantine.handle_kill(message(1), Incarnation(1)), 1);
    }

    #[test]
    fn the_message_whose_last_kill_is_longest_ago_is_forgotten_first() {
        let config = QuarantineConfig { kills: 1, remembered: 2 };
        let mut quarantine = Quarantine::new(config);
        quarantine.handle_kill(message(1), Incarnation(1));
        quarantine.handle_kill(message(2), Incarnation(2));
        quarantine.handle_kill(message(1), Incarnation(3));

        quarantine.handle_kill(message(3), Incarnation(4));

        assert_eq!(quarantine.refuses(message(2)), None);
        assert_eq!(quarantine.refuses(message(1)), Some(2));
        assert_eq!(quarantine.refuses(message(3)), Some(1));
    }
}
