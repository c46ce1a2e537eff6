//! What the framework tells the host of a component.

use actix::Message;

/// What the framework tells a host, on the control queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub(crate) enum HostCommand {
    /// End in order.
    Stop,
    /// End in order, because another incarnation follows.
    MakeWay,
    /// Recover from an error.
    Reset,
    /// Return to work, or leave it.
    Activate(bool),
    /// Look again: something was decided elsewhere.
    Wake,
    /// A test has it panic.
    Panic,
}
