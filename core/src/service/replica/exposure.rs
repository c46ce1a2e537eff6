//! Whether somebody else holds what the primary holds, and what is said where nobody does.
//!
//! ```text
//!  enough standbys in step ◄──────── one comes into step ──────── exposed: replies wait for nobody,
//!            │                                                      and a fault says so
//!            └─ fewer: replies are held back ── none can come: a lease; one may: twenty ──►
//! ```
//!
//! A standby that takes nothing, or is not heard, is not waited for: the service goes on, which
//! most robots need more than certainty, and whoever looks after it is told what a failure would
//! cost now. And where it did cost that, the one who begins without the state says so: each replica
//! remembers how far callers were answered, and tells whom it votes for.

use super::accord::some_of;
use super::*;
use std::time::Duration;

impl ReplicaConfig {
    /// How long who has the state, or is about to, is waited for. Longer than a process is likely
    /// to stand still; shorter brings a service sooner back of which nobody has the state any more,
    /// and which begins anew then.
    pub(super) fn patience(&self) -> Duration {
        self.lease() * 20
    }
}

impl Replica {
    /// Whether replies are let go that no majority knows of: too few others can be told of them.
    pub(super) fn judge_exposure(&mut self, now: Instant) -> bool {
        let Acting::Primary(primary) = &mut self.role else { return false };
        let config = &self.config;
        if config.kind == StandbyKind::Cold || primary.holders() + 1 >= config.majority() {
            primary.alone_since = None;
            self.set_fault(FaultKind::Unreplicated, None);
            return false;
        }
        let since = *primary.alone_since.get_or_insert(now);
        // Where each part goes on by itself, whoever starts first is alone until the others have
        // come.
        let comes = config.on_partition == OnPartition::Continue || primary.expects(config, now);
        let wait = if comes { config.patience() } else { config.lease() };
        if now - since < wait {
            return false;
        }
        let detail = primary.describe_exposure(config, now);
        self.set_fault(FaultKind::Unreplicated, Some(detail));
        true
    }

    /// This is wrong now, or is not any more.
    pub(super) fn set_fault(&mut self, kind: FaultKind, detail: Option<String>) {
        match detail {
            Some(detail) if self.faults.get(&kind) != Some(&detail) => {
                self.faults.insert(kind.clone(), detail.clone());
                self.outputs.push_back(ReplicaOutput::Fault { kind, detail });
            }
            None if self.faults.remove(&kind).is_some() => {
                self.outputs.push_back(ReplicaOutput::Mended { kind });
            }
            Some(_) | None => {}
        }
    }

    /// What concerns whoever serves is over for this one.
    pub(super) fn end_faults(&mut self) {
        self.set_fault(FaultKind::Unreplicated, None);
        self.set_fault(FaultKind::StateLost, None);
    }

    /// What others were answered that this replica does not know of, nobody knows of: it begins
    /// without that, under an epoch that is new to all. Answers whether there is any.
    pub(super) fn begin_without(&mut self, epoch: u64) -> bool {
        let lost = self.config.kind != StandbyKind::Cold && self.lacks();
        if lost {
            self.tell_loss(self.position, self.answered);
            self.position = Position { epoch, number: 0 };
            self.learned = false;
            self.answered = self.position;
        }
        lost
    }

    /// So does the only member, in the middle of serving.
    pub(super) fn begin_again_without(&mut self, epoch: u64) {
        self.position = Position::default();
        self.begin_without(epoch);
        if let Acting::Primary(primary) = &mut self.role {
            (primary.base, primary.released) = (self.position, self.position);
        }
    }

    /// A standby knows how far callers were answered, of whom this primary had not heard when it
    /// began.
    pub(super) fn hear_loss(&mut self, epoch: u64, answered: Position) {
        let Acting::Primary(primary) = &self.role else { return };
        let base = primary.base;
        let news = epoch == primary.epoch && answered > base && answered.epoch < epoch;
        // Where each part of a network went on by itself, one of them is to be forgotten.
        if news && self.tells_by_position() && !self.faults.contains_key(&FaultKind::StateLost) {
            self.tell_loss(base, answered);
        }
    }

    /// Somebody who was told another list knows how far callers were answered by that.
    pub(super) fn hear_answered(&mut self, answered: Position, now: Instant) {
        if let Acting::Primary(primary) = &self.role {
            // Beyond what it was when we began, and not by us.
            let ours = answered.epoch >= primary.epoch && answered <= self.answered;
            let base = primary.base;
            if answered > base && !ours && !self.faults.contains_key(&FaultKind::StateLost) {
                self.tell_loss(base, answered);
            }
        } else if answered > self.answered {
            self.answered = answered;
            // So that what comes of our own list is told apart from that.
            self.claimed = self.claimed.max(answered.epoch);
            // Whoever says so may have it.
            self.wait_for_state(now);
            if let Acting::Standby(standby) = &mut self.role
                && self.position < answered
            {
                standby.claim_no_more();
            }
        }
    }

    fn tell_loss(&mut self, had: Position, known: Position) {
        let what = match had == Position::default() {
            true => "begins anew, as it was built",
            false => "goes on with an older state",
        };
        let detail = format!(
            "it {what}: the state after {} requests that callers were answered, the last under epoch {}, was \
             lost with those who held it; let more nodes carry it, and see to it that a standby is in step",
            known.number, known.epoch
        );
        self.set_fault(FaultKind::StateLost, Some(detail));
    }

    /// Callers were answered further than this replica has come.
    pub(super) fn lacks(&self) -> bool {
        self.position < self.answered
    }

    /// How far whoever is to serve must have come. While those may return who have the most that is
    /// known of, that is it.
    pub(super) fn floor(&self, now: Instant) -> Position {
        let waits = self.lacking_since().is_some_and(|since| now < since + self.config.patience());
        if waits { self.position.max(self.answered) } else { self.position }
    }

    /// Since when somebody is waited for who has what is missing here.
    pub(super) fn lacking_since(&self) -> Option<Instant> {
        match self.health {
            Health::Bare { since } | Health::Gone { since } => Some(since),
            // Where each part of a network goes on by itself, none waits for another.
            Health::Whole if self.tells_by_position() && self.lacks() => Some(self.heard_at),
            Health::Whole => None,
        }
    }
}

impl Primary {
    /// How many standbys hold all that this primary holds.
    fn holders(&self) -> usize {
        let holds = |follower: &&Follower| follower.step == Step::Abreast && !follower.learns;
        self.standbys.values().filter(holds).count()
    }

    /// Somebody may come into step yet.
    fn expects(&self, config: &ReplicaConfig, now: Instant) -> bool {
        let comes = |follower: &Follower| matches!(follower.step, Step::Behind | Step::Sent(_));
        self.standbys.values().any(|follower| comes(follower) && follower.is_heard(config, now))
    }

    fn describe_exposure(&self, config: &ReplicaConfig, now: Instant) -> String {
        let (mut holding, mut resting, mut behind, mut unheard) = (vec![], vec![], vec![], vec![]);
        for member in config.members.iter().filter(|member| **member != config.own) {
            let follower =
                self.standbys.get(member).filter(|follower| follower.is_heard(config, now));
            let list = match follower.map(|follower| follower.step) {
                Some(Step::Abreast) => &mut holding,
                Some(Step::Unable) => &mut resting,
                Some(Step::Behind | Step::Sent(_)) => &mut behind,
                None => &mut unheard,
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
            ("not in step", behind, "see whether their components can take the state over"),
            ("not heard", unheard, "start them, or mend the way there"),
        ];
        let lists = lists.into_iter().filter(|(_, nodes, _)| !nodes.is_empty());
        let lists: Vec<_> = lists
            .map(|(what, nodes, help)| format!("{what}: {} ({help})", some_of(&nodes, ", ")))
            .collect();
        format!("{who}; {}", lists.join("; "))
    }
}

impl Follower {
    /// It has promised lately.
    pub(super) fn is_heard(&self, config: &ReplicaConfig, now: Instant) -> bool {
        now - self.promised <= config.lease() + config.margin()
    }
}
