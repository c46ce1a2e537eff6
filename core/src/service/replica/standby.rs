//! A replica that stands by: lease promises, votes and elections.

use super::*;
use std::time::Duration;

/// The state of a replica that stands by.
#[derive(Debug)]
pub(super) struct Standby {
    /// The node of the primary, if one is known.
    pub(super) primary: Option<NodeName>,
    /// Until then this replica votes for no other one.
    pub(super) promised_until: Instant,
    /// When this replica stands for election, unless it receives a heartbeat before.
    pub(super) election_at: Instant,
    /// The epoch in which it was brought into step. It has all entries of that epoch since.
    pub(super) in_step: Option<u64>,
    /// It has all entries up to its position.
    complete: bool,
    /// Votes for it count while it is there.
    pub(super) candidacy: Option<Candidacy>,
    /// It is due to stand for election, and waits for the services that it depends on.
    pub(super) checking_dependencies: bool,
    /// Those services have primaries, which counts for one election.
    pub(super) dependencies_ready: bool,
    /// A vote request that came while a promise holds. It is handled when the promise ends.
    pending_request: Option<(NodeName, VoteRequest)>,
}

/// An epoch in which this replica stands for election.
#[derive(Debug)]
pub(super) struct Candidacy {
    epoch: u64,
    requested_at: Instant,
    /// This replica's position at that time.
    position: Position,
    /// The voters, and whether each has this replica's entries.
    votes: SortedMap<NodeName, bool>,
}

impl Standby {
    /// A replica that has served, or has restarted. Other replicas may lack its last entries.
    pub(super) fn new(config: &ReplicaConfig, primary: Option<NodeName>, now: Instant) -> Self {
        let promised_until = now + config.lease() + config.margin();
        Standby {
            election_at: promised_until + election_delay(config, primary.as_ref()),
            primary,
            promised_until,
            in_step: None,
            complete: false,
            candidacy: None,
            checking_dependencies: false,
            dependencies_ready: false,
            pending_request: None,
        }
    }

    /// A replica at its start, which has all zero entries.
    pub(super) fn starting(config: &ReplicaConfig, now: Instant) -> Self {
        Standby { complete: true, ..Standby::new(config, None, now) }
    }

    /// Returns the next time at which there is something to do.
    pub(super) fn due(&self) -> Instant {
        match self.pending_request {
            Some(_) => self.election_at.min(self.promised_until),
            None => self.election_at,
        }
    }

    /// Stands for election as soon as the promise has ended and it is this replica's turn.
    pub(super) fn advance_election(&mut self, config: &ReplicaConfig, now: Instant) {
        let delay = election_delay(config, self.primary.as_ref());
        self.election_at = self.election_at.min(self.promised_until.max(now) + delay);
    }

    /// This replica lacks entries of the primary.
    pub(super) fn fall_behind(&mut self) {
        self.in_step = None;
        self.complete = false;
    }
}

/// Returns the delay before this replica stands for election: half a heartbeat interval for each
/// member before it in the list, without the one that is gone.
fn election_delay(config: &ReplicaConfig, gone: Option<&NodeName>) -> Duration {
    let others = config.members.iter().filter(|member| Some(*member) != gone);
    let before = others.take_while(|member| **member != config.own).count();
    config.heartbeat_interval / 2 * u32::try_from(before).unwrap_or(u32::MAX)
}

impl Replica {
    pub(super) fn handle_heartbeat(
        &mut self,
        from: &NodeName,
        heartbeat: ReplicaHeartbeat,
        now: Instant,
    ) {
        if heartbeat.epoch < self.epoch {
            return self.send(from, &Message::Outdated { epoch: self.epoch });
        }
        if let RoleState::Primary(primary) = &self.role {
            // Two replicas serve in one epoch only with `OnPartition::Continue`.
            if (primary.epoch, from) > (heartbeat.epoch, &self.config.own) {
                return;
            }
            self.step_down(Some(from.clone()), now);
        }
        let ReplicaHeartbeat { epoch, sent, position, answered } = heartbeat;
        self.note_epoch(epoch);
        self.log.answered = self.log.answered.max(answered);
        self.primary_seen_at = now;
        let (own, loading) = (self.log.position, self.component.is_loading());
        let comparable = self.comparable_by_position();
        let RoleState::Standby(standby) = &mut self.role else { return };
        if comparable && standby.complete && position == own {
            standby.in_step = Some(epoch);
        } else if comparable && position > own {
            // The missing entries were sent to others only.
            standby.in_step = None;
        }
        standby.primary = Some(from.clone());
        (standby.candidacy, standby.pending_request) = (None, None);
        standby.checking_dependencies = false;
        let timeout = self.config.lease() + self.config.margin();
        standby.promised_until = now + timeout;
        standby.election_at = standby.promised_until + election_delay(&self.config, Some(from));
        let status = match (self.config.kind, self.component.health) {
            (StandbyKind::Cold, _) => StandbyStatus::InStep,
            (StandbyKind::Hot, Health::Inactive) => StandbyStatus::Inactive,
            _ if standby.in_step != Some(epoch) => StandbyStatus::Behind,
            (StandbyKind::Hot, _) if loading => StandbyStatus::Loading,
            _ => StandbyStatus::InStep,
        };
        let (position, answered) = (self.log.position, self.log.answered);
        let promise = LeasePromise { epoch, sent: Some(sent), position, answered, status };
        self.send(from, &Message::LeasePromise(promise));
        self.report_role();
    }

    /// Stands for election in a new epoch, unless this replica is not eligible.
    pub(super) fn stand_for_election(&mut self, now: Instant) {
        let again = self.config.heartbeat_interval + election_delay(&self.config, None);
        let ineligible = self.ineligible_until(now);
        let RoleState::Standby(standby) = &mut self.role else { return };
        standby.election_at = now + again;
        standby.primary = None;
        let needs_no_vote =
            self.config.majority() == 1 || self.config.on_partition == OnPartition::Continue;
        if self.agreement.is_disputed() || needs_no_vote && !self.agreement.has_asked() {
            standby.checking_dependencies = false;
            return self.report_role();
        }
        if let Some(until) = ineligible {
            standby.election_at = until;
            return self.report_role();
        }
        if self.config.depends && !std::mem::take(&mut standby.dependencies_ready) {
            if !std::mem::replace(&mut standby.checking_dependencies, true) {
                self.reports.outputs.push_back(ReplicaOutput::CheckDependencies);
            }
            return self.report_role();
        }
        standby.checking_dependencies = false;
        self.report_role();
        let epoch = self.epoch.max(self.used_epoch).saturating_add(1);
        self.used_epoch = epoch;
        let position = self.log.position;
        let RoleState::Standby(standby) = &mut self.role else { return };
        let votes = SortedMap::new();
        standby.candidacy = Some(Candidacy { epoch, requested_at: now, position, votes });
        if needs_no_vote {
            return self.take_over(epoch, now, [], now);
        }
        self.send_to_others(&Message::VoteRequest(VoteRequest { epoch, position }));
    }

    pub(super) fn handle_vote_request(
        &mut self,
        from: &NodeName,
        request: VoteRequest,
        now: Instant,
    ) {
        if let RoleState::Primary(_) = self.role {
            // The candidate has not received a heartbeat yet, and will.
            return;
        }
        let VoteRequest { epoch, position } = request;
        let voted = self.epoch.max(self.used_epoch);
        if epoch <= voted {
            return self.send(from, &Message::Voted { epoch: voted });
        }
        let ineligible = self.ineligible_until(now);
        let required = self.required_position(now);
        let RoleState::Standby(standby) = &mut self.role else { return };
        if position < required {
            self.used_epoch = self.used_epoch.max(epoch);
            if ineligible.is_some() {
                // Another member may have the entries that the candidate lacks.
                return;
            }
            // This replica has them, and stands for election itself.
            standby.election_at = standby.election_at.min(standby.promised_until.max(now));
            return self.handle_timeout(now);
        }
        if now < standby.promised_until {
            standby.pending_request = Some((from.clone(), request));
            return;
        }
        if self.agreement.is_disputed() {
            return;
        }
        // A vote is a lease promise as well.
        (standby.candidacy, standby.pending_request) = (None, None);
        standby.promised_until = now + self.config.lease() + self.config.margin();
        standby.election_at = standby.promised_until + election_delay(&self.config, None);
        let in_step = standby.complete && position == self.log.position;
        if in_step {
            standby.in_step = Some(epoch);
        }
        self.note_epoch(epoch);
        let answered = self.log.answered;
        self.send(from, &Message::Vote(Vote { epoch, in_step, answered }));
    }

    /// The primary has resigned.
    pub(super) fn handle_resignation(&mut self, from: &NodeName, epoch: u64, now: Instant) {
        let RoleState::Standby(standby) = &mut self.role else { return };
        // In a later epoch the promise may have been made to another replica.
        if epoch != self.epoch || standby.primary.as_ref() != Some(from) {
            return;
        }
        standby.promised_until = standby.promised_until.min(now);
        self.follow_none(now);
    }

    fn follow_none(&mut self, now: Instant) {
        let RoleState::Standby(standby) = &mut self.role else { return };
        standby.advance_election(&self.config, now);
        standby.primary = None;
        self.report_role();
        self.handle_timeout(now);
    }

    /// Handles the vote request that came while a promise held.
    pub(super) fn handle_pending_request(&mut self, now: Instant) {
        let RoleState::Standby(standby) = &mut self.role else { return };
        if let Some((from, request)) = standby.pending_request.take() {
            self.handle_vote_request(&from, request, now);
        }
    }

    /// Stores the result of a request that was begun as primary. No other replica has it.
    pub(super) fn note_late_result(
        &mut self,
        id: MessageId,
        result: Result<Bytes, DeliveryError>,
        state: Option<Bytes>,
    ) {
        if self.config.kind == StandbyKind::Cold {
            return;
        }
        self.log.position.number += 1;
        if let Some(state) = state {
            self.log.state = state;
        }
        self.log.table.note(Served { id, result: result.map(Vec::from) });
    }

    /// Returns whether two replicas at one position have the same entries. With
    /// `OnPartition::Continue`, they may have reached it with different ones.
    pub(super) fn comparable_by_position(&self) -> bool {
        self.config.on_partition == OnPartition::Stop && self.config.kind != StandbyKind::Cold
    }

    pub(super) fn handle_vote(&mut self, from: &NodeName, vote: Vote, now: Instant) {
        self.log.answered = self.log.answered.max(vote.answered);
        let in_step = vote.in_step && self.comparable_by_position();
        let RoleState::Standby(standby) = &mut self.role else { return };
        let Some(candidacy) = &mut standby.candidacy else { return };
        if candidacy.epoch != vote.epoch
            || now - candidacy.requested_at >= self.config.lease()
            || self.agreement.is_disputed()
        {
            return;
        }
        candidacy.votes.insert(from.clone(), in_step);
        if candidacy.votes.len() + 1 >= self.config.majority() {
            let requested_at = candidacy.requested_at;
            let votes = std::mem::take(&mut candidacy.votes);
            // The voters compared their positions with the one at the request.
            let unchanged = candidacy.position == self.log.position;
            let voters = votes.into_iter().map(|(node, in_step)| (node, unchanged && in_step));
            self.take_over(vote.epoch, requested_at, voters, now);
        }
    }

    pub(super) fn handle_entry(&mut self, from: &NodeName, entry: LogEntry) {
        let LogEntry { epoch, position, served, settled, payload } = entry;
        let RoleState::Standby(standby) = &mut self.role else { return };
        if epoch < self.epoch || standby.in_step != Some(epoch) {
            return;
        }
        if position.number != self.log.position.number.saturating_add(1) {
            standby.fall_behind();
            return self.report_role();
        }
        match payload {
            EntryPayload::State(change) => match change.apply(&self.log.state) {
                Some(state) => self.log.state = state.into(),
                // The state is not the one that the primary made the change for.
                None => {
                    standby.fall_behind();
                    return self.report_role();
                }
            },
            EntryPayload::Request(request) => {
                self.component.jobs.push_back(Job::Replay { request: request.into() });
            }
            EntryPayload::Failed => {}
        }
        self.log.position = position;
        self.log.table.settle(served.id.sender, settled);
        self.log.table.note(served);
        self.start_next_job();
        self.confirm(from, epoch);
    }

    pub(super) fn handle_snapshot(&mut self, from: &NodeName, snapshot: Snapshot) {
        let Snapshot { epoch, position, state, table } = snapshot;
        let inactive =
            self.config.kind == StandbyKind::Hot && self.component.health == Health::Inactive;
        let RoleState::Standby(standby) = &mut self.role else { return };
        if epoch < self.epoch || inactive {
            return;
        }
        (standby.in_step, standby.complete) = (Some(epoch), true);
        if self.component.health == Health::Stateless {
            self.component.health = Health::Complete;
        }
        self.note_epoch(epoch);
        self.log.position = position;
        self.log.table = table.bounded();
        // The snapshot does not contain the request that the component executes now.
        if let Some(Job::Serve { request, .. }) = &self.component.current {
            self.component.current = Some(Job::Replay { request: request.clone() });
        }
        match self.config.kind {
            StandbyKind::Hot => {
                self.component.jobs.clear();
                self.component.jobs.push_back(Job::Load { state: state.into() });
            }
            StandbyKind::Warm | StandbyKind::Cold => self.log.state = state.into(),
        }
        self.start_next_job();
        self.confirm(from, epoch);
        self.report_role();
    }

    /// Confirms to the primary that the component has loaded the state.
    pub(super) fn confirm_state(&mut self) {
        if let RoleState::Standby(standby) = &self.role
            && let (Some(primary), Some(epoch)) = (standby.primary.clone(), standby.in_step)
            && self.config.kind == StandbyKind::Hot
        {
            self.confirm(&primary, epoch);
        }
    }

    /// Sends this replica's position to the primary, without a promise.
    fn confirm(&mut self, primary: &NodeName, epoch: u64) {
        if self.config.kind == StandbyKind::Hot && self.component.is_loading() {
            return;
        }
        let (position, answered, status) =
            (self.log.position, self.log.answered, StandbyStatus::InStep);
        let confirmation = LeasePromise { epoch, sent: None, position, answered, status };
        self.send(primary, &Message::LeasePromise(confirmation));
    }
}
