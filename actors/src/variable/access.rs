//! How variables are asked for, in this process and from other nodes alike.

use super::RestoreDecision;
use crate::messaging::error::encode_kind;
use blastema_core::variables::{ValueReport, ValueState};
use blastema_core::{DeliveryError, ObjectName};
use blastema_macros::{Request, Structure};
use std::time::Duration;

/// What is wanted of a node's variables. It is asked at any object of the node that has some.
#[derive(Clone, Debug, Request)]
#[contract(
    crate = "crate",
    name = "blastema/variables",
    version = 3,
    reply = VariableReply,
    max_size = 1024 * 1024
)]
pub(crate) enum VariableRequest {
    Read { variable: VariableSelector },
    Watch { variable: VariableSelector, after: u64 },
    Write { writes: Vec<WriteEntry> },
    Choose { variable: VariableSelector, choice: RestoreDecision<Vec<u8>> },
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
    pub(crate) value: Vec<u8>,
    pub(crate) if_revision: Option<u64>,
}

/// What came of it.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) enum VariableReply {
    Value {
        value: Vec<u8>,
        revision: u64,
        state: ValueState,
        age: Duration,
    },
    Revision(u64),
    /// The contract is another one here: this.
    Differs {
        identity: Vec<u8>,
    },
    Refused {
        why: Vec<u8>,
    },
}

impl VariableReply {
    pub(crate) fn refused(why: &DeliveryError) -> Self {
        VariableReply::Refused { why: encode_kind(why) }
    }
}

impl From<ValueReport> for VariableReply {
    fn from(ValueReport { value, revision, state, age }: ValueReport) -> Self {
        VariableReply::Value { value: value.into(), revision, state, age }
    }
}

/// How long a watcher waits before it asks again, so that one who has gone is not kept for ever.
pub(crate) const WATCH_WITHIN: Duration = Duration::from_secs(3);
