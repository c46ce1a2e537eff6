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

use super::agreement::{describe_lists, some_of};
use super::*;
use crate::sorted::SortedSet;
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
    /// The members that did not vote for this replica in its last election.
    pub(super) unwilling: Vec<NodeName>,
    /// The members that this node isolated when a message to them was last refused.
    pub(super) isolated: SortedSet<NodeName>,
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

    /// Returns why this replica knows of no primary.
    pub(super) fn describe(&self, replica: &Replica, now: Instant) -> String {
        let RoleState::Standby(standby) = &replica.role else { return String::new() };
        let Replica { config, agreement, .. } = replica;
        let mut causes = Vec::new();
        if replica.component.health == Health::Inactive {
            causes.push(
                "its component here accepts no jobs, as it is stopped or isolated, or its node is at rest (bring it \
                 back)"
                    .to_owned(),
            );
        }
        let isolated = &self.isolated;
        let (mut available, mut unreachable, mut without_service) = (1, vec![], vec![]);
        for member in config.members.iter().filter(|member| **member != config.own) {
            match agreement.known.get(member) {
                Some(known) if known.differs() => {}
                Some(known) if agreement.is_absent(member, known) => {
                    without_service.push(member.as_str());
                }
                Some(known) if known.seen => available += 1,
                _ if isolated.contains(member) => {}
                _ => unreachable.push(member.as_str()),
            }
        }
        let known = agreement.known.iter();
        let differing: Vec<_> =
            known.filter(|(_, known)| known.differs()).map(|(node, _)| node.as_str()).collect();
        if !differing.is_empty() {
            causes.push(format!(
                "not all nodes have the same configuration of it; it differs on {} (the fault contract \
                 mismatch, B10, says what to write)",
                some_of(&differing, ", ")
            ));
        }
        if !isolated.is_empty() {
            let nodes: Vec<_> = isolated.iter().map(NodeName::as_str).collect();
            causes.push(format!(
                "isolated here: {} (admit those that work again)",
                some_of(&nodes, ", ")
            ));
        }
        let (members, majority) = (config.members.len(), config.majority());
        if config.on_partition == OnPartition::Stop && available < majority {
            let missing = [
                ("not reachable", unreachable, "start them, or repair the path to them"),
                (
                    "without this service",
                    without_service,
                    "add the service there, or remove them from all lists",
                ),
            ];
            causes.push(format!(
                "there is no majority: it needs {majority} of its {members} nodes, and has {available}"
            ));
            causes.extend(describe_lists(missing));
        }
        // An isolated node does not explain why the others have elected no primary.
        if causes.len() == usize::from(!isolated.is_empty()) {
            causes.push(self.describe_election(replica, standby, now));
        }
        format!("no primary is known here: {}", causes.join("; "))
    }

    /// Returns why the reachable members have elected no primary.
    fn describe_election(&self, replica: &Replica, standby: &Standby, now: Instant) -> String {
        if standby.checking_dependencies {
            return "it waits for the services that it depends on, which have no primary either (see their faults)"
                .to_owned();
        }
        let timeout = replica.config.state_timeout();
        if replica.waiting_since().is_some_and(|since| now < since + timeout) {
            let seconds = timeout.as_secs_f64();
            return format!(
                "this node lacks the state, and waits {seconds:.1} s for a node that has it before it starts without it"
            );
        }
        let Outage { unwilling, isolated, .. } = self;
        let unwilling = unwilling.iter().filter(|node| !isolated.contains(*node));
        let unwilling: Vec<_> = unwilling.map(NodeName::as_str).collect();
        match unwilling.is_empty() {
            true => "its nodes have not elected a primary yet".to_owned(),
            false => format!(
                "this node stood for election without the votes of {} (their components may be at rest, they may know \
                 of a newer state, or their messages may take longer than the heartbeat interval, {:?})",
                some_of(&unwilling, ", "),
                replica.config.heartbeat_interval
            ),
        }
    }
}
