//! A route to another node, with its links by name.

use blastema_contract::link::LinkRow;
use blastema_core::net::{LinkId, Route};
use blastema_core::{Incarnation, NodeName};
use std::sync::Arc;

/// A route to another node, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct RouteRow {
    /// Whereto.
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
