//! What others may say to, and ask of, the detector.

use actix::{Message, Recipient};
use blastema_core::detection::{FaultRecord, FaultTransition, RecoveryOutcome};
use blastema_core::{Fault, FaultId, Instant};

/// The recoverer tells what becomes of a fault.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct FaultOutcome {
    /// The fault that the outcome belongs to.
    pub id: FaultId,
    /// When it was so, on this node's clock.
    pub at: Instant,
    /// The outcome of its recovery.
    pub what: RecoveryOutcome,
}

/// Asks for the record of faults, roots before their symptoms.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "FaultRecord")]
pub struct ReadRecord;

/// From now on, every [`FaultEvent`] goes to this listener too, until its mailbox closes.
#[derive(Clone, Message)]
#[rtype(result = "()")]
pub struct Subscribe(pub Recipient<FaultEvent>);

/// One step in the history of a fault.
#[derive(Clone, Debug, PartialEq, Message)]
#[rtype(result = "()")]
pub struct FaultEvent {
    /// The fault, as it now stands.
    pub fault: Fault,
    /// When it was so.
    pub at: Instant,
    /// The step that the fault has taken.
    pub turn: FaultTransition,
}
