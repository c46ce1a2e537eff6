//! How a supervisor keeps its children: the words of Erlang/OTP.

use serde::{Deserialize, Serialize};
use std::time::Duration;

/// Which children a supervisor restarts together.
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

/// The action of a supervisor when a child exceeds the intensity of restarts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum WhenExceeded {
    /// Restarts are counted per child. The child that exceeds the intensity is not restarted any
    /// more: the plan's next action is taken, at last safe stop. Its siblings go on.
    ///
    /// Under [`OneForAll`](Strategy::OneForAll) and [`RestForOne`](Strategy::RestForOne) children
    /// depend on each other, and this is the same as [`Escalate`](Self::Escalate).
    #[default]
    StopChild,
    /// Restarts are counted for all children together, as in Erlang/OTP. When they exceed the
    /// intensity, the supervisor ends all children and itself, and its parent decides; the root's
    /// end is the node's safe state.
    Escalate,
}

/// Which ends of a child are followed by a restart.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Restart {
    /// Every end is followed by a restart.
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
    /// The limit from the order to stop to the end. A child that takes longer is abandoned.
    pub shutdown_within: Duration,
    /// A panic's first action is the built-in restart, so that the guard may restart on the spot.
    pub on_the_spot: bool,
    /// The supervisor cannot do without it: if it is not worth restarting any more, or is put into
    /// the safe state because of a fault, the supervisor escalates.
    pub essential: bool,
    /// It decides about children of its own: it is informed beforehand when its incarnation is
    /// about to end.
    pub supervises: bool,
}

impl Default for ChildRules {
    /// Five seconds each way, as OTP's workers; no restart on the spot until a plan says so.
    fn default() -> Self {
        ChildRules {
            restart: Restart::Permanent,
            ready_within: Duration::from_secs(5),
            shutdown_within: Duration::from_secs(5),
            on_the_spot: false,
            essential: false,
            supervises: false,
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
    /// other, so that it has none itself, as in OTP.
    pub fn supervisor() -> Self {
        ChildRules {
            ready_within: Duration::MAX,
            shutdown_within: Duration::MAX,
            supervises: true,
            ..ChildRules::default()
        }
    }
}

/// How a supervisor decides.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SupervisorRules {
    /// Which children it restarts together.
    pub strategy: Strategy,
    /// More restarts than this in one `period`, and `when_exceeded` applies. Higher rides out more;
    /// lower reaches the next authority sooner.
    pub intensity: u32,
    /// The sliding window in which restarts are counted.
    pub period: Duration,
    /// The action when restarts exceed the intensity.
    pub when_exceeded: WhenExceeded,
    /// The supervisor is the root: its escalation puts the node into the safe state.
    pub root: bool,
    /// The first start completes or is undone: a child that cannot be started, and is not
    /// [temporary](Restart::Temporary), ends all others. Later starts follow the other rules.
    pub whole_start: bool,
}

impl Default for SupervisorRules {
    /// Three in ten seconds, one for one.
    fn default() -> Self {
        SupervisorRules {
            strategy: Strategy::OneForOne,
            intensity: 3,
            period: Duration::from_secs(10),
            when_exceeded: WhenExceeded::StopChild,
            root: false,
            whole_start: false,
        }
    }
}

impl SupervisorRules {
    /// Whether the restarts of all children are one count, whose end is the supervisor's.
    pub fn counts_together(&self) -> bool {
        self.strategy != Strategy::OneForOne || self.when_exceeded == WhenExceeded::Escalate
    }
}
