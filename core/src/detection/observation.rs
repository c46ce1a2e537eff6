//! What the monitor saw, before the detector has judged it.

use crate::{FaultKind, FaultLocation, Incarnation, Instant, Lifecycle, ObjectAddress, ObjectName};
use std::sync::Arc;
use std::time::Duration;

/// One observation that the monitor reports to the detector.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Observation {
    /// The object, link or node that was observed.
    pub location: FaultLocation,
    /// In which incarnation; zero for a link.
    pub incarnation: Incarnation,
    /// What was observed.
    pub finding: Finding,
    /// When the monitor learned of it.
    pub seen_at: Instant,
}

/// The kind of an observation. The detector decides whether it is a fault.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Finding {
    /// The object is now known, and needs these to do its work.
    Enrolled {
        /// That it ends itself in order is no fault.
        may_end: bool,
        /// The objects, here or elsewhere, without which it cannot work.
        depends_on: Arc<[ObjectAddress]>,
    },
    /// The object is no longer to be looked at.
    Dismissed,
    /// An incarnation ended.
    Exited {
        /// How the incarnation ended.
        exit: ExitReason,
        /// The guard used its grant: this incarnation has begun in the old one's place.
        restarted_as: Option<Incarnation>,
    },
    /// An incarnation came to another state.
    State {
        /// Where it now stands.
        state: Lifecycle,
        /// For `Error` and `Fatal`: why, as the component said it.
        reason: Option<String>,
    },
    /// The object itself declared a fault.
    Declared {
        /// The kind of the declared fault.
        kind: FaultKind,
        /// The text that the object gives as the cause.
        detail: String,
    },
    /// A fault that the object had declared is over.
    Cleared {
        /// The kind of the fault that is over.
        kind: FaultKind,
    },
    /// The object gave no sign of life, or no reply to a ping, for longer than is tolerated.
    Silent {
        /// For how long.
        age: Duration,
    },
    /// The object was silent and gives signs of life again.
    Spoke,
    /// Its handler keeps its arbiter from turning.
    Hangs {
        /// The contract or hook in service.
        during: &'static str,
        /// For how long at least.
        age: Duration,
        /// The components that are blocked behind it.
        victims: Arc<[ObjectName]>,
    },
    /// Its handler awaits something for longer than it may; its arbiter turns.
    Waits {
        /// The contract or hook in service.
        during: &'static str,
        /// For how long at least.
        age: Duration,
    },
    /// The object hung, and its arbiter runs again.
    Resumed,
    /// The object is blocked for good behind this culprit and must be re-created on another thread.
    Lost {
        /// The component whose handler keeps their arbiter.
        culprit: ObjectName,
    },
    /// The object works, but exceeds its own limits of lateness or those of others on its thread.
    Overloaded {
        /// How late the components are, and how busy their thread is.
        figures: OverloadFigures,
        /// The components that are late behind it, on the same thread.
        victims: Arc<[ObjectName]>,
    },
    /// The object was overloaded and has caught up.
    Flows,
    /// Its sending and receiving was forbidden, or allowed again, for all its incarnations.
    Isolated {
        /// Whether it is forbidden now.
        isolated: bool,
    },
    /// A link changed.
    Link(LinkCondition),
    /// A node changed.
    Node(NodeCondition),
}

impl Finding {
    /// Whether a component did this itself, so that the end of its node does not explain it.
    pub(super) fn is_own_doing(&self) -> bool {
        matches!(
            self,
            Finding::Exited { exit: ExitReason::Panicked { .. }, .. } | Finding::Declared { .. }
        )
    }
}

/// How an incarnation ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ExitReason {
    /// The incarnation ended itself, in order.
    Returned,
    /// The incarnation did not become active, or declared a fatal fault. Its earlier declaration
    /// names the cause.
    Fatal,
    /// The incarnation panicked.
    Panicked {
        /// The panic's text.
        text: String,
        /// File and line, as `src/laser.rs:42`.
        at: String,
        /// What it was serving: the contract's name, or the hook's.
        during: &'static str,
    },
    /// Its future was dropped before it ended: its arbiter went away.
    Aborted,
    /// The incarnation was stopped.
    Stopped,
}

/// An object's answer to the question whether it is alive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WorkProgress {
    /// Which incarnation answers.
    pub incarnation: Incarnation,
    /// Where it stands.
    pub state: Lifecycle,
}

/// How a link is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkCondition {
    /// The link carries frames.
    Up,
    /// The link carries frames, but late or with loss.
    Degraded {
        /// What was measured, and against which limit.
        reason: String,
    },
    /// The link carries no frames.
    Down {
        /// How that was noticed.
        reason: String,
    },
    /// The link was removed: it had been discovered, and its neighbour has been absent for long.
    Forgotten,
}

/// How another node is, as this one sees it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NodeCondition {
    /// At least one path leads there.
    Reachable,
    /// No path leads there any more.
    Lost {
        /// How that was noticed.
        reason: String,
    },
    /// The node was reached under a new incarnation: its process died and was restarted.
    Restarted,
    /// The node offends: a single offence is an accident, several are a fault.
    Offends {
        /// What it has done, in words that are the same each time.
        what: String,
    },
    /// Nothing is taken from it or sent there any more. That it cannot be reached is no news then.
    Isolated {
        /// Why the node is isolated.
        reason: String,
    },
    /// The node is no longer isolated.
    Admitted,
    /// Messages to its objects, which this node had accepted, were lost with a session.
    MessagesLost {
        /// How many, in words.
        detail: String,
    },
    /// A session is open with it.
    InSession,
    /// The node reports that it is in the safe state: it can be reached, and no component of it
    /// serves.
    InSafeState {
        /// Why the node entered the safe state.
        reason: String,
    },
    /// The node reports that it is active again.
    AtWork,
    /// This node itself: none of its threads ran.
    Paused {
        /// For how long.
        span: Duration,
    },
    /// This node itself: its computer is overloaded, and these components are late because their
    /// threads waited for a processor.
    Overloaded {
        /// For which share of the time the worst of these threads waited.
        waited_percent: u8,
        /// How late they are.
        figures: OverloadFigures,
        /// The components that are late.
        victims: Arc<[ObjectName]>,
    },
    /// No component of this node is late any more because of that.
    Relieved,
    /// The node reported that it leaves in order: its silence from now on is no fault, and its
    /// return is an ordinary one.
    Left,
    /// The robot's roster does not list the node any more: that it cannot be reached is as it should
    /// be.
    Removed,
    /// The roster lists the node again.
    Listed,
    /// The description of this node says so: that the other one cannot be reached is no fault.
    MayBeAway,
}

/// The figures of an overload, each the worst since it began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OverloadFigures {
    /// The share of the latest looks that found the component on its thread.
    pub utilisation_percent: u8,
    /// How many messages waited for the component that was latest: itself, or one behind it.
    pub queued: usize,
    /// How long the oldest of them had waited.
    pub oldest: Duration,
    /// Rounds that it, and those behind it, missed within one window.
    pub missed_rounds: u64,
    /// Messages to them whose sender did not wait any more when their turn came, within the same.
    pub expired: u64,
    /// For how long one of them has given no sign of life, where that is longer than it may.
    pub silent_for: Duration,
}

impl OverloadFigures {
    /// The worse of each figure.
    pub(super) fn worst(self, other: Self) -> Self {
        OverloadFigures {
            utilisation_percent: self.utilisation_percent.max(other.utilisation_percent),
            queued: self.queued.max(other.queued),
            oldest: self.oldest.max(other.oldest),
            missed_rounds: self.missed_rounds.max(other.missed_rounds),
            expired: self.expired.max(other.expired),
            silent_for: self.silent_for.max(other.silent_for),
        }
    }
}
