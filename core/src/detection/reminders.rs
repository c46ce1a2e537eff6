//! When to ask again about a fault that is not decided.

use crate::sorted::{SortedMap, SortedSet};
use crate::{FaultId, Instant};

/// When to remind of which fault that is not decided: one reminder per fault.
#[derive(Clone, Debug, Default)]
pub(super) struct DecisionTimeouts {
    agenda: SortedSet<(Instant, FaultId)>,
    by_fault: SortedMap<FaultId, DecisionTimeout>,
    /// The latest decision for each rank of faults: when, and about which.
    decided: SortedMap<u8, (Instant, FaultId)>,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct DecisionTimeout {
    pub(super) due: Instant,
    /// How many were sent before this one.
    pub(super) sent: u32,
}

impl DecisionTimeouts {
    /// When the next one is due.
    pub(super) fn next(&self) -> Option<Instant> {
        self.agenda.first().map(|&(due, _)| due)
    }

    pub(super) fn set(&mut self, id: FaultId, reminder: DecisionTimeout) {
        self.cancel(id);
        self.agenda.insert((reminder.due, id));
        self.by_fault.insert(id, reminder);
    }

    /// A recoverer has said something about a fault. What it says about one on which it has decided
    /// before is not progress.
    pub(super) fn handle_outcome(&mut self, rank: u8, id: FaultId, at: Instant) {
        if self.by_fault.contains_key(&id) {
            self.decided.insert(rank, (at, id));
        }
        self.cancel(id);
    }

    /// When a recoverer last decided about a fault that goes before this one: since then this one
    /// waits in vain. One that was overtaken is not in the queue.
    pub(super) fn progress_towards(&self, rank: u8, id: FaultId) -> Option<Instant> {
        let decided = self.decided.iter().map(|(&of, &(at, last))| (at, (of, last)));
        decided.filter(|&(_, last)| last < (rank, id)).map(|(at, _)| at).max()
    }

    pub(super) fn cancel(&mut self, id: FaultId) {
        if let Some(reminder) = self.by_fault.remove(&id) {
            self.agenda.remove(&(reminder.due, id));
        }
    }

    pub(super) fn pop_due(&mut self, now: Instant) -> Option<(FaultId, DecisionTimeout)> {
        let &(due, id) = self.agenda.first()?;
        if due > now {
            return None;
        }
        self.agenda.pop_first();
        Some((id, self.by_fault.remove(&id)?))
    }
}
