//! Whether the component has what its replica knows of, and what follows where it has not.
//!
//! A replica's table and votes outlive its component's lives; with hot standbys the state does not.
//! Such a member leaves the service to those who have it: it votes, for nobody who has come less
//! far than it knows of, and does not stand for election until it was brought up to date (Raft's
//! election restriction, of the state as well as of the log).

use super::*;

/// What the component has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Health {
    /// All that its replica has, or will have when it has done its jobs.
    Whole,
    /// It began a new life, or could not do what the primary did; nobody was heard to serve since
    /// then.
    Bare { since: Instant },
    /// It takes nothing: it was stopped, or is isolated. Nobody was heard to serve since then.
    Gone { since: Instant },
}

impl Replica {
    /// A life of the component has ended, and its state with it.
    pub fn handle_component_died(&mut self, now: Instant) {
        match (&self.role, self.config.kind) {
            // Nobody else has more than its next life.
            (_, StandbyKind::Cold) => {}
            (Acting::Primary(Primary { epoch, .. }), StandbyKind::Hot)
                if self.config.members.len() == 1 =>
            {
                // There is nobody to leave the service to.
                self.begin_again_without(*epoch);
            }
            (Acting::Primary(_), StandbyKind::Warm) => {
                self.void = self.working.is_some();
                let state = self.last_state();
                self.jobs.push_front(Job::Load { state });
                self.work();
            }
            (Acting::Standby(_), StandbyKind::Warm) => self.void = self.working.is_some(),
            (_, StandbyKind::Hot) => self.lose_state(now),
        }
    }

    /// The component was stopped, or isolated: it does nothing until
    /// [`Replica::handle_component_back`].
    pub fn handle_component_gone(&mut self, now: Instant) {
        if let Health::Gone { .. } = self.health {
            return;
        }
        if self.config.kind == StandbyKind::Hot {
            self.lose_state(now);
        } else {
            self.void = self.working.is_some();
            self.resign(now);
            self.jobs.clear();
        }
        self.health = Health::Gone { since: now };
        if let Acting::Standby(standby) = &mut self.role {
            standby.claim_no_more();
        }
        self.tell_role();
    }

    /// The component takes what it is given.
    pub fn handle_component_back(&mut self, now: Instant) {
        let Health::Gone { .. } = self.health else { return };
        self.health = match self.config.kind {
            StandbyKind::Hot => Health::Bare { since: now },
            StandbyKind::Warm | StandbyKind::Cold => Health::Whole,
        };
        if let Acting::Standby(standby) = &mut self.role {
            if self.config.kind == StandbyKind::Hot {
                standby.fall_behind();
            }
            standby.hurry(&self.config, now);
        }
        self.tell_role();
    }

    /// The component could not take over the state that it was given.
    pub fn handle_not_loaded(&mut self, now: Instant) {
        self.end_load();
        if self.config.kind == StandbyKind::Hot {
            self.lose_state(now);
        }
    }

    /// The component is not what the position says. Only hot ones have to be.
    pub(super) fn lose_state(&mut self, now: Instant) {
        self.void = self.working.is_some();
        if let Acting::Primary(primary) = &self.role {
            // What nobody has been answered yet need not be kept by whoever follows.
            self.position = primary.released;
        }
        self.resign(now);
        self.jobs.clear();
        if self.health == Health::Whole {
            self.health = Health::Bare { since: now };
        }
        if let Acting::Standby(standby) = &mut self.role {
            standby.fall_behind();
            // Votes that are on their way were asked for with a state that is gone.
            standby.claim_no_more();
        }
        self.tell_role();
    }

    /// A life has done the job that had not been given the state.
    pub(super) fn serve_again(&mut self) {
        match (&self.role, self.working.take()) {
            (Acting::Primary(_), Some(serve @ Job::Serve { .. })) => {
                let loads = matches!(self.jobs.front(), Some(Job::Load { .. }));
                self.jobs.insert(usize::from(loads), serve);
            }
            (_, Some(Job::Serve { .. } | Job::Replay { .. }) | None) => {}
            (_, other) => (self.working, self.void) = (other, true),
        }
    }

    /// What the primary did has been done again.
    pub(super) fn note_replayed(
        &mut self,
        result: Result<Bytes, DeliveryError>,
        void: bool,
        now: Instant,
    ) {
        let loads = self.jobs.iter().any(|job| matches!(job, Job::Load { .. }));
        match result {
            Err(DeliveryError::Stopped | DeliveryError::Isolated { .. }) => {
                self.handle_component_gone(now)
            }
            // The primary could.
            Err(_) if !void && !loads => self.lose_state(now),
            Ok(_) | Err(_) => {}
        }
    }

    /// It cannot serve any more, and does not wait until the others notice.
    pub(super) fn resign(&mut self, now: Instant) {
        let Acting::Primary(primary) = &self.role else { return };
        let epoch = primary.epoch;
        self.step_down(None, now);
        if let Acting::Standby(standby) = &mut self.role {
            standby.release_promise(now);
        }
        self.tell_others(&Message::Resigned { epoch });
    }

    /// Somebody serves, and has the state.
    pub(super) fn wait_for_state(&mut self, now: Instant) {
        self.heard_at = now;
        if let Health::Bare { since } | Health::Gone { since } = &mut self.health {
            *since = now;
        }
    }

    /// Whether this replica does not stand for election; if so, until when it need not look again.
    /// Whoever waited in vain for those who know more forgets that there are any.
    pub(super) fn barred_until(&mut self, now: Instant) -> Option<Instant> {
        let until = self.lacking_since()? + self.config.patience();
        if now < until && self.config.members.len() > 1 {
            return Some(until);
        }
        let gone = match self.health {
            // What it has is the best that is left.
            Health::Whole => return None,
            Health::Bare { .. } => false,
            Health::Gone { .. } => true,
        };
        // What a replica keeps for its component is there however long that rests.
        if gone && self.config.kind == StandbyKind::Warm {
            return Some(now + self.config.patience());
        }
        self.position = Position::default();
        self.table.clear();
        self.state = None;
        gone.then(|| now + self.config.patience())
    }
}
