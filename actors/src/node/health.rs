//! The health of a node in one small value: for a readiness probe, a dashboard, a status message.

use super::snapshot::in_time;
use super::{Node, NodeState};
use crate::platform;
use blastema_core::detection::{FaultEntry, FaultRecord};
use blastema_core::{FaultLocation, Incarnation, Instant, NodeName, Severity};
use serde::Serialize;
use std::time::Duration;

/// How well a node is. From [`Node::health`]. It serializes to a flat JSON object; spans are in
/// milliseconds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct NodeHealth {
    /// The name of the node.
    pub node: NodeName,
    /// The incarnation of the node that runs now.
    pub incarnation: Incarnation,
    /// Its state: `"state": "running"`, and a `"reason"` in the safe state.
    #[serde(flatten)]
    pub state: NodeState,
    /// The faults that stand. `None` if the fault chain did not answer within a second.
    pub faults: Option<FaultCounts>,
    /// The parts that do not work as they should, in the order in which their faults were found.
    pub degraded: Vec<DegradedPart>,
    /// The last fault after which service was restored.
    pub last_recovery: Option<LastRecovery>,
}

/// How many faults of each severity stand, without those that are symptoms of another one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct FaultCounts {
    /// Several services are gone, or recovery itself failed.
    pub critical: usize,
    /// A service is interrupted.
    pub error: usize,
    /// Service goes on.
    pub warning: usize,
}

/// A part with a fault that stands, or with a symptom of one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct DegradedPart {
    /// An object, a link or a node.
    pub part: String,
    /// The severity of the first of its faults that stand.
    pub severity: Severity,
    /// The kind of that fault, and its particulars.
    pub fault: String,
    /// What has become of it: `open`, `given up`, or `recovered` where service goes on without the
    /// part.
    pub status: String,
    /// How long it stands.
    pub standing_ms: u64,
}

/// A fault after which service was restored.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct LastRecovery {
    /// An object, a link or a node.
    pub part: String,
    /// The kind of the fault.
    pub fault: String,
    /// The recovery action, such as `restart`; `None` if the fault went by itself.
    pub action: Option<String>,
    /// The time from the fault to restored service.
    pub after_ms: u64,
    /// The time since then.
    pub ago_ms: u64,
}

impl NodeHealth {
    pub(super) async fn of(node: &Node) -> Self {
        let record = in_time(node.faults()).await;
        let now = platform::now();
        NodeHealth {
            node: node.name().clone(),
            incarnation: node.incarnation(),
            state: node.state(),
            faults: record.as_ref().map(FaultCounts::of),
            degraded: record.as_ref().map_or_else(Vec::new, |record| degraded(record, now)),
            last_recovery: record.and_then(|record| LastRecovery::of(&record, now)),
        }
    }

    /// Whether the node runs, the fault chain answers, and neither a critical fault nor an error
    /// stands: what a readiness probe asks.
    pub fn is_well(&self) -> bool {
        let well = |faults: FaultCounts| faults.critical == 0 && faults.error == 0;
        self.state == NodeState::Running && self.faults.is_some_and(well)
    }
}

impl FaultCounts {
    fn of(record: &FaultRecord) -> Self {
        let roots = standing(record).filter(|entry| entry.fault.symptom_of.is_none());
        roots.fold(FaultCounts::default(), |mut counts, entry| {
            *match entry.fault.severity {
                Severity::Critical => &mut counts.critical,
                Severity::Error => &mut counts.error,
                Severity::Warning => &mut counts.warning,
            } += 1;
            counts
        })
    }
}

fn standing(record: &FaultRecord) -> impl Iterator<Item = &FaultEntry> {
    record.entries.iter().filter(|entry| entry.stands())
}

fn degraded(record: &FaultRecord, now: Instant) -> Vec<DegradedPart> {
    let mut known: Vec<&FaultLocation> = Vec::new();
    let mut parts = Vec::new();
    for entry in standing(record) {
        let fault = &entry.fault;
        if known.contains(&&fault.location) {
            continue;
        }
        known.push(&fault.location);
        parts.push(DegradedPart {
            part: fault.location.to_string(),
            severity: fault.severity,
            fault: format!("{}: {}", fault.kind, fault.detail),
            status: entry.status().to_string(),
            standing_ms: millis(now - fault.found_at),
        });
    }
    parts
}

impl LastRecovery {
    fn of(record: &FaultRecord, now: Instant) -> Option<Self> {
        let last = record.entries.iter().max_by_key(|entry| entry.recovered_at)?;
        Some(LastRecovery {
            part: last.fault.location.to_string(),
            fault: last.fault.kind.to_string(),
            action: last.decided.as_ref().map(|(_, action)| action.clone()),
            after_ms: millis(last.recovered_after()?),
            ago_ms: millis(now - last.recovered_at?),
        })
    }
}

fn millis(span: Duration) -> u64 {
    u64::try_from(span.as_millis()).unwrap_or(u64::MAX)
}
