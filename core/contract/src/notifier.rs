//! What others may say to, and ask of, the notifier.
//!
//! ```text
//! Detector ──FaultFound, FaultCleared──► Notifier ──Recover, StandDown──► local recoverer
//!                                            ├────── the same ──────────► node 2's recoverer
//!                                            └────── the same ──────────► node 3's recoverer
//! ```

use crate::Confirmed;
use crate::recoverer::{CancelRecovery, Recover};
use actix::{Message, Recipient};
use blastema_core::detection::{RecovererPort, RecovererPortRow};
use blastema_core::{Fault, FaultId, FaultLocation};

/// The detector hands a fault over, and repeats it until it is confirmed.
#[derive(Clone, Debug, PartialEq, Message)]
#[rtype(result = "Confirmed")]
pub struct FaultFound {
    /// The fault.
    pub fault: Fault,
}

/// A fault is over, by whatever means: nothing more needs to be done about it.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Confirmed")]
pub struct FaultCleared {
    /// Which.
    pub id: FaultId,
    /// Where it was.
    pub location: FaultLocation,
}

/// Hands every fault to this recoverer too. Sent again for a known port, it replaces the recipients
/// and keeps what waits.
#[derive(Clone, Message)]
#[rtype(result = "()")]
pub struct AddPort {
    /// Whose recoverer it is.
    pub port: RecovererPort,
    /// Takes the faults.
    pub recover: Recipient<Recover>,
    /// Is told when one is over, if it cares.
    pub stand_down: Option<Recipient<CancelRecovery>>,
}

/// Forgets a port, with what waits there.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct RemovePort {
    /// Which.
    pub port: RecovererPort,
}

/// Asks how the hand-overs stand, port by port.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Vec<RecovererPortRow>")]
pub struct ReadPorts;
