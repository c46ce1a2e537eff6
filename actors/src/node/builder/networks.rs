//! How other nodes are described, and what is done by way of them.

use super::NodeBuilder;
use crate::node::network::Network;
use crate::service::{ServiceSpec, Stateful};
use std::time::Duration;

/// Other nodes; with the feature `network`.
impl NodeBuilder {
    /// One more network that the node is on.
    pub fn network(mut self, network: Network) -> Self {
        self.networks.networks.push(network);
        self
    }

    /// One more node whose word alone [isolates](crate::Node::isolate) another one, or lets it in
    /// again. Without any, it takes more than half of the nodes that are there. Every node of the
    /// robot is told the same.
    pub fn warden(mut self, node: &str) -> Self {
        self.networks.wardens.push(node.to_owned());
        self
    }

    /// Carries a service together with other nodes, which are given the same spec. The component
    /// stands under the root supervisor as `<name>/replica`.
    pub fn service<C: Stateful>(mut self, spec: ServiceSpec<C>) -> Self {
        let (component, carried) = spec.carried(&self.name);
        self.networks.services.push(carried);
        self.child(component)
    }

    /// How long another node may owe an answer, or be without a path, before the session with it
    /// ends and what it did not acknowledge comes back: 2 s unless this says otherwise, 200 ms to
    /// an hour. Longer rides out longer outages; shorter resolves requests sooner. Where answers
    /// take long, it is three of the present retransmission timeouts if these are longer.
    pub fn session_timeout(mut self, timeout: Duration) -> Self {
        self.networks.session_timeout = timeout;
        self
    }
}
