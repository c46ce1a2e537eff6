//! Between a supervisor and what it supervises.

use actix::{Message, Recipient};
use blastema_core::{Incarnation, ObjectName};
use std::time::Duration;

/// What a supervisor may do with a child: a component, or a supervisor below it.
///
/// Every call returns at once; what came of it is told to the [`Recipient`] given to
/// [`start`](Child::start). None of them may block, whatever state the child is in.
pub trait Child: Send {
    /// The child's name.
    fn name(&self) -> &ObjectName;

    /// Begins the next life: builds the child, initialises and activates it. Answer:
    /// [`ChildEvent::Started`] or [`ChildEvent::StartFailed`].
    fn start(&mut self, incarnation: Incarnation, report: Recipient<ChildReport>);

    /// Asks the present life to end in order. Answer: [`ChildEvent::Stopped`]. A child that is not
    /// alive answers at once.
    fn stop(&mut self);

    /// Gives the present life up without asking it: its queue is taken away, what it still says goes
    /// nowhere. No answer. The next [`start`](Child::start) finds another place for the child if the
    /// old one is stuck.
    fn abandon(&mut self);

    /// Asks a child in error to recover by itself. Answer: [`ChildEvent::Reset`] or
    /// [`ChildEvent::ResetFailed`].
    fn reset(&mut self);

    /// Forbids the child to send and receive, or allows it again.
    fn isolate(&mut self, isolated: bool);

    /// Leaves a decision with the child's guard, or withdraws it.
    fn standing_order(&mut self, order: Option<StandingOrder>);
}

/// "Panic: restart on the spot, up to `times` in `period`."
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StandingOrder {
    /// How many restarts the guard may still make by itself.
    pub times: u32,
    /// The sliding window in which they are counted.
    pub period: Duration,
}

/// What became of a supervisor's call.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct ChildReport {
    /// The child.
    pub object: ObjectName,
    /// Which of its lives.
    pub incarnation: Incarnation,
    /// What became of it.
    pub event: ChildEvent,
}

/// See [`Child`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ChildEvent {
    /// The new life is active.
    Started,
    /// It could not be built, initialised or activated.
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
}
