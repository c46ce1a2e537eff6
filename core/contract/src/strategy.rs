//! Between the recoverer and the strategies that carry its decisions out.

use actix::Message;
use blastema_core::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};
use blastema_core::{Fault, FaultLocation, NodeName};

/// Carry one action out. Answered when it has worked or failed; a strategy that dies, or is silent
/// for longer than the plan gives it, has failed.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Result<RecoveryDone, RecoveryFailed>")]
pub struct ExecuteAction(pub RecoveryOrder);

/// To the router: find another way for what goes over this link, or to this node.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Result<RecoveryDone, RecoveryFailed>")]
pub struct Reroute {
    /// What is not to be used any more.
    pub location: FaultLocation,
}

/// To the network: isolate this node, or admit it again.
#[derive(Clone, Debug, Message)]
#[rtype(result = "Result<RecoveryDone, RecoveryFailed>")]
pub struct IsolateNode {
    /// The node to isolate or to admit.
    pub node: NodeName,
    /// Whether it is to be isolated.
    pub isolated: bool,
    /// Why, for display.
    pub cause: String,
}

/// To the node: nothing else could contain this. Apply the safe outputs, stop everything, rest.
#[derive(Clone, Debug, Message)]
#[rtype(result = "()")]
pub struct EnterSafeState {
    /// The fault that could not be contained.
    pub fault: Fault,
    /// What was tried last, and what it said.
    pub reason: String,
}
