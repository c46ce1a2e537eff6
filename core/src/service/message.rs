//! What the replicas of a service say to each other.

use super::change::Change;
use super::table::Table;
use crate::{DeliveryError, MessageId};
use serde::{Deserialize, Serialize};

/// How far a replica has come: under which epoch its last entry was made, and the how manieth it
/// was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) struct Position {
    pub(super) epoch: u64,
    pub(super) number: u64,
}

/// One request that was executed, and its reply.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Served {
    pub(super) id: MessageId,
    pub(super) result: Result<Vec<u8>, DeliveryError>,
}

/// What a standby needs of a request that was executed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum After {
    /// A warm one: what has changed of the state.
    State(Change),
    /// A hot one: the request.
    Request(Vec<u8>),
    /// It has failed: what kills one of them need not kill the others.
    Failed,
}

/// What a standby has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Standing {
    /// All that the primary has told.
    InStep,
    /// It was sent everything, and gets what comes after; its component has yet to take it over.
    Coming,
    /// Less: it needs everything.
    Behind,
    /// Nothing, and it can take nothing: its component rests.
    Unable,
}

/// What one replica tells another.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Message {
    /// From the primary: it acts under this epoch, has come so far, and has answered so far.
    /// And it reckons with these other terms.
    Hello { epoch: u64, number: u64, position: Position, answered: Position, heard: Vec<u64> },
    /// The standby votes for nobody else for a lease, has come so far, and knows callers to be
    /// answered so far.
    Promise { epoch: u64, number: u64, position: Position, answered: Position, standing: Standing },
    /// The sender acts under no such epoch: this one holds.
    Outdated { epoch: u64 },
    /// The sender has voted in this epoch already: claim a greater one.
    Voted { epoch: u64 },
    /// A standby wants to be primary, and reckons with these other terms.
    Claim { epoch: u64, position: Position, heard: Vec<u64> },
    /// Somebody was told these other terms, with which the receiver has to reckon.
    Rival { terms: Vec<u8> },
    /// It may; whether the voter has what the claimant has, and how far it knows callers to be
    /// answered.
    Vote { epoch: u64, in_step: bool, answered: Position },
    /// A request was executed; its caller has its answers below this number.
    Entry { epoch: u64, position: Position, served: Served, settled: u64, after: After },
    /// Everything, for a standby that is not in step.
    Snapshot { epoch: u64, position: Position, state: Vec<u8>, table: Table },
    /// The primary of this epoch serves no more: promises made to it are over.
    Resigned { epoch: u64 },
}
