//! What is asked of a supervisor, and what it answers.
//!
//! ```text
//! strategy, node ──ChildRequest, AddChild──► Supervisor
//!                ◄──Recovered | GaveUp─────────┘ once it is decided
//! parent, or the node ──SupervisorOrder──► Supervisor
//!                     ◄──ChildReport───────┘
//! ```
//!
//! Requests go down the tree, events go up; a supervisor awaits no other object.

use crate::child::{Child, ChildOrder, ChildReport};
use actix::{Message, Recipient};
use blastema_core::recovery::{ChildRules, ChildState, GiveUpReason, Strategy};
use blastema_core::{Fault, Incarnation, ObjectName};
use std::sync::Arc;

/// A child is well again, or is let go because its specification says so.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recovered {
    /// The child that has recovered.
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
    /// The child that was not brought back.
    pub object: ObjectName,
    /// Why the supervisor gave up.
    pub why: GiveUpReason,
}

/// Have something done with one child. Answered when it is done, or when that has failed.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Result<Recovered, GaveUp>")]
pub struct ChildRequest {
    /// The child that is meant.
    pub object: ObjectName,
    /// What is to be done.
    pub action: ChildAction,
}

/// What a supervisor does with a child when it is asked to.
#[derive(Clone, Debug)]
pub enum ChildAction {
    /// Replace its incarnation by the next one, and do with its siblings what the supervisor's
    /// strategy says: for this fault, or because a person asks. Done when all of them are at work
    /// again; what befalls a sibling on the way is a fault of its own.
    Restart(Option<Fault>),
    /// The same, where the next incarnation of the child runs on a thread of its own, with the same
    /// queue.
    Move(Option<Fault>),
    /// Let it recover from its error by itself.
    Reset,
    /// Forbid it to send and receive, or allow it again.
    Isolate {
        /// The incarnation that a fault struck: nothing is done if another one has followed it.
        /// `None` means the child, whichever incarnation it has.
        faulty: Option<Incarnation>,
        /// Forbidden, or allowed.
        isolated: bool,
        /// The reason, for display.
        reason: String,
    },
    /// Put it in safe state: its incarnation ends, it is isolated, and only an explicit restart
    /// brings it back. Done when it has ended.
    SafeStop(Option<Fault>),
    /// Stop it and forget it. Done when it has ended.
    Remove,
}

/// Take in one more child, behind all the others, and start it if the supervisor is at work.
/// Answered at once, or, if it is to be whole, when the child is at work or is forgotten because it
/// could not be started.
#[derive(Message)]
#[rtype(result = "Result<Recovered, GaveUp>")]
pub struct AddChild {
    /// The child to take in.
    pub child: Box<dyn Child>,
    /// How it is kept.
    pub rules: ChildRules,
    /// Completes or is undone.
    pub whole: bool,
}

/// What a supervisor is told by its parent, or the root by its node.
#[derive(Clone, Debug, Message)]
#[rtype(result = "()")]
pub enum SupervisorOrder {
    /// Begin an incarnation and start all children in order. `report` is told [`Started`] when all
    /// are at work; later [`Escalated`] if the supervisor gives up.
    ///
    /// [`Started`]: crate::child::ChildEvent::Started
    /// [`Escalated`]: crate::child::ChildEvent::Escalated
    Start {
        /// Which incarnation of the supervisor this is.
        incarnation: Incarnation,
        /// Where its reports go.
        report: Arc<Recipient<ChildReport>>,
    },
    /// Carry this out, as any child does.
    Carry(ChildOrder),
    /// Why its children will be isolated.
    ExplainIsolation(String),
    /// The parent has forgotten the supervisor: forget all children, and end the actor.
    Forget,
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
    /// The supervisor's present incarnation.
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
    /// The child's name.
    pub name: ObjectName,
    /// The child's present incarnation.
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
