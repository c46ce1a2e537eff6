//! Whether a device has the expected ports: its table, record by record.

use crate::message::Status;
use crate::port::{Port, PortSet};

/// Why a device is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mismatch {
    /// It has this type. Another device is connected, or another firmware runs.
    Type(u32),
    /// The port with this index has another size or fingerprint than expected, those of this
    /// record: firmware and robot were built from different contracts.
    Port(usize, Port),
    /// The port with this index is missing.
    Missing(usize),
}

/// How far the comparison is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Matching {
    index: u8,
    matched: PortSet,
}

/// What a record has led to.
pub(super) enum MatchingStep {
    Next,
    Right,
    Wrong(Mismatch),
}

impl Matching {
    /// The index that is asked for.
    pub(super) fn index(&self) -> u8 {
        self.index
    }

    /// Takes an answer without the index; `None` if it is none.
    pub(super) fn record(&mut self, expected: &[Port], data: &[u8]) -> Option<MatchingStep> {
        let &[object, id, size, f0, f1, f2, f3] = data else {
            return (*data == [Status::End as u8]).then(|| self.end(expected));
        };
        let fingerprint = u32::from_le_bytes([f0, f1, f2, f3]);
        if let Some(at) = Port::find(expected, object, id) {
            if (expected[at].size(), expected[at].fingerprint()) != (size, fingerprint) {
                let record = Port::from_record(object, id, size, fingerprint);
                return Some(MatchingStep::Wrong(Mismatch::Port(at, record)));
            }
            self.matched.insert(at);
        }
        let Some(next) = self.index.checked_add(1) else { return Some(self.end(expected)) };
        self.index = next;
        Some(MatchingStep::Next)
    }

    /// A chip that is too small for a port table has an empty one: then its type alone must match.
    fn end(&self, expected: &[Port]) -> MatchingStep {
        let missing = (0..expected.len()).find(|port| !self.matched.contains(*port));
        match missing.filter(|_| self.index > 0) {
            Some(port) => MatchingStep::Wrong(Mismatch::Missing(port)),
            None => MatchingStep::Right,
        }
    }
}
