//! When to ask again about a fault that is not decided.

use crate::{FaultId, Instant};
use std::collections::{BTreeMap, BTreeSet};

/// When to remind of which fault that is not decided: one reminder per fault.
#[derive(Clone, Debug, Default)]
pub(super) struct DecisionTimeouts {
    agenda: BTreeSet<(Instant, FaultId)>,
    by_fault: BTreeMap<FaultId, DecisionTimeout>,
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
