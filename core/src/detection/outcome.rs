//! What becomes of a fault after it was found.

use crate::{Fault, FaultId, FaultLocation, Instant, Severity};
use std::fmt;
use std::time::Duration;

/// A step of recovery that the recoverer reports to the detector, for the record.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RecoveryOutcome {
    /// A recovery action was chosen.
    Decided {
        /// Which, as a person reads it: "restart", "re-route".
        action: String,
    },
    /// The action that was chosen has not helped. Another attempt, or another action, follows.
    Failed {
        /// Which, as in `Decided`.
        action: String,
        /// Why the action has not helped.
        reason: String,
    },
    /// Service is restored.
    Recovered,
    /// Nothing more is done: the incarnation that an action has begun waits for something that is
    /// not there yet. The fault stands until it is at work.
    Waits,
    /// Nothing more will be tried; what is left is safe state.
    GaveUp {
        /// Why recovery ends.
        reason: String,
    },
}

/// One step in the history of a fault, as reported to subscribers.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum FaultTransition {
    /// The fault was found.
    Found,
    /// The fault was observed again while open; reported at powers of two, so that a storm stays
    /// readable.
    Repeated,
    /// The fault proved to be a symptom: [`Fault::symptom_of`] now names the root. Where it names
    /// none, the fault was taken for a symptom, and is a root.
    Explained,
    /// A recovery action was chosen.
    Decided {
        /// Which one, for display.
        action: String,
    },
    /// A recovery action has not helped; another attempt, or another action, follows.
    Failed {
        /// Which one, for display.
        action: String,
        /// Why: what the strategy said, or what it panicked with.
        reason: String,
    },
    /// Service is restored. Of an object, the fault is over; of a link or a node it stands until
    /// [`Cleared`](FaultTransition::Cleared): see [`Fault::is_repaired_by_recovery`].
    Recovered,
    /// Nothing more will be tried.
    GaveUp {
        /// Why recovery ends.
        reason: String,
    },
    /// Its cause is away: it went by itself, or the part was repaired.
    Cleared,
}

/// A message from the detector to the notifier, which forwards it to every recoverer.
#[derive(Clone, Debug, PartialEq)]
pub enum FaultNotice {
    /// A fault was found.
    Found(Fault),
    /// It went away by itself: what is not yet under way for it need not begin.
    Cleared {
        /// The number of the fault.
        id: FaultId,
        /// Where it was.
        location: FaultLocation,
    },
}

impl fmt::Display for FaultNotice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            FaultNotice::Found(fault) => write!(f, "{} of {}", fault.kind, fault.location),
            FaultNotice::Cleared { location, .. } => write!(f, "the end of a fault of {location}"),
        }
    }
}

impl FaultNotice {
    /// Which fault it is about.
    pub fn id(&self) -> FaultId {
        match self {
            FaultNotice::Found(fault) => fault.id,
            FaultNotice::Cleared { id, .. } => *id,
        }
    }

    /// The order in which notices that wait are handed over: what is over, so that no recoverer
    /// acts upon it; then critical faults, errors, warnings; of each the roots first.
    pub fn rank(&self) -> u8 {
        let FaultNotice::Found(fault) = self else { return 0 };
        let severity = match fault.severity {
            Severity::Critical => 1,
            Severity::Error => 3,
            Severity::Warning => 5,
        };
        severity + u8::from(fault.symptom_of.is_some())
    }
}

/// A fault and what became of it, with the instants.
///
/// That service is restored and that the part is repaired are two facts. A cable that is out stays
/// a standing fault while its traffic takes another path:
/// [`recovered_at`](FaultEntry::recovered_at) is set, [`repaired_at`](FaultEntry::repaired_at) is
/// not. See [`Fault::is_repaired_by_recovery`].
#[derive(Clone, Debug, PartialEq)]
pub struct FaultEntry {
    /// The fault; [`Fault::found_at`] is when it was found, and [`Fault::detail`] the newest one.
    pub fault: Fault,
    /// The detail with which it was found, where the newest is another one.
    pub first_detail: Option<String>,
    /// The action that was chosen last, and when.
    pub decided: Option<(Instant, String)>,
    /// When service was restored.
    pub recovered_at: Option<Instant>,
    /// When the cause was away. Until then the fault stands.
    pub repaired_at: Option<Instant>,
    /// When and why the recoverer ceased to try. The fault still stands until its place begins a
    /// new incarnation.
    pub given_up: Option<(Instant, String)>,
    /// It may turn out to be a symptom.
    pub(super) explicable: bool,
    /// The notifier knows of it, and does not know it to be over.
    pub(super) handed: bool,
    /// It stands, and no recoverer treats it: a symptom behind what keeps its thread, which was
    /// only reported, or a fault whose next incarnation is on its way already.
    pub(super) unhanded: bool,
    /// When it is over, unless the next incarnation of its object has begun.
    pub(super) end_due: Option<Instant>,
}

impl FaultEntry {
    /// An entry for a fault that was just found.
    pub fn new(fault: Fault) -> Self {
        FaultEntry {
            fault,
            first_detail: None,
            decided: None,
            recovered_at: None,
            repaired_at: None,
            given_up: None,
            explicable: false,
            handed: false,
            unhanded: false,
            end_due: None,
        }
    }

    /// Whether the cause is not known to be away.
    pub fn stands(&self) -> bool {
        self.repaired_at.is_none()
    }

    /// How the fault is, in one word.
    pub fn status(&self) -> FaultStatus {
        if self.repaired_at.is_some() {
            FaultStatus::Closed
        } else if self.recovered_at.is_some() {
            FaultStatus::Recovered
        } else if self.given_up.is_some() {
            FaultStatus::GivenUp
        } else {
            FaultStatus::Open
        }
    }

    /// How long it took from finding the fault to restored service, if service was restored.
    pub fn recovered_after(&self) -> Option<Duration> {
        self.recovered_at.map(|at| at - self.fault.found_at)
    }

    /// How long the fault stood, if it is over.
    pub fn repaired_after(&self) -> Option<Duration> {
        self.repaired_at.map(|at| at - self.fault.found_at)
    }
}

/// How a fault is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum FaultStatus {
    /// The fault is open, and service is not restored.
    Open,
    /// The fault is open, and the recoverer has given it up.
    GivenUp,
    /// Service is restored; the part is not repaired.
    Recovered,
    /// The cause is away.
    Closed,
}

impl fmt::Display for FaultStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            FaultStatus::Open => "open",
            FaultStatus::GivenUp => "given up",
            FaultStatus::Recovered => "recovered",
            FaultStatus::Closed => "closed",
        })
    }
}

/// The record of faults, as it is read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FaultRecord {
    /// Each root in the order in which they were found, each followed by its symptoms.
    pub entries: Vec<FaultEntry>,
    /// How many older entries had to make room.
    pub dropped: u64,
}
