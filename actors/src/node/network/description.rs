//! What the description of a node says of other nodes.

use super::Network;
use super::checks::check_networks;
use crate::node::NodeBuilder;
use crate::node::error::StartError;
use crate::service::{Carried, ServiceSpec, ServiceSpecError, Stateful};
use crate::settings::network::SESSION_TIMEOUT;
use blastema_core::NodeName;
use blastema_core::net::isolation::IsolationAuthority;
use std::time::Duration;

/// The networks of a node, and what it does by way of them.
pub(in crate::node) struct NetworkDescription {
    pub(in crate::node) networks: Vec<Network>,
    pub(in crate::node) services: Vec<Result<Carried, ServiceSpecError>>,
    pub(in crate::node) wardens: Vec<String>,
    pub(in crate::node) session_timeout: Duration,
}

impl Default for NetworkDescription {
    fn default() -> Self {
        NetworkDescription {
            networks: Vec::new(),
            services: Vec::new(),
            wardens: Vec::new(),
            session_timeout: SESSION_TIMEOUT.default,
        }
    }
}

impl NetworkDescription {
    /// Finds what can be known to be wrong before anything is started.
    pub(in crate::node) fn check(&self, node: &NodeName) -> Result<(), StartError> {
        self.judges()?;
        SESSION_TIMEOUT.check(self.session_timeout)?;
        check_networks(&self.networks, node)
    }

    /// Whose word isolates a node.
    pub(in crate::node) fn judges(&self) -> Result<IsolationAuthority, StartError> {
        if self.wardens.is_empty() {
            return Ok(IsolationAuthority::Majority);
        }
        let wardens = self.wardens.iter().map(|name| NodeName::new(name));
        let wardens = wardens
            .collect::<Result<_, _>>()
            .map_err(StartError::name_of("the name of a node that isolates others"))?;
        Ok(IsolationAuthority::Named(wardens))
    }
}

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
