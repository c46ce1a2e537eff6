//! The state of the component, and what its replica does when that is lost or inactive.
//!
//! A replica's table and votes outlive its component's incarnations. With hot standbys the state
//! does not. A member without the state resigns. It still votes, for candidates that have at least
//! the position that it knows of. It does not stand for election until it has been brought into
//! step (Raft's election restriction, applied to the state as well as to the log).

use super::*;

/// How the component's state compares with its replica's log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Health {
    /// It has the state at the replica's position, or will have when it has done its jobs.
    Complete,
    /// It has restarted without the state, or failed to execute a request of the primary. Since
    /// then the replica knew of no primary.
    Stateless { since: Instant },
    /// It accepts no jobs: it is stopped or isolated. Since then the replica knew of no primary.
    Inactive { since: Instant },
}

impl Replica {
    /// The component has ended, and its state with it.
    pub fn handle_component_died(&mut self, now: Instant) {
        match (&self.role, self.config.kind) {
            // No other node has more than the restarted component.
            (_, StandbyKind::Cold) => {}
            (RoleState::Primary(Primary { epoch, .. }), StandbyKind::Hot)
                if self.config.members.len() == 1 =>
            {
                // There is no other member to serve.
                self.restart_without_lost_state(*epoch);
            }
            (RoleState::Primary(_), StandbyKind::Warm) => {
                self.discard_result = self.current_job.is_some();
                let state = self.last_state();
                self.jobs.push_front(Job::Load { state });
                self.start_next_job();
            }
            (RoleState::Standby(_), StandbyKind::Warm) => {
                self.discard_result = self.current_job.is_some()
            }
            (_, StandbyKind::Hot) => self.lose_state(now),
        }
    }

    /// The component was stopped or isolated: it accepts no jobs until
    /// [`Replica::handle_component_resumed`].
    pub fn handle_component_stopped(&mut self, now: Instant) {
        if let Health::Inactive { .. } = self.health {
            return;
        }
        if self.config.kind == StandbyKind::Hot {
            self.lose_state(now);
        } else {
            self.discard_result = self.current_job.is_some();
            self.resign(now);
            self.jobs.clear();
        }
        self.health = Health::Inactive { since: now };
        if let RoleState::Standby(standby) = &mut self.role {
            standby.withdraw();
        }
        self.report_role();
    }

    /// The component accepts jobs.
    pub fn handle_component_resumed(&mut self, now: Instant) {
        let Health::Inactive { .. } = self.health else { return };
        self.health = match self.config.kind {
            StandbyKind::Hot => Health::Stateless { since: now },
            StandbyKind::Warm | StandbyKind::Cold => Health::Complete,
        };
        if let RoleState::Standby(standby) = &mut self.role {
            if self.config.kind == StandbyKind::Hot {
                standby.fall_behind();
            }
            standby.advance_election(&self.config, now);
        }
        self.report_role();
    }

    /// The component failed to load a state.
    pub fn handle_not_loaded(&mut self, now: Instant) {
        self.end_load();
        if self.config.kind == StandbyKind::Hot {
            self.lose_state(now);
        }
    }

    /// The component does not have the state at the replica's position, which hot ones need.
    pub(super) fn lose_state(&mut self, now: Instant) {
        self.discard_result = self.current_job.is_some();
        if let RoleState::Primary(primary) = &self.role {
            // The next primary need not have requests whose replies were not sent.
            self.position = primary.released;
        }
        self.resign(now);
        self.jobs.clear();
        if self.health == Health::Complete {
            self.health = Health::Stateless { since: now };
        }
        if let RoleState::Standby(standby) = &mut self.role {
            standby.fall_behind();
            // Votes in flight were requested with a position that does not hold any more.
            standby.withdraw();
        }
        self.report_role();
    }

    /// The component restarted, and did the current job without the state. Schedules the job again.
    pub(super) fn retry_job(&mut self) {
        match (&self.role, self.current_job.take()) {
            (RoleState::Primary(_), Some(serve @ Job::Serve { .. })) => {
                let loads = matches!(self.jobs.front(), Some(Job::Load { .. }));
                self.jobs.insert(usize::from(loads), serve);
            }
            (_, Some(Job::Serve { .. } | Job::Replay { .. }) | None) => {}
            (_, other) => (self.current_job, self.discard_result) = (other, true),
        }
    }

    /// Handles the result of a request that the primary has served.
    pub(super) fn note_replayed(
        &mut self,
        result: Result<Bytes, DeliveryError>,
        discarded: bool,
        now: Instant,
    ) {
        let loads = self.jobs.iter().any(|job| matches!(job, Job::Load { .. }));
        match result {
            Err(DeliveryError::Stopped | DeliveryError::Isolated { .. }) => {
                self.handle_component_stopped(now)
            }
            // The primary's component executed it.
            Err(_) if !discarded && !loads => self.lose_state(now),
            Ok(_) | Err(_) => {}
        }
    }

    /// Ends the role of primary, and reports that to the other members before its lease ends.
    pub(super) fn resign(&mut self, now: Instant) {
        let RoleState::Primary(primary) = &self.role else { return };
        let epoch = primary.epoch;
        self.step_down(None, now);
        if let RoleState::Standby(standby) = &mut self.role {
            standby.release_promise(now);
        }
        self.send_to_others(&Message::Resigned { epoch });
    }

    /// Notes that a node has the state that this one may lack.
    pub(super) fn note_primary_seen(&mut self, now: Instant) {
        self.primary_seen_at = now;
        if let Health::Stateless { since } | Health::Inactive { since } = &mut self.health {
            *since = now;
        }
    }

    /// Returns until when this replica may not stand for election. If it has waited in vain for a
    /// node with a newer state, it drops its own position, so that the service starts without that
    /// state.
    pub(super) fn ineligible_until(&mut self, now: Instant) -> Option<Instant> {
        let until = self.waiting_since()? + self.config.state_timeout();
        if now < until && self.config.members.len() > 1 {
            return Some(until);
        }
        let is_inactive = match self.health {
            // No reachable member has a newer state.
            Health::Complete => return None,
            Health::Stateless { .. } => false,
            Health::Inactive { .. } => true,
        };
        // A warm replica keeps the state however long its component rests.
        if is_inactive && self.config.kind == StandbyKind::Warm {
            return Some(now + self.config.state_timeout());
        }
        self.position = Position::default();
        self.table.clear();
        self.state = None;
        is_inactive.then(|| now + self.config.state_timeout())
    }
}
