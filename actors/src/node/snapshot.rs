//! The state of a node at one moment as one JSON document, for display and for tools.

mod network;

use super::Node;
use crate::actuator::ActuatorRow;
use crate::liveness::threads::{ThreadRow, ThreadState};
use crate::platform;
#[cfg(feature = "trees")]
use crate::trees::TreeChangeRow;
use blastema_core::delivery::dead_letters::DeadLetterCount;
use blastema_core::detection::{FaultEntry, MonitorRow, ObjectKind};
use blastema_core::lease::LeaseStatus;
use blastema_core::{Instant, NodeName, ObjectName};
use futures_util::future::join;
use serde_json::{Value, json};
use std::time::Duration;

/// How long the parts of the document are waited for, all at once. What does not come by then is
/// `null`, so that a node whose network hangs still shows the rest.
pub(super) const PART_TIMEOUT: Duration = Duration::from_secs(1);

/// Everything that the node knows of itself. Spans are in milliseconds (`_ms`); unknown values are
/// `null`.
pub(super) async fn document(node: &Node) -> Value {
    let own = join(in_time(node.table()), in_time(node.faults()));
    let (network, own) = join(network::NetworkParts::of(node), own).await;
    let (table, faults) = own;
    let seen_at = platform::now();
    let faults = faults.as_ref();
    let entry = |entry: &FaultEntry| fault(entry, seen_at);
    let mut document = json!({
        "node": node.name().as_str(),
        "incarnation": node.incarnation().0,
        "reason": null,
        "table": table.as_deref().map(|rows| rows_of(rows, object)),
        "threads": rows_of(&node.threads(), thread),
        "actuators": rows_of(&node.actuators(), actuator),
        "topics": node.topics(),
        "dead_letters": rows_of(&node.dead_letters().counts(), dead_letter),
        "dead_letters_beyond": node.dead_letters().beyond(),
        "faults": faults.map(|record| rows_of(&record.entries, entry)),
        "faults_dropped": faults.map(|record| record.dropped),
    });
    // The state, and a reason where it has one.
    if let (Value::Object(all), Value::Object(state)) = (&mut document, json!(node.state())) {
        all.extend(state);
    }
    #[cfg(feature = "trees")]
    {
        let change = |row: &TreeChangeRow| tree_change(row, seen_at);
        document["trees"] = json!(node.trees());
        document["tree_changes"] = rows_of(&node.tree_changes(), change).into();
    }
    network.show_in(node, &mut document);
    document
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

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn a_part_that_does_not_answer_is_not_known_and_one_that_is_empty_is() {
        assert_eq!(in_time(future::pending::<Vec<MonitorRow>>()).await, None);
        assert_eq!(in_time(future::ready([0; 0])).await, Some([]));
    }
}
