//! The methods of a node that show its networks.

use super::Cable;
use crate::directory::NodeRow;
use crate::net::RosterRow;
use crate::node::Node;
use crate::node::network_rows::MediumRow;
use crate::topic::TopicRow;
use blastema_contract::link::LinkRow;
use blastema_contract::router::InjectPanic;
use blastema_contract::session::SessionRow;
use blastema_core::directory::DirectoryKey;
use blastema_core::net::Route;
use blastema_core::{NodeName, ObjectName};
use std::time::Duration;

/// Links, routes and sessions; with the feature `network`.
impl Node {
    /// Waits until the node of this name has a path and a session, its start is over, and it has
    /// told what it listens to, and returns whether this happened in time: what is published then
    /// reaches its listeners, what is asked its objects, and their ends their watchers. A link
    /// needs a few hellos to come up, also after both nodes have started. A process that was killed
    /// counts as connected until its absence is found.
    pub async fn connected(&self, node: &str, within: Duration) -> bool {
        let (Some(networks), Ok(node)) = (&self.0.networks, NodeName::new(node)) else {
            return false;
        };
        tokio::time::timeout(within, networks.handle.connected(&node)).await.is_ok()
    }

    /// All links, in the order in which they were described; none without a network.
    pub async fn links(&self) -> Vec<LinkRow> {
        match &self.0.networks {
            Some(networks) => networks.handle.read_links().await,
            None => Vec::new(),
        }
    }

    /// What the medium of each network has carried and lost, and what waits for it now.
    pub async fn media(&self) -> Vec<MediumRow> {
        let Some(networks) = &self.0.networks else { return Vec::new() };
        let rows = networks.handle.read_media().await;
        rows.into_iter().map(|(network, counters)| MediumRow { network, counters }).collect()
    }

    /// Every node that can be reached from here, and over which link.
    pub async fn routes(&self) -> Vec<Route> {
        match &self.0.networks {
            Some(networks) => networks.handle.read_routes().await.routes,
            None => Vec::new(),
        }
    }

    /// The roster that this node uses, with its serial number; none without keys.
    pub async fn roster(&self) -> Option<RosterRow> {
        self.0.networks.as_ref()?.handle.read_roster().await
    }

    /// The sessions with other nodes: whether they stand, how much is under way, and what was lost,
    /// repeated, late or refused.
    pub async fn sessions(&self) -> Vec<SessionRow> {
        match &self.0.networks {
            Some(networks) => networks.handle.read_sessions().await,
            None => Vec::new(),
        }
    }

    /// Completes a row by what other nodes have.
    pub(in crate::node) fn with_publishing_nodes(&self, row: TopicRow) -> TopicRow {
        let Ok(topic) = ObjectName::new(&row.topic) else { return row };
        let key = DirectoryKey::Publisher { topic, contract: row.contract.clone() };
        let publishing_nodes = self.0.environment.directory().nodes_with(&key);
        TopicRow { publishing_nodes, ..row }
    }

    /// Every other node that a session is open with, and its objects.
    pub fn neighbourhood(&self) -> Vec<NodeRow> {
        self.0.environment.directory().node_rows()
    }

    /// The cable of a network that was described [`with_faults`](crate::Network::with_faults).
    pub fn cable(&self, network: &str) -> Option<Cable> {
        self.0.networks.as_ref()?.cables.get(network).cloned()
    }

    /// Makes this node's router panic, for demonstrations and tests; nothing without a network.
    pub fn panic_router(&self) {
        if let Some(networks) = &self.0.networks {
            networks.handle.router().do_send(InjectPanic);
        }
    }
}
