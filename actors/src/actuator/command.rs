//! The messages between a commander and an actuator's node.

use crate::registry::encoding::OtherContract;
use blastema_macros::{Request, Structure};

/// What a commander wants. It is asked at the actuator's name.
#[derive(Clone, Debug, Request)]
#[contract(
    crate = "crate",
    name = "blastema/command",
    version = 4,
    reply = Result<CommandDone, OtherContract>,
    max_size = 1024 * 1024
)]
pub(crate) struct ActuatorCommand {
    /// Name, version and fingerprint of the actuator's contract.
    pub(crate) identity: Vec<u8>,
    pub(crate) wish: CommandKind,
}

/// Which. A command says how old the data is that it was made from, and how long the way takes at
/// most.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) enum CommandKind {
    Claim { commander: String, incarnation: u64 },
    Renew { epoch: u64 },
    Release { epoch: u64 },
    Command { epoch: u64, age_us: u64, way_us: u64, message: Vec<u8> },
}

/// What came of it: the lease that a claim was granted, or the actuator's reply to a command.
#[derive(Clone, Debug, Default, Structure)]
#[contract(crate = "crate")]
pub(crate) struct CommandDone {
    pub(crate) epoch: u64,
    pub(crate) span_us: u64,
    pub(crate) reply: Vec<u8>,
}
