//! What is done about one kind of fault: first this, then that, at last safe state.

use super::Backoff;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

/// A recovery action.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum RecoveryAction {
    /// Nothing but to keep it in the record: it passes, or another part recovers it.
    Observe,
    /// Let the component recover by itself, in its present incarnation (`on_reset`).
    Reset,
    /// Replace the present incarnation by the next one, and its siblings as the supervisor's
    /// strategy requires.
    Restart,
    /// Let the component go on in its next incarnation on a thread of its own, with its queue:
    /// against an overload that makes its neighbours late. It fails where the component has one
    /// already.
    MoveToOwnThread,
    /// Find another way over the network.
    Reroute,
    /// Forbid its sending and receiving.
    Isolate,
    /// Safe outputs, and the object, or the node, enters the safe state.
    SafeStop,
    /// A strategy of the application's own, by name.
    Custom(Arc<str>),
}

impl RecoveryAction {
    /// The name of the strategy that carries it out.
    pub fn name(&self) -> &str {
        match self {
            RecoveryAction::Observe => "observe",
            RecoveryAction::Reset => "reset",
            RecoveryAction::Restart => "restart",
            RecoveryAction::MoveToOwnThread => "move to own thread",
            RecoveryAction::Reroute => "reroute",
            RecoveryAction::Isolate => "isolate",
            RecoveryAction::SafeStop => "safe stop",
            RecoveryAction::Custom(name) => name,
        }
    }

    /// The default limit of this action: about ten times what it takes on a busy computer, and for
    /// a restart the deadlines of a group of children one after the other.
    fn usual_limit(&self) -> Duration {
        match self {
            RecoveryAction::Observe | RecoveryAction::Isolate => Duration::from_secs(1),
            RecoveryAction::Reset | RecoveryAction::Reroute => Duration::from_secs(2),
            RecoveryAction::SafeStop => Duration::from_secs(10),
            RecoveryAction::Restart
            | RecoveryAction::MoveToOwnThread
            | RecoveryAction::Custom(_) => Duration::from_secs(30),
        }
    }
}

impl fmt::Display for RecoveryAction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One rung of a [`Ladder`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LadderStep {
    /// The action of this step.
    pub action: RecoveryAction,
    /// How often it is tried before the next rung; at least 1.
    pub attempts: u32,
    /// How long to wait between two attempts.
    pub backoff: Backoff,
    /// The limit of one attempt; an attempt that takes longer has failed.
    pub within: Duration,
}

/// Actions in the order in which they are tried.
///
/// A ladder that is exhausted ends in the safe state, whether or not that is its last rung.
///
/// ```
/// use blastema_core::recovery::{Ladder, RecoveryAction};
///
/// let ladder = Ladder::first(RecoveryAction::Reset).then(RecoveryAction::Restart).times(3);
/// assert_eq!(ladder.steps()[1].attempts, 3);
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ladder(Vec<LadderStep>);

impl Ladder {
    /// A ladder whose first rung is one attempt at `action`.
    pub fn first(action: RecoveryAction) -> Self {
        Ladder(Vec::new()).then(action)
    }

    /// Adds a step: one attempt at `action`.
    #[must_use]
    pub fn then(mut self, action: RecoveryAction) -> Self {
        let within = action.usual_limit();
        self.0.push(LadderStep { action, attempts: 1, backoff: Backoff::default(), within });
        self
    }

    /// The rung added last is tried so often.
    #[must_use]
    pub fn times(mut self, attempts: u32) -> Self {
        self.last().attempts = attempts;
        self
    }

    /// The rung added last waits so between its attempts.
    #[must_use]
    pub fn backoff(mut self, backoff: Backoff) -> Self {
        self.last().backoff = backoff;
        self
    }

    /// An attempt at the rung added last that takes longer has failed.
    #[must_use]
    pub fn within(mut self, limit: Duration) -> Self {
        self.last().within = limit;
        self
    }

    /// The rungs, lowest first; never empty.
    pub fn steps(&self) -> &[LadderStep] {
        &self.0
    }

    fn last(&mut self) -> &mut LadderStep {
        self.0.last_mut().expect("a ladder is made with its first rung")
    }
}
