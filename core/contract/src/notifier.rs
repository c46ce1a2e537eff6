//! What others may say to, and ask of, the notifier.
//!
//! ```text
//! Notifier ──Recover, CancelRecovery──► local recoverer
//!    ├────── the same ───────────────► node 2's recoverer
//!    └────── the same ───────────────► node 3's recoverer
//! ```

use crate::recoverer::{CancelRecovery, Recover};
use actix::{Message, Recipient};
use blastema_core::detection::RecovererPort;

/// Hands every fault to this recoverer too. Sent again for a known port, it replaces the recipients
/// and keeps what waits.
#[derive(Clone, Message)]
#[rtype(result = "()")]
pub struct AddPort {
    /// The port that the recoverer serves.
    pub port: RecovererPort,
    /// Takes the faults.
    pub recover: Recipient<Recover>,
    /// Is told when one is over, if it cares.
    pub stand_down: Option<Recipient<CancelRecovery>>,
}
