//! What the notifier hands over to a recoverer.

use crate::Confirmed;
use actix::Message;
use blastema_core::{Fault, FaultId, FaultLocation};

/// A fault was found: do about it what the plan says. Repeated until it is confirmed; a recoverer
/// that already has it confirms again and does nothing.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Confirmed")]
pub struct Recover {
    /// The fault that is to be recovered from.
    pub fault: Fault,
}

/// From the controller: whether recovery is possible in this node.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub enum SafeStateChanged {
    /// The node enters the safe state: its safe outputs are being applied, and nothing is treated
    /// any more.
    Entering,
    /// The node has entered the safe state.
    Entered {
        /// Why the node has entered it, for display.
        reason: String,
    },
    /// The node goes to work again.
    Left,
    /// The node was told to stop: what ends is not restarted.
    NodeEnds,
}

/// A fault has gone by itself: what is not yet under way for it need not begin.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Confirmed")]
pub struct CancelRecovery {
    /// The fault's number in its finder's record.
    pub id: FaultId,
    /// Where it was.
    pub location: FaultLocation,
}
