//! Declares the fault that the service has had no primary for longer than a takeover takes, with
//! the causes.
//!
//! ```text
//!  a primary ──── lost ────► no primary known ──── longer than a takeover, or a start ────► declared
//!      ▲                             │                                                          │
//!      └───────── a primary ─────────┴──────────────────────────────────────────────────────────┘
//! ```
//!
//! Each member reports what it knows itself, also in one part of a divided robot. The detail is
//! updated when the causes change, at most once per takeover time.

use super::agreement::{NAMED_MAX, describe_lists};
use super::*;
use std::time::Duration;

/// The least time without a primary that is a fault: a shorter one is over before an operator can
/// read it.
const OUTAGE_MIN: Duration = Duration::from_secs(1);
/// The least time at the start of a node, which may be the first one of its robot: as long as other
/// parts of the node wait for a neighbour that never comes.
const START_GRACE: Duration = Duration::from_secs(5);

impl ReplicaConfig {
    /// Returns a time longer than a takeover takes: the end of a promise, the election delays of
    /// all members before, and a few split votes. A longer time declares an outage later; a shorter
    /// one declares outages that end by themselves.
    fn takeover(&self) -> Duration {
        let turns =
            self.heartbeat_interval / 2 * u32::try_from(self.members.len()).unwrap_or(u32::MAX);
        (self.lease() * 10 + turns).max(OUTAGE_MIN)
    }
}

/// The time without a known primary.
#[derive(Clone, Debug, Default)]
pub(super) struct Outage {
    pub(super) since: Option<Instant>,
    /// There has been a primary since this replica started.
    pub(super) served: bool,
    /// When the causes were last described.
    pub(super) described_at: Option<Instant>,
}

impl Outage {
    /// Returns when the fault, or its detail, is due.
    pub(super) fn due(&self, config: &ReplicaConfig) -> Option<Instant> {
        let since = self.since?;
        Some(match self.described_at {
            Some(described_at) => described_at + config.takeover(),
            None if self.served => since + config.takeover(),
            None => since + config.takeover().max(START_GRACE),
        })
    }
}

/// Returns why a replica knows of no primary, as far as it knows itself.
pub(super) fn causes(replica: &Replica, now: Instant) -> String {
    let mut causes = Vec::new();
    if replica.component.health == Health::Inactive {
        let rests = "its component here accepts no jobs, as it is stopped or isolated, or its node \
                     is at rest (bring it back)";
        causes.push(rests.to_owned());
    }
    let (mut available, mut differing, mut unreachable, mut absent) = (1, vec![], vec![], vec![]);
    for (node, known) in &replica.agreement.known {
        let is_member = replica.config.members.contains(node);
        match known.comparison {
            ConfigComparison::Differs { .. } => differing.push(node.as_str()),
            _ if !is_member => {}
            ConfigComparison::Absent { confirmed: true } => absent.push(node.as_str()),
            _ if known.seen => available += 1,
            _ => unreachable.push(node.as_str()),
        }
    }
    differing.truncate(NAMED_MAX);
    causes.extend(describe_lists([(
        "nodes with another configuration of it",
        differing,
        "the fault contract mismatch, B10, says what to write",
    )]));
    let (members, majority) = (replica.config.members.len(), replica.config.majority());
    if replica.config.on_partition == OnPartition::Stop && available < majority {
        causes.push(format!(
            "there is no majority: it needs {majority} of its {members} nodes, and has {available}"
        ));
        causes.extend(describe_lists([
            (
                "not reachable",
                unreachable,
                "start them, repair the path to them, or admit them if they are isolated here",
            ),
            ("without this service", absent, "add it there, or remove them from all lists"),
        ]));
    }
    if causes.is_empty() {
        causes.push(describe_election(replica, now));
    }
    causes.join("; ")
}

/// Returns why the reachable members have elected no primary.
fn describe_election(replica: &Replica, now: Instant) -> String {
    let timeout = replica.config.state_timeout();
    match &replica.role {
        RoleState::Standby(Standby { checking_dependencies: true, .. }) => {
            "it waits for the services that it depends on, which have no primary either (see their \
             faults)"
                .to_owned()
        }
        _ if replica.waiting_since().is_some_and(|since| now < since + timeout) => format!(
            "this node lacks the state, and waits {:.1} s for a node that has it before it starts \
             without it",
            timeout.as_secs_f64()
        ),
        _ => format!(
            "its nodes have not elected a primary yet (their components may be at rest, they may \
             know of a newer state, or their messages may take longer than the heartbeat interval, \
             {:?})",
            replica.config.heartbeat_interval
        ),
    }
}
