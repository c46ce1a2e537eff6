//! How other nodes are described, and what is done by way of them.

use super::NodeBuilder;
use crate::net::keys::KeysPermissions;
use crate::node::network::Network;
use crate::service::{ServiceSpec, Stateful};
use std::path::PathBuf;
use std::time::Duration;

/// Other nodes.
impl NodeBuilder {
    /// Adds a network.
    pub fn network(mut self, network: Network) -> Self {
        self.networks.networks.push(network);
        self
    }

    /// Lets each network that was added be cut and impaired by [`Node::cable`](crate::Node::cable),
    /// as [`Network::with_faults`] does.
    pub fn with_faults(mut self, seed: u64) -> Self {
        let networks = self.networks.networks.into_iter();
        self.networks.networks = networks.map(|network| network.with_faults(seed)).collect();
        self
    }

    /// Gives the node its key, which `blastema keys new` has made, and the roster beside it: all
    /// its networks are [sealed](crate::manual::security). Without this line the environment
    /// variable `BLASTEMA_KEYS` names the file, if it is set and not empty.
    ///
    /// A file that is missing, another node's, or open to other users is
    /// [`StartError::Keys`](crate::StartError::Keys) when the node starts.
    pub fn keys(mut self, file: impl Into<PathBuf>) -> Self {
        self.networks.key_file = Some(file.into());
        self
    }

    /// Sets whether keys and rosters that other users can read or change are refused, as they are
    /// by default.
    pub fn keys_permissions(mut self, permissions: KeysPermissions) -> Self {
        self.networks.keys_permissions = permissions;
        self
    }

    /// Carries a service together with other nodes, which are given the same spec. The component
    /// stands under the root supervisor as `<name>/replica`.
    pub fn service<C: Stateful>(mut self, spec: ServiceSpec<C>) -> Self {
        let (component, carried) = spec.carried(&self.name);
        self.networks.services.push(carried);
        self.child(component)
    }

    /// Declares that another node may be away, such as an operator's laptop: that it is not there
    /// yet, ends, or cannot be reached is [a state of its row](crate::Node::table) and no fault,
    /// and its links are [not expected](crate::Link::expected_within) to come up. What depends on
    /// it knows by a [condition](crate::Connected::node), and watchers by [`Down`](crate::Down).
    ///
    /// This node itself, a node that its roster does not list, and any on a node without networks
    /// are [`StartError::Network`](crate::StartError::Network) when the node starts.
    pub fn may_be_away(mut self, node: &str) -> Self {
        self.networks.may_be_away.push(node.to_owned());
        self
    }

    /// Sets how long another node may leave segments unacknowledged, or be without a path, before
    /// the session with it ends and unacknowledged messages are returned: 2 s by default, 200 ms to
    /// 1 h. Longer rides out longer outages; shorter resolves requests sooner. Where answers take
    /// long, it is three of the present retransmission timeouts if these are longer.
    pub fn session_timeout(mut self, timeout: Duration) -> Self {
        self.networks.session_timeout = timeout;
        self
    }
}
