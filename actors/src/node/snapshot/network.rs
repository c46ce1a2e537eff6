//! Everything that a node knows of other nodes at one moment.

use crate::AccessRefusal;
use crate::directory::ClaimRow;
use crate::net::RosterRow;
use crate::node::Node;
use crate::node::snapshot::{in_time, millis, rows_of};
use crate::service::ServiceRow;
use blastema_contract::link::LinkRow;
use blastema_contract::session::SessionRow;
use blastema_contract::transport::TransportCounters;
use blastema_core::NodeName;
use blastema_core::net::{LinkId, Route};
use futures_util::future::join5;
use serde_json::{Value, json};
use std::sync::Arc;

/// What the actors of the network have answered; `None` where one did not in time.
pub(super) struct NetworkParts {
    links: Option<Vec<LinkRow>>,
    routes: Option<Vec<Route>>,
    roster: Option<Option<RosterRow>>,
    sessions: Option<Vec<SessionRow>>,
    media: Option<Vec<(Arc<str>, TransportCounters)>>,
}

impl NetworkParts {
    pub(super) async fn of(node: &Node) -> Self {
        let (links, routes, roster, sessions, media) = join5(
            in_time(node.links()),
            in_time(node.routes()),
            in_time(node.roster()),
            in_time(node.sessions()),
            in_time(node.media()),
        )
        .await;
        NetworkParts { links, routes, roster, sessions, media }
    }

    /// Completes the node's JSON document.
    pub(super) fn show_in(&self, node: &Node, document: &mut Value) {
        let links = self.links.as_deref().unwrap_or_default();
        let route = |row: &Route| route(row, links);
        document["networks"] = json!(node.networks());
        document["links"] = self.links.as_deref().map(|rows| rows_of(rows, link)).into();
        document["media"] = self.media.as_deref().map(|rows| rows_of(rows, medium)).into();
        document["roster"] = json!(self.roster.as_ref().map(Vec::from_iter));
        document["routes"] = self.routes.as_deref().map(|rows| rows_of(rows, route)).into();
        document["sessions"] = self.sessions.as_deref().map(|rows| rows_of(rows, session)).into();
        document["global_names"] = rows_of(&node.claims(), claim).into();
        document["services"] = rows_of(&node.services(), service).into();
        document["forbidden"] = rows_of(&node.refusals(), forbidden).into();
    }
}

fn medium((network, counters): &(Arc<str>, TransportCounters)) -> Value {
    json!({
        "network": &**network,
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

/// A route, whose links are among these; a link that is gone by now has no name.
fn route(row: &Route, links: &[LinkRow]) -> Value {
    let named = |number: Option<LinkId>| links.iter().find(|row| Some(row.number) == number);
    let (chosen, alternate) = (named(row.chosen), named(row.alternate));
    json!({
        "node": row.node.as_str(),
        "incarnation": row.incarnation.0,
        "network": chosen.map(|row| &*row.network),
        "link": chosen.map(|row| &*row.link),
        "alternate_network": alternate.map(|row| &*row.network),
        "alternate_link": alternate.map(|row| &*row.link),
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
