//! A robot of replicas over a network that delays, is cut, and whose nodes die and return: one
//! seed, one run. Each component counts: a request adds one, the reply is the sum.

mod agreement;
mod component;
mod election;
mod lists;
mod outage;
mod requests;
mod single;
mod under_replication;

use super::*;
use crate::random::Random;
use std::collections::BTreeSet;
use std::time::Duration;

const HEARTBEAT: Duration = Duration::from_millis(10);
/// The resolution of the simulation: all events happen at multiples of this.
const STEP: Duration = Duration::from_micros(100);

fn node(index: usize) -> NodeName {
    NodeName::new(&format!("module{index}")).unwrap()
}

fn index(node: &NodeName) -> usize {
    node.as_str()["module".len()..].parse().unwrap()
}

/// Returns the first step that is not before this time.
fn on_step(at: Instant) -> Instant {
    let step = u64::try_from(STEP.as_nanos()).unwrap();
    Instant::from_nanos(at.as_nanos().div_ceil(step) * step)
}

/// What a clock shows that runs faster by so many thousandths.
fn clock(now: Instant, drift: u64) -> Instant {
    Instant::from_nanos(now.as_nanos() / 1000 * (1000 + drift))
}

fn request(caller: u64, id: MessageId) -> ServiceRequest {
    ServiceRequest { caller, id, settled: 0, until: None, request: Bytes::from_static(b"+") }
}

fn is_snapshot(message: &[u8]) -> bool {
    let read = codec::decode_bounded::<Message, MESSAGE_MAX>(&message[..message.len() - 8]);
    matches!(read, Ok(Message::Snapshot { .. }))
}

/// A replica and its component, as the actor drives them: each job takes a moment.
struct Member {
    replica: Replica,
    sum: u64,
    /// The current job, and when it is done.
    busy: Option<(Instant, ReplicaOutput)>,
    /// It waits for the services that it depends on.
    inquires: bool,
    /// How much faster this node's clock runs, in thousandths.
    drift: u64,
}

/// A caller that repeats its request until it has an answer.
struct Caller {
    id: MessageId,
    again: Instant,
    answer: Option<u64>,
    asked: Instant,
    answered: Option<Instant>,
}

struct Robot {
    now: Instant,
    random: Random,
    kind: StandbyKind,
    on_partition: OnPartition,
    size: usize,
    members: Vec<Option<Member>>,
    /// On which side of a cut each node is.
    sides: Vec<u8>,
    /// Processes that are stopped, and the messages that wait for them.
    stopped: Vec<bool>,
    stalled: Vec<(usize, usize, Bytes)>,
    wire: SortedMap<(Instant, u64), (usize, usize, Bytes)>,
    /// Messages that wait for the end of a cut, as sessions keep them; `None` if they are lost.
    dammed: Option<Vec<(usize, usize, Bytes)>>,
    /// Sessions keep the order.
    last: SortedMap<(usize, usize), Instant>,
    count: u64,
    callers: Vec<Caller>,
    /// The primary of each epoch.
    epochs: SortedMap<u64, usize>,
    overlaps: u64,
    /// When the services have primaries that this one depends on, if it does.
    served_ms: Option<u64>,
    /// The configuration of each member, where they are not all equal.
    configurations: SortedMap<usize, ReplicaConfig>,
    /// The declared faults of each member.
    faults: SortedMap<(usize, FaultKind), String>,
    /// How often a member declared that state was lost.
    losses: u64,
    /// How many snapshots were sent, and the member that receives none.
    snapshots: u64,
    withheld: Option<usize>,
    /// The member whose component cannot load a state.
    unloadable: Option<usize>,
}

impl Robot {
    fn new(seed: u64, size: usize, kind: StandbyKind, on_partition: OnPartition) -> Self {
        let mut robot = Robot {
            now: Instant::from_millis(1_000_000),
            random: Random::new(seed),
            kind,
            on_partition,
            size,
            members: (0..size).map(|_| None).collect(),
            sides: vec![0; size],
            stopped: vec![false; size],
            stalled: Vec::new(),
            wire: SortedMap::new(),
            dammed: (!seed.is_multiple_of(3)).then(Vec::new),
            last: SortedMap::new(),
            count: 0,
            callers: Vec::new(),
            epochs: SortedMap::new(),
            overlaps: 0,
            served_ms: None,
            configurations: SortedMap::new(),
            faults: SortedMap::new(),
            losses: 0,
            snapshots: 0,
            withheld: None,
            unloadable: None,
        };
        (0..size).for_each(|member| robot.start(member));
        if size == 1 || on_partition == OnPartition::Continue {
            // Members that need no vote begin after the second poll.
            (0..2).for_each(|_| robot.poll_directories(0));
        }
        robot
    }

    /// A service that stops on a partition, and has its first primary.
    fn elected(seed: u64, size: usize, kind: StandbyKind) -> Self {
        let mut robot = Robot::new(seed, size, kind, OnPartition::Stop);
        robot.advance_ms(100);
        robot
    }

    fn config(&self, member: usize) -> ReplicaConfig {
        ReplicaConfig {
            own: node(member),
            members: (0..self.size).map(node).collect(),
            kind: self.kind,
            on_partition: self.on_partition,
            depends: self.served_ms.is_some(),
            heartbeat_interval: HEARTBEAT,
        }
    }

    fn start(&mut self, member: usize) {
        let config =
            self.configurations.get(&member).cloned().unwrap_or_else(|| self.config(member));
        // A twentieth at most: half of the margin on either side.
        let drift = (self.random.unit() * 45.0) as u64;
        let initial = Bytes::copy_from_slice(&0u64.to_le_bytes());
        let now = self.clock(drift);
        let replica = Replica::new(config, initial, now);
        self.members[member] = Some(Member { replica, sum: 0, busy: None, inquires: false, drift });
    }

    fn clock(&self, drift: u64) -> Instant {
        clock(self.now, drift)
    }

    fn kill(&mut self, member: usize) {
        self.members[member] = None;
        self.wire.retain(|_, (from, to, _)| *from != member && *to != member);
        if let Some(dammed) = &mut self.dammed {
            dammed.retain(|(from, to, _)| *from != member && *to != member);
        }
    }

    fn primaries(&self) -> Vec<usize> {
        let serves = |member: &Option<Member>| {
            let member = member.as_ref()?;
            let now = self.clock(member.drift);
            match &member.replica.role {
                RoleState::Primary(primary) => {
                    primary.has_lease(&member.replica.config, now).then_some(())
                }
                RoleState::Standby(_) => None,
            }
        };
        (0..self.size).filter(|member| serves(&self.members[*member]).is_some()).collect()
    }

    fn drain(&mut self, member: usize) {
        loop {
            let Some(own) = self.members[member].as_mut() else { return };
            let Some(output) = own.replica.poll_output() else { return };
            match output {
                ReplicaOutput::Send { to, message } => self.carry(member, index(&to), message),
                ReplicaOutput::RoleChanged(Role::Primary { epoch }) => {
                    let before = self.epochs.insert(epoch, member);
                    if self.on_partition == OnPartition::Stop && self.configurations.is_empty() {
                        assert!(before.is_none(), "two primaries under epoch {epoch}");
                    }
                }
                ReplicaOutput::RoleChanged(Role::Standby { .. }) => {}
                ReplicaOutput::CheckDependencies => own.inquires = true,
                ReplicaOutput::Compare { with } => self.compare(member, index(&with)),
                ReplicaOutput::Fault { kind, detail } => {
                    self.losses += u64::from(kind == FaultKind::StateLost);
                    self.faults.insert((member, kind), detail);
                }
                ReplicaOutput::FaultCleared { kind } => drop(self.faults.remove(&(member, kind))),
                ReplicaOutput::Answer { caller, outcome } => {
                    let caller = &mut self.callers[caller as usize];
                    if let ServiceOutcome::Refused(why) = outcome {
                        assert!(matches!(why, DeliveryError::ContractDiffers { .. }), "{why}");
                    } else if let ServiceOutcome::Served(result) = outcome {
                        let bytes = result.expect("counting does not fail");
                        let sum = u64::from_le_bytes(bytes[..].try_into().unwrap());
                        assert!(caller.answer.is_none_or(|before| before == sum));
                        caller.answer = Some(sum);
                        caller.answered.get_or_insert(self.now);
                    }
                }
                job => own.busy = Some((self.now + Duration::from_micros(300), job)),
            }
        }
    }

    fn carry(&mut self, from: usize, to: usize, message: Bytes) {
        if self.members.get(to).is_none_or(Option::is_none) {
            return;
        }
        if is_snapshot(&message) {
            self.snapshots += 1;
            if self.withheld == Some(to) {
                return;
            }
        }
        if self.sides[from] != self.sides[to] {
            if let Some(dammed) = &mut self.dammed {
                dammed.push((from, to, message));
            }
            return;
        }
        let delay = Duration::from_micros(200 + (self.random.unit() * 1500.0) as u64);
        let at = (self.now + delay).max(self.last.get(&(from, to)).copied().unwrap_or_default());
        self.last.insert((from, to), at);
        self.count += 1;
        self.wire.insert((at, self.count), (from, to, message));
    }

    fn do_job(&mut self, member: usize) {
        let Some(own) = self.members[member].as_mut() else { return };
        let drift = own.drift;
        if own.busy.as_ref().is_none_or(|(at, _)| *at > self.now) {
            return;
        }
        let now = clock(self.now, drift);
        let state = |sum: u64| Bytes::copy_from_slice(&sum.to_le_bytes());
        match own.busy.take().unwrap().1 {
            ReplicaOutput::Execute { save, .. } => {
                own.sum += 1;
                let saved = save.then(|| Ok(state(own.sum)));
                own.replica.handle_executed(Ok(state(own.sum)), saved, now);
            }
            ReplicaOutput::Save => own.replica.handle_saved(Ok(state(own.sum)), now),
            ReplicaOutput::Load { .. } if self.unloadable == Some(member) => {
                own.sum = 0;
                own.replica.handle_not_loaded(now);
            }
            ReplicaOutput::Load { state } => {
                own.sum = u64::from_le_bytes(state[..].try_into().unwrap());
                own.replica.handle_loaded();
            }
            other => panic!("no job: {other:?}"),
        }
        self.drain(member);
    }

    fn ask(&mut self) -> usize {
        let id = MessageId { sender: 1, sequence: self.callers.len() as u64 };
        let (again, asked) = (self.now, self.now);
        self.callers.push(Caller { id, again, answer: None, asked, answered: None });
        self.callers.len() - 1
    }

    /// Callers ask all members, which is more than real ones do.
    fn repeat(&mut self) {
        for caller in 0..self.callers.len() {
            if self.callers[caller].answer.is_some() || self.callers[caller].again > self.now {
                continue;
            }
            self.callers[caller].again = self.now + Duration::from_millis(5);
            let id = self.callers[caller].id;
            // All requests before the first one that waits have their answers.
            let waits = |caller: &Caller| caller.answer.is_none();
            let settled = self.callers.iter().position(waits).unwrap_or(self.callers.len()) as u64;
            for member in 0..self.size {
                let Some(own) = self.members[member].as_mut() else { continue };
                if self.stopped[member] {
                    continue;
                }
                let now = clock(self.now, own.drift);
                let asked = ServiceRequest { settled, ..request(caller as u64, id) };
                own.replica.handle_request(asked, now);
                self.drain(member);
            }
        }
    }

    /// Advances in steps of a tenth of a millisecond, without those in which nothing happens.
    fn advance(&mut self, span: Duration) {
        let end = self.now + span;
        // The sides of a cut change between two calls only.
        for (from, to, message) in self.dammed.as_mut().map(std::mem::take).unwrap_or_default() {
            self.carry(from, to, message);
        }
        while self.now < end {
            let next = self.next_event().map_or(end, |event| event.min(end));
            self.now = on_step(next.max(self.now + STEP));
            while let Some((_, (from, to, message))) =
                self.wire.pop_first_if(|(due, _)| *due <= self.now)
            {
                if self.stopped[to] {
                    self.stalled.push((from, to, message));
                    continue;
                }
                if let Some(own) = self.members[to].as_mut() {
                    let now = clock(self.now, own.drift);
                    own.replica.handle_message(&node(from), &message, now);
                    self.drain(to);
                }
            }
            for member in (0..self.size).filter(|member| !self.stopped[*member]).collect::<Vec<_>>()
            {
                self.do_job(member);
                if let Some(own) = self.members[member].as_mut() {
                    let now = clock(self.now, own.drift);
                    own.replica.handle_timeout(now);
                    let served =
                        self.served_ms.is_some_and(|at| Instant::from_millis(at) <= self.now);
                    if served && std::mem::take(&mut own.inquires) {
                        own.replica.handle_ready(now);
                    }
                    self.drain(member);
                }
            }
            self.repeat();
            self.overlaps += u64::from(self.primaries().len() > 1);
        }
    }

    /// Returns the time of the next event.
    fn next_event(&self) -> Option<Instant> {
        let wire = self.wire.keys().map(|(at, _)| *at).next();
        let waiting = self.callers.iter().filter(|caller| caller.answer.is_none());
        let asking = waiting.map(|caller| caller.again).min();
        let running = self.members.iter().zip(&self.stopped).filter(|(_, stopped)| !**stopped);
        let members = running.filter_map(|(member, _)| {
            let member = member.as_ref()?;
            let timeout = member.replica.poll_timeout().map(|due| {
                // The first time at which this node's clock has reached that.
                Instant::from_nanos(due.as_nanos().div_ceil(1000 + member.drift) * 1000)
            });
            let done = member.busy.as_ref().map(|(at, _)| *at);
            let served = self.served_ms.filter(|_| member.inquires).map(Instant::from_millis);
            [timeout, done, served].into_iter().flatten().min()
        });
        members.chain(wire).chain(asking).min()
    }

    fn advance_ms(&mut self, millis: u64) {
        self.advance(Duration::from_millis(millis));
    }

    /// Returns how long the caller waited.
    fn waited(&self, caller: usize) -> Duration {
        let caller = &self.callers[caller];
        caller.answered.expect("it was answered") - caller.asked
    }

    fn answers(&self) -> Vec<Option<u64>> {
        self.callers.iter().map(|caller| caller.answer).collect()
    }
}
