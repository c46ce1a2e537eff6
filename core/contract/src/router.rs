//! What the rest of the node asks of its router.

use actix::Message;
use blastema_core::net::Route;

/// Asks for every node that can be reached, and how, in the order of the nodes' names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Vec<Route>")]
pub struct ReadRoutes;

/// The receiver panics. For demonstrations and tests of what becomes of that.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct InjectPanic;
