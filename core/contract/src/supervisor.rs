//! What is asked of a supervisor, and what it answers.
//!
//! ```text
//! strategy ──RestartChild, ResetChild, IsolateChild, SafeStop──► Supervisor
//!          ◄──Recovered | GaveUp (once it is decided)───────────┘
//! parent, or the node ──StartSupervisor, ExpectEnd, StopSupervisor, AbandonChildren──► Supervisor
//!                     ◄──ChildReport───────────────────────────────────────────────────┘
//! ```
//!
//! Requests go down the tree, events go up; a supervisor awaits no other object.

use crate::child::{Child, ChildReport};
use actix::{Message, Recipient};
use blastema_core::recovery::{ChildRules, ChildState, GiveUpReason, Strategy};
use blastema_core::{Fault, Incarnation, ObjectName};
use std::sync::Arc;

/// A child is well again, or is let go because its specification says so.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recovered {
    /// The child.
    pub object: ObjectName,
    /// The incarnation that is now at work; `None` for a child whose end is final: a temporary one,
    /// or a transient one that had ended in order.
    pub incarnation: Option<Incarnation>,
    /// That incarnation waits for something that is not there yet, and tries again by itself.
    pub waits: bool,
}

/// A supervisor did not bring a child back.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GaveUp {
    /// The child.
    pub object: ObjectName,
    /// Why.
    pub why: GiveUpReason,
}

/// Replace a child's incarnation by the next one, and do with its siblings what the supervisor's
/// strategy says. Answered when all of them are at work again, or when that has failed; what
/// befalls a sibling on the way is a fault of its own.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Result<Recovered, GaveUp>")]
pub struct RestartChild {
    /// The child.
    pub object: ObjectName,
    /// What is wrong with it; `None` when a person asks.
    pub fault: Option<Fault>,
}

/// Let a child go on in its next incarnation on a thread of its own, and its queue with it.
/// Answered as [`RestartChild`].
#[derive(Clone, Debug, Message)]
#[rtype(result = "Result<Recovered, GaveUp>")]
pub struct MoveChild {
    /// The child.
    pub object: ObjectName,
    /// What is wrong with it; `None` when a person asks.
    pub fault: Option<Fault>,
}

/// Let a child in error recover by itself.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Result<Recovered, GaveUp>")]
pub struct ResetChild {
    /// The child.
    pub object: ObjectName,
}

/// Forbid a child to send and receive, or allow it again.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Result<Recovered, GaveUp>")]
pub struct IsolateChild {
    /// The child.
    pub object: ObjectName,
    /// The incarnation that a fault struck: nothing is done if another one has followed it. `None`
    /// means the child, whichever incarnation it has.
    pub faulty: Option<Incarnation>,
    /// Forbidden, or allowed.
    pub isolated: bool,
    /// Why.
    pub reason: String,
}

/// Put a child in safe state: its incarnation ends, it is isolated, and only an explicit restart
/// brings it back. Answered when it has ended.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Result<Recovered, GaveUp>")]
pub struct SafeStop {
    /// The child.
    pub object: ObjectName,
    /// What is wrong with it; `None` when a person asks.
    pub fault: Option<Fault>,
}

/// Take in one more child, behind all the others, and start it if the supervisor is at work.
/// Answered at once, or, if it is to be whole, when the child is at work or is forgotten because it
/// could not be started.
#[derive(Message)]
#[rtype(result = "Result<Recovered, GaveUp>")]
pub struct AddChild {
    /// The child.
    pub child: Box<dyn Child>,
    /// How it is kept.
    pub rules: ChildRules,
    /// Completes or is undone.
    pub whole: bool,
}

/// Stop a child and forget it. Answered when it has ended.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Result<Recovered, GaveUp>")]
pub struct RemoveChild {
    /// The child.
    pub object: ObjectName,
}

/// From the parent, or from the node to the root: begin an incarnation and start all children in
/// order. `report` is told [`Started`] when all are at work; later [`Escalated`] if the supervisor
/// gives up.
///
/// [`Started`]: crate::child::ChildEvent::Started
/// [`Escalated`]: crate::child::ChildEvent::Escalated
#[derive(Clone, Message)]
#[rtype(result = "()")]
pub struct StartSupervisor {
    /// Which incarnation of the supervisor this is.
    pub incarnation: Incarnation,
    /// Who is told what becomes of it.
    pub report: Arc<Recipient<ChildReport>>,
}

/// From the parent: stop all children in reverse order. `Stopped` is reported when all have ended.
#[derive(Clone, Copy, Debug, Message)]
#[rtype(result = "()")]
pub struct StopSupervisor {
    /// The supervisor is to restart, so that what waits for its children goes on waiting.
    pub again: bool,
}

/// From the parent, which has forgotten it: forget all children, and end the supervisor's actor.
#[derive(Clone, Copy, Debug, Message)]
#[rtype(result = "()")]
pub struct ForgetSupervisor;

/// From the parent: you are about to be told to stop, so begin nothing any more. Nothing is
/// reported.
#[derive(Clone, Copy, Debug, Message)]
#[rtype(result = "()")]
pub struct ExpectEnd;

/// From the parent: give all children up at once. Nothing is reported.
#[derive(Clone, Copy, Debug, Message)]
#[rtype(result = "()")]
pub struct AbandonChildren;

/// From the parent: forbid all children to send and receive, or allow it again.
#[derive(Clone, Debug, Message)]
#[rtype(result = "()")]
pub struct IsolateAll {
    /// Forbidden, or allowed.
    pub isolated: bool,
    /// Why.
    pub reason: String,
}

/// How do a supervisor and everything below it stand?
#[derive(Clone, Copy, Debug, Message)]
#[rtype(result = "SupervisionTree")]
pub struct ReadTree;

/// The answer to [`ReadTree`].
#[derive(Clone, Debug, PartialEq, Eq, actix::MessageResponse)]
pub struct SupervisionTree {
    /// The supervisor's name.
    pub name: ObjectName,
    /// Which incarnation.
    pub incarnation: Incarnation,
    /// Whom it restarts together.
    pub strategy: Strategy,
    /// How many more restarts it would allow at this moment.
    pub restarts_left: u32,
    /// Its children in their start order.
    pub children: Vec<SupervisionTreeChild>,
}

/// One child in a [`SupervisionTree`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SupervisionTreeChild {
    /// Its name.
    pub name: ObjectName,
    /// Which incarnation.
    pub incarnation: Incarnation,
    /// Where it stands with its supervisor.
    pub state: ChildState,
    /// How often it was restarted by itself or with its group.
    pub restarts: u64,
    /// Its sending and receiving is forbidden.
    pub isolated: bool,
    /// What stands below it, if it is a supervisor.
    pub below: Option<SupervisionTree>,
}
