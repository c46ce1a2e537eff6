//! Isolating another node by hand, and admitting it again.

use crate::node::Node;
use blastema_contract::strategy::IsolateNode;
use blastema_core::suggestion::nearest;
use blastema_core::{NameError, NodeName};

/// Why a node was neither isolated nor admitted: nothing has changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum IsolateError {
    /// The name does not parse.
    #[error("the name of the node: {0}")]
    Name(#[from] NameError),
    /// The node is this node. To take it out of service, shut it down.
    #[error("{node} is this node itself: shut it down instead")]
    Oneself {
        /// The name of this node.
        node: NodeName,
    },
    /// No node of this name was ever reached or is described. Correct the name, or describe the
    /// node, for example as a neighbour.
    #[error("no node is known here as {node}: {}", known_here(nearest.as_ref(), known))]
    Unknown {
        /// The name that was given.
        node: NodeName,
        /// What may have been meant.
        nearest: Option<NodeName>,
        /// Those that are known, in the order of their names; at most ten.
        known: Vec<NodeName>,
    },
}

/// So many known nodes are listed if the given name is none of them.
const KNOWN_MAX: usize = 10;

fn known_here(nearest: Option<&NodeName>, known: &[NodeName]) -> String {
    let names: Vec<&str> = known.iter().map(NodeName::as_str).collect();
    match (nearest, names.is_empty()) {
        (Some(name), _) => format!("did you mean {name}?"),
        (None, true) => "it knows no other one; is it on a network?".to_owned(),
        (None, false) => format!("it knows {}", names.join(", ")),
    }
}

/// Isolation; with the feature `network`.
impl Node {
    /// Isolates a node that cannot be recovered: from here on its messages are refused here, and
    /// none is sent to it ([`DeliveryError::Isolated`](crate::DeliveryError::Isolated)). Other
    /// nodes decide for themselves; an operator [orders](Node::order_isolation) them, or revokes the
    /// node's key.
    ///
    /// # Errors
    /// Nothing has changed: the name does not parse, is this node's own, or is not that of a node
    /// that this one has met or was configured with, as neighbour or member of a service.
    pub fn isolate(&self, node: &str) -> Result<(), IsolateError> {
        self.set_isolated(node, true)
    }

    /// Admits a node that this one has isolated. The session with that node is opened again.
    ///
    /// # Errors
    /// As [`isolate`](Self::isolate).
    pub fn admit(&self, node: &str) -> Result<(), IsolateError> {
        self.set_isolated(node, false)
    }

    fn set_isolated(&self, node: &str, isolated: bool) -> Result<(), IsolateError> {
        let node = NodeName::new(node)?;
        if node == self.0.name {
            return Err(IsolateError::Oneself { node });
        }
        let networks = self.0.networks.as_ref().filter(|networks| networks.know(&node));
        let Some(networks) = networks else { return Err(self.unknown(node)) };
        let cause = "the application says so".to_owned();
        networks.handle.decide(IsolateNode { node, isolated, cause });
        Ok(())
    }

    fn unknown(&self, node: NodeName) -> IsolateError {
        let mut known = self.0.networks.as_ref().map(|all| all.known()).unwrap_or_default();
        known.remove(&self.0.name);
        let nearest = nearest(node.as_str(), known.iter().map(NodeName::as_str));
        let nearest = nearest.and_then(|name| known.get(name)).cloned();
        IsolateError::Unknown { node, nearest, known: known.into_iter().take(KNOWN_MAX).collect() }
    }
}
