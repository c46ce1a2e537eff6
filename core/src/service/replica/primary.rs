//! A replica that serves: heartbeats, followers and replies; and the faults when too few standbys
//! hold its state.
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

use super::agreement::describe_lists;
use super::*;

/// The state of a replica that serves.
#[derive(Debug)]
pub(super) struct Primary {
    pub(super) epoch: u64,
    pub(super) heartbeat_at: Instant,
    pub(super) standbys: SortedMap<NodeName, Follower>,
    /// The caller that waits for each request.
    pub(super) waiting: SortedMap<MessageId, u64>,
    /// The requests whose replies are held back, in order: the position, and since when.
    held_replies: VecDeque<(Position, MessageId, Instant)>,
    elected_at: Instant,
    /// The last position whose reply was sent.
    pub(super) released: Position,
    /// The position at which it was elected.
    pub(super) base: Position,
    /// Since when too few standbys are in step.
    pub(super) under_replicated_since: Option<Instant>,
}

/// What the primary knows of a standby.
#[derive(Clone, Copy, Debug)]
pub(super) struct Follower {
    /// When the newest heartbeat was sent that it has answered by a lease promise.
    pub(super) promised: Instant,
    pub(super) catch_up: CatchUp,
    position: Position,
}

/// How far a standby has caught up with the primary's log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CatchUp {
    /// It needs a snapshot.
    Behind,
    /// A snapshot was sent at this time, and every entry since.
    SnapshotSent(Instant),
    /// It has all entries, and is sent the next ones.
    InStep,
    /// Its component is stopped or isolated.
    Inactive,
}

impl Follower {
    /// A follower that has no entries yet.
    fn behind(promised: Instant) -> Self {
        Follower { promised, catch_up: CatchUp::Behind, position: Position::default() }
    }

    /// Returns whether its promise is no older than a lease and the margin.
    pub(super) fn is_live(&self, config: &ReplicaConfig, now: Instant) -> bool {
        now - self.promised <= config.lease() + config.margin()
    }
}

impl Primary {
    fn new(epoch: u64, released: Position, now: Instant) -> Self {
        Primary {
            epoch,
            heartbeat_at: now,
            standbys: SortedMap::new(),
            waiting: SortedMap::new(),
            held_replies: VecDeque::new(),
            elected_at: now,
            released,
            base: released,
            under_replicated_since: None,
        }
    }

    /// Holds the reply of a repeated request back until the followers have all entries of earlier
    /// epochs, of which its own may be one.
    pub(super) fn hold_repeat(&mut self, id: MessageId, caller: u64, now: Instant) {
        self.waiting.insert(id, caller);
        self.held_replies.push_front((self.base, id, now));
    }

    /// Returns until when a majority has promised to vote for no other replica.
    fn lease_until(&self, config: &ReplicaConfig) -> Option<Instant> {
        let needed = config.majority() - 1;
        if needed == 0 || config.on_partition == OnPartition::Continue {
            return None;
        }
        let promised = self.standbys.values().map(|follower| follower.promised);
        // A vote is a promise as well, from the time of the request.
        let mut promised: Vec<_> =
            promised.chain(std::iter::repeat_n(self.elected_at, needed)).collect();
        promised.sort_unstable_by(|a, b| b.cmp(a));
        promised.get(needed - 1).map(|at| *at + config.lease())
    }

    /// Returns whether a majority's promises hold.
    pub(super) fn has_lease(&self, config: &ReplicaConfig, now: Instant) -> bool {
        self.lease_until(config).is_none_or(|until| now < until)
    }

    /// Returns when the next heartbeat is due, or the lease ends.
    pub(super) fn due(&self, config: &ReplicaConfig) -> Instant {
        self.lease_until(config).map_or(self.heartbeat_at, |until| until.min(self.heartbeat_at))
    }

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
                holding.join(", ")
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

impl Replica {
    /// Starts to serve. The votes were requested at `asked`; each voter comes with whether it
    /// has this replica's entries.
    pub(super) fn take_over(
        &mut self,
        epoch: u64,
        asked: Instant,
        voters: impl IntoIterator<Item = (NodeName, bool)>,
        now: Instant,
    ) {
        let lost = self.start_without_lost_state(epoch);
        let mut primary = Primary::new(epoch, self.log.position, asked);
        let position = self.log.position;
        primary.standbys.extend(voters.into_iter().map(|(node, in_step)| {
            let mut follower = Follower::behind(asked);
            if in_step && !lost {
                (follower.catch_up, follower.position) = (CatchUp::InStep, position);
            }
            (node, follower)
        }));
        self.role = RoleState::Primary(primary);
        self.note_epoch(epoch);
        self.report_role();
        if self.config.kind == StandbyKind::Cold {
            self.log.table.clear();
        }
        // A hot component has executed all requests, or they are among its jobs. One without the
        // state starts as it was built.
        if self.config.kind != StandbyKind::Hot || self.component.health == Health::Stateless {
            self.component.jobs.push_back(Job::Load { state: self.log.state.clone() });
        }
        self.component.health = Health::Complete;
        self.start_next_job();
        self.send_heartbeat(now);
    }

    pub(super) fn send_heartbeat(&mut self, now: Instant) {
        let RoleState::Primary(primary) = &mut self.role else { return };
        primary.heartbeat_at = now + self.config.heartbeat_interval;
        let (epoch, position, answered) = (primary.epoch, self.log.position, self.log.answered);
        let heartbeat = ReplicaHeartbeat { epoch, sent: now.as_nanos(), position, answered };
        self.send_to_others(&Message::Heartbeat(heartbeat));
    }

    pub(super) fn handle_promise(&mut self, from: &NodeName, promise: &LeasePromise, now: Instant) {
        let LeasePromise { epoch, sent, position, status, .. } = *promise;
        let lease = self.config.lease();
        let nothing_missing = self.comparable_by_position() && position == self.log.position;
        let RoleState::Primary(primary) = &mut self.role else { return };
        if epoch != primary.epoch {
            return;
        }
        // No heartbeat was sent later than now, or before this replica was elected.
        let sent_at = sent.map(|sent| Instant::from_nanos(sent).min(now));
        let sent_at = sent_at.filter(|at| *at >= primary.elected_at);
        // A standby becomes a follower by its first promise.
        let before = primary.standbys.get(from).map(|known| known.promised);
        let Some(promised) = sent_at.or(before) else { return };
        let fresh = Follower::behind(promised);
        let follower = primary.standbys.entry(from.clone()).or_insert(fresh);
        follower.promised = follower.promised.max(promised);
        follower.catch_up = match (follower.catch_up, status) {
            (_, StandbyStatus::Inactive) => CatchUp::Inactive,
            (CatchUp::Behind | CatchUp::Inactive, StandbyStatus::InStep) if nothing_missing => {
                follower.position = position;
                CatchUp::InStep
            }
            // While it was behind, it was sent no entries.
            (CatchUp::Behind | CatchUp::Inactive, _) => CatchUp::Behind,
            (CatchUp::SnapshotSent(_) | CatchUp::InStep, StandbyStatus::Loading) => {
                CatchUp::SnapshotSent(now)
            }
            (CatchUp::SnapshotSent(at), StandbyStatus::Behind) if now - at > lease => {
                CatchUp::Behind
            }
            (CatchUp::SnapshotSent(at), StandbyStatus::Behind) => CatchUp::SnapshotSent(at),
            // It has restarted, and no longer has the entries that it confirmed.
            (CatchUp::InStep, StandbyStatus::Behind) => CatchUp::Behind,
            (CatchUp::SnapshotSent(_) | CatchUp::InStep, StandbyStatus::InStep) => {
                follower.position = follower.position.max(position);
                CatchUp::InStep
            }
        };
        // An entry was lost with its session.
        let waits = |(needed, _, at): &(Position, MessageId, Instant)| {
            follower.position < *needed && now - *at > lease
        };
        if follower.catch_up == CatchUp::InStep && primary.held_replies.iter().any(waits) {
            follower.catch_up = CatchUp::Behind;
        }
        let is_behind = follower.catch_up == CatchUp::Behind;
        match self.config.kind {
            StandbyKind::Warm if is_behind => self.send_snapshots(&self.log.state.clone(), now),
            StandbyKind::Hot if is_behind => {
                let mut jobs = self.component.jobs.iter().chain(&self.component.current);
                if !jobs.any(|job| matches!(job, Job::Save)) {
                    self.component.jobs.push_back(Job::Save);
                }
            }
            _ => {}
        }
        self.start_next_job();
        self.release(now);
    }

    /// Sends the state to all followers that are behind.
    pub(super) fn send_snapshots(&mut self, state: &Bytes, now: Instant) {
        let RoleState::Primary(primary) = &mut self.role else { return };
        let (epoch, position) = (primary.epoch, self.log.position);
        let mut recipients = Vec::new();
        for (node, follower) in &mut primary.standbys {
            if follower.catch_up == CatchUp::Behind {
                // Later entries arrive later: sessions keep the order.
                follower.catch_up = CatchUp::SnapshotSent(now);
                follower.position = Position::default();
                recipients.push(node.clone());
            }
        }
        let (state, table) = (state.to_vec(), self.log.table.clone());
        let snapshot = Message::Snapshot(Snapshot { epoch, position, state, table });
        recipients.iter().for_each(|node| self.send(node, &snapshot));
    }

    /// Appends an executed request to the log, and holds its reply back until the followers in step
    /// have it.
    pub(super) fn commit_later(
        &mut self,
        id: MessageId,
        settled: u64,
        request: Bytes,
        result: Result<Bytes, DeliveryError>,
        state: Option<Bytes>,
        now: Instant,
    ) {
        let RoleState::Primary(primary) = &mut self.role else { return };
        let epoch = primary.epoch;
        if self.config.kind != StandbyKind::Cold {
            self.log.position = Position { epoch, number: self.log.position.number + 1 };
        }
        let position = self.log.position;
        primary.held_replies.push_back((position, id, now));
        let followers = primary.standbys.iter().filter(|(_, follower)| {
            matches!(follower.catch_up, CatchUp::SnapshotSent(_) | CatchUp::InStep)
        });
        let recipients: Vec<_> = followers.map(|(node, _)| node.clone()).collect();
        let failed = result.is_err();
        let served = Served { id, result: result.map(Vec::from) };
        self.log.table.settle(id.sender, settled);
        self.log.table.note(served.clone());
        if self.config.kind != StandbyKind::Cold {
            let payload = match (self.config.kind, state) {
                (StandbyKind::Warm, Some(state)) => {
                    let change = Change::between(&self.log.state, &state);
                    self.log.state = state;
                    EntryPayload::State(change)
                }
                (StandbyKind::Hot, _) if !failed => EntryPayload::Request(request.into()),
                _ => EntryPayload::Failed,
            };
            let entry = LogEntry { epoch, position, served, settled, payload };
            let entry = Message::Entry(entry);
            recipients.iter().for_each(|node| self.send(node, &entry));
        }
        self.release(now);
    }

    /// Sends the replies that all standbys in step, and a majority, have; or all replies while too
    /// few standbys can be in step.
    pub(super) fn release(&mut self, now: Instant) {
        self.mark_silent_followers(now);
        let under_replicated = self.check_replication(now);
        let config = &self.config;
        let RoleState::Primary(primary) = &mut self.role else { return };
        if !primary.has_lease(config, now) {
            return;
        }
        let mut answers = Vec::new();
        while let Some((position, id, _)) = primary.held_replies.front().copied() {
            if config.kind != StandbyKind::Cold {
                let followers = primary.standbys.values();
                let in_step = followers.filter(|follower| follower.catch_up == CatchUp::InStep);
                let knows = |follower: &&Follower| follower.position >= position;
                let all = in_step.clone().all(|follower| knows(&follower));
                let known = in_step.filter(knows).count();
                let enough = under_replicated
                    || config.on_partition == OnPartition::Continue
                    || known + 1 >= config.majority();
                if !all || !enough {
                    break;
                }
            }
            primary.held_replies.pop_front();
            primary.released = primary.released.max(position);
            self.log.answered = self.log.answered.max(position);
            answers.extend(primary.waiting.remove(&id).map(|caller| (caller, id)));
        }
        for (caller, id) in answers {
            let outcome = match self.log.table.find(id) {
                Some(served) => ServiceOutcome::Served(served.result.clone()),
                // The caller has abandoned the request.
                None => ServiceOutcome::Refused(DeliveryError::Expired),
            };
            self.answer(caller, outcome);
        }
    }

    /// Removes followers that have been silent for a lease from those in step. Replies do not wait
    /// for them.
    fn mark_silent_followers(&mut self, now: Instant) {
        let RoleState::Primary(primary) = &mut self.role else { return };
        for follower in primary.standbys.values_mut() {
            if !follower.is_live(&self.config, now) {
                follower.catch_up = CatchUp::Behind;
            }
        }
    }

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
            Some(detail) if self.reports.faults.get(&kind) != Some(&detail) => {
                self.reports.faults.insert(kind.clone(), detail.clone());
                self.reports.outputs.push_back(ReplicaOutput::Fault { kind, detail });
            }
            None if self.reports.faults.remove(&kind).is_some() => {
                self.reports.outputs.push_back(ReplicaOutput::FaultCleared { kind });
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
        let lost = self.config.kind != StandbyKind::Cold && self.log.position < self.log.answered;
        if lost {
            self.report_loss(self.log.position, self.log.answered);
            self.log.position = Position { epoch, number: 0 };
            self.log.answered = self.log.position;
        }
        lost
    }

    /// Does so in the middle of an epoch, for the only member of a service.
    pub(super) fn restart_without_lost_state(&mut self, epoch: u64) {
        self.log.position = Position::default();
        self.start_without_lost_state(epoch);
        if let RoleState::Primary(primary) = &mut self.role {
            (primary.base, primary.released) = (self.log.position, self.log.position);
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
            && !self.reports.faults.contains_key(&FaultKind::StateLost)
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

    /// Returns the position that a candidate needs for this replica's vote: while a node that has
    /// the state may return, the greatest one that is known.
    pub(super) fn required_position(&self, now: Instant) -> Position {
        let waits =
            self.waiting_since().is_some_and(|since| now < since + self.config.state_timeout());
        if waits { self.log.position.max(self.log.answered) } else { self.log.position }
    }

    /// Returns since when this replica waits for a node that has the state that it lacks.
    pub(super) fn waiting_since(&self) -> Option<Instant> {
        // With `Continue`, no part waits for another one.
        let lacks = self.comparable_by_position() && self.log.position < self.log.answered;
        (lacks || self.component.health != Health::Complete).then_some(self.primary_seen_at)
    }
}
