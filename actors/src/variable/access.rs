//! How variables are asked for, in this process and from other nodes alike.

use crate::registry::encoding::OtherContract;
use blastema_core::ObjectName;
use blastema_core::variables::ValueReport;
use blastema_macros::{Request, Structure};
use std::time::Duration;

/// What is wanted of a variable. It is asked at the object that owns it.
#[derive(Clone, Debug, Request)]
#[contract(
    crate = "crate",
    name = "blastema/variables",
    version = 5,
    reply = Result<ValueReport, OtherContract>,
    max_size = 1024 * 1024
)]
pub(crate) struct VariableRequest {
    pub(crate) object: ObjectName,
    /// What its value is taken for: the contract's name, version and fingerprint.
    pub(crate) identity: Vec<u8>,
    pub(crate) wish: VariableWish,
}

#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) enum VariableWish {
    Read,
    Watch { after: u64 },
    Write { value: Vec<u8>, if_revision: Option<u64> },
}

/// How long a watcher waits before it asks again, so that one who has gone is not kept for ever.
pub(crate) const WATCH_WITHIN: Duration = Duration::from_secs(3);
