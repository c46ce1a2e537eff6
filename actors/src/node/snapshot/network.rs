//! Everything that a node knows of other nodes at one moment.

use crate::AccessRefusal;
use crate::directory::ClaimRow;
use crate::net::RosterRow;
use crate::node::Node;
use crate::node::network_rows::{LinkName, MediumRow, NetworkRow, RouteRow};
use crate::node::snapshot::{in_time, millis, rows_of};
use crate::service::ServiceRow;
use blastema_contract::link::LinkRow;
use blastema_contract::session::SessionRow;
use blastema_core::NodeName;
use futures_util::future::join5;
use serde_json::{Value, json};

/// Everything that a node knows of other nodes at one moment, as part of its
/// [`NodeSnapshot`](crate::NodeSnapshot).
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct NetworkSnapshot {
    /// The networks, and which of them are sealed or insecure.
    pub networks: Vec<NetworkRow>,
    /// What the medium of each network has carried and lost.
    pub media: Option<Vec<MediumRow>>,
    /// The roster that the node uses; an empty list without keys.
    pub roster: Option<Vec<RosterRow>>,
    /// The links, in the order in which they were described.
    pub links: Option<Vec<LinkRow>>,
    /// Every node that can be reached, and over which link.
    pub routes: Option<Vec<RouteRow>>,
    /// The sessions with other nodes.
    pub sessions: Option<Vec<SessionRow>>,
    /// The global names with a holder, as known to this node.
    pub claims: Vec<ClaimRow>,
    /// The services that the node hosts, and the primary of each.
    pub services: Vec<ServiceRow>,
    /// What other nodes were refused by the robot's policy.
    pub forbidden: Vec<AccessRefusal>,
}

impl NetworkSnapshot {
    pub(in crate::node) async fn of(node: &Node) -> Self {
        let (links, routes, roster, sessions, media) = join5(
            in_time(node.links()),
            in_time(node.routes()),
            in_time(node.roster()),
            in_time(node.sessions()),
            in_time(node.media()),
        )
        .await;
        // Without the links, those of a route have no names.
        let routes = links
            .as_deref()
            .zip(routes)
            .map(|(links, routes)| routes.iter().map(|route| RouteRow::of(route, links)).collect());
        NetworkSnapshot {
            networks: node.networks().to_vec(),
            media,
            roster: roster.map(Vec::from_iter),
            links,
            routes,
            sessions,
            claims: node.claims(),
            services: node.services(),
            forbidden: node.refusals(),
        }
    }

    /// Completes the node's JSON document.
    pub(in crate::node) fn shown_in(&self, mut document: Value) -> Value {
        document["networks"] = json!(self.networks);
        document["links"] = self.links.as_deref().map(|rows| rows_of(rows, link)).into();
        document["media"] = self.media.as_deref().map(|rows| rows_of(rows, medium)).into();
        document["roster"] = json!(self.roster);
        document["routes"] = self.routes.as_deref().map(|rows| rows_of(rows, route)).into();
        document["sessions"] = self.sessions.as_deref().map(|rows| rows_of(rows, session)).into();
        document["global_names"] = rows_of(&self.claims, claim).into();
        document["services"] = rows_of(&self.services, service).into();
        document["forbidden"] = rows_of(&self.forbidden, forbidden).into();
        document
    }
}

fn medium(row: &MediumRow) -> Value {
    let counters = &row.counters;
    json!({
        "network": &*row.network,
        "frames_sent": counters.sent,
        "frames_received": counters.received,
        "frames_dropped": counters.dropped,
        "refused": counters.refused,
        "errors": counters.errors,
        "queued": counters.backlog.frames,
        "oldest_ms": millis(counters.backlog.oldest),
    })
}

fn link(row: &LinkRow) -> Value {
    json!({
        "network": &*row.network,
        "link": &*row.link,
        "state": row.state.to_string(),
        "neighbour": row.neighbour.as_ref().map(|neighbour| neighbour.node.as_str()),
        "last_sign_ms": millis(row.last_sign),
        "round_trip_ms": millis(row.quality.round_trip),
        "jitter_ms": millis(row.quality.jitter),
        "loss_permille": row.quality.loss_permille,
        "cost": row.cost,
        "frames_sent": row.traffic.frames_sent,
        "bytes_sent": row.traffic.bytes_sent,
        "frames_received": row.traffic.frames_received,
        "bytes_received": row.traffic.bytes_received,
        "bytes_sent_per_s": row.rate.sent,
        "bytes_received_per_s": row.rate.received,
        "frames_dropped": row.traffic.frames_dropped,
        "refused": row.refusals.total(),
        "seal": row.seal.map(|seal| seal.cipher),
        "key_age_ms": millis(row.seal.map(|seal| seal.key_age)),
    })
}

fn route(row: &RouteRow) -> Value {
    let network = |name: &Option<LinkName>| name.as_ref().map(|name| name.network.to_string());
    let link = |name: &Option<LinkName>| name.as_ref().map(|name| name.link.to_string());
    json!({
        "node": row.node.as_str(),
        "incarnation": row.incarnation.0,
        "network": network(&row.link),
        "link": link(&row.link),
        "alternate_network": network(&row.alternate),
        "alternate_link": link(&row.alternate),
        "cost": row.cost,
        "mtu_bytes": row.mtu,
        "relays": row.relays,
    })
}

fn session(row: &SessionRow) -> Value {
    let (status, counters) = (&row.status, &row.status.counters);
    json!({
        "node": row.node.as_str(),
        "state": status.state.to_string(),
        "incarnation": status.incarnation.map(|incarnation| incarnation.0),
        "round_trip_ms": millis(status.round_trip),
        "unacknowledged": status.unacknowledged,
        "in_flight": status.in_flight,
        "window": status.window,
        "queueing_ms": millis(status.queueing),
        "sent": counters.sent,
        "bytes_sent": counters.bytes_sent,
        "bytes_received": counters.bytes_received,
        "bytes_sent_per_s": row.rate.sent,
        "bytes_received_per_s": row.rate.received,
        "retransmitted": counters.retransmitted,
        "duplicates": counters.duplicates,
        "superseded": counters.superseded,
        "replaced": counters.replaced,
        "incomplete": counters.incomplete,
        "returned": counters.returned,
        "refused": status.refusals.total(),
        "differences": row.differences,
    })
}

fn forbidden(row: &AccessRefusal) -> Value {
    json!({
        "node": row.node.as_str(),
        "verb": row.verb,
        "object": row.object,
        "contract": row.contract,
        "policy_line": row.policy_line,
        "times": row.times,
        "first_ms": millis(row.first),
        "last_ms": millis(row.last),
    })
}

fn claim(row: &ClaimRow) -> Value {
    json!({
        "name": row.name.as_str(),
        "node": row.holder.node.as_str(),
        "object": row.holder.object.as_str(),
        "epoch": row.holder.epoch,
        "incarnation": row.incarnation.0,
        "age_ms": millis(row.age),
    })
}

fn service(row: &ServiceRow) -> Value {
    let names = |nodes: &[NodeName]| rows_of(nodes, |node| node.as_str().into());
    json!({
        "name": row.name.as_str(),
        "state": row.state.to_string(),
        "since_ms": millis(row.since),
        "kind": row.kind.to_string(),
        "epoch": row.epoch,
        "primary": row.primary.as_ref().map(NodeName::as_str),
        "members": names(&row.members),
        "missing_members": names(&row.missing_members),
        "unreplicated": row.unreplicated,
        "seen_ms": millis(row.age),
    })
}
