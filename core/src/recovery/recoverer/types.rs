//! Outputs, inputs and limits of a recoverer.

use super::RecoveryAction;
use crate::detection::RecoveryOutcome;
use crate::{Fault, FaultId, Incarnation};
use std::time::Duration;

/// An order to execute one recovery action.
#[derive(Clone, Debug, PartialEq)]
pub struct RecoveryOrder {
    /// The order's number at its recoverer.
    pub number: u64,
    /// The action to execute.
    pub action: RecoveryAction,
    /// Against what. Of several faults of one place it is one of the newest incarnation: the one
    /// that says that it does not answer, or else the first.
    pub fault: Fault,
    /// The number of this attempt at the action, from 1.
    pub attempt: u32,
    /// How long it is given. After that it has failed.
    pub within: Duration,
}

/// An action has worked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RecoveryDone {
    /// The incarnation that is at work because of it, if it began one.
    pub incarnation: Option<Incarnation>,
    /// That incarnation waits for something that is not there yet, such as a device, and tries
    /// again by itself. It has recovered when it is at work.
    pub waits: bool,
    /// No incarnation follows: its end was final, as its rules say. Service is not restored.
    pub finished: bool,
}

/// An action has not worked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecoveryFailed {
    /// Why the action failed, for display.
    pub reason: String,
    /// Another attempt cannot help either: the next step of the ladder follows at once.
    pub is_final: bool,
}

impl<T: Into<String>> From<T> for RecoveryFailed {
    fn from(reason: T) -> Self {
        RecoveryFailed { reason: reason.into(), is_final: false }
    }
}

/// An output of a recoverer.
#[derive(Clone, Debug, PartialEq)]
pub enum RecovererOutput {
    /// Have this order carried out, by the strategy of the action's name.
    CarryOut(RecoveryOrder),
    /// Tell the detector, which has found it.
    Settle {
        /// The fault's number in the detector's record.
        fault: FaultId,
        /// What became of it.
        outcome: RecoveryOutcome,
    },
    /// The node is in the safe state, or ends, and this incarnation keeps its thread, or stands
    /// still behind the one that does: have it given up, so that no component that stops waits for
    /// it.
    AbandonIncarnation {
        /// The hang of that incarnation.
        fault: Fault,
    },
    /// Not even safe stop could be carried out: the whole node enters the safe state.
    LastResort {
        /// The fault that could not be contained.
        fault: Fault,
        /// What safe stop said.
        reason: String,
    },
}

/// Open cases. More places than this at once, and further ones are given up loudly; as many as a
/// large node has objects.
pub const CASES_MAX: usize = 4096;
/// Symptoms that wait for their roots. More, and a symptom is acted upon at once.
pub(super) const SYMPTOMS_MAX: usize = 4096;
/// From the root's recovery to acting upon a symptom that was not cleared. Longer leaves victims
/// more time to come back by themselves.
pub(super) const GRACE: Duration = Duration::from_millis(200);
/// A fault that returns within this time after a reset, or a strategy of the application's own, had
/// cured it is not treated from the beginning but goes on up its ladder.
pub(super) const MEMORY: Duration = Duration::from_secs(10);
