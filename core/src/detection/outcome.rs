//! What becomes of a fault after it was found.

use crate::{Fault, FaultId, Instant, Place, Severity};
use std::time::Duration;

/// What the recoverer tells the detector, for the record.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// A measure was chosen.
    Decided {
        /// Which, as a person reads it: "restart", "re-route".
        measure: String,
    },
    /// Service is restored.
    Recovered,
    /// Nothing more will be tried; what is left is safe rest.
    GaveUp {
        /// Why.
        reason: String,
    },
}

/// One step in the history of a fault, as subscribers are told it.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Turn {
    /// It was found.
    Found,
    /// It was seen again while it stood; told at powers of two, so that a storm stays readable.
    Repeated,
    /// It turned out to be a symptom: [`Fault::symptom_of`] now names the root.
    Explained,
    /// A measure was chosen.
    Decided {
        /// Which, as a person reads it.
        measure: String,
    },
    /// Service is restored.
    Recovered,
    /// Nothing more will be tried.
    GaveUp {
        /// Why.
        reason: String,
    },
    /// It went away by itself.
    Cleared,
}

/// What goes from the detector to the notifier, and on to every recoverer.
#[derive(Clone, Debug, PartialEq)]
pub enum Notice {
    /// A fault was found.
    Found(Fault),
    /// It went away by itself: what is not yet under way for it need not begin.
    Cleared {
        /// Which.
        id: FaultId,
        /// Where it was.
        place: Place,
    },
}

impl Notice {
    /// Which fault it is about.
    pub fn id(&self) -> FaultId {
        match self {
            Notice::Found(fault) => fault.id,
            Notice::Cleared { id, .. } => *id,
        }
    }

    /// The order in which notices that wait are handed over: what is over, so that nobody acts upon it;
    /// then critical faults, errors, warnings; of each the roots first.
    pub fn rank(&self) -> u8 {
        let Notice::Found(fault) = self else { return 0 };
        let severity = match fault.severity {
            Severity::Critical => 1,
            Severity::Error => 3,
            Severity::Warning => 5,
        };
        severity + u8::from(fault.symptom_of.is_some())
    }
}

/// A fault and what became of it, with the instants.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// The fault; [`Fault::found_at`] is when it was found.
    pub fault: Fault,
    /// The measure that was chosen last, and when.
    pub decided: Option<(Instant, String)>,
    /// How it ended, and when; `None` while it stands.
    pub ended: Option<(Instant, End)>,
}

impl Entry {
    /// How long it took from finding it to its recovery, if it was recovered.
    pub fn recovered_after(&self) -> Option<Duration> {
        match self.ended {
            Some((at, End::Recovered)) => Some(at - self.fault.found_at),
            _ => None,
        }
    }
}

/// How a fault ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// Service was restored by a measure.
    Recovered,
    /// It went away by itself.
    Cleared,
    /// Nothing more was tried. The fault still stands until its place begins a new life.
    GaveUp {
        /// Why.
        reason: String,
    },
}

/// The record of faults, as it is read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Record {
    /// Each root in the order in which they were found, each followed by its symptoms.
    pub entries: Vec<Entry>,
    /// How many older entries had to make room.
    pub dropped: u64,
}
