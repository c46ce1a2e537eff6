//! Isolates other nodes for this one, and admits them again.
//!
//! Each node decides for itself. An operator orders every node, or takes a node off the roster that
//! all of them follow.

use super::stub::PeerStubs;
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_contract::strategy::IsolateNode;
use blastema_core::detection::NodeCondition;
use blastema_core::{Incarnation, NodeName};
use std::sync::Arc;
use tracing::warn;

/// A node is isolated from here on, or admitted again.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct IsolationChanged {
    pub(super) node: NodeName,
    pub(super) isolated: bool,
}

/// The parts of the network that refuse an isolated node. Clones are the same.
#[derive(Clone)]
pub(crate) struct IsolationControl {
    pub(super) stubs: Arc<PeerStubs>,
    pub(super) stack: Recipient<IsolationChanged>,
    pub(super) monitor: Option<Recipient<NodeReported>>,
}

impl IsolationControl {
    /// Isolates another node or admits it; does nothing where that is so already.
    pub(super) fn decide(&self, decision: IsolateNode) {
        let IsolateNode { node, isolated, cause } = decision;
        if !self.stubs.send_state(&node).set_isolated(isolated) {
            return;
        }
        warn!(%node, isolated, "isolated, or admitted again: {cause}");
        self.stack.do_send(IsolationChanged { node: node.clone(), isolated });
        if let Some(monitor) = &self.monitor {
            let condition = match isolated {
                true => NodeCondition::Isolated { reason: cause },
                false => NodeCondition::Admitted,
            };
            let incarnation = Incarnation::default();
            monitor.do_send(NodeReported { node, incarnation, condition });
        }
    }
}
