//! The directory of the robot: what other nodes have, and names without a node.
//!
//! ```text
//!  Claim ── ClaimCommand ──► DirectoryActor ◄── messages ──► those of other nodes
//!                              │ drives
//!                              ▼
//!  CurrentSender    ── who? ── DirectoryTable    `*:map` is sent to the holder of `map`
//!  services, rows ─── where? ─┘
//! ```

pub(crate) mod actor;
mod spec;
pub(crate) mod table;

pub use blastema_core::directory::{ClaimPolicy, ClaimRefused, Holder, NameHeld};

pub(crate) use table::{ClaimCommand, DirectoryTable};

use crate::registry::remote::NameResolver;
use blastema_core::directory::ClaimRequest;
use blastema_core::{Incarnation, NameError, NodeName, ObjectAddress, ObjectName};
use std::fmt;
use std::time::Duration;
use tokio::sync::watch;

/// Why a name was not claimed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ClaimError {
    /// The name does not parse.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The robot does not grant it.
    #[error(transparent)]
    Refused(#[from] ClaimRefused),
    /// The node has ended.
    #[error("the node has ended")]
    Stopped,
}

/// How a claim stands.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ClaimState {
    /// The node has just started, and waits for the claims of other nodes.
    Waiting,
    /// The name is ours.
    Held {
        /// Under which epoch: each holder has a greater one than those before.
        epoch: u64,
    },
    /// Another node holds it; we are to follow.
    StandsBy,
    /// The claim is over: it was not granted.
    Refused(ClaimRefused),
    /// The claim is over: two had claimed the name, out of each other's sight, and the other's is
    /// the later claim.
    Lost {
        /// Whose it is.
        to: NodeName,
        /// Under which epoch.
        epoch: u64,
    },
}

/// A name of the whole robot that an object of this node claims. From
/// [`Node::claim`](crate::Node::claim). It is given back when this is dropped. Needs the feature
/// `network`.
pub struct Claim {
    name: ObjectName,
    number: u64,
    names: DirectoryTable,
    state: watch::Receiver<ClaimState>,
}

impl fmt::Debug for Claim {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "claim of {}: {:?}", self.name, *self.state.borrow())
    }
}

impl Claim {
    /// Claims, and waits until that is granted, refused, or stood by for.
    pub(crate) async fn make(
        names: &DirectoryTable,
        wanted: ClaimRequest,
    ) -> Result<Self, ClaimError> {
        let (name, number) = (wanted.name.clone(), names.number());
        let state = names.claim(wanted, number, false);
        let mut claim = Claim { name, number, names: names.clone(), state };
        let decided = claim.state.wait_for(|state| *state != ClaimState::Waiting).await;
        match decided.map(|state| state.clone()) {
            Ok(ClaimState::Refused(refused)) => Err(refused.into()),
            Ok(_) => Ok(claim),
            Err(_) => Err(ClaimError::Stopped),
        }
    }

    /// Returns the global name that is claimed.
    pub fn name(&self) -> &ObjectName {
        &self.name
    }

    /// How it stands now.
    pub fn state(&self) -> ClaimState {
        self.state.borrow().clone()
    }

    /// Under which epoch the name is ours, if it is.
    pub fn epoch(&self) -> Option<u64> {
        match *self.state.borrow() {
            ClaimState::Held { epoch } => Some(epoch),
            _ => None,
        }
    }

    /// Waits until the state differs from the one last returned, and returns it; `None` once the
    /// node has ended.
    pub async fn changed(&mut self) -> Option<ClaimState> {
        self.state.changed().await.ok()?;
        Some(self.state.borrow_and_update().clone())
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        self.names.withdraw(&self.name, self.number);
    }
}

/// Reports each change of the holder of a global name. From
/// [`Node::watch_name`](crate::Node::watch_name).
pub struct NameWatch {
    name: ObjectName,
    names: DirectoryTable,
    revision: watch::Receiver<u64>,
    last_reported: Option<Option<Holder>>,
}

impl fmt::Debug for NameWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "watch of {}", self.name)
    }
}

impl NameWatch {
    pub(crate) fn new(names: &DirectoryTable, name: ObjectName) -> Self {
        NameWatch { name, names: names.clone(), revision: names.revision(), last_reported: None }
    }

    /// Returns the holder: at once on the first call, and then whenever it has changed; `None` if
    /// there is no holder. Of several changes since the last call, the last is returned.
    pub async fn next(&mut self) -> Option<Holder> {
        loop {
            self.revision.mark_unchanged();
            let holder = self.names.holder(&self.name);
            if self.last_reported.as_ref() != Some(&holder) {
                self.last_reported = Some(holder.clone());
                return holder;
            }
            // It ends with the last clone of the names, of which this has one.
            let _ = self.revision.changed().await;
        }
    }

    /// Waits until the name has a holder.
    pub async fn held(&mut self) -> Holder {
        loop {
            if let Some(holder) = self.next().await {
                return holder;
            }
        }
    }
}

/// One other node, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeRow {
    /// The name of the node.
    pub node: NodeName,
    /// In which incarnation.
    pub incarnation: Incarnation,
    /// Its objects: 20,000 at most, publishers included.
    pub objects: Vec<ObjectAddress>,
}

/// A global name and its holder, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClaimRow {
    /// The global name.
    pub name: ObjectName,
    /// The holder, and the epoch of its claim.
    pub holder: Holder,
    /// In which incarnation of its node.
    pub incarnation: Incarnation,
    /// For how long this node has known so.
    pub age: Duration,
}
