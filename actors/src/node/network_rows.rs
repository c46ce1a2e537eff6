//! A node's networks, their media and its routes, for display.

use blastema_contract::link::LinkRow;
use blastema_contract::reports::FaultDeclared;
use blastema_contract::transport::TransportCounters;
use blastema_core::net::{LinkId, Route};
use blastema_core::{FaultKind, Incarnation, NodeName, ObjectName};
use blastema_transports::Reach;
use serde::{Serialize, Serializer};
use std::sync::Arc;
use tracing::info;

/// One network of a node, for display.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct NetworkRow {
    /// The network's name.
    pub network: Arc<str>,
    /// Its medium, as in `udp://0.0.0.0:7400`.
    pub medium: String,
    /// How far its frames travel.
    #[serde(serialize_with = "shown")]
    pub reach: Reach,
    /// Whether its frames are authenticated and, but on a bus, encrypted.
    pub sealed: bool,
    /// Whether it leaves this computer without authentication.
    pub insecure: bool,
}

fn shown<S: Serializer>(reach: &Reach, to: S) -> Result<S::Ok, S::Error> {
    to.collect_str(reach)
}

impl NetworkRow {
    /// Tells the user of a network that other users of this computer can reach.
    pub(in crate::node) fn log(&self) {
        if self.reach == Reach::Computer && !self.sealed {
            info!(
                network = %self.network,
                "any user of this computer can speak to this node over {}", self.medium
            );
        }
    }

    /// The fault of an insecure network, declared of its transport.
    pub(in crate::node) fn fault(&self) -> Option<FaultDeclared> {
        let object = ObjectName::new(&format!("transport/{}", self.network)).ok()?;
        self.insecure.then(|| FaultDeclared {
            object,
            incarnation: Incarnation::FIRST,
            kind: FaultKind::Insecure,
            detail: format!(
                "network {} ({}) is insecure: every station on it can command this robot",
                self.network, self.medium
            ),
            hold: None,
        })
    }
}

/// What the medium of a network has carried and lost, for display. All links of the network share
/// it.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct MediumRow {
    /// The network's name.
    pub network: Arc<str>,
    /// What its transport has counted, and what waits now.
    pub counters: TransportCounters,
}

/// A route to another node, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct RouteRow {
    /// The node that the route leads to.
    pub node: NodeName,
    /// In which incarnation.
    pub incarnation: Incarnation,
    /// The link that is taken now; `None` when none carries.
    pub link: Option<LinkName>,
    /// The link to take when that of the shortest path fails.
    pub alternate: Option<LinkName>,
    /// The sum of the costs of the links on the shortest path.
    pub cost: u32,
    /// The largest frame that both paths carry, in bytes.
    pub mtu: u16,
    /// How many nodes pass a packet on along the longer of both.
    pub relays: u8,
}

/// A link of a node, by the names of its configuration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkName {
    /// The network's name.
    pub network: Arc<str>,
    /// The link's name there.
    pub link: Arc<str>,
}

impl RouteRow {
    /// The route, whose links are among these; a link that is gone by now has no name.
    pub(in crate::node) fn of(route: &Route, links: &[LinkRow]) -> Self {
        let named = |number: LinkId| {
            let row = links.iter().find(|row| row.number == number)?;
            Some(LinkName { network: row.network.clone(), link: row.link.clone() })
        };
        RouteRow {
            node: route.node.clone(),
            incarnation: route.incarnation,
            link: route.chosen.and_then(named),
            alternate: route.alternate.and_then(named),
            cost: route.cost,
            mtu: route.mtu,
            relays: route.relays,
        }
    }
}
