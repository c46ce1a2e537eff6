//! What a service's callers, replicas and component say to each other.

use blastema_macros::{Event, Request, Structure};

/// One replica to another. The bytes are the machine's.
#[derive(Clone, Debug, Event)]
#[contract(crate = "crate", name = "blastema/replica", version = 1, max_size = 5 * 1024 * 1024)]
pub(crate) struct ReplicaSays {
    pub(crate) from: String,
    pub(crate) message: Vec<u8>,
}

/// A replica says what it was told of the service, and asks another what that one was. The bytes
/// are the machine's.
#[derive(Clone, Debug, Request)]
#[contract(crate = "crate", name = "blastema/service-terms", version = 1, reply = Vec<u8>)]
pub(crate) struct CompareTerms {
    pub(crate) from: String,
    pub(crate) terms: Vec<u8>,
}

/// A caller asks a replica for the service.
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
    /// The sender has the answers to all of its requests below this number.
    pub(crate) settled: u64,
    /// Whoever serves under a lower epoch than this is not meant: another has answered since.
    pub(crate) since: u64,
    pub(crate) task: Task,
}

/// What is to be done, as replicas keep it.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) struct Task {
    /// Name, version and fingerprint of the contract.
    pub(crate) identity: Vec<u8>,
    pub(crate) payload: Vec<u8>,
}

/// What came of it.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) enum Answered {
    Done {
        reply: Vec<u8>,
        /// Under which epoch it is answered.
        epoch: u64,
    },
    /// It was served, and failed.
    Failed { why: Vec<u8>, epoch: u64 },
    /// It was not taken.
    Refused { why: Vec<u8> },
    /// Another node serves, if any.
    Elsewhere { primary: Option<String> },
}

/// Who serves? It is answered as soon as that is known.
#[derive(Clone, Debug, Request)]
#[contract(crate = "crate", name = "blastema/who-serves", version = 2, reply = Serving)]
pub(crate) struct WhoServes {
    /// This one is not meant: the asker has found it silent.
    pub(crate) besides: Option<String>,
}

/// As far as this replica knows.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) struct Serving {
    pub(crate) primary: Option<String>,
    /// The greatest epoch in which somebody served.
    pub(crate) epoch: u64,
    /// Whoever takes over knows what was served before.
    pub(crate) keeps: bool,
    /// All who carry the service.
    pub(crate) members: Vec<String>,
    /// Why nobody serves as long as that is not mended.
    pub(crate) disputed: Option<String>,
}

/// The component gives its state.
#[derive(Clone, Copy, Debug, Request)]
#[contract(
    crate = "crate",
    name = "blastema/save-state",
    version = 1,
    reply = Vec<u8>,
    max_size = 4 * 1024 * 1024
)]
pub struct SaveState;

/// The component takes a state over, and says whether it could.
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

/// The component serves from now on, or stands by.
#[derive(Clone, Copy, Debug, Event)]
#[contract(crate = "crate", name = "blastema/role", version = 1)]
pub struct RoleChanged {
    pub(crate) epoch: Option<u64>,
}
