//! How variables are asked for, in this process and from other nodes alike.

use super::RestoreDecision;
use crate::registry::encoding::OtherContract;
use blastema_core::ObjectName;
use blastema_core::variables::ValueReport;
use blastema_macros::{Request, Structure};
use std::time::Duration;

/// What is wanted of a node's variables. It is asked at any object of the node that has some.
#[derive(Clone, Debug, Request)]
#[contract(
    crate = "crate",
    name = "blastema/variables",
    version = 5,
    reply = Result<ValueReport, OtherContract>,
    max_size = 1024 * 1024
)]
pub(crate) enum VariableRequest {
    /// What the variable is now.
    Read { variable: VariableSelector },
    /// What it is once its revision is another than `after`.
    Watch { variable: VariableSelector, after: u64 },
    /// The values decide what becomes of variables that await it, or none of them does. The answer
    /// to a write has the new revision, and no value.
    Write { writes: Vec<WriteEntry>, decides: bool },
}

/// A variable, and what its value is taken for.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) struct VariableSelector {
    pub(crate) object: ObjectName,
    /// The contract's name, version and fingerprint.
    pub(crate) identity: Vec<u8>,
}

/// One value to be written.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) struct WriteEntry {
    pub(crate) variable: VariableSelector,
    pub(crate) value: RestoreDecision<Vec<u8>>,
    pub(crate) if_revision: Option<u64>,
}

/// How long a watcher waits before it asks again, so that one who has gone is not kept for ever.
pub(crate) const WATCH_WITHIN: Duration = Duration::from_secs(3);
