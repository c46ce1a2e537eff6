//! The state of a node at one moment, for display and for tools.

mod network;

pub use network::NetworkSnapshot;

use super::{Node, NodeState};
use crate::actuator::ActuatorRow;
use crate::liveness::threads::{ThreadRow, ThreadState};
use crate::messaging::dead_letters::DeadLetterSnapshot;
use crate::platform;
use crate::topic::TopicRow;
#[cfg(feature = "trees")]
use crate::trees::{TreeChangeRow, TreeNodeRow};
use blastema_core::delivery::dead_letters::DeadLetterCount;
use blastema_core::detection::{FaultEntry, FaultRecord, MonitorRow, ObjectKind};
use blastema_core::lease::LeaseStatus;
use blastema_core::{Incarnation, Instant, NodeName, ObjectName};
use futures_util::future::join;
use serde_json::{Value, json};
use std::future::Future;
use std::time::Duration;

/// How long the parts of the picture are waited for, all at once. What does not come by then is not
/// known, so that a node whose network hangs still shows the rest.
pub(super) const PART_TIMEOUT: Duration = Duration::from_secs(1);

/// The state of a node at one moment. From [`Node::snapshot`]. A part is `None` if the actor that
/// keeps it did not answer within a second; an empty list means that there is nothing.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct NodeSnapshot {
    /// The name of the node.
    pub node: NodeName,
    /// The incarnation of the node that runs now.
    pub incarnation: Incarnation,
    /// How it is.
    pub state: NodeState,
    /// When this was seen, on the node's clock.
    pub seen_at: Instant,
    /// The monitor's table: components, supervisors, links, neighbours, objects of the middleware.
    pub table: Option<Vec<MonitorRow>>,
    /// The threads that components live on.
    pub threads: Vec<ThreadRow>,
    /// The node's record of other nodes.
    pub network: NetworkSnapshot,
    /// The node's actuators, and the commander of each.
    pub actuators: Vec<ActuatorRow>,
    /// The topics that objects of the node have named.
    pub topics: Vec<TopicRow>,
    /// The nodes of behaviour trees that are not idle.
    #[cfg(feature = "trees")]
    pub trees: Vec<TreeNodeRow>,
    /// The last ticks of behaviour trees in which nodes have changed.
    #[cfg(feature = "trees")]
    pub tree_changes: Vec<TreeChangeRow>,
    /// What was not delivered.
    pub dead_letters: DeadLetterSnapshot,
    /// The record of faults.
    pub faults: Option<FaultRecord>,
}

impl NodeSnapshot {
    pub(super) async fn of(node: &Node) -> Self {
        let own = join(in_time(node.table()), in_time(node.faults()));
        let (network, own) = join(NetworkSnapshot::of(node), own).await;
        let (table, faults) = own;
        NodeSnapshot {
            node: node.name().clone(),
            incarnation: node.incarnation(),
            state: node.state(),
            table,
            threads: node.threads(),
            network,
            actuators: node.actuators(),
            topics: node.topics(),
            #[cfg(feature = "trees")]
            trees: node.0.environment.trees().nodes(),
            #[cfg(feature = "trees")]
            tree_changes: node.0.environment.trees().changes(),
            dead_letters: node.dead_letters().snapshot(),
            faults,
            seen_at: platform::now(),
        }
    }

    /// Returns the snapshot as one JSON document, on one line. Spans are in milliseconds (`_ms`);
    /// unknown values are `null`.
    pub fn to_json(&self) -> String {
        let (state, reason) = match &self.state {
            NodeState::Starting => ("starting", None),
            NodeState::Running => ("running", None),
            NodeState::InSafeState { reason } => ("in safe state", Some(reason)),
            NodeState::Stopped => ("stopped", None),
        };
        let faults = self.faults.as_ref();
        let entry = |entry: &FaultEntry| fault(entry, self.seen_at);
        let document = json!({
            "node": self.node.as_str(),
            "incarnation": self.incarnation.0,
            "state": state,
            "reason": reason,
            "table": self.table.as_deref().map(|rows| rows_of(rows, object)),
            "threads": rows_of(&self.threads, thread),
            "actuators": rows_of(&self.actuators, actuator),
            "topics": self.topics,
            "dead_letters": rows_of(&self.dead_letters.counts, dead_letter),
            "dead_letters_beyond": self.dead_letters.beyond,
            "faults": faults.map(|record| rows_of(&record.entries, entry)),
            "faults_dropped": faults.map(|record| record.dropped),
        });
        #[cfg(feature = "trees")]
        let document = {
            let mut document = document;
            let change = |row: &TreeChangeRow| tree_change(row, self.seen_at);
            document["trees"] = json!(self.trees);
            document["tree_changes"] = rows_of(&self.tree_changes, change).into();
            document
        };
        let document = self.network.shown_in(document);
        document.to_string()
    }
}

pub(super) async fn in_time<T>(part: impl Future<Output = T>) -> Option<T> {
    tokio::time::timeout(PART_TIMEOUT, part).await.ok()
}

pub(super) fn rows_of<T>(rows: &[T], row: impl Fn(&T) -> Value) -> Vec<Value> {
    rows.iter().map(row).collect()
}

pub(super) fn millis(span: impl Into<Option<Duration>>) -> Option<f64> {
    // To the microsecond: finer than anything that is measured here.
    span.into().map(|span| (span.as_secs_f64() * 1e6).round() / 1e3)
}

fn object(row: &MonitorRow) -> Value {
    json!({
        "location": row.location.to_string(),
        "kind": match row.kind {
            ObjectKind::Component => "component",
            ObjectKind::Middleware => "middleware",
            ObjectKind::Link => "link",
            ObjectKind::Node => "node",
        },
        "incarnation": row.incarnation.0,
        "state": match &row.waiting_for {
            Some(_) => Some("waiting".to_owned()),
            None => row.state.map(|state| state.to_string()),
        },
        "waiting_for": row.waiting_for,
        "opinion": row.opinion.to_string(),
        "last_sign_ms": millis(row.last_sign),
        "restarts": row.restarts,
        "suspicions": row.suspicions,
        "missed_rounds": row.missed_rounds,
        "late_p50_ms": millis(row.round_lateness.map(|late| late.p50)),
        "late_p99_ms": millis(row.round_lateness.map(|late| late.p99)),
        "late_max_ms": millis(row.round_lateness.map(|late| late.max)),
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

fn actuator(row: &ActuatorRow) -> Value {
    let (state, commander, lease) = match &row.status {
        LeaseStatus::Free => ("free", None, None),
        LeaseStatus::Held { commander, epoch, left } => {
            ("held", Some(commander), Some((*epoch, *left)))
        }
        LeaseStatus::Settling { commander } => ("settling", Some(commander), None),
    };
    json!({
        "object": row.object.as_str(),
        "contract": row.contract,
        "state": state,
        "commander": commander.map(|commander| commander.name.as_str()),
        "incarnation": commander.map(|commander| commander.incarnation.0),
        "epoch": lease.map(|(epoch, _)| epoch),
        "left_ms": millis(lease.map(|(_, left)| left)),
    })
}

#[cfg(feature = "trees")]
fn tree_change(row: &TreeChangeRow, now: Instant) -> Value {
    json!({
        "tree": row.tree.as_str(),
        "tick": row.tick,
        "age_ms": millis(now - row.at),
        "changes": row.changes,
    })
}

fn dead_letter(row: &DeadLetterCount) -> Value {
    json!({
        "node": row.node.as_ref().map(NodeName::as_str),
        "object": row.object.as_str(),
        "contract": row.contract,
        "reason": row.reason.text(),
        "count": row.count,
    })
}

fn fault(entry: &FaultEntry, now: Instant) -> Value {
    let fault = &entry.fault;
    json!({
        "id": fault.id.to_string(),
        "code": fault.kind.code(),
        "kind": fault.kind.to_string(),
        "severity": fault.severity.to_string(),
        "location": fault.location.to_string(),
        "incarnation": fault.incarnation.0,
        "detail": fault.detail,
        "first_detail": entry.first_detail,
        "count": fault.count,
        "symptom_of": fault.symptom_of.map(|root| root.to_string()),
        "age_ms": millis(now - fault.found_at),
        "action": entry.decided.as_ref().map(|(_, action)| action),
        "status": entry.status().to_string(),
        "given_up": entry.given_up.as_ref().map(|(_, reason)| reason),
        "recovered_ms": millis(entry.recovered_at.map(|at| now - at)),
        "recovered_after_ms": millis(entry.recovered_after()),
        "repaired_ms": millis(entry.repaired_at.map(|at| now - at)),
        "repaired_after_ms": millis(entry.repaired_after()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_core::{FaultLocation, Lifecycle, ObjectAddress};
    use blastema_doubles::paused;
    use std::future;

    #[test]
    fn a_component_that_waits_for_its_device_is_shown_as_waiting_and_for_what() {
        let arm = ObjectAddress::new(NodeName::new("n").unwrap(), ObjectName::new("arm").unwrap());
        let mut row = MonitorRow::blank(FaultLocation::Object(arm), ObjectKind::Component);
        row.state = Some(Lifecycle::Created);
        assert_eq!(object(&row)["state"], Lifecycle::Created.to_string());

        row.waiting_for = Some("no such device".to_owned());
        let shown = object(&row);
        assert_eq!(
            (&shown["state"], &shown["waiting_for"]),
            (&json!("waiting"), &json!("no such device"))
        );
    }

    #[test]
    fn a_part_that_does_not_answer_is_not_known_and_one_that_is_empty_is() {
        paused(async {
            let picture = NodeSnapshot {
                node: NodeName::new("n").unwrap(),
                incarnation: Incarnation(1),
                state: NodeState::Running,
                seen_at: Instant::ORIGIN,
                table: in_time(future::ready(Vec::new())).await,
                threads: Vec::new(),
                network: NetworkSnapshot {
                    networks: Vec::new(),
                    media: in_time(future::ready(Vec::new())).await,
                    roster: in_time(future::ready(Vec::new())).await,
                    links: in_time(future::ready(Vec::new())).await,
                    routes: in_time(future::pending()).await,
                    sessions: in_time(future::pending()).await,
                    claims: Vec::new(),
                    services: Vec::new(),
                    forbidden: Vec::new(),
                },
                actuators: Vec::new(),
                topics: Vec::new(),
                #[cfg(feature = "trees")]
                trees: Vec::new(),
                #[cfg(feature = "trees")]
                tree_changes: Vec::new(),
                dead_letters: DeadLetterSnapshot::default(),
                faults: in_time(future::pending()).await,
            };

            let seen: Value = serde_json::from_str(&picture.to_json()).unwrap();

            for silent in ["faults", "faults_dropped"] {
                assert_eq!(seen.get(silent), Some(&Value::Null), "{silent}");
            }
            for empty in ["table", "threads"] {
                assert_eq!(seen[empty], json!([]), "{empty}");
            }
            assert_eq!(seen.get("sessions"), Some(&Value::Null));
            assert_eq!(seen.get("links"), Some(&json!([])));
        });
    }
}
