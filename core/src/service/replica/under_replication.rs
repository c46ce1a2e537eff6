//! Whether enough standbys hold the primary's state, and the faults when they do not.
//!
//! ```text
//!  enough standbys in step ◄──────── one comes into step ──────── under-replicated: replies do not
//!            │                                                      wait, and a fault is declared
//!            └─ fewer: replies are held back ── none can come: a lease; one may: twenty ──►
//! ```
//!
//! A primary does not wait for a standby that is inactive or silent: most robots need the service
//! more than they need certainty. The fault says what a failure of this node would cost. After such
//! a failure, a primary that starts without the state declares that it is lost: each replica keeps
//! the last position whose reply was sent, and sends it with its vote.

use super::agreement::{describe_lists, some_of};
use super::*;
use std::time::Duration;

impl ReplicaConfig {
    /// Returns how long a replica waits for a node that has the state, or is about to. Longer than
    /// a process is likely to stand still. A shorter timeout restores a service sooner whose state
    /// is lost, and which then starts without it.
    pub(super) fn state_timeout(&self) -> Duration {
        self.lease() * 20
    }
}

impl Replica {
    /// Returns whether replies are sent before a majority has them, as too few standbys can be in
    /// step.
    pub(super) fn check_replication(&mut self, now: Instant) -> bool {
        let RoleState::Primary(primary) = &mut self.role else { return false };
        let config = &self.config;
        if config.kind == StandbyKind::Cold || primary.holders() + 1 >= config.majority() {
            primary.under_replicated_since = None;
            self.set_fault(FaultKind::Unreplicated, None);
            return false;
        }
        let since = *primary.under_replicated_since.get_or_insert(now);
        // With `Continue`, the first node to start is alone until the others have started.
        let comes =
            config.on_partition == OnPartition::Continue || primary.expects_follower(config, now);
        let wait = if comes { config.state_timeout() } else { config.lease() };
        if now - since < wait {
            return false;
        }
        let detail = primary.describe_replication(config, now);
        self.set_fault(FaultKind::Unreplicated, Some(detail));
        true
    }

    /// Declares a fault with this detail, or clears it.
    pub(super) fn set_fault(&mut self, kind: FaultKind, detail: Option<String>) {
        match detail {
            Some(detail) if self.faults.get(&kind) != Some(&detail) => {
                self.faults.insert(kind.clone(), detail.clone());
                self.outputs.push_back(ReplicaOutput::Fault { kind, detail });
            }
            None if self.faults.remove(&kind).is_some() => {
                self.outputs.push_back(ReplicaOutput::FaultCleared { kind });
            }
            Some(_) | None => {}
        }
    }

    /// Clears the faults of a primary.
    pub(super) fn clear_faults(&mut self) {
        self.set_fault(FaultKind::Unreplicated, None);
        self.set_fault(FaultKind::StateLost, None);
    }

    /// Starts this epoch without the entries that this replica lacks, as no reachable member has
    /// them. Returns whether there are any. The new position is greater than all earlier ones.
    pub(super) fn start_without_lost_state(&mut self, epoch: u64) -> bool {
        let lost = self.config.kind != StandbyKind::Cold && self.lacks_answered_state();
        if lost {
            self.report_loss(self.position, self.answered);
            self.position = Position { epoch, number: 0 };
            self.answered = self.position;
        }
        lost
    }

    /// Does so in the middle of an epoch, for the only member of a service.
    pub(super) fn restart_without_lost_state(&mut self, epoch: u64) {
        self.position = Position::default();
        self.start_without_lost_state(epoch);
        if let RoleState::Primary(primary) = &mut self.role {
            (primary.base, primary.released) = (self.position, self.position);
        }
    }

    /// Detects from a standby's promise that replies were sent before this epoch for entries that
    /// this primary lacks.
    pub(super) fn detect_loss(&mut self, epoch: u64, answered: Position) {
        let RoleState::Primary(primary) = &self.role else { return };
        let base = primary.base;
        let is_loss = epoch == primary.epoch && answered > base && answered.epoch < epoch;
        // With `Continue`, the entries of one part are lost when the parts meet.
        if is_loss
            && self.comparable_by_position()
            && !self.faults.contains_key(&FaultKind::StateLost)
        {
            self.report_loss(base, answered);
        }
    }

    fn report_loss(&mut self, had: Position, known: Position) {
        let what = match had == Position::default() {
            true => "starts again with the state that it was built with",
            false => "goes on with an older state",
        };
        let detail = format!(
            "it {what}: the state after {} answered requests, the last in epoch {}, was lost with the nodes that \
             held it; let more nodes carry the service, and keep a standby in step",
            known.number, known.epoch
        );
        self.set_fault(FaultKind::StateLost, Some(detail));
    }

    /// Returns whether replies were sent for entries that this replica lacks.
    pub(super) fn lacks_answered_state(&self) -> bool {
        self.position < self.answered
    }

    /// Returns the position that a candidate needs for this replica's vote: while a node that has
    /// the state may return, the greatest one that is known.
    pub(super) fn required_position(&self, now: Instant) -> Position {
        let waits =
            self.waiting_since().is_some_and(|since| now < since + self.config.state_timeout());
        if waits { self.position.max(self.answered) } else { self.position }
    }

    /// Returns since when this replica waits for a node that has the state that it lacks.
    pub(super) fn waiting_since(&self) -> Option<Instant> {
        match self.health {
            Health::Stateless { since } | Health::Inactive { since } => Some(since),
            // With `Continue`, no part waits for another one.
            Health::Complete if self.comparable_by_position() && self.lacks_answered_state() => {
                Some(self.primary_seen_at)
            }
            Health::Complete => None,
        }
    }
}

impl Primary {
    /// Returns how many standbys are in step.
    fn holders(&self) -> usize {
        self.standbys.values().filter(|follower| follower.catch_up == CatchUp::InStep).count()
    }

    /// Returns whether a standby may still come into step.
    fn expects_follower(&self, config: &ReplicaConfig, now: Instant) -> bool {
        let comes = |follower: &Follower| {
            matches!(follower.catch_up, CatchUp::Behind | CatchUp::SnapshotSent(_))
        };
        self.standbys.values().any(|follower| comes(follower) && follower.is_live(config, now))
    }

    fn describe_replication(&self, config: &ReplicaConfig, now: Instant) -> String {
        let (mut holding, mut resting, mut behind, mut unreachable) =
            (vec![], vec![], vec![], vec![]);
        for member in config.members.iter().filter(|member| **member != config.own) {
            let follower =
                self.standbys.get(member).filter(|follower| follower.is_live(config, now));
            let list = match follower.map(|follower| follower.catch_up) {
                Some(CatchUp::InStep) => &mut holding,
                Some(CatchUp::Inactive) => &mut resting,
                Some(CatchUp::Behind | CatchUp::SnapshotSent(_)) => &mut behind,
                None => &mut unreachable,
            };
            list.push(member.as_str());
        }
        let who = match holding.is_empty() {
            true => "no standby holds its state: a failure of this node now loses it".to_owned(),
            false => format!(
                "of its standbys only {} hold its state, with this node fewer than a majority: further \
                 failures now lose it",
                some_of(&holding, ", ")
            ),
        };
        let lists = [
            ("at rest, stopped or isolated", resting, "bring their components back"),
            ("not in step", behind, "see whether their components can load the state"),
            ("not reachable", unreachable, "start them, or repair the path to them"),
        ];
        format!("{who}; {}", describe_lists(lists).join("; "))
    }
}

impl Follower {
    /// Returns whether its promise is no older than a lease and the margin.
    pub(super) fn is_live(&self, config: &ReplicaConfig, now: Instant) -> bool {
        now - self.promised <= config.lease() + config.margin()
    }
}
