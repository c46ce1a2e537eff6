//! Everything that a node knows of itself at one moment, for people and for their tools.

use super::{Node, NodeState};
use crate::claim::ClaimRow;
use crate::host::threads::{ThreadRow, ThreadState};
use crate::lease::ActuatorRow;
use crate::platform;
use blastema_contract::link::LinkRow;
use blastema_contract::session::SessionRow;
use blastema_core::detection::{End, Entry, ObjectKind, Record, Row};
use blastema_core::lease::LeaseStanding;
use blastema_core::{Incarnation, Instant, NodeName, ObjectName, Severity};
use serde_json::{Value, json};
use std::future::Future;
use std::time::Duration;

/// How long a part of the picture is waited for. What does not come by then is left out, so that a node
/// whose network hangs still shows the rest.
const PATIENCE: Duration = Duration::from_secs(1);

/// Everything that a node knows of itself at one moment. From [`Node::picture`].
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Picture {
    /// Which node.
    pub node: NodeName,
    /// Which of its lives.
    pub incarnation: Incarnation,
    /// How it is.
    pub state: NodeState,
    /// When this was seen, on the node's clock.
    pub seen_at: Instant,
    /// The monitor's table: components, supervisors, links, neighbours, objects of the middleware.
    pub table: Vec<Row>,
    /// The threads that components live on.
    pub threads: Vec<ThreadRow>,
    /// The links, in the order in which they were described.
    pub links: Vec<LinkRow>,
    /// The sessions with other nodes.
    pub sessions: Vec<SessionRow>,
    /// The names of the whole robot that are held, as far as this node knows.
    pub claims: Vec<ClaimRow>,
    /// The node's actuators, and who commands each.
    pub actuators: Vec<ActuatorRow>,
    /// The record of faults.
    pub faults: Record,
}

impl Picture {
    pub(super) async fn of(node: &Node) -> Self {
        Picture {
            node: node.name().clone(),
            incarnation: node.incarnation(),
            state: node.state(),
            table: in_time(node.table()).await,
            threads: node.threads(),
            links: in_time(node.links()).await,
            sessions: in_time(node.sessions()).await,
            claims: node.claims(),
            actuators: node.actuators(),
            faults: in_time(node.faults()).await,
            seen_at: platform::now(),
        }
    }

    /// The same as one JSON document, on one line. Spans are in milliseconds (`_ms`); what is not known is
    /// `null`.
    pub fn to_json(&self) -> String {
        let (state, reason) = match &self.state {
            NodeState::Starting => ("starting", None),
            NodeState::Running => ("running", None),
            NodeState::AtRest { reason } => ("at rest", Some(reason)),
            NodeState::Stopped => ("stopped", None),
        };
        let document = json!({
            "node": self.node.as_str(),
            "incarnation": self.incarnation.0,
            "state": state,
            "reason": reason,
            "table": self.table.iter().map(object).collect::<Vec<_>>(),
            "threads": self.threads.iter().map(thread).collect::<Vec<_>>(),
            "links": self.links.iter().map(link).collect::<Vec<_>>(),
            "sessions": self.sessions.iter().map(session).collect::<Vec<_>>(),
            "claims": self.claims.iter().map(claim).collect::<Vec<_>>(),
            "actuators": self.actuators.iter().map(actuator).collect::<Vec<_>>(),
            "faults": self.faults.entries.iter().map(|entry| fault(entry, self.seen_at)).collect::<Vec<_>>(),
            "faults_dropped": self.faults.dropped,
        });
        document.to_string()
    }
}

async fn in_time<T: Default>(part: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, part).await.unwrap_or_default()
}

fn millis(span: impl Into<Option<Duration>>) -> Option<f64> {
    // To the microsecond: finer than anything that is measured here.
    span.into().map(|span| (span.as_secs_f64() * 1e6).round() / 1e3)
}

fn object(row: &Row) -> Value {
    json!({
        "place": row.place.to_string(),
        "kind": match row.kind {
            ObjectKind::Component => "component",
            ObjectKind::Middleware => "middleware",
            ObjectKind::Link => "link",
            ObjectKind::Node => "node",
        },
        "incarnation": row.incarnation.0,
        "state": row.state.map(|state| state.to_string()),
        "opinion": row.opinion.to_string(),
        "last_sign_ms": millis(row.last_sign),
        "restarts": row.restarts,
        "suspicions": row.suspicions,
        "queued": row.queue.map(|queue| queue.queued),
        "oldest_ms": millis(row.queue.map(|queue| queue.oldest)),
        "current": row.current.map(|current| current.during),
        "current_ms": millis(row.current.map(|current| current.age)),
        "isolated": row.isolated,
        "note": row.note,
    })
}

fn thread(row: &ThreadRow) -> Value {
    let (state, by, blocked) = match &row.state {
        ThreadState::Alive => ("alive", None, None),
        ThreadState::Blocked { by, age } => ("blocked", Some(by), Some(*age)),
        ThreadState::Abandoned { by } => ("abandoned", Some(by), None),
    };
    json!({
        "number": row.number,
        "kind": row.kind.to_string(),
        "state": state,
        "by": by.map(ObjectName::as_str),
        "blocked_ms": millis(blocked),
        "busy": row.busy,
        "last_beat_ms": millis(row.last_beat),
        "running": row.running.as_ref().map(ObjectName::as_str),
        "queued": row.queued,
        "components": row.components.iter().map(ObjectName::as_str).collect::<Vec<_>>(),
    })
}

fn link(row: &LinkRow) -> Value {
    json!({
        "network": &*row.network,
        "link": &*row.link,
        "state": row.state.to_string(),
        "neighbour": row.neighbour.as_ref().map(|neighbour| neighbour.node.as_str()),
        "round_trip_ms": millis(row.quality.round_trip),
        "jitter_ms": millis(row.quality.jitter),
        "loss_permille": row.quality.loss_permille,
        "cost": row.cost,
        "refused": row.refusals.total(),
    })
}

fn session(row: &SessionRow) -> Value {
    let (standing, counters) = (&row.standing, &row.standing.counters);
    json!({
        "node": row.node.as_str(),
        "state": standing.state.to_string(),
        "incarnation": standing.incarnation.map(|life| life.0),
        "round_trip_ms": millis(standing.round_trip),
        "unacknowledged": standing.unacknowledged,
        "in_flight": standing.in_flight,
        "window": standing.window,
        "sent": counters.sent,
        "repeated": counters.repeated,
        "doubled": counters.doubled,
        "late": counters.overtaken,
        "unfinished": counters.unfinished,
        "returned": counters.returned,
        "refused": standing.refusals.total(),
        "differences": row.differences,
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

fn actuator(row: &ActuatorRow) -> Value {
    let (state, commander, lease) = match &row.standing {
        LeaseStanding::Free => ("free", None, None),
        LeaseStanding::Held { commander, epoch, left } => {
            ("held", Some(commander), Some((*epoch, *left)))
        }
        LeaseStanding::Settling { commander } => ("settling", Some(commander), None),
    };
    json!({
        "object": row.object.as_str(),
        "contract": row.contract,
        "state": state,
        "commander": commander.map(|commander| commander.name.as_str()),
        "life": commander.map(|commander| commander.life.0),
        "epoch": lease.map(|(epoch, _)| epoch),
        "left_ms": millis(lease.map(|(_, left)| left)),
    })
}

fn fault(entry: &Entry, now: Instant) -> Value {
    let fault = &entry.fault;
    let (ended, reason) = match &entry.ended {
        None => (None, None),
        Some((_, End::Recovered)) => (Some("recovered"), None),
        Some((_, End::Cleared)) => (Some("cleared"), None),
        Some((_, End::GaveUp { reason })) => (Some("given up"), Some(reason)),
    };
    json!({
        "id": fault.id.to_string(),
        "code": fault.kind.code(),
        "kind": fault.kind.to_string(),
        "severity": match fault.severity {
            Severity::Warning => "warning",
            Severity::Error => "error",
            Severity::Critical => "critical",
        },
        "place": fault.place.to_string(),
        "incarnation": fault.incarnation.0,
        "detail": fault.detail,
        "count": fault.count,
        "symptom_of": fault.symptom_of.map(|root| root.to_string()),
        "age_ms": millis(now - fault.found_at),
        "measure": entry.decided.as_ref().map(|(_, measure)| measure),
        "ended": ended,
        "reason": reason,
        "recovered_after_ms": millis(entry.recovered_after()),
    })
}
