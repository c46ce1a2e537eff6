//! That nobody serves, as far as this replica knows, for longer than a takeover takes; and why.
//!
//! ```text
//!  somebody serves ──── lost ────► nobody is known ──── longer than a takeover, or a start ────► told
//!         ▲                               │                                                        │
//!         └───────── somebody serves ─────┴────────────────────────────────────────────────────────┘
//! ```
//!
//! Each member says what it sees itself, a part of a divided robot also: there nobody serves. The
//! words are those of the last look, and told anew when they change, but not more often than one
//! takeover takes.

use super::accord::some_of;
use super::*;
use crate::sorted::SortedSet;
use std::time::Duration;

/// The least time for which nobody serves before that is a fault: less is over before anybody has
/// read it.
const OUTAGE_MIN: Duration = Duration::from_secs(1);
/// And at the start of a node, which may be the first of its robot: as long as a neighbour is
/// waited for that never comes.
const START: Duration = Duration::from_secs(5);

impl ReplicaConfig {
    /// Longer than a takeover takes: a promise that ends, the turns of all who come before, and
    /// votes that were split a few times. Longer tells of an outage later; shorter tells of those
    /// that are over by themselves.
    fn takeover(&self) -> Duration {
        let turns = self.hello_interval / 2 * u32::try_from(self.members.len()).unwrap_or(u32::MAX);
        (self.lease() * 10 + turns).max(OUTAGE_MIN)
    }
}

/// Since when nobody is known who serves.
#[derive(Clone, Debug, Default)]
pub(super) struct Outage {
    since: Option<Instant>,
    /// Somebody has served, in this life.
    served: bool,
    /// When its cause was last put into words.
    worded: Option<Instant>,
    /// Who did not vote for this replica when it last stood for election.
    unwilling: Vec<NodeName>,
    /// To whom nothing is sent, as this node keeps them out: of the members, when they were last
    /// written to.
    kept_out: SortedSet<NodeName>,
}

impl Outage {
    pub(super) fn beginning(now: Instant) -> Self {
        Outage { since: Some(now), ..Outage::default() }
    }

    /// It has stood for election in vain.
    pub(super) fn note_vote(&mut self, unwilling: Vec<NodeName>) {
        self.unwilling = unwilling;
    }

    /// When there is something to be told.
    pub(super) fn due(&self, config: &ReplicaConfig) -> Option<Instant> {
        let since = self.since?;
        Some(match self.worded {
            Some(worded) => worded + config.takeover(),
            None if self.served => since + config.takeover(),
            None => since + config.takeover().max(START),
        })
    }
}

impl Replica {
    /// What was last sent to this member went its way, or was refused here since this node keeps it
    /// out.
    pub fn handle_sent(&mut self, to: &NodeName, kept_out: bool) {
        if !kept_out {
            self.outage.kept_out.remove(to);
        } else if self.config.members.contains(to) {
            self.outage.kept_out.insert(to.clone());
        }
    }

    /// Takes down whether anybody is known to serve.
    pub(super) fn note_served(&mut self) {
        let served = match &self.role {
            Acting::Primary(_) => true,
            Acting::Standby(standby) => standby.primary.is_some(),
        };
        let outage = &mut self.outage;
        if served {
            *outage = Outage { served: true, ..Outage::default() };
            self.set_fault(FaultKind::ServiceUnavailable, None);
        } else if outage.since.is_none() {
            outage.since = Some(self.now);
        }
    }

    /// Says that nobody serves where that lasts too long.
    pub(super) fn judge_outage(&mut self, now: Instant) {
        if self.outage.due(&self.config).is_none_or(|due| now < due) {
            return;
        }
        self.outage.worded = Some(now);
        let detail = self.describe_outage(now);
        self.set_fault(FaultKind::ServiceUnavailable, Some(detail));
    }

    fn describe_outage(&self, now: Instant) -> String {
        let Acting::Standby(standby) = &self.role else { return String::new() };
        let mut causes = Vec::new();
        if let Health::Gone { .. } = self.health {
            causes.push(
                "its component here takes nothing, as it was stopped or isolated, or its node is at rest (bring it \
                 back)"
                    .to_owned(),
            );
        }
        let roll = self.accord.roll(&self.config);
        if self.accord.is_hopeless() || !roll.differing.is_empty() {
            let who = match self.accord.is_overfull() {
                true => "more than can be told apart".to_owned(),
                false => some_of(&roll.differing, ", "),
            };
            causes.push(format!(
                "not all nodes were told the same of it; otherwise were {who} (what to write says the fault contract \
                 mismatch, B10)"
            ));
        }
        let kept_out = &self.outage.kept_out;
        if !kept_out.is_empty() {
            let nodes: Vec<_> = kept_out.iter().map(NodeName::as_str).collect();
            causes.push(format!(
                "isolated here: {} (admit what is well again)",
                some_of(&nodes, ", ")
            ));
        }
        let unheard = roll.unheard.into_iter();
        let unheard = unheard.filter(|node| !kept_out.iter().any(|out| out.as_str() == *node));
        let (members, majority) = (self.config.members.len(), self.config.majority());
        if self.config.on_partition == OnPartition::Stop && roll.there < majority {
            let needs = format!(
                "there is no majority: it needs {majority} of its {members} nodes, and has {}",
                roll.there
            );
            let missing = [
                ("not heard", unheard.collect::<Vec<_>>(), "start them, or mend the way there"),
                (
                    "without this service",
                    roll.without,
                    "give it there too, or leave them out of all lists",
                ),
            ];
            let missing = missing.into_iter().filter(|(_, nodes, _)| !nodes.is_empty());
            let missing = missing
                .map(|(what, nodes, help)| format!("{what}: {} ({help})", some_of(&nodes, ", ")));
            causes.extend(std::iter::once(needs).chain(missing));
        }
        // That a node is kept out does not say why the others have elected nobody.
        if causes.len() == usize::from(!kept_out.is_empty()) {
            causes.push(self.describe_election(standby, now));
        }
        format!("nobody is known here who serves: {}", causes.join("; "))
    }

    /// Why nobody was elected of those who could be.
    fn describe_election(&self, standby: &Standby, now: Instant) -> String {
        if standby.inquiring {
            return "it waits for the services that it depends on, which are not served either (see there)".to_owned();
        }
        let patience = self.config.patience();
        if self.lacking_since().is_some_and(|since| now < since + patience) {
            let seconds = patience.as_secs_f64();
            return format!(
                "this node has not the state, and waits {seconds:.1} s for whoever has it before it begins without"
            );
        }
        let Outage { unwilling, kept_out, .. } = &self.outage;
        let unwilling = unwilling.iter().filter(|node| !kept_out.contains(*node));
        let unwilling: Vec<_> = unwilling.map(NodeName::as_str).collect();
        match unwilling.is_empty() {
            true => "its nodes have elected nobody yet".to_owned(),
            false => format!(
                "this node stood for election, and was not voted for by {} (their components may be at rest, they may \
                 know of a newer state, or may not be heard as fast as every {:?})",
                some_of(&unwilling, ", "),
                self.config.hello_interval
            ),
        }
    }
}
