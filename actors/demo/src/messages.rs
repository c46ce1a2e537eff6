//! What the director asks of the modules.

use blastema::prelude::*;
use blastema::{FaultId, FaultKind, FaultLocation};

/// The spans from the publisher of an event to a listener without a condition.
pub(crate) const UNFILTERED: &str = "event, unfiltered";
/// The same to a listener with a condition.
pub(crate) const FILTERED: &str = "event, filtered";

/// Injects a fault of [`FAULTS`](crate::faults::FAULTS), or plugs in again the cables that it has
/// cut. The answer is the instant at which it was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Request)]
#[contract(name = "demo/strike", reply = Result<u64, String>)]
pub(crate) struct Strike {
    /// Its place in the list.
    pub(crate) fault: u32,
    /// It is to be repaired.
    pub(crate) repair: bool,
}

/// Asks how the module is.
#[derive(Clone, Copy, Debug, Request)]
#[contract(name = "demo/look", reply = ModuleReport, max_size = 262144)]
pub(crate) struct ReadModule {
    /// From when on messages must have been sent to count as `passed`, in nanoseconds.
    pub(crate) since: u64,
}

/// How a module is.
#[derive(Clone, Debug, Default, Structure)]
pub(crate) struct ModuleReport {
    /// When its process began, in nanoseconds of the computer's clock: no two have the same.
    pub(crate) process: u64,
    /// When this was seen.
    pub(crate) at: u64,
    /// From when on messages were to be sent to count as `passed`.
    pub(crate) since: u64,
    /// The cables that end here, and whether each is up.
    pub(crate) cables: Vec<(String, bool)>,
    /// The flows that begin here.
    pub(crate) sources: Vec<SourceReport>,
    /// The flows that end here.
    pub(crate) sinks: Vec<SinkReport>,
    /// What was measured since the last report, in nanoseconds, by its name.
    pub(crate) measured: Vec<(String, Vec<u64>)>,
    /// The record of faults.
    pub(crate) faults: Vec<FaultReport>,
    /// The fault after which an object was last seen to answer again, and when.
    pub(crate) served: Option<(u32, u64)>,
}

/// The sending end of a flow.
#[derive(Clone, Debug, Default, PartialEq, Structure)]
pub(crate) struct SourceReport {
    pub(crate) flow: String,
    /// How many messages the middleware has accepted.
    pub(crate) sent: u64,
    /// How many of them are dead letters because the receiver, or its process, had died.
    pub(crate) perished: u64,
    /// How many of them are dead letters for another reason.
    pub(crate) returned: u64,
}

/// The receiving end of a flow.
#[derive(Clone, Debug, Default, PartialEq, Structure)]
pub(crate) struct SinkReport {
    pub(crate) flow: String,
    /// The process of the source; 0 before the first message.
    pub(crate) source: u64,
    /// The first number that came from that process.
    pub(crate) first: u64,
    /// The highest number that came from it.
    pub(crate) highest: u64,
    /// How many numbers were left out.
    pub(crate) missing: u64,
    /// How many numbers came that had come, or had been left out, before.
    pub(crate) doubled: u64,
    /// When the first message arrived that was sent since the instant of the question.
    pub(crate) passed: Option<u64>,
}

/// An entry of a node's record of faults.
#[derive(Clone, Debug, PartialEq, Structure)]
pub(crate) struct FaultReport {
    pub(crate) id: FaultId,
    pub(crate) kind: FaultKind,
    pub(crate) location: FaultLocation,
    /// When it was found, in nanoseconds.
    pub(crate) found_at: u64,
    pub(crate) detail: String,
    /// The fault that it is a consequence of.
    pub(crate) symptom_of: Option<FaultId>,
    /// Service is restored, or the cause is away.
    pub(crate) recovered: bool,
    /// Why nothing more is tried.
    pub(crate) given_up: Option<String>,
}

impl FaultReport {
    /// Returns whether it is a warning: on a busy machine hellos arrive late and rounds are missed,
    /// which is not a fault of the robot.
    pub(crate) fn is_warning(&self) -> bool {
        matches!(self.kind, FaultKind::LinkDegraded | FaultKind::Overload)
    }
}
