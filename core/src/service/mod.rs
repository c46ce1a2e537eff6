//! A service with one primary and standbys on other nodes.
//!
//! ```text
//!            majority votes                lease over, or a greater epoch
//!  Standby ─────────────────► Primary ──────────────────────────────────► Standby
//!     │ promise over             │ hello, entry, snapshot
//!     └─ claims an epoch         └─► standbys: promise, store or execute, confirm
//! ```
//!
//! It is an election with leases, and a log of which only the end matters. The primary says hello;
//! a standby that hears it promises to vote for nobody else for a lease and a margin for the
//! clocks' drift. The primary acts for as long as a majority's promises last by its own clock,
//! counted from when it *asked*, without the margin: it stops before anybody may follow. Each
//! primary has an epoch of its own, and what an older one says is refused.
//!
//! A request is executed by the primary, and its reply held back until every standby that is in
//! step has the request's identity, its reply, and the state (warm) or the request (hot), and a
//! majority has them. A request that comes again is answered from that table. The election is won
//! only by who has the newest entry of a majority: what was answered once stays done.
//!
//! With hot standbys, a component that begins a new life has no state, whatever its replica knows.
//! Such a member resigns, votes for nobody who has come less far than it knows of, and does not
//! stand for election before it was sent the state, or has waited for twenty leases in vain. So
//! does one whose component takes nothing any more, whatever the standbys do.
//!
//! All of this holds among those who were told the same: the same nodes, kind, rule and hello. Who
//! finds that another one was told otherwise serves only where too few are left to elect somebody
//! by those other terms.
//!
//! The replicas keep their table in memory. A process that begins anew has forgotten it: that is
//! one failure. What the machine promises, it promises for fewer than half of the nodes failing at
//! a time.

mod change;
mod message;
mod replica;
mod table;
mod terms;
mod view;
mod vocabulary;

pub use replica::{MESSAGE_MAX, QUEUE_MAX, Replica, STATE_MAX};
pub use table::TABLE_MAX;
pub use view::{ServiceState, ServiceView};
pub use vocabulary::{ReplicaOutput, Role, ServiceOutcome, ServiceRequest};

use crate::NodeName;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::time::Duration;

/// What standbys do while they stand by.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum StandbyKind {
    /// Nothing: whoever takes over begins with the state that it was built with. The outcome of
    /// requests in flight is unknown.
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

/// What happens where less than a majority of the declared nodes see each other.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum OnPartition {
    /// There is no service there.
    #[default]
    Stop,
    /// There is one in every part: for what does no harm twice. When the parts meet again, what the
    /// primary of the lower epoch did is forgotten.
    Continue,
}

/// The most nodes that carry one service: as many as one network has. Each hello is one message to
/// each.
pub const MEMBERS_MAX: usize = 256;
/// The shortest interval of hellos: shorter, timers and turns of a computer are longer than what
/// they tell.
pub const HELLO_MIN: Duration = Duration::from_millis(1);
/// And the longest: whoever waits three of them for a service does not want standbys.
pub const HELLO_MAX: Duration = Duration::from_secs(60 * 60);

/// A replica's settings.
#[derive(Clone, Debug)]
pub struct ReplicaConfig {
    /// Which of the members we are.
    pub own: NodeName,
    /// All nodes that carry the service, at most [`MEMBERS_MAX`]; the one that should begin first.
    pub members: Vec<NodeName>,
    /// What standbys do.
    pub kind: StandbyKind,
    /// What to do without a majority.
    pub on_partition: OnPartition,
    /// Other services have to be there before this one takes over: [`ReplicaOutput::Inquire`].
    pub depends: bool,
    /// How often the primary says hello, from [`HELLO_MIN`] to [`HELLO_MAX`]. Shorter finds its
    /// death sooner and costs more.
    pub hello_interval: Duration,
}

impl ReplicaConfig {
    /// How long a primary may act after a majority was last heard of: three hellos, of which two
    /// may be lost.
    pub fn lease(&self) -> Duration {
        self.hello_interval * 3
    }

    /// What clocks may drift apart in one lease, and timers be late: a tenth, far above what quartz
    /// does, so that a busy computer has some room too.
    pub fn margin(&self) -> Duration {
        self.lease() / 10
    }

    fn majority(&self) -> usize {
        self.members.len() / 2 + 1
    }
}
