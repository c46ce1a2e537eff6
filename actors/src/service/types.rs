//! The messages between a service's callers, replicas and components.

use blastema_macros::{Event, Request, Structure};

/// A message from one replica to another. The machine encodes the bytes.
#[derive(Clone, Debug, Event)]
#[contract(crate = "crate", name = "blastema/replica", version = 3, max_size = 5 * 1024 * 1024)]
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
    version = 3,
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
    /// The encoded [`Task`].
    pub(crate) task: Vec<u8>,
}

/// The most bytes of an encoded [`Task`], which fits into an [`AskService`].
pub(crate) const TASK_MAX: usize = 2 * 1024 * 1024 - 1024;

/// The encoded request, as replicas keep it.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) struct Task {
    /// Name, version and fingerprint of the contract.
    pub(crate) identity: Vec<u8>,
    pub(crate) payload: Vec<u8>,
}

/// The answer to a request.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) struct Answered {
    /// The encoded `ServiceOutcome`.
    pub(crate) outcome: Vec<u8>,
    /// The epoch in which the replica serves, or the greatest one that it knows.
    pub(crate) epoch: u64,
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

/// What a replica wants of its component. The reply to [`DriveComponent::Save`] is the state. There
/// is no reply to [`DriveComponent::Load`] if the component cannot load the state.
#[derive(Clone, Debug, Request)]
#[contract(
    crate = "crate",
    name = "blastema/drive-component",
    version = 1,
    reply = Option<Vec<u8>>,
    max_size = 4 * 1024 * 1024
)]
pub enum DriveComponent {
    /// Return the state.
    Save,
    /// Replace the state.
    Load {
        /// The state that another replica has saved.
        state: Vec<u8>,
    },
    /// The component serves from now on, in this epoch, or stands by.
    RoleChanged {
        /// The epoch in which it serves.
        epoch: Option<u64>,
    },
}
