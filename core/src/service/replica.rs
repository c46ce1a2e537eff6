//! One replica of a service.
#![allow(clippy::wildcard_imports, reason = "its files are parts of the replica")]

mod agreement;
mod outage;
mod primary;
mod standby;
#[cfg(test)]
mod tests;

use super::change::Change;
use super::message::{
    EntryPayload, LeasePromise, LogEntry, MESSAGE_MAX, Message, Position, ReplicaHeartbeat, Served,
    Snapshot, StandbyStatus, Vote, VoteRequest,
};
use super::table::Table;
use super::types::{ReplicaOutput, Role, ServiceOutcome, ServiceRequest};
use super::view::{ServiceState, ServiceView};
use super::{OnPartition, ReplicaConfig, StandbyKind};
use crate::contract::codec;
use crate::sorted::SortedMap;
use crate::{DeliveryError, FaultKind, Instant, Machine, MessageId, NodeName};
use agreement::{ConfigAgreement, ConfigComparison};
use bytes::Bytes;
use outage::Outage;
use primary::Primary;
use standby::Standby;
use std::collections::VecDeque;

/// The most requests that may wait in one replica. Further ones are refused as full.
pub const QUEUE_MAX: usize = 256;
/// The most bytes of a component's state. A larger one is not kept for the standbys.
pub const STATE_MAX: usize = 3 * 1024 * 1024;

/// One job of the component. It has one at a time.
#[derive(Clone, Debug)]
enum Job {
    /// Serve a request as primary.
    Serve { id: MessageId, settled: u64, until: Option<Instant>, request: Bytes },
    /// Execute a request that the primary has served.
    Replay { request: Bytes },
    /// Load a state.
    Load { state: Bytes },
    /// Save the state, for standbys that are behind.
    Save,
}

/// The state machine of one service on one of its nodes.
#[derive(Debug)]
pub struct Replica {
    config: ReplicaConfig,
    /// The greatest epoch that had a primary, or in which this replica voted for another one.
    epoch: u64,
    /// The greatest epoch in which this replica stood for election, or which it must not use.
    used_epoch: u64,
    log: ReplicaLog,
    /// When this replica last knew of a primary, or its component lost the state or came to rest.
    primary_seen_at: Instant,
    role: RoleState,
    /// The time of the last input that had one.
    now: Instant,
    component: ReplicaComponent,
    agreement: ConfigAgreement,
    outage: Outage,
    refused: u64,
    reports: ReplicaReports,
}

/// The end of the log of requests.
#[derive(Debug)]
struct ReplicaLog {
    position: Position,
    /// The last position whose reply was sent by any primary, as far as this replica knows.
    answered: Position,
    /// The newest state if standbys are warm, or else the one that the component was built with.
    state: Bytes,
    table: Table,
}

/// The component and its jobs.
#[derive(Debug)]
struct ReplicaComponent {
    jobs: VecDeque<Job>,
    /// The job that it does now.
    current: Option<Job>,
    /// It has restarted since it was given that job: the result does not count.
    discards: bool,
    health: Health,
    /// The fault that the state cannot be kept for the standbys is declared.
    state_refused: bool,
}

impl ReplicaComponent {
    /// It has restarted: the result of its current job does not count.
    fn discard(&mut self) {
        self.discards = self.current.is_some();
    }

    /// Returns whether it has yet to load a state.
    fn is_loading(&self) -> bool {
        self.jobs.iter().chain(&self.current).any(|job| matches!(job, Job::Load { .. }))
    }
}

/// What is reported to the actor.
#[derive(Debug)]
struct ReplicaReports {
    /// The role as it was reported last.
    role: Role,
    /// The declared faults with their details.
    faults: SortedMap<FaultKind, String>,
    outputs: VecDeque<ReplicaOutput>,
}

/// How the component's state compares with its replica's log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Health {
    /// It has the state at the replica's position, or will have when it has done its jobs.
    Complete,
    /// It has restarted without the state, or failed to execute a request of the primary.
    Stateless,
    /// It accepts no jobs: it is stopped or isolated.
    Inactive,
}

#[derive(Debug)]
enum RoleState {
    Primary(Primary),
    Standby(Standby),
}

impl Replica {
    /// Returns a replica that stands by. For one lease it does not vote: it may have promised its
    /// vote before it restarted. `initial` is the state that the component was built with.
    pub fn new(config: ReplicaConfig, initial: Bytes, now: Instant) -> Self {
        let standby = Standby::starting(&config, now);
        let log = ReplicaLog {
            position: Position::default(),
            answered: Position::default(),
            state: initial,
            table: Table::default(),
        };
        let component = ReplicaComponent {
            jobs: VecDeque::new(),
            current: None,
            discards: false,
            health: Health::Complete,
            state_refused: false,
        };
        let reports = ReplicaReports {
            role: Role::default(),
            faults: SortedMap::new(),
            outputs: VecDeque::new(),
        };
        let mut replica = Replica {
            agreement: ConfigAgreement::new(&config),
            config,
            epoch: 0,
            used_epoch: 0,
            log,
            primary_seen_at: now,
            role: RoleState::Standby(standby),
            now,
            component,
            outage: Outage { since: Some(now), ..Outage::default() },
            refused: 0,
            reports,
        };
        // Cold standbys keep no state.
        if replica.config.kind != StandbyKind::Cold
            && let Err(why) = within_bounds(Ok(replica.log.state.clone()))
        {
            replica.refuse_state(&why);
        }
        replica
    }

    /// Returns the role of this replica.
    pub fn role(&self) -> Role {
        match &self.role {
            RoleState::Primary(primary) => Role::Primary { epoch: primary.epoch },
            RoleState::Standby(Standby { primary, in_step, .. }) => {
                // A cold standby keeps no state, so it lacks none.
                let kept = self.config.kind == StandbyKind::Cold || *in_step == Some(self.epoch);
                let in_step =
                    kept && primary.is_some() && self.component.health == Health::Complete;
                Role::Standby { primary: primary.clone(), in_step }
            }
        }
    }

    /// Returns how many messages were refused: undecodable, of a node that may not send them, or
    /// beyond the capacity.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Counts a message that names another sender than the node that it came from, or comes from a
    /// node that may not claim the service.
    pub fn handle_refused(&mut self) {
        self.refused += 1;
    }

    /// Declares that the service has no primary, or updates the causes, if that is due.
    fn report_outage(&mut self, now: Instant) {
        if self.outage.due(&self.config).is_some_and(|due| now >= due) {
            self.outage.described_at = Some(now);
            let detail = format!("no primary is known here: {}", outage::causes(self, now));
            self.set_fault(FaultKind::ServiceUnavailable, Some(detail));
        }
    }

    /// The services that this one depends on have primaries: this replica may stand for election,
    /// if it still has to.
    pub fn handle_ready(&mut self, now: Instant) {
        let RoleState::Standby(standby) = &mut self.role else { return };
        if standby.checking_dependencies {
            standby.dependencies_ready = true;
            self.stand_for_election(now);
        }
    }

    /// Handles a caller's request.
    pub fn handle_request(&mut self, asked: ServiceRequest, now: Instant) {
        let ServiceRequest { caller, id, settled, until, request } = asked;
        self.handle_timeout(now);
        if let Some(difference) = self.mismatch() {
            let why = DeliveryError::ContractDiffers { difference };
            return self.answer(caller, ServiceOutcome::Refused(why));
        }
        if self.log.table.is_settled(id) {
            // The request was delayed, and its caller has a reply by another path.
            return self.answer(caller, ServiceOutcome::Refused(DeliveryError::Expired));
        }
        let served = self.log.table.find(id).cloned();
        let primary = match &mut self.role {
            RoleState::Standby(standby) => {
                let elsewhere = ServiceOutcome::Elsewhere(standby.primary.clone());
                return self.answer(caller, elsewhere);
            }
            RoleState::Primary(primary) => primary,
        };
        // A caller that asks again waits for the newer request only.
        if let Some(waiting) = primary.waiting.get_mut(&id) {
            let before = std::mem::replace(waiting, caller);
            return self.answer(before, ServiceOutcome::Elsewhere(None));
        }
        match served {
            // No other replica keeps what a cold service has served.
            Some(served) if self.config.kind == StandbyKind::Cold => {
                self.answer(caller, ServiceOutcome::Served(served.result));
            }
            Some(_) => {
                primary.hold_repeat(id, caller, now);
                self.release(now);
            }
            None if primary.waiting.len() >= QUEUE_MAX => {
                self.answer(caller, ServiceOutcome::Refused(DeliveryError::Full));
            }
            None => {
                primary.waiting.insert(id, caller);
                self.component.jobs.push_back(Job::Serve { id, settled, until, request });
                self.start_next_job();
            }
        }
    }

    /// Handles the component's result of [`ReplicaOutput::Execute`].
    pub fn handle_executed(
        &mut self,
        result: Result<Bytes, DeliveryError>,
        state: Option<Result<Bytes, DeliveryError>>,
        now: Instant,
    ) {
        self.now = now;
        let discarded = std::mem::take(&mut self.component.discards);
        if discarded && result.is_ok() && !matches!(state, Some(Err(_))) {
            self.retry_job();
            return self.start_next_job();
        }
        let (result, state) = self.kept(result, state);
        match self.component.current.take() {
            Some(Job::Serve { id, settled, request, .. }) => match (&mut self.role, result) {
                (_, Err(DeliveryError::Stopped | DeliveryError::Isolated { .. })) => {
                    self.handle_component_stopped(now)
                }
                (RoleState::Standby(_), _) if discarded => {}
                // This replica was primary when the request began. If it is elected again, the result
                // counts.
                (RoleState::Standby(_), result) => self.note_late_result(id, result, state),
                // The component has not begun the request: the caller may send it again.
                (
                    RoleState::Primary(primary),
                    Err(why @ (DeliveryError::Restarting | DeliveryError::Full)),
                ) => {
                    if let Some(caller) = primary.waiting.remove(&id) {
                        self.answer(caller, ServiceOutcome::Refused(why));
                    }
                }
                (RoleState::Primary(_), result) => {
                    self.commit_later(id, settled, request, result, state, now);
                }
            },
            Some(Job::Replay { .. }) => self.note_replayed(result, discarded, now),
            None => {}
            Some(other) => self.component.current = Some(other),
        }
        self.start_next_job();
    }

    /// Returns the result, and the state if it can be kept for the standbys. If it cannot, the
    /// request fails, and the component loads the state that it had before.
    fn kept(
        &mut self,
        result: Result<Bytes, DeliveryError>,
        state: Option<Result<Bytes, DeliveryError>>,
    ) -> (Result<Bytes, DeliveryError>, Option<Bytes>) {
        match (result, state.map(within_bounds)) {
            (Ok(reply), Some(Ok(state))) => {
                self.component.state_refused = false;
                (Ok(reply), Some(state))
            }
            (Ok(_), Some(Err(why))) => {
                self.refuse_state(&why);
                let state = self.log.state.clone();
                self.component.jobs.push_front(Job::Load { state });
                (Err(why), None)
            }
            (result, state) => (result, state.and_then(Result::ok)),
        }
    }

    fn refuse_state(&mut self, why: &DeliveryError) {
        // The end of a component is a fault by itself.
        let large = matches!(why, DeliveryError::TooLarge { .. });
        if large && !std::mem::replace(&mut self.component.state_refused, true) {
            let detail = format!(
                "its state cannot be kept for its standbys, so none of them can take over: {why}; make it \
                 smaller, or keep large data elsewhere"
            );
            let kind = FaultKind::CheckFailed;
            self.reports.outputs.push_back(ReplicaOutput::Fault { kind, detail });
        }
    }

    /// Handles the component's result of [`ReplicaOutput::Save`].
    pub fn handle_saved(&mut self, state: Result<Bytes, DeliveryError>, now: Instant) {
        match self.component.current.take() {
            Some(Job::Save) => {
                let discarded = std::mem::take(&mut self.component.discards);
                match within_bounds(state) {
                    Ok(_) if discarded => {}
                    Ok(state) => self.send_snapshots(&state, now),
                    Err(why) => self.refuse_state(&why),
                }
            }
            other => self.component.current = other,
        }
        self.start_next_job();
    }

    /// The component has loaded a state.
    pub fn handle_loaded(&mut self) {
        self.end_load();
        self.confirm_state();
    }

    fn end_load(&mut self) {
        match self.component.current.take() {
            Some(Job::Load { .. }) => self.component.discards = false,
            other => self.component.current = other,
        }
        self.start_next_job();
    }

    /// Handles a message of another replica.
    pub fn handle_message(&mut self, from: &NodeName, message: &[u8], now: Instant) {
        let is_member = *from != self.config.own && self.config.members.contains(from);
        match message.split_last_chunk().filter(|_| is_member) {
            Some((message, mark)) if u64::from_le_bytes(*mark) == self.agreement.fingerprint => {
                match codec::decode_bounded::<Message, MESSAGE_MAX>(message) {
                    Ok(message) => self.dispatch(from, message, now),
                    Err(_) => self.refused += 1,
                }
            }
            Some(_) => {
                self.refused += 1;
                self.agreement.note_foreign(from);
                self.compare(from, now);
            }
            None => self.refused += 1,
        }
    }

    /// Handles a message of a member with the same configuration.
    fn dispatch(&mut self, from: &NodeName, message: Message, now: Instant) {
        self.handle_timeout(now);
        match message {
            Message::Heartbeat(heartbeat) => self.handle_heartbeat(from, heartbeat, now),
            Message::LeasePromise(promise) => {
                self.detect_loss(promise.epoch, promise.answered);
                self.handle_promise(from, &promise, now);
            }
            Message::Outdated { epoch } => match &self.role {
                RoleState::Primary(primary) if epoch > primary.epoch => self.step_down(None, now),
                RoleState::Primary(_) => {}
                RoleState::Standby(_) => self.used_epoch = self.used_epoch.max(epoch),
            },
            // A failed candidacy of another replica deposes no primary.
            Message::Voted { epoch } => self.used_epoch = self.used_epoch.max(epoch),
            Message::VoteRequest(request) => self.handle_vote_request(from, request, now),
            Message::Vote(vote) => self.handle_vote(from, vote, now),
            Message::Entry(entry) => self.handle_entry(from, entry),
            Message::Snapshot(snapshot) => self.handle_snapshot(from, snapshot),
            Message::Resigned { epoch } => self.handle_resignation(from, epoch, now),
        }
    }

    /// Returns what this replica knows of its service now.
    pub fn view(&self) -> ServiceView {
        let primary = match &self.role {
            RoleState::Primary(_) => Some(self.config.own.clone()),
            RoleState::Standby(standby) => standby.primary.clone(),
        };
        let unreachable = |member: &&NodeName| {
            **member != self.config.own
                && self.agreement.known.get(*member).is_none_or(|known| !known.seen)
        };
        ServiceView {
            state: self.state_shown(),
            role: self.role(),
            epoch: self.epoch,
            primary,
            unreachable: self.config.members.iter().filter(unreachable).cloned().collect(),
            unreplicated: self.reports.faults.contains_key(&FaultKind::Unreplicated),
        }
    }

    fn state_shown(&self) -> ServiceState {
        if let RoleState::Primary(_) = self.role {
            return ServiceState::Primary;
        }
        match (self.component.health, self.role()) {
            (Health::Inactive, _) => ServiceState::Resting,
            (_, Role::Standby { primary: None, .. }) if self.agreement.is_disputed() => {
                ServiceState::Fenced
            }
            (_, Role::Standby { primary: None, .. }) => ServiceState::Candidate,
            (_, Role::Standby { in_step: true, .. }) => ServiceState::Standby,
            _ => ServiceState::Behind,
        }
    }

    /// Returns this replica's configuration and whether it serves, encoded for
    /// [`Replica::handle_configuration`] of the other replicas.
    pub fn configuration(&self) -> Bytes {
        self.agreement.encode(matches!(self.role, RoleState::Primary(_)))
    }

    /// Returns how the configurations differ and what to write, if this replica knows of no primary
    /// and no node begins to serve until then.
    pub fn mismatch(&self) -> Option<String> {
        match &self.role {
            RoleState::Standby(Standby { primary: None, .. }) => self.agreement.differences(),
            RoleState::Standby(_) | RoleState::Primary(_) => None,
        }
    }

    /// Sets the other nodes that have an object of the service's name and to which a path leads.
    /// Drops what is known of nodes that may not claim the service. Call it several times a second,
    /// as the policy of the robot may change.
    pub fn handle_carriers(
        &mut self,
        found: &[NodeName],
        may_claim: impl Fn(&NodeName) -> bool,
        now: Instant,
    ) {
        self.agreement.see(found, may_claim);
        let nodes: Vec<_> = self.agreement.known.keys().cloned().collect();
        nodes.iter().for_each(|node| self.compare(node, now));
        self.report_mismatch();
    }

    /// Handles the configuration that another node sends, with its question or as its answer.
    pub fn handle_configuration(&mut self, from: &NodeName, bytes: &[u8], now: Instant) {
        let compared = self.agreement.compare(from, bytes).filter(|_| *from != self.config.own);
        let Some((comparison, other_goes_on)) = compared else {
            self.refused += 1;
            return;
        };
        self.note_comparison(from, comparison);
        if other_goes_on {
            // Its standbys keep their promises: a lease's time to meet that node as well.
            self.step_down(None, now);
        }
    }

    /// A node is there, and does not carry the service.
    pub fn handle_no_service(&mut self, of: &NodeName) {
        let before = self.agreement.known.get(of).map(|known| &known.comparison);
        let confirmed = matches!(before, Some(ConfigComparison::Absent { .. }));
        self.note_comparison(of, ConfigComparison::Absent { confirmed });
    }

    /// A node has ended in order.
    pub fn handle_left(&mut self, node: &NodeName) {
        self.note_comparison(node, ConfigComparison::Unknown);
    }

    /// Returns a replica that starts with what this one knows of the others, after its actor has
    /// failed. `initial` is as in [`Replica::new`].
    #[must_use]
    pub fn restarted(&self, initial: Bytes, now: Instant) -> Self {
        let mut next = Replica::new(self.config.clone(), initial, now);
        next.agreement = self.agreement.clone();
        next.log.answered = self.log.answered;
        // The new replica finds again what is still wrong.
        for kind in self.reports.faults.keys() {
            next.reports.outputs.push_back(ReplicaOutput::FaultCleared { kind: kind.clone() });
        }
        next.report_mismatch();
        next
    }

    /// Asks a node for its configuration, if that is due.
    fn compare(&mut self, with: &NodeName, now: Instant) {
        if *with != self.config.own && self.agreement.is_due(with, now) {
            self.reports.outputs.push_back(ReplicaOutput::Compare { with: with.clone() });
        }
    }

    fn note_comparison(&mut self, of: &NodeName, comparison: ConfigComparison) {
        match self.agreement.record(of) {
            Some(known) => known.comparison = comparison,
            None => self.refused += 1,
        }
        self.report_mismatch();
    }

    /// Declares the mismatch if it has changed, or clears it.
    fn report_mismatch(&mut self) {
        self.set_fault(FaultKind::ContractMismatch, self.agreement.describe());
    }

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
                self.component.discard();
                let state = self.log.state.clone();
                self.component.jobs.push_front(Job::Load { state });
                self.start_next_job();
            }
            (RoleState::Standby(_), StandbyKind::Warm) => {
                self.component.discard();
            }
            (_, StandbyKind::Hot) => self.lose_state(now),
        }
    }

    /// The component was stopped or isolated: it accepts no jobs until
    /// [`Replica::handle_component_resumed`].
    pub fn handle_component_stopped(&mut self, now: Instant) {
        if self.component.health == Health::Inactive {
            return;
        }
        if self.config.kind == StandbyKind::Hot {
            self.lose_state(now);
        } else {
            self.component.discard();
            self.resign(now);
            self.component.jobs.clear();
        }
        (self.component.health, self.primary_seen_at) = (Health::Inactive, now);
        if let RoleState::Standby(standby) = &mut self.role {
            standby.candidacy = None;
        }
        self.report_role();
    }

    /// The component accepts jobs.
    pub fn handle_component_resumed(&mut self, now: Instant) {
        if self.component.health != Health::Inactive {
            return;
        }
        self.component.health = Health::Complete;
        if self.config.kind == StandbyKind::Hot {
            self.lose_state(now);
        }
        if let RoleState::Standby(standby) = &mut self.role {
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
    fn lose_state(&mut self, now: Instant) {
        self.component.discard();
        if let RoleState::Primary(primary) = &self.role {
            // The next primary need not have requests whose replies were not sent.
            self.log.position = primary.released;
        }
        self.resign(now);
        self.component.jobs.clear();
        if self.component.health == Health::Complete {
            (self.component.health, self.primary_seen_at) = (Health::Stateless, now);
        }
        if let RoleState::Standby(standby) = &mut self.role {
            standby.fall_behind();
            // Votes in flight were requested with a position that does not hold any more.
            standby.candidacy = None;
        }
        self.report_role();
    }

    /// The component restarted, and did the current job without the state. Schedules the job again.
    fn retry_job(&mut self) {
        match (&self.role, self.component.current.take()) {
            (RoleState::Primary(_), Some(serve @ Job::Serve { .. })) => {
                let loads = matches!(self.component.jobs.front(), Some(Job::Load { .. }));
                self.component.jobs.insert(usize::from(loads), serve);
            }
            (_, Some(Job::Serve { .. } | Job::Replay { .. }) | None) => {}
            (_, other) => (self.component.current, self.component.discards) = (other, true),
        }
    }

    /// Handles the result of a request that the primary has served.
    fn note_replayed(
        &mut self,
        result: Result<Bytes, DeliveryError>,
        discarded: bool,
        now: Instant,
    ) {
        let loads = self.component.is_loading();
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
    fn resign(&mut self, now: Instant) {
        let RoleState::Primary(primary) = &self.role else { return };
        let epoch = primary.epoch;
        self.step_down(None, now);
        if let RoleState::Standby(standby) = &mut self.role {
            standby.promised_until = standby.promised_until.min(now);
        }
        self.send_to_others(&Message::Resigned { epoch });
    }

    /// Returns until when this replica may not stand for election. If it has waited in vain for a
    /// node with a newer state, it drops its own position, so that the service starts without that
    /// state.
    fn ineligible_until(&mut self, now: Instant) -> Option<Instant> {
        let until = self.waiting_since()? + self.config.state_timeout();
        if now < until && self.config.members.len() > 1 {
            return Some(until);
        }
        if self.component.health == Health::Complete {
            // No reachable member has a newer state.
            return None;
        }
        let is_inactive = self.component.health == Health::Inactive;
        // A warm replica keeps the state however long its component rests.
        if is_inactive && self.config.kind == StandbyKind::Warm {
            return Some(now + self.config.state_timeout());
        }
        self.log.position = Position::default();
        self.log.table.clear();
        is_inactive.then(|| now + self.config.state_timeout())
    }

    fn note_epoch(&mut self, epoch: u64) {
        self.epoch = self.epoch.max(epoch);
    }

    /// Gives the component the next job, if it has none.
    fn start_next_job(&mut self) {
        if self.component.current.is_some() {
            return;
        }
        if self.component.health == Health::Inactive {
            return self.component.jobs.clear();
        }
        let Some(job) = self.next_job() else { return };
        self.reports.outputs.push_back(match &job {
            Job::Serve { request, .. } => {
                let save = self.config.kind == StandbyKind::Warm;
                ReplicaOutput::Execute { request: request.clone(), save }
            }
            Job::Replay { request } => {
                ReplicaOutput::Execute { request: request.clone(), save: false }
            }
            Job::Load { state } => ReplicaOutput::Load { state: state.clone() },
            Job::Save => ReplicaOutput::Save,
        });
        self.component.current = Some(job);
    }

    /// Removes and returns the next job. Requests whose deadline has passed are refused.
    fn next_job(&mut self) -> Option<Job> {
        loop {
            let job = self.component.jobs.pop_front()?;
            let Job::Serve { id, until: Some(until), .. } = &job else { return Some(job) };
            if self.now < *until {
                return Some(job);
            }
            if let RoleState::Primary(primary) = &mut self.role
                && let Some(caller) = primary.waiting.remove(id)
            {
                self.answer(caller, ServiceOutcome::Refused(DeliveryError::DeadlinePassed));
            }
        }
    }

    /// Ends the role of primary.
    fn step_down(&mut self, primary: Option<NodeName>, now: Instant) {
        let standby = Standby::new(&self.config, primary.clone(), now);
        let RoleState::Primary(past) =
            std::mem::replace(&mut self.role, RoleState::Standby(standby))
        else {
            return;
        };
        // Requests that no standby has are dropped: their callers send them to the next primary.
        self.component.jobs.retain(|job| !matches!(job, Job::Serve { .. } | Job::Save));
        for caller in past.waiting.into_values() {
            let outcome = match self.config.kind {
                // No other replica knows of the request.
                StandbyKind::Cold => {
                    let reason = "the primary stopped while it served".into();
                    ServiceOutcome::Served(Err(DeliveryError::OutcomeUnknown { reason }))
                }
                _ => ServiceOutcome::Elsewhere(primary.clone()),
            };
            self.answer(caller, outcome);
        }
        self.clear_faults();
        self.report_role();
    }

    /// Reports the role, if it has changed.
    fn report_role(&mut self) {
        let role = self.role();
        if role != self.reports.role {
            self.reports.role = role.clone();
            self.reports.outputs.push_back(ReplicaOutput::RoleChanged(role.clone()));
        }
        // The time without a known primary begins or ends.
        if let Role::Standby { primary: None, .. } = role {
            self.outage.since.get_or_insert(self.now);
        } else {
            self.outage = Outage { served: true, ..Outage::default() };
            self.set_fault(FaultKind::ServiceUnavailable, None);
        }
    }

    fn answer(&mut self, caller: u64, outcome: ServiceOutcome) {
        self.reports.outputs.push_back(ReplicaOutput::Answer { caller, outcome });
    }

    fn send(&mut self, to: &NodeName, message: &Message) {
        let message = self.agreement.sign(codec::encode_unbounded(message));
        self.reports.outputs.push_back(ReplicaOutput::Send { to: to.clone(), message });
    }

    fn send_to_others(&mut self, message: &Message) {
        let message = self.agreement.sign(codec::encode_unbounded(message));
        let members = self.config.members.iter().filter(|member| **member != self.config.own);
        for to in members.cloned() {
            self.reports.outputs.push_back(ReplicaOutput::Send { to, message: message.clone() });
        }
    }
}

/// Returns the state, or an error if it is too large. A state that did not fit into the component's
/// reply is too large as well.
fn within_bounds(state: Result<Bytes, DeliveryError>) -> Result<Bytes, DeliveryError> {
    match state {
        Ok(state) if state.len() > STATE_MAX => Err(DeliveryError::TooLarge { limit: STATE_MAX }),
        Err(DeliveryError::ReplyTooLarge { .. }) => {
            Err(DeliveryError::TooLarge { limit: STATE_MAX })
        }
        other => other,
    }
}

impl Machine for Replica {
    type Output = ReplicaOutput;

    fn poll_output(&mut self) -> Option<ReplicaOutput> {
        self.reports.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        match &self.role {
            RoleState::Primary(primary) => Some(primary.due(&self.config)),
            RoleState::Standby(standby) => {
                let outage = self.outage.due(&self.config);
                Some(outage.map_or(standby.due(), |due| due.min(standby.due())))
            }
        }
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.now = now;
        match &self.role {
            RoleState::Primary(primary) if !primary.has_lease(&self.config, now) => {
                self.step_down(None, now);
            }
            RoleState::Primary(primary) if now >= primary.heartbeat_at => {
                self.send_heartbeat(now);
                self.release(now);
            }
            RoleState::Standby(standby) if now >= standby.election_at => {
                self.stand_for_election(now)
            }
            RoleState::Standby(standby) if now >= standby.due() => self.handle_pending_request(now),
            RoleState::Primary(_) | RoleState::Standby(_) => {}
        }
        self.report_outage(now);
    }
}
