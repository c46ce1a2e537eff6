//! What a supervisor is asked, what it wants done, and why it did not do something.

use crate::{Incarnation, ObjectName};
use std::time::Duration;

/// A request that waits for its outcome; the caller chooses the number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CallId(pub u64);

/// Why a supervisor did not do what it was asked.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GiveUpReason {
    /// The supervisor has no child of this name.
    #[error("no such child")]
    Unknown,
    /// The supervisor itself was stopped or has not begun.
    #[error("its supervisor is not at work")]
    NotAtWork,
    /// The next incarnation could not be built, initialised or activated.
    #[error("its next incarnation did not start: {reason}")]
    StartFailed {
        /// Why, as the component said it.
        reason: String,
    },
    /// The component could not recover by itself.
    #[error("it could not reset itself: {reason}")]
    ResetFailed {
        /// Why, as the component said it.
        reason: String,
    },
    /// A reset needs an incarnation at work, and there is none.
    #[error("it has no incarnation that could be reset")]
    NoIncarnation,
    /// The child did not answer in time.
    #[error("it did not answer within {limit:?}")]
    Overdue {
        /// The deadline of its rules.
        limit: Duration,
    },
    /// The child is in the safe state; only a person restarts it, no recovery.
    #[error("it is in the safe state")]
    Resting,
    /// Its end was final.
    #[error("it is not restarted: its end was final, as its rules say")]
    Finished,
    /// The child needs more restarts than the intensity allows; its siblings continue.
    #[error("it is not restarted any more: {reason}")]
    IntensityExceeded {
        /// The limit that was exceeded.
        reason: String,
    },
    /// More restarts than the intensity allows, up to the root.
    #[error("given up: {reason}")]
    Escalated {
        /// The limit that was exceeded, and the child that exceeded it.
        reason: String,
    },
    /// There already is a child of this name.
    #[error("there already is a child of this name")]
    NameTaken,
    /// The supervisor can take no more children or requests.
    #[error("its supervisor is full: it takes no more than {limit}")]
    Full {
        /// The most children or requests.
        limit: usize,
    },
    /// A user has ordered the child to start while it was put into the safe state.
    #[error("it is started again, on request")]
    StartedAgain,
    /// The supervisor lost this request when it was restarted.
    #[error("its supervisor was restarted")]
    Forgotten,
}

/// What a supervisor has a child do, besides to start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChildOrder {
    /// End the present incarnation in order. A child that is not alive answers at once.
    Stop {
        /// Another incarnation is to follow, so that what waits for the child goes on waiting.
        again: bool,
    },
    /// The present incarnation is about to be asked to end, after others: a supervisor starts
    /// nothing any more. No answer.
    ExpectEnd,
    /// The child has no incarnation that works, and none is to follow: give back what waits for it,
    /// and give one up whose start has failed, with its last hooks. No answer. The next start takes
    /// the child up again.
    Retire,
    /// Give the present incarnation up without asking it: its queue is taken away, what it still
    /// says goes nowhere. No answer. The next start finds another place for the child if the old
    /// one is stuck.
    Abandon,
    /// The same with an incarnation that has had its time to start, or to end; report where it
    /// keeps its thread.
    CutOff,
    /// Recover from an error.
    Reset,
    /// Forbid sending and receiving, or allow it again.
    Isolate(bool),
    /// The child's guard may restart it once by itself after a panic, or no longer.
    GrantRestart(bool),
}

/// An output of a supervisor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SupervisorOutput {
    /// Begin the child's next incarnation.
    Start {
        /// The child to start.
        child: ObjectName,
        /// The incarnation that begins.
        incarnation: Incarnation,
    },
    /// Have the child carry this out.
    Order {
        /// The child that carries it out.
        child: ObjectName,
        /// The order that it carries out.
        order: ChildOrder,
    },
    /// The request is fulfilled: the child is at work, or let go.
    Recovered {
        /// The number of the request.
        call: CallId,
        /// The child that the request is about.
        child: ObjectName,
        /// The incarnation at work; `None` where no incarnation is wanted.
        incarnation: Option<Incarnation>,
    },
    /// The request is fulfilled as far as it can be: the new incarnation waits for something that
    /// is not there yet, and tries again by itself.
    Waits {
        /// The number of the request.
        call: CallId,
        /// The child that the request is about.
        child: ObjectName,
        /// The incarnation that waits.
        incarnation: Incarnation,
    },
    /// The request is not going to be fulfilled.
    GaveUp {
        /// The number of the request.
        call: CallId,
        /// The child that the request is about.
        child: ObjectName,
        /// Why it is not fulfilled.
        why: GiveUpReason,
    },
    /// A child that is a supervisor has escalated, and is not worth restarting any more; it has
    /// ended. The recoverer decides about it.
    Refused {
        /// The child that has ended.
        child: ObjectName,
        /// The incarnation that escalated.
        incarnation: Incarnation,
        /// The limit that was exceeded, and the child that exceeded it.
        reason: String,
    },
    /// The supervisor has come as far as it can: a child waits for something that is not there yet,
    /// and those behind it depend on it. What it waits for, as the component said it.
    Unavailable(String),
    /// A start took too long, and its guard does not say so: give the incarnation up, and report
    /// it.
    Overdue {
        /// The child that does not start.
        child: ObjectName,
        /// The incarnation that did not come to be.
        incarnation: Incarnation,
        /// The deadline of its rules.
        limit: Duration,
    },
    /// The child has ended and is forgotten.
    Left(ObjectName),
    /// The root's restarts are not worth it any more: what must be safe is made safe now. All
    /// children are ended next, which takes its time. The limit that was exceeded, and the child
    /// that exceeded it.
    GiveUp(String),
    /// Restarts are not worth it any more; all children have ended. The next authority decides.
    /// The limit that was exceeded, and the child that exceeded it.
    Escalate(String),
    /// All children are at work for the first time in this incarnation.
    AllStarted,
    /// All children have ended, as ordered.
    AllStopped,
}
