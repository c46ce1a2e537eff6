//! How a supervisor keeps its children: the words of Erlang/OTP.

use serde::{Deserialize, Serialize};
use std::time::Duration;

/// Whom a supervisor restarts together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Strategy {
    /// Only the child that failed.
    #[default]
    OneForOne,
    /// All children: they cannot do without each other.
    OneForAll,
    /// The child that failed and those that were started after it, because they depend on it.
    RestForOne,
}

/// Which ends of a child are followed by a restart.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Restart {
    /// Every one.
    #[default]
    Permanent,
    /// Every one but an orderly end.
    Transient,
    /// None: it is not missed.
    Temporary,
}

/// How one child is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChildRules {
    /// Which of its ends are followed by a restart.
    pub restart: Restart,
    /// From start to being at work. Longer suits slow devices; a failed start is noticed later.
    pub ready_within: Duration,
    /// From being told to stop to having stopped. After that it is given up without its consent.
    pub shutdown_within: Duration,
    /// A panic's first measure is the built-in restart, so that the guard may restart on the spot.
    pub on_the_spot: bool,
}

impl Default for ChildRules {
    /// Five seconds each way, as OTP's workers; no restart on the spot until a plan says so.
    fn default() -> Self {
        ChildRules {
            restart: Restart::Permanent,
            ready_within: Duration::from_secs(5),
            shutdown_within: Duration::from_secs(5),
            on_the_spot: false,
        }
    }
}

/// The guard of a component keeps the component's deadlines itself and says more about it when they
/// pass; the supervisor waits this much longer, for the case that the guard is stuck too.
const GUARD_MARGIN: Duration = Duration::from_millis(250);

impl ChildRules {
    /// For a component whose guard keeps these deadlines.
    pub fn guarded(ready_within: Duration, shutdown_within: Duration) -> Self {
        ChildRules {
            ready_within: ready_within.saturating_add(GUARD_MARGIN),
            shutdown_within: shutdown_within.saturating_add(GUARD_MARGIN),
            ..ChildRules::default()
        }
    }

    /// For a child that is a supervisor: its own children take their own deadlines, one after the
    /// other, so that its deadline is only there for the case that it is stuck itself.
    pub fn supervisor() -> Self {
        ChildRules {
            ready_within: Duration::from_secs(60),
            shutdown_within: Duration::from_secs(60),
            ..ChildRules::default()
        }
    }
}

/// How a supervisor decides.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SupervisorRules {
    /// Whom it restarts together.
    pub strategy: Strategy,
    /// More restarts than this in one `period`, and it gives up. Higher rides out more; lower
    /// reaches the next authority sooner.
    pub intensity: u32,
    /// The sliding window in which restarts are counted.
    pub period: Duration,
    /// Nobody stands above it: its end is the node's safe rest.
    pub root: bool,
}

impl Default for SupervisorRules {
    /// Three in ten seconds, one for one.
    fn default() -> Self {
        SupervisorRules {
            strategy: Strategy::OneForOne,
            intensity: 3,
            period: Duration::from_secs(10),
            root: false,
        }
    }
}

/// "Panic: restart on the spot, up to `times` in `period`."
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StandingOrder {
    /// How many restarts the guard may make by itself in any one period, counting those that it has
    /// made already since it was started.
    pub times: u32,
    /// The sliding window in which they are counted.
    pub period: Duration,
}
