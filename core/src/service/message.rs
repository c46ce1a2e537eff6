//! The messages between the replicas of a service.

use super::change::Change;
use super::table::Table;
use crate::{DeliveryError, MessageId};
use serde::{Deserialize, Serialize};

/// The most bytes of one message between replicas: a state and the table of replies.
pub const MESSAGE_MAX: usize = 4 * 1024 * 1024;

/// A replica's position in the log: the epoch and the index of its last entry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) struct Position {
    pub(super) epoch: u64,
    pub(super) number: u64,
}

/// One executed request and its reply.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Served {
    pub(super) id: MessageId,
    pub(super) result: Result<Vec<u8>, DeliveryError>,
}

/// The part of an executed request that a standby needs to follow the primary.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum EntryPayload {
    /// For a warm standby: the change of the state.
    State(Change),
    /// For a hot standby: the request.
    Request(Vec<u8>),
    /// The request has failed. The standby does not execute it: a request that ended the component
    /// of the primary must not end the component of a standby.
    Failed,
}

/// How much of the primary's log a standby has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum StandbyStatus {
    /// All entries, and its component has loaded what it has to.
    InStep,
    /// All entries, and its component has yet to load the state.
    Loading,
    /// Not all entries: it needs a snapshot.
    Behind,
    /// None, and it cannot load a snapshot: its component is stopped or isolated.
    Inactive,
}

/// A message from one replica to another.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Message {
    /// The primary's sign of life.
    Heartbeat(ReplicaHeartbeat),
    /// A standby's answer to it; or its position alone, which promises nothing.
    LeasePromise(LeasePromise),
    /// The epoch of the receiver's heartbeat is outdated: this is the current one.
    Outdated { epoch: u64 },
    /// The sender has already voted in this epoch: the receiver needs a greater one.
    Voted { epoch: u64 },
    /// The sender wants to become primary.
    VoteRequest(VoteRequest),
    /// The sender votes for the receiver.
    Vote(Vote),
    /// The next entry of the log.
    Entry(LogEntry),
    /// The whole state, for a standby that is behind.
    Snapshot(Snapshot),
    /// The primary of this epoch has resigned: lease promises to it are void.
    Resigned { epoch: u64 },
}

/// The primary's periodic sign of life, which asks for a [`LeasePromise`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct ReplicaHeartbeat {
    pub(super) epoch: u64,
    /// When it was sent, in nanoseconds of the primary's clock.
    pub(super) sent: u64,
    pub(super) position: Position,
    /// The last position whose reply the primary has sent.
    pub(super) answered: Position,
}

/// A standby's promise to vote for no other replica for one lease.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct LeasePromise {
    pub(super) epoch: u64,
    /// When the heartbeat was sent that it answers. Without one it reports the position only, and
    /// promises nothing.
    pub(super) sent: Option<u64>,
    pub(super) position: Position,
    /// The last position whose reply was sent, as far as the standby knows.
    pub(super) answered: Position,
    pub(super) status: StandbyStatus,
}

/// A candidate's request for a vote in a new epoch.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct VoteRequest {
    pub(super) epoch: u64,
    pub(super) position: Position,
}

/// A vote for a candidate.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Vote {
    pub(super) epoch: u64,
    /// The voter has the entries that the candidate has.
    pub(super) in_step: bool,
    /// The last position whose reply was sent, as far as the voter knows.
    pub(super) answered: Position,
}

/// One executed request, for standbys in step.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct LogEntry {
    pub(super) epoch: u64,
    pub(super) position: Position,
    pub(super) served: Served,
    /// The caller has received the replies to its requests below this number.
    pub(super) settled: u64,
    pub(super) payload: EntryPayload,
}

/// The state and the table of replies, for a standby that is behind.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Snapshot {
    pub(super) epoch: u64,
    pub(super) position: Position,
    pub(super) state: Vec<u8>,
    pub(super) table: Table,
}
