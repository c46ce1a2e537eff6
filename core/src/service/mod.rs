//! A service with one primary and standbys on other nodes.
//!
//! ```text
//!            majority votes                lease over, or a greater epoch
//!  Standby ─────────────────► Primary ──────────────────────────────────► Standby
//!     │ promise over             │ heartbeat, entry, snapshot
//!     └─ vote request            └─► standbys: promise, store or execute, confirm
//! ```
//!
//! The replicas elect a primary, which holds a lease (Gray and Cheriton 1989), and keep a log of
//! which only the end matters. The primary sends heartbeats. A standby that receives one promises
//! to vote for no other replica for a lease, and for a margin for the drift of clocks. The primary
//! acts while a majority's promises last by its own clock, counted from when it sent the heartbeat,
//! without the margin. It therefore stops before another replica may be elected. Each primary has
//! its own epoch, and messages of earlier epochs are refused.
//!
//! The primary executes a request and holds the reply back. Every standby in step, and a majority,
//! must first have the request's identity, its reply, and the state (warm) or the request (hot). A
//! request that is sent again is answered from that table. Only a candidate with the newest entry
//! of a majority is elected, so that an answered request is kept.
//!
//! With hot standbys, a component that restarts has no state. Such a member resigns, and votes only
//! for candidates that have at least the position that it knows of. It does not stand for election
//! until it has received the state, or has waited for it for twenty leases. A member whose
//! component is stopped or isolated behaves the same, with any kind of standbys.
//!
//! All of this holds among nodes with equal configurations: the same nodes, kind, rule and
//! heartbeat interval. A replica that has met another configuration does not begin to serve.
//!
//! The replicas keep their table in memory. A process that restarts has lost it, which counts as
//! one failure. The guarantees hold while fewer than half of the nodes fail at a time.

mod change;
mod configuration;
mod message;
mod replica;
mod table;
mod types;
mod view;

pub use message::MESSAGE_MAX;
pub use replica::{QUEUE_MAX, Replica, STATE_MAX};
pub use table::TABLE_MAX;
pub use types::{ReplicaOutput, Role, ServiceOutcome, ServiceRequest};
pub use view::{ServiceState, ServiceView};

use crate::NodeName;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::time::Duration;

/// What standbys do until they take over.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum StandbyKind {
    /// They do nothing. The next primary starts with the state that its component was built with.
    /// The outcome of requests in flight is unknown.
    Cold,
    /// They keep the primary's state and table, and load the state when they take over.
    #[default]
    Warm,
    /// They execute every request as the primary did: they take over at once.
    Hot,
}

impl fmt::Display for StandbyKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            StandbyKind::Cold => "cold",
            StandbyKind::Warm => "warm",
            StandbyKind::Hot => "hot",
        })
    }
}

/// What happens in a part of the network with less than a majority of the declared nodes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum OnPartition {
    /// No node of that part serves.
    #[default]
    Stop,
    /// One node of each part serves, for services that do no harm twice. When the parts meet again,
    /// the effects of the primary with the lower epoch are lost.
    Continue,
}

/// The most nodes that carry one service: three may fail. Each reply waits for a majority, so that
/// more nodes make a service slower and not safer.
pub const MEMBERS_MAX: usize = 7;
/// The shortest interval of heartbeats: a shorter one is less than the delay of timers and of the
/// scheduler.
pub const HEARTBEAT_MIN: Duration = Duration::from_millis(1);
/// The longest interval of heartbeats: three of them are the time until a standby takes over.
pub const HEARTBEAT_MAX: Duration = Duration::from_secs(60 * 60);

/// A replica's settings.
#[derive(Clone, Debug)]
pub struct ReplicaConfig {
    /// The node of this replica, which is one of the members.
    pub own: NodeName,
    /// All nodes that carry the service, at most [`MEMBERS_MAX`]. The earlier a node stands in the
    /// list, the earlier it stands for election.
    pub members: Vec<NodeName>,
    /// What standbys do.
    pub kind: StandbyKind,
    /// What happens without a majority.
    pub on_partition: OnPartition,
    /// The service depends on others, which need primaries before this replica stands for election:
    /// [`ReplicaOutput::CheckDependencies`].
    pub depends: bool,
    /// How often the primary sends a heartbeat, from [`HEARTBEAT_MIN`] to [`HEARTBEAT_MAX`]. A
    /// shorter interval detects its failure sooner and costs more messages.
    pub heartbeat_interval: Duration,
}

impl ReplicaConfig {
    /// Returns how long a primary may act after a majority's last promises: three heartbeats, of
    /// which two may be lost.
    pub fn lease(&self) -> Duration {
        self.heartbeat_interval * 3
    }

    /// Returns the margin for the drift of clocks in one lease, and for late timers: a tenth, far
    /// above the drift of quartz, so that a busy computer has some slack too.
    pub fn margin(&self) -> Duration {
        self.lease() / 10
    }

    /// Returns how long a replica waits for a node that has the state, or is about to. Longer than
    /// a process is likely to stand still. A shorter timeout restores a service sooner whose state
    /// is lost, and which then starts without it.
    fn state_timeout(&self) -> Duration {
        self.lease() * 20
    }

    fn majority(&self) -> usize {
        self.members.len() / 2 + 1
    }
}
