//! The replies of a service, for requests that are sent again.

use super::message::Served;
use crate::MessageId;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// The most replies that are kept: several times as many as callers can have in flight.
pub const TABLE_MAX: usize = 1024;
/// The most bytes of the replies, without the newest one. Together with the largest state they fit
/// into one message.
const TABLE_BYTES_MAX: usize = 768 * 1024;
/// The most callers whose received replies are known. Beyond, the caller that was silent longest is
/// forgotten.
const CALLERS_MAX: usize = 256;
/// The approximate bytes of an entry beside its reply.
const ENTRY: usize = 32;

/// The table of replies of one service.
///
/// Each request carries the number below which its caller has received all replies. The table drops
/// those replies, and a request below that number is late and is not served again.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Table {
    served: VecDeque<Served>,
    /// The number below which each caller has received its replies. The caller that sent last is
    /// last.
    settled: VecDeque<(u64, u64)>,
}

impl Table {
    pub(super) fn find(&self, id: MessageId) -> Option<&Served> {
        self.served.iter().rev().find(|served| served.id == id)
    }

    /// Returns whether the caller has received the reply to this request.
    pub(super) fn is_settled(&self, id: MessageId) -> bool {
        let settled = self.settled.iter().find(|(sender, _)| *sender == id.sender);
        settled.is_some_and(|(_, below)| id.sequence < *below)
    }

    /// The caller has received all replies below this number.
    pub(super) fn settle(&mut self, sender: u64, below: u64) {
        let known = self.settled.iter().position(|(known, _)| *known == sender);
        let before = known.and_then(|at| self.settled.remove(at)).map_or(0, |(_, below)| below);
        let below = below.max(before);
        if below == 0 {
            return;
        }
        if self.settled.len() >= CALLERS_MAX {
            self.settled.pop_front();
        }
        self.settled.push_back((sender, below));
        if below > before {
            self.served.retain(|served| served.id.sender != sender || served.id.sequence >= below);
        }
    }

    pub(super) fn note(&mut self, served: Served) {
        self.served.push_back(served);
        let mut bytes: usize = self.served.iter().map(bytes_of).sum();
        while self.served.len() > TABLE_MAX || (bytes > TABLE_BYTES_MAX && self.served.len() > 1) {
            bytes -= self.served.pop_front().as_ref().map_or(0, bytes_of);
        }
    }

    pub(super) fn clear(&mut self) {
        self.served.clear();
    }

    /// Returns a table received from another replica, cut to this replica's bounds.
    pub(super) fn bounded(mut self) -> Self {
        let over = self.served.len().saturating_sub(TABLE_MAX);
        self.served.drain(..over);
        let over = self.settled.len().saturating_sub(CALLERS_MAX);
        self.settled.drain(..over);
        self
    }
}

fn bytes_of(served: &Served) -> usize {
    ENTRY + served.result.as_ref().map_or(0, Vec::len)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DeliveryError;

    fn served(sender: u64, sequence: u64, length: usize) -> Served {
        Served { id: MessageId { sender, sequence }, result: Ok(vec![7; length]) }
    }

    #[test]
    fn what_a_caller_has_got_is_forgotten_and_not_served_again() {
        let mut table = Table::default();
        (1..=10).for_each(|sequence| table.note(served(1, sequence, 8)));
        table.note(served(2, 1, 8));

        table.settle(1, 9);
        table.settle(1, 4);

        assert_eq!(table.served.len(), 3);
        let id = |sender, sequence| MessageId { sender, sequence };
        assert!(table.is_settled(id(1, 8)) && !table.is_settled(id(1, 9)));
        assert!(!table.is_settled(id(2, 1)), "another caller has received none");
        assert!(table.find(id(1, 9)).is_some() && table.find(id(1, 8)).is_none());
    }

    #[test]
    fn replies_are_bounded_by_number_and_bytes_and_callers_by_number() {
        let mut table = Table::default();
        (0..2000).for_each(|sequence| table.note(served(1, sequence, 8)));
        assert_eq!(table.served.len(), TABLE_MAX);
        (0..100).for_each(|sequence| table.note(served(2, sequence, 100_000)));
        assert_eq!(table.served.len(), 7);
        table.note(served(3, 1, 2_000_000));
        assert_eq!(table.served.len(), 1, "the newest is kept whatever its size");
        table.note(Served {
            id: MessageId { sender: 4, sequence: 1 },
            result: Err(DeliveryError::Stopped),
        });

        (0..1000).for_each(|sender| table.settle(sender, 5));
        assert_eq!(table.settled.len(), CALLERS_MAX);
        assert!(table.is_settled(MessageId { sender: 999, sequence: 4 }));
        assert_eq!(table.clone().bounded(), table);
    }
}
