//! The messages between a service's callers, replicas and components.

use blastema_macros::{Event, Request, Structure};

/// A message from one replica to another. The machine encodes the bytes.
#[derive(Clone, Debug, Event)]
#[contract(crate = "crate", name = "blastema/replica", version = 2, max_size = 5 * 1024 * 1024)]
pub(crate) struct ReplicaMessage {
    pub(crate) from: String,
    pub(crate) message: Vec<u8>,
}

/// A replica's configuration of the service, and the question for that of another one. The machine
/// encodes the bytes.
#[derive(Clone, Debug, Request)]
#[contract(crate = "crate", name = "blastema/service-configuration", version = 2, reply = Vec<u8>)]
pub(crate) struct CompareConfiguration {
    pub(crate) from: String,
    pub(crate) configuration: Vec<u8>,
}

/// A caller's request to a replica.
#[derive(Clone, Debug, Request)]
#[contract(
    crate = "crate",
    name = "blastema/serve",
    version = 2,
    reply = Answered,
    max_size = 2 * 1024 * 1024
)]
pub(crate) struct AskService {
    /// The request's identity, the same however often it is sent.
    pub(crate) sender: u64,
    pub(crate) sequence: u64,
    /// The sender has received the replies to all of its requests below this number.
    pub(crate) settled: u64,
    /// A primary with a lower epoch refuses the request: another one has answered since.
    pub(crate) since: u64,
    pub(crate) task: Task,
}

/// The encoded request, as replicas keep it.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) struct Task {
    /// Name, version and fingerprint of the contract.
    pub(crate) identity: Vec<u8>,
    pub(crate) payload: Vec<u8>,
}

/// The result of a request.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) enum Answered {
    Done {
        reply: Vec<u8>,
        /// The epoch in which it is answered.
        epoch: u64,
    },
    /// It was executed, and failed.
    Failed { why: Vec<u8>, epoch: u64 },
    /// It was not accepted.
    Refused { why: Vec<u8> },
    /// Another node is primary, if there is one.
    Elsewhere { primary: Option<String> },
}

/// The question for the primary. A replica answers as soon as it knows of one.
#[derive(Clone, Debug, Request)]
#[contract(crate = "crate", name = "blastema/who-serves", version = 2, reply = Serving)]
pub(crate) struct WhoServes {
    /// This node does not count: it did not answer the caller.
    pub(crate) besides: Option<String>,
}

/// The primary, as far as the replica knows.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) struct Serving {
    pub(crate) primary: Option<String>,
    /// The greatest epoch that had a primary.
    pub(crate) epoch: u64,
    /// The next primary keeps the state of this one.
    pub(crate) keeps: bool,
    /// All nodes that carry the service.
    pub(crate) members: Vec<String>,
    /// How the configurations differ, if there is no primary until that is corrected.
    pub(crate) disputed: Option<String>,
}

/// Asks the component for its state.
#[derive(Clone, Copy, Debug, Request)]
#[contract(
    crate = "crate",
    name = "blastema/save-state",
    version = 1,
    reply = Vec<u8>,
    max_size = 4 * 1024 * 1024
)]
pub struct SaveState;

/// Gives the component a state. The reply is whether it has loaded it.
#[derive(Clone, Debug, Request)]
#[contract(
    crate = "crate",
    name = "blastema/load-state",
    version = 1,
    reply = bool,
    max_size = 4 * 1024 * 1024
)]
pub struct LoadState {
    pub(crate) state: Vec<u8>,
}

/// Reports to the component that it serves from now on, or stands by.
#[derive(Clone, Copy, Debug, Event)]
#[contract(crate = "crate", name = "blastema/role", version = 1)]
pub struct RoleChanged {
    pub(crate) epoch: Option<u64>,
}
