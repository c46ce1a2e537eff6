//! Configuration, inputs and outputs of the directory.

use crate::net::trust::access::AccessDenied;
use crate::{Incarnation, NodeName, ObjectName};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;
use std::time::Duration;

/// What a claimant wants where another one holds the name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ClaimPolicy {
    /// To be told so, and to go without.
    Refuse,
    /// To take its place when it has gone.
    Standby,
}

/// How records are held.
#[derive(Clone, Debug)]
pub struct DirectoryConfig {
    /// The name of this node.
    pub node: NodeName,
    /// The present incarnation of this node.
    pub incarnation: Incarnation,
    /// How long records hold after the last path to their node was lost. Longer rides out longer
    /// outages, and keeps the names of a node that died for longer.
    pub lease: Duration,
    /// How long after our start nothing is granted here, so that who holds a name already is heard
    /// first. Longer waits for slower networks; a name without a holder is granted later.
    pub settle: Duration,
    /// Once all of these have told what they have, claims are granted at once. Without any,
    /// `settle` is waited for.
    pub expected: BTreeSet<NodeName>,
}

/// What an object claims.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClaimRequest {
    /// The global name to claim.
    pub name: ObjectName,
    /// The object of this node that is meant by it.
    pub object: ObjectName,
    /// What becomes of it where another claimant holds the name.
    pub policy: ClaimPolicy,
}

impl ClaimRequest {
    /// The name for the object that is called so on this node, too.
    pub fn new(name: ObjectName, policy: ClaimPolicy) -> Self {
        ClaimRequest { object: name.clone(), name, policy }
    }
}

/// Who holds a name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Holder {
    /// The node of the object that has the name.
    pub node: NodeName,
    /// The object there.
    pub object: ObjectName,
    /// Since which claim: each that is granted has a greater one than those before.
    pub epoch: u64,
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.node, self.object)
    }
}

/// Another claimant holds the name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{name} is claimed by {holder}, under epoch {epoch}: stand by, or take another name")]
pub struct NameHeld {
    /// The global name that was claimed.
    pub name: ObjectName,
    /// Who holds it.
    pub holder: NodeName,
    /// Since which claim.
    pub epoch: u64,
}

/// Why a claim is not taken.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ClaimRefused {
    /// Another claimant holds the name.
    #[error(transparent)]
    Held(#[from] NameHeld),
    /// This node claims too many names already. Give some back.
    #[error("this node claims {limit} names already, and no more: give some back")]
    TooMany {
        /// The most that it may.
        limit: usize,
    },
    /// The policy of the robot does not let the node claim the name. Change roles or policy.
    #[error(
        "node {node} may not claim {name}, by its roster {serial}: change roles or policy by `blastema keys edit`"
    )]
    Forbidden {
        /// The global name that was claimed.
        name: String,
        /// The node that claimed the name.
        node: NodeName,
        /// The serial number of the roster.
        serial: u64,
    },
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DirectoryOutput {
    /// Tell this node.
    Send {
        /// The node to send to.
        to: NodeName,
        /// The encoded message.
        message: Bytes,
    },
    /// A name is ours.
    Granted {
        /// The name that is granted.
        name: ObjectName,
        /// Under which epoch.
        epoch: u64,
    },
    /// Another claimant holds a name that we stand by for.
    StandsBy {
        /// The name that has another holder.
        name: ObjectName,
    },
    /// A claim that had to wait after our start is refused; or one that was granted, by another
    /// policy.
    Refused {
        /// The name of the refused claim.
        name: ObjectName,
        /// Why the claim is refused, and what helps.
        refused: ClaimRefused,
    },
    /// Another node claims a name that it may not.
    AccessDenied {
        /// Which node, and what.
        denied: Box<AccessDenied>,
    },
    /// A name that was ours is another's: two had claimed it, out of each other's sight.
    Lost {
        /// The name that this node has lost.
        name: ObjectName,
        /// Whose it is.
        to: NodeName,
        /// Under which epoch.
        epoch: u64,
        /// We stand by for it from now on.
        stands_by: bool,
    },
    /// A name has another holder than before, or none.
    Held {
        /// The global name.
        name: ObjectName,
        /// The new holder; `None` while the name has none.
        holder: Option<Holder>,
    },
}

/// What nodes tell each other.
#[derive(Serialize, Deserialize)]
pub(super) enum DirectoryMessage {
    All { first: bool, last: bool, records: Vec<DirectoryRecord> },
    Changed { records: Vec<DirectoryRecord>, gone: Vec<DirectoryKey> },
}

/// What a record is of.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum DirectoryKey {
    /// The node has an object of this name.
    Object(ObjectName),
    /// An object of the node publishes events.
    Publisher {
        /// On this topic.
        topic: ObjectName,
        /// The name of their contract.
        contract: String,
    },
    /// The node claims this global name, or stands by for it.
    Name(ObjectName),
}

/// The longest name of a contract, in bytes.
const CONTRACT_MAX: usize = 255;

impl DirectoryKey {
    /// Names of objects and topics have their bound by themselves.
    pub(super) fn is_short(&self) -> bool {
        match self {
            DirectoryKey::Publisher { contract, .. } => contract.len() <= CONTRACT_MAX,
            DirectoryKey::Object(_) | DirectoryKey::Name(_) => true,
        }
    }

    /// How many bytes it takes in a message, about.
    pub(super) fn bytes(&self) -> usize {
        let (name, contract) = match self {
            DirectoryKey::Object(name) | DirectoryKey::Name(name) => (name, ""),
            DirectoryKey::Publisher { topic, contract } => (topic, contract.as_str()),
        };
        name.as_str().len() + contract.len() + 6
    }
}

/// A record as it is told.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct DirectoryRecord {
    pub(super) key: DirectoryKey,
    pub(super) claim: NameClaim,
}

/// What a node has of a global name; nothing where the record is of something else.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct NameClaim {
    /// Without one it stands by.
    pub(super) epoch: Option<u64>,
    /// The object that is meant, where it is not called as the name is.
    pub(super) object: Option<ObjectName>,
}
