//! What a replica does while it serves.

use super::*;

/// Hellos whose promises may still come.
const HELLOS_KEPT: usize = 16;

/// A replica that serves.
#[derive(Debug)]
pub(super) struct Primary {
    pub(super) epoch: u64,
    pub(super) hello_at: Instant,
    number: u64,
    /// When which hello was said.
    said: VecDeque<(u64, Instant)>,
    pub(super) standbys: SortedMap<NodeName, Follower>,
    /// Who waits for which request, and where it stands.
    pub(super) waiting: SortedMap<MessageId, u64>,
    /// Replies that are held back, in order.
    held: VecDeque<(Position, MessageId, Instant)>,
    began: Instant,
    /// How far everything was answered.
    pub(super) released: Position,
    /// With what it began.
    pub(super) base: Position,
    /// Since when too few others hold what this one holds.
    pub(super) alone_since: Option<Instant>,
}

/// What the primary knows of a standby.
#[derive(Clone, Copy, Debug)]
pub(super) struct Follower {
    /// When the newest hello was said that it has promised after.
    pub(super) promised: Instant,
    pub(super) step: Step,
    position: Position,
    /// It was told another list: it follows, and its promise counts for nothing.
    pub(super) learns: bool,
}

/// Whether a standby has what the primary has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// It needs a snapshot.
    Behind,
    /// One was sent then, and everything since.
    Sent(Instant),
    /// It has it, and gets everything since.
    Abreast,
    /// It can take nothing.
    Unable,
}

impl Follower {
    /// One that has nothing yet.
    fn behind(promised: Instant, learns: bool) -> Self {
        Follower { promised, step: Step::Behind, position: Position::default(), learns }
    }
}

impl Primary {
    fn new(epoch: u64, released: Position, now: Instant) -> Self {
        Primary {
            epoch,
            hello_at: now,
            number: 0,
            said: VecDeque::new(),
            standbys: SortedMap::new(),
            waiting: SortedMap::new(),
            held: VecDeque::new(),
            began: now,
            released,
            base: released,
            alone_since: None,
        }
    }

    /// Until when a majority has promised to vote for nobody else.
    fn lease_until(&self, config: &ReplicaConfig) -> Option<Instant> {
        let needed = config.majority() - 1;
        if needed == 0 || config.on_partition == OnPartition::Continue {
            return None;
        }
        let voters = self.standbys.values().filter(|follower| !follower.learns);
        let promised = voters.map(|follower| follower.promised);
        // Those who voted have promised so, since before we began.
        let mut promised: Vec<_> =
            promised.chain(std::iter::repeat_n(self.began, needed)).collect();
        promised.sort_unstable_by(|a, b| b.cmp(a));
        promised.get(needed - 1).map(|at| *at + config.lease())
    }

    pub(super) fn holds(&self, config: &ReplicaConfig, accord: &Accord, now: Instant) -> bool {
        let supports = |node: &NodeName| {
            let follower = self.standbys.get(node);
            *node == config.own
                || follower
                    .is_some_and(|known| !known.learns && now < known.promised + config.lease())
        };
        self.lease_until(config).is_none_or(|until| now < until)
            && (accord.is_undisputed() || accord.allows(supports, now))
    }

    pub(super) fn due(&self, config: &ReplicaConfig, accord: &Accord) -> Instant {
        let until =
            self.lease_until(config).map_or(self.hello_at, |until| until.min(self.hello_at));
        if accord.is_undisputed() {
            return until;
        }
        // Each single promise may be needed.
        let last_hello = self.said.back().map_or(self.began, |(_, at)| *at);
        let ends = self.standbys.values().map(|known| known.promised + config.lease());
        ends.filter(|end| *end > last_hello).fold(until, Instant::min)
    }

    pub(super) fn callers(self) -> impl Iterator<Item = u64> {
        self.waiting.into_values()
    }
}

impl Replica {
    /// A majority wants this replica to serve; it was asked at `asked`. Whoever voted may have what
    /// it has.
    pub(super) fn take_over(
        &mut self,
        epoch: u64,
        asked: Instant,
        voters: impl IntoIterator<Item = (NodeName, bool)>,
        now: Instant,
    ) {
        let lost = self.begin_without(epoch);
        let mut primary = Primary::new(epoch, self.position, asked);
        let (position, learned) = (self.position, self.learned);
        primary.standbys.extend(voters.into_iter().map(|(node, in_step)| {
            let mut follower = Follower::behind(asked, false);
            if in_step && !lost && !learned {
                (follower.step, follower.position) = (Step::Abreast, position);
            }
            (node, follower)
        }));
        self.role = Acting::Primary(primary);
        self.see(epoch);
        self.tell_role();
        match self.config.kind {
            StandbyKind::Cold => {
                self.table.clear();
                self.jobs.push_back(Job::Load { state: self.initial.clone() });
            }
            StandbyKind::Warm => {
                let state = self.last_state();
                self.jobs.push_back(Job::Load { state });
            }
            StandbyKind::Hot => {
                // It has executed everything already, or is about to; or else nobody has.
                if let Health::Bare { .. } = self.health {
                    self.jobs.push_back(Job::Load { state: self.initial.clone() });
                }
            }
        }
        self.health = Health::Whole;
        self.work();
        self.say_hello(now);
    }

    pub(super) fn say_hello(&mut self, now: Instant) {
        let Acting::Primary(primary) = &mut self.role else { return };
        primary.number += 1;
        primary.hello_at = now + self.config.hello_interval;
        primary.said.push_back((primary.number, now));
        if primary.said.len() > HELLOS_KEPT {
            primary.said.pop_front();
        }
        let (epoch, number, position) = (primary.epoch, primary.number, self.position);
        let answered = self.answered;
        let heard = self.accord.reckons_with(now);
        let hello = Message::Hello { epoch, number, position, answered, heard };
        self.tell_others(&hello);
    }

    pub(super) fn hear_promise(
        &mut self,
        (from, learns): (&NodeName, bool),
        epoch: u64,
        number: u64,
        (position, standing): (Position, Standing),
        now: Instant,
    ) {
        let lease = self.config.lease();
        let comparable = self.tells_by_position() && !learns && !self.learned;
        let nothing_missing = comparable && position == self.position;
        let Acting::Primary(primary) = &mut self.role else { return };
        if epoch != primary.epoch {
            return;
        }
        let said = primary.said.iter().find(|(said, _)| *said == number).map(|(_, at)| *at);
        // In a life that was told otherwise it has forgotten all.
        if primary.standbys.get(from).is_some_and(|known| known.learns != learns) {
            primary.standbys.remove(from);
        }
        // Somebody without a promise is no follower yet.
        let Some(promised) = said.or(primary.standbys.get(from).map(|known| known.promised)) else {
            return;
        };
        let fresh = Follower::behind(promised, learns);
        let follower = primary.standbys.entry(from.clone()).or_insert(fresh);
        follower.promised = follower.promised.max(promised);
        follower.step = match (follower.step, standing) {
            (_, Standing::Unable) => Step::Unable,
            (Step::Behind | Step::Unable, Standing::InStep) if nothing_missing => {
                follower.position = position;
                Step::Abreast
            }
            // While it was behind, entries were not sent to it.
            (Step::Behind | Step::Unable, _) => Step::Behind,
            (Step::Sent(_) | Step::Abreast, Standing::Coming) => Step::Sent(now),
            (Step::Sent(at), Standing::Behind) if now - at > lease => Step::Behind,
            (Step::Sent(at), Standing::Behind) => Step::Sent(at),
            // It has begun anew: what it once confirmed, it has forgotten.
            (Step::Abreast, Standing::Behind) => Step::Behind,
            (Step::Sent(_) | Step::Abreast, Standing::InStep) => {
                follower.position = follower.position.max(position);
                Step::Abreast
            }
        };
        // An entry went astray with its session.
        let waits = |(needed, _, at): &(Position, MessageId, Instant)| {
            follower.position < *needed && now - *at > lease
        };
        if follower.step == Step::Abreast && primary.held.front().is_some_and(waits) {
            follower.step = Step::Behind;
        }
        if follower.step == Step::Behind && self.config.kind != StandbyKind::Cold {
            let mut jobs = self.jobs.iter().chain(&self.working);
            if !jobs.any(|job| matches!(job, Job::Save)) {
                self.jobs.push_back(Job::Save);
            }
        }
        self.work();
        self.release(now);
    }

    /// The component's state as it is now, for everybody who is behind.
    pub(super) fn send_snapshots(&mut self, state: &Bytes, now: Instant) {
        let Acting::Primary(primary) = &mut self.role else { return };
        let (epoch, position) = (primary.epoch, self.position);
        let mut late = Vec::new();
        for (node, follower) in &mut primary.standbys {
            if follower.step == Step::Behind {
                // What comes after reaches it after: sessions keep the order.
                follower.step = Step::Sent(now);
                follower.position = Position::default();
                late.push(node.clone());
            }
        }
        // What comes after is told as changes of the last state that was kept.
        let kept = self.state.as_ref().filter(|_| self.config.kind == StandbyKind::Warm);
        let (state, table) = (kept.unwrap_or(state).to_vec(), self.table.clone());
        let snapshot = Message::Snapshot { epoch, position, state, table };
        late.iter().for_each(|node| self.send(node, &snapshot));
    }

    /// A request has been executed: whoever is in step has to know before its caller does.
    pub(super) fn commit_later(
        &mut self,
        (id, settled): (MessageId, u64),
        request: Bytes,
        result: Result<Bytes, DeliveryError>,
        state: Option<Bytes>,
        now: Instant,
    ) {
        let Acting::Primary(primary) = &mut self.role else { return };
        let epoch = primary.epoch;
        if self.config.kind != StandbyKind::Cold {
            self.position = Position { epoch, number: self.position.number + 1 };
            self.learned = false;
        }
        let position = self.position;
        primary.held.push_back((position, id, now));
        let follows = |step: Step| matches!(step, Step::Sent(_) | Step::Abreast);
        let told = primary.standbys.iter().filter(|(_, follower)| follows(follower.step));
        let told: Vec<_> = told.map(|(node, _)| node.clone()).collect();
        let died = result.is_err();
        let served = Served { id, result: result.map(Vec::from) };
        self.table.settle(id.sender, settled);
        self.table.note(served.clone());
        if self.config.kind != StandbyKind::Cold {
            let after = match (self.config.kind, state) {
                (StandbyKind::Warm, Some(state)) => {
                    let change = Change::between(self.state.as_deref(), &state);
                    self.state = Some(state);
                    After::State(change)
                }
                _ if died => After::Failed,
                (StandbyKind::Warm, None) => After::Failed,
                _ => After::Request(request.into()),
            };
            let entry = Message::Entry { epoch, position, served, settled, after };
            told.iter().for_each(|node| self.send(node, &entry));
        }
        self.release(now);
    }

    /// Lets go of the replies that every standby in step, and a majority, knows of; or all that
    /// can.
    pub(super) fn release(&mut self, now: Instant) {
        self.expect_no_silent(now);
        let exposed = self.judge_exposure(now);
        let config = &self.config;
        let Acting::Primary(primary) = &mut self.role else { return };
        if !primary.holds(config, &self.accord, now) {
            return;
        }
        let mut answers = Vec::new();
        while let Some((position, id, _)) = primary.held.front().copied() {
            if config.kind != StandbyKind::Cold {
                let followers = primary.standbys.values();
                let in_step = followers.filter(|follower| follower.step == Step::Abreast);
                let knows = |follower: &&Follower| follower.position >= position;
                let all = in_step.clone().all(|follower| knows(&follower));
                let known = in_step.filter(|follower| !follower.learns).filter(knows).count();
                let enough = exposed
                    || config.on_partition == OnPartition::Continue
                    || known + 1 >= config.majority();
                if !all || !enough {
                    break;
                }
            }
            primary.held.pop_front();
            primary.released = position;
            self.answered = self.answered.max(position);
            answers.extend(primary.waiting.remove(&id).map(|caller| (caller, id)));
        }
        for (caller, id) in answers {
            let outcome = match self.table.find(id) {
                Some(served) => ServiceOutcome::Served(served.result.clone().map(Bytes::from)),
                // Its caller has given it up meanwhile.
                None => ServiceOutcome::Refused(DeliveryError::Expired),
            };
            self.answer(caller, outcome);
        }
    }
    /// Whoever has been silent for a lease keeps nobody waiting, and has to come into step anew.
    fn expect_no_silent(&mut self, now: Instant) {
        let Acting::Primary(primary) = &mut self.role else { return };
        for follower in primary.standbys.values_mut() {
            if !follower.is_heard(&self.config, now) {
                follower.step = Step::Behind;
            }
        }
    }
}
