//! What the rest of the node asks of its router.

use actix::Message;
use blastema_core::net::Route;

/// Asks for every node that can be reached, and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Routes")]
pub struct ReadRoutes;

/// The answer to [`ReadRoutes`].
#[derive(Clone, Debug, PartialEq, Eq, actix::MessageResponse)]
pub struct Routes {
    /// In the order of the nodes' names.
    pub routes: Vec<Route>,
}

/// The receiver panics. For demonstrations and tests of what becomes of that.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct InjectPanic;
