//! Between a supervisor and what it supervises.

use crate::reports::ExitReason;
use actix::{Message, Recipient};
use blastema_core::{Incarnation, ObjectName};
use std::sync::Arc;

pub use blastema_core::recovery::ChildOrder;

/// What a supervisor may do with a child: a component, or a supervisor below it.
///
/// Every call returns at once; what came of it is told to the [`Recipient`] given to
/// [`start`](Child::start). None of them may block, whatever state the child is in.
pub trait Child: Send {
    /// The child's name.
    fn name(&self) -> &ObjectName;

    /// Begins the next incarnation: builds the child, initialises and activates it. Says which
    /// incarnation it is: `incarnation`, or a later one where the child's guard has begun that one
    /// by itself and the report of it is still under way. Answer: [`ChildEvent::Started`],
    /// [`ChildEvent::StartFailed`], or [`ChildEvent::Unavailable`] first.
    fn start(
        &mut self,
        incarnation: Incarnation,
        report: Arc<Recipient<ChildReport>>,
    ) -> Incarnation;

    /// Carries an order out. Answer to [`ChildOrder::Stop`]: [`ChildEvent::Stopped`]; to
    /// [`ChildOrder::Reset`]: [`ChildEvent::Reset`] or [`ChildEvent::ResetFailed`]. Says whether an
    /// incarnation that was [cut off](ChildOrder::CutOff) keeps its thread.
    fn order(&mut self, order: ChildOrder) -> bool;

    /// From its next [`start`](Child::start) on, the child lives on a thread of its own.
    ///
    /// # Errors
    /// It does already, or cannot.
    fn move_to_own_thread(&mut self) -> Result<(), &'static str> {
        Err("it has no thread that it could leave")
    }

    /// The reason of a [`ChildOrder::Isolate`] that follows, for those whose messages are refused
    /// then.
    fn explain_isolation(&mut self, _reason: &str) {}
}

/// The outcome of a supervisor's call.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct ChildReport {
    /// The child that the report is about.
    pub object: ObjectName,
    /// The incarnation that the report is about.
    pub incarnation: Incarnation,
    /// The event, such as the outcome of a call.
    pub event: ChildEvent,
}

/// The event that a [`ChildReport`] carries.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ChildEvent {
    /// The new incarnation is active, or, after [`Unavailable`](ChildEvent::Unavailable), it is at
    /// last.
    Started,
    /// Something that it needs, such as its device, is not there yet. It tries again by itself, for
    /// as long as that takes; until then it is not active.
    Unavailable {
        /// What it waits for, as the component said it.
        reason: String,
    },
    /// It could not be built, initialised or activated; its last hooks run.
    /// [`StartFailed`](ChildEvent::StartFailed) follows when they have.
    FailsToStart,
    /// It could not be built, initialised or activated, and has ended: its last hooks have run.
    StartFailed {
        /// Why, as the component said it.
        reason: String,
    },
    /// It ended in order, as it was told.
    Stopped,
    /// It is initialised again after an error, and active.
    Reset,
    /// It is still in error.
    ResetFailed {
        /// Why, as the component said it.
        reason: String,
    },
    /// Its incarnation ended although its supervisor had not asked for it; the guard has told the
    /// monitor the same in [`Exited`](crate::reports::Exited).
    Died {
        /// How it ended.
        exit: ExitReason,
        /// The guard has used its grant: this incarnation has begun in the old
        /// one's place.
        restarted_as: Option<Incarnation>,
    },
    /// It is the root, whose children failed more often than it allows; it ends them all from now
    /// on, and then has [escalated](ChildEvent::Escalated).
    GivesUp {
        /// The limit that was exceeded, and the child that exceeded it.
        reason: String,
    },
    /// It is a supervisor whose children failed more often than it allows; it has ended them all
    /// and leaves the decision to whom it reports.
    Escalated {
        /// The limit that was exceeded, and the child that exceeded it.
        reason: String,
    },
}
