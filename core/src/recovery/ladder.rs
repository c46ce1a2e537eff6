//! What is done about one kind of fault: first this, then that, at last safe rest.

use super::Backoff;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

/// One thing that can be done about a fault.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Measure {
    /// Nothing but to keep it in the record: it passes, or somebody else has it in hand.
    Observe,
    /// Let the component recover by itself, in its present life (`on_reset`).
    Reset,
    /// Replace the present life by the next one, with its siblings as the supervisor's strategy says.
    Restart,
    /// Let the component go on in its next life on a thread of its own, with its queue: against an
    /// overload that makes its neighbours late. It fails where the component has one already.
    MoveToOwnThread,
    /// Find another way over the network.
    Reroute,
    /// Forbid its sending and receiving.
    Isolate,
    /// Safe rest: safe outputs, and the object, or the node, comes to rest.
    SafeStop,
    /// A strategy of the application's own, by name.
    Custom(Arc<str>),
}

impl Measure {
    /// The name of the strategy that carries it out.
    pub fn name(&self) -> &str {
        match self {
            Measure::Observe => "observe",
            Measure::Reset => "reset",
            Measure::Restart => "restart",
            Measure::MoveToOwnThread => "move to own thread",
            Measure::Reroute => "reroute",
            Measure::Isolate => "isolate",
            Measure::SafeStop => "safe stop",
            Measure::Custom(name) => name,
        }
    }

    /// How long it is given unless the plan says otherwise: about ten times what it takes on a busy
    /// computer, and for a restart the deadlines of a group of children one after the other.
    pub fn usual_limit(&self) -> Duration {
        match self {
            Measure::Observe | Measure::Isolate => Duration::from_secs(1),
            Measure::Reset | Measure::Reroute => Duration::from_secs(2),
            Measure::SafeStop => Duration::from_secs(10),
            Measure::Restart | Measure::MoveToOwnThread | Measure::Custom(_) => {
                Duration::from_secs(30)
            }
        }
    }
}

impl fmt::Display for Measure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One rung of a [`Ladder`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Step {
    /// What is done.
    pub measure: Measure,
    /// How often it is tried before the next rung; at least 1.
    pub attempts: u32,
    /// How long to wait between two attempts.
    pub backoff: Backoff,
    /// One attempt that takes longer has failed.
    pub within: Duration,
}

/// Measures in the order in which they are tried.
///
/// A ladder that is exhausted ends in safe rest, whether or not that is its last rung.
///
/// ```
/// use blastema_core::recovery::{Ladder, Measure};
///
/// let ladder = Ladder::first(Measure::Reset).then(Measure::Restart).times(3);
/// assert_eq!(ladder.steps()[1].attempts, 3);
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ladder(Vec<Step>);

impl Ladder {
    /// A ladder whose first rung is one attempt at `measure`.
    pub fn first(measure: Measure) -> Self {
        Ladder(Vec::new()).then(measure)
    }

    /// One more rung: one attempt at `measure`.
    #[must_use]
    pub fn then(mut self, measure: Measure) -> Self {
        let within = measure.usual_limit();
        self.0.push(Step { measure, attempts: 1, backoff: Backoff::default(), within });
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
    pub fn steps(&self) -> &[Step] {
        &self.0
    }

    fn last(&mut self) -> &mut Step {
        self.0.last_mut().expect("a ladder is made with its first rung")
    }
}
