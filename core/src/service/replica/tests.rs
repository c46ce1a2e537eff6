//! A robot of replicas over a network that delays, is cut, and whose nodes die and return: one seed,
//! one run. Each component counts: a request adds one, the reply is the sum.

mod accord;
mod component;
mod exposure;
mod lists;
mod rivals;

use super::*;
use crate::random::Random;
use std::collections::BTreeSet;
use std::time::Duration;

const HELLO: Duration = Duration::from_millis(10);

fn node(index: usize) -> NodeName {
    NodeName::new(&format!("module{index}")).unwrap()
}

fn index(node: &NodeName) -> usize {
    node.as_str()["module".len()..].parse().unwrap()
}

fn request(caller: u64, id: MessageId) -> ServiceRequest {
    ServiceRequest { caller, id, settled: 0, until: None, request: Bytes::from_static(b"+") }
}

fn is_snapshot(message: &[u8]) -> bool {
    let read = codec::decode_bounded::<Message, MESSAGE_MAX>(&message[..message.len() - 8]);
    matches!(read, Ok(Message::Snapshot { .. }))
}

/// A component, as its body would drive it: each job takes a moment.
struct Member {
    replica: Replica,
    sum: u64,
    /// When the job at hand is done, and which it is.
    busy: Option<(Instant, ReplicaOutput)>,
    /// It wants to know whether others are there.
    inquires: bool,
    /// This node's clock runs so much faster, in thousandths.
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
    /// Processes that get no time, and what waits for them.
    stopped: Vec<bool>,
    stalled: Vec<(usize, usize, Bytes)>,
    wire: BTreeMap<(Instant, u64), (usize, usize, Bytes)>,
    /// Messages that wait for a cut to be mended, as sessions keep them; `None` where they are lost.
    dammed: Option<Vec<(usize, usize, Bytes)>>,
    /// Sessions keep the order.
    last: BTreeMap<(usize, usize), Instant>,
    count: u64,
    callers: Vec<Caller>,
    /// Under which epochs somebody served.
    epochs: BTreeMap<u64, usize>,
    overlaps: u64,
    /// From when on the services are there that this one depends on, if it does.
    served_ms: Option<u64>,
    /// What each member was told, where that is not the same for all.
    told: BTreeMap<usize, ReplicaConfig>,
    /// What members have said about each other's terms.
    disputes: BTreeMap<usize, String>,
    /// What is wrong of the service, on which member.
    faults: BTreeMap<(usize, FaultKind), String>,
    /// How often it was said that state was lost.
    losses: u64,
    /// How many states were sent, and who is sent none.
    snapshots: u64,
    withheld: Option<usize>,
    /// Whose component takes no state over.
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
            wire: BTreeMap::new(),
            dammed: (!seed.is_multiple_of(3)).then(Vec::new),
            last: BTreeMap::new(),
            count: 0,
            callers: Vec::new(),
            epochs: BTreeMap::new(),
            overlaps: 0,
            served_ms: None,
            told: BTreeMap::new(),
            disputes: BTreeMap::new(),
            faults: BTreeMap::new(),
            losses: 0,
            snapshots: 0,
            withheld: None,
            unloadable: None,
        };
        (0..size).for_each(|member| robot.start(member));
        robot
    }

    fn config(&self, member: usize) -> ReplicaConfig {
        ReplicaConfig {
            own: node(member),
            members: (0..self.size).map(node).collect(),
            kind: self.kind,
            on_partition: self.on_partition,
            depends: self.served_ms.is_some(),
            hello_interval: HELLO,
        }
    }

    fn start(&mut self, member: usize) {
        let config = self.told.get(&member).cloned().unwrap_or_else(|| self.config(member));
        // A twentieth at most: half of the margin on either side.
        let drift = (self.random.unit() * 45.0) as u64;
        let initial = Bytes::copy_from_slice(&0u64.to_le_bytes());
        let now = self.clock(drift);
        let replica = Replica::new(config, initial, now);
        self.members[member] = Some(Member { replica, sum: 0, busy: None, inquires: false, drift });
    }

    fn clock(&self, drift: u64) -> Instant {
        Instant::from_nanos(self.now.as_nanos() / 1000 * (1000 + drift))
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
                Acting::Primary(primary) => {
                    primary.holds(&member.replica.config, &member.replica.accord, now).then_some(())
                }
                Acting::Standby(_) => None,
            }
        };
        (0..self.size).filter(|member| serves(&self.members[*member]).is_some()).collect()
    }

    fn settle(&mut self, member: usize) {
        loop {
            let Some(own) = self.members[member].as_mut() else { return };
            let Some(output) = own.replica.poll_output() else { return };
            match output {
                ReplicaOutput::Send { to, message } => self.carry(member, index(&to), message),
                ReplicaOutput::Became(Role::Primary { epoch }) => {
                    let before = self.epochs.insert(epoch, member);
                    if self.on_partition == OnPartition::Stop && self.told.is_empty() {
                        assert!(before.is_none(), "two primaries under epoch {epoch}");
                    }
                }
                ReplicaOutput::Became(Role::Standby { .. }) => {}
                ReplicaOutput::Inquire => own.inquires = true,
                ReplicaOutput::Compare { with } => self.compare(member, index(&with)),
                ReplicaOutput::Disputed { detail } => drop(self.disputes.insert(member, detail)),
                ReplicaOutput::Agreed => drop(self.disputes.remove(&member)),
                ReplicaOutput::Fault { kind, detail } => {
                    self.losses += u64::from(kind == FaultKind::StateLost);
                    self.faults.insert((member, kind), detail);
                }
                ReplicaOutput::Mended { kind } => drop(self.faults.remove(&(member, kind))),
                ReplicaOutput::Answer { caller, outcome } => {
                    let caller = &mut self.callers[caller as usize];
                    if let ServiceOutcome::Refused(why) = outcome {
                        assert!(matches!(why, Why::ContractDiffers { .. }), "{why}");
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
        let now = Instant::from_nanos(self.now.as_nanos() / 1000 * (1000 + drift));
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
        self.settle(member);
    }

    fn ask(&mut self) -> usize {
        let id = MessageId { sender: 1, sequence: self.callers.len() as u64 };
        let (again, asked) = (self.now, self.now);
        self.callers.push(Caller { id, again, answer: None, asked, answered: None });
        self.callers.len() - 1
    }

    /// Callers ask everybody, which is more than real ones do.
    fn repeat(&mut self) {
        for caller in 0..self.callers.len() {
            if self.callers[caller].answer.is_some() || self.callers[caller].again > self.now {
                continue;
            }
            self.callers[caller].again = self.now + Duration::from_millis(5);
            let id = self.callers[caller].id;
            // All before the first that waits have their answers.
            let waits = |caller: &Caller| caller.answer.is_none();
            let settled = self.callers.iter().position(waits).unwrap_or(self.callers.len()) as u64;
            for member in 0..self.size {
                let Some(own) = self.members[member].as_mut() else { continue };
                if self.stopped[member] {
                    continue;
                }
                let now = Instant::from_nanos(self.now.as_nanos() / 1000 * (1000 + own.drift));
                let asked = ServiceRequest { settled, ..request(caller as u64, id) };
                own.replica.handle_request(asked, now);
                self.settle(member);
            }
        }
    }

    fn advance(&mut self, span: Duration) {
        let end = self.now + span;
        while self.now < end {
            self.now = self.now + Duration::from_micros(100);
            for (from, to, message) in self.dammed.as_mut().map(std::mem::take).unwrap_or_default()
            {
                self.carry(from, to, message);
            }
            while let Some(entry) = self.wire.first_entry()
                && entry.key().0 <= self.now
            {
                let (from, to, message) = entry.remove();
                if self.stopped[to] {
                    self.stalled.push((from, to, message));
                    continue;
                }
                if let Some(own) = self.members[to].as_mut() {
                    let now = Instant::from_nanos(self.now.as_nanos() / 1000 * (1000 + own.drift));
                    own.replica.handle_message(&node(from), &message, now);
                    self.settle(to);
                }
            }
            for member in (0..self.size).filter(|member| !self.stopped[*member]).collect::<Vec<_>>()
            {
                self.do_job(member);
                if let Some(own) = self.members[member].as_mut() {
                    let now = Instant::from_nanos(self.now.as_nanos() / 1000 * (1000 + own.drift));
                    own.replica.handle_timeout(now);
                    let served =
                        self.served_ms.is_some_and(|at| Instant::from_millis(at) <= self.now);
                    if served && std::mem::take(&mut own.inquires) {
                        own.replica.handle_ready(now);
                    }
                    self.settle(member);
                }
            }
            self.repeat();
            self.overlaps += u64::from(self.primaries().len() > 1);
        }
    }

    fn advance_ms(&mut self, millis: u64) {
        self.advance(Duration::from_millis(millis));
    }

    /// How long the caller waited.
    fn waited(&self, caller: usize) -> Duration {
        let caller = &self.callers[caller];
        caller.answered.expect("it was answered") - caller.asked
    }

    fn answers(&self) -> Vec<Option<u64>> {
        self.callers.iter().map(|caller| caller.answer).collect()
    }
}

#[test]
fn the_first_of_the_members_serves_and_all_others_know_it() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.advance_ms(100);
    assert_eq!(robot.primaries(), [0]);
    for member in 1..3 {
        let role = robot.members[member].as_ref().unwrap().replica.role();
        assert_eq!(role, Role::Standby { primary: Some(node(0)), in_step: true });
    }

    for sum in 1..=20 {
        let caller = robot.ask();
        robot.advance_ms(10);
        assert_eq!(robot.callers[caller].answer, Some(sum));
    }
}

#[test]
fn a_request_in_flight_completes_once_when_the_primary_is_killed() {
    for kind in [StandbyKind::Warm, StandbyKind::Hot] {
        for moment in 0..60 {
            let mut robot = Robot::new(moment, 3, kind, OnPartition::Stop);
            robot.advance_ms(100);
            for _ in 0..5 {
                robot.ask();
                robot.advance_ms(5);
            }
            let caller = robot.ask();
            robot.advance(Duration::from_micros(100 * moment));
            robot.kill(0);
            robot.advance_ms(100);
            robot.ask();
            robot.advance_ms(20);

            let expected: Vec<_> = (1..=7).map(Some).collect();
            assert_eq!(robot.answers(), expected, "{kind:?}, killed {moment} tenths later");
            assert!(robot.waited(caller) < Duration::from_millis(50), "{:?}", robot.waited(caller));
            assert_eq!(robot.overlaps, 0);
        }
    }
}

#[test]
fn whoever_takes_over_answers_after_one_round_trip_where_the_others_have_what_it_has() {
    for kind in [StandbyKind::Warm, StandbyKind::Hot] {
        let mut robot = Robot::new(4, 3, kind, OnPartition::Stop);
        robot.advance_ms(100);
        for _ in 0..5 {
            robot.ask();
            robot.advance_ms(5);
        }
        robot.kill(0);
        while robot.primaries().is_empty() {
            robot.advance(Duration::from_micros(100));
        }
        let caller = robot.ask();
        robot.advance_ms(20);

        // Two ways of at most 1.7 ms, and the component's 0.3 ms, twice for a state to be loaded.
        assert!(robot.waited(caller) <= Duration::from_millis(5), "{:?}", robot.waited(caller));
        let follower = robot.primaries()[0];
        let standby = robot.members[3 - follower].as_ref().unwrap().replica.role();
        assert_eq!(standby, Role::Standby { primary: Some(node(follower)), in_step: true });
    }
}

#[test]
fn nobody_takes_over_before_the_services_that_it_depends_on() {
    let mut robot = Robot::new(2, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.served_ms = Some(robot.now.as_nanos() / 1_000_000 + 150);
    (0..3).for_each(|member| robot.start(member));
    robot.advance_ms(145);
    assert_eq!(robot.primaries(), []);
    robot.advance_ms(30);
    assert_eq!(robot.primaries().len(), 1, "as soon as they are there");

    // They are lost together with the primary, and come back later.
    let first = robot.primaries()[0];
    robot.served_ms = Some(robot.now.as_nanos() / 1_000_000 + 300);
    robot.kill(first);
    robot.advance_ms(295);
    assert_eq!(robot.primaries(), []);
    robot.advance_ms(30);
    assert_eq!(robot.primaries().len(), 1);
    assert_eq!(robot.overlaps, 0);
}

#[test]
fn the_return_of_a_node_does_not_take_the_service_back() {
    for kind in [StandbyKind::Cold, StandbyKind::Warm, StandbyKind::Hot] {
        let mut robot = Robot::new(3, 3, kind, OnPartition::Stop);
        robot.advance_ms(100);
        robot.ask();
        robot.advance_ms(10);
        robot.kill(0);
        robot.advance_ms(100);
        let follower = robot.primaries();
        robot.start(0);
        robot.advance_ms(500);

        assert_eq!(robot.primaries(), follower, "{kind:?}");
        robot.ask();
        robot.advance_ms(10);
        let second = if kind == StandbyKind::Cold { 1 } else { 2 };
        assert_eq!(robot.answers(), [Some(1), Some(second)]);

        // It is in step again: the next one to go leaves everything to it, or to the third.
        robot.kill(follower[0]);
        robot.advance_ms(100);
        robot.ask();
        robot.advance_ms(10);
        let third = if kind == StandbyKind::Cold { 1 } else { 3 };
        assert_eq!(robot.answers()[2], Some(third), "{kind:?}");
    }
}

#[test]
fn a_primary_without_a_majority_stops_before_anybody_follows() {
    for seed in 0..40 {
        let mut robot = Robot::new(seed, 3, StandbyKind::Warm, OnPartition::Stop);
        robot.advance_ms(100 + seed);
        assert_eq!(robot.primaries(), [0]);
        robot.sides = vec![1, 0, 0];
        robot.advance_ms(100);
        let follower = robot.primaries();
        assert!(matches!(follower[..], [1 | 2]), "{seed}: {follower:?}");
        robot.sides = vec![0, 0, 0];
        robot.advance_ms(200);
        assert_eq!(robot.primaries(), follower, "seed {seed}");
        assert_eq!(robot.overlaps, 0, "seed {seed}");
    }
}

#[test]
fn in_two_halves_nobody_serves_or_both_do_as_it_was_said() {
    let mut robot = Robot::new(5, 2, StandbyKind::Warm, OnPartition::Stop);
    robot.advance_ms(200);
    assert_eq!(robot.primaries(), [0]);
    robot.sides = vec![0, 1];
    robot.advance_ms(500);
    assert_eq!(robot.primaries(), []);
    robot.sides = vec![0, 0];
    robot.advance_ms(500);
    assert_eq!(robot.primaries().len(), 1);

    let mut robot = Robot::new(5, 2, StandbyKind::Warm, OnPartition::Continue);
    robot.advance_ms(200);
    let first = robot.primaries();
    assert_eq!(first.len(), 1);
    robot.sides = vec![0, 1];
    robot.advance_ms(500);
    assert_eq!(robot.primaries(), [0, 1]);
    robot.sides = vec![0, 0];
    robot.advance_ms(500);
    assert_eq!(robot.primaries(), [1 - first[0]], "the greater epoch stays");
}

#[test]
fn whatever_is_cut_killed_and_started_again_nothing_is_answered_twice_or_forgotten() {
    for seed in 0_u64..40 {
        let kind = if seed.is_multiple_of(2) { StandbyKind::Warm } else { StandbyKind::Hot };
        let mut robot = Robot::new(seed, 3, kind, OnPartition::Stop);
        let mut chance = Random::new(seed ^ 0xfeed);
        robot.advance_ms(100);
        for _ in 0..25 {
            for _ in 0..3 {
                robot.ask();
                robot.advance_ms((chance.unit() * 6.0) as u64);
            }
            // One failure at a time, and time to come into step again.
            let member = (chance.unit() * 3.0) as usize;
            if chance.chance(0.5) {
                robot.kill(member);
                robot.advance_ms(60 + (chance.unit() * 100.0) as u64);
                robot.start(member);
            } else {
                robot.sides[member] = 1;
                robot.advance_ms((chance.unit() * 120.0) as u64);
                robot.sides[member] = 0;
            }
            robot.advance_ms(250);
        }
        robot.advance_ms(500);

        let answers: Vec<u64> =
            robot.callers.iter().map(|caller| caller.answer.expect("it was answered")).collect();
        let different: BTreeSet<_> = answers.iter().collect();
        assert_eq!(different.len(), answers.len(), "seed {seed}: {answers:?}");
        assert_eq!(answers.iter().max(), Some(&(answers.len() as u64)), "seed {seed}: {answers:?}");
        assert_eq!(robot.overlaps, 0, "seed {seed}");
    }
}

#[test]
fn who_is_no_member_and_what_is_no_message_is_refused() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    let own = robot.members[0].as_mut().unwrap();
    own.replica.handle_message(&NodeName::new("stranger").unwrap(), b"\0\0", robot.now);
    own.replica.handle_message(&node(1), b"\xff\xff\xff", robot.now);
    own.replica.handle_message(&node(0), b"\0\0", robot.now);
    assert_eq!(own.replica.refused(), 3);
}

#[test]
fn a_request_that_comes_again_is_answered_from_the_table_and_too_many_are_refused() {
    let mut robot = Robot::new(1, 1, StandbyKind::Warm, OnPartition::Stop);
    robot.advance_ms(100);
    let first = robot.ask();
    robot.advance_ms(10);
    robot.callers[first].answered = None;
    robot.callers[first].answer = None;
    robot.advance_ms(10);
    assert_eq!(robot.callers[first].answer, Some(1), "it is not counted again");

    let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
    let own = robot.members[0].as_mut().unwrap();
    for n in 0..=QUEUE_MAX as u64 {
        let id = MessageId { sender: 2, sequence: n };
        own.replica.handle_request(request(n, id), now);
    }
    let last = std::iter::from_fn(|| own.replica.poll_output()).last();
    let outcome = ServiceOutcome::Refused(Why::Full);
    assert_eq!(last, Some(ReplicaOutput::Answer { caller: QUEUE_MAX as u64, outcome }));
}

#[test]
fn a_request_whose_deadline_passed_while_it_waited_is_not_begun() {
    let mut robot = Robot::new(1, 1, StandbyKind::Warm, OnPartition::Stop);
    robot.advance_ms(100);
    let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
    let own = robot.members[0].as_mut().unwrap();
    let id = |sequence| MessageId { sender: 2, sequence };
    let soon = Some(now + Duration::from_millis(5));
    own.replica.handle_request(request(0, id(0)), now);
    own.replica.handle_request(ServiceRequest { until: soon, ..request(1, id(1)) }, now);
    own.replica.handle_request(request(2, id(2)), now);
    while own.replica.poll_output().is_some() {}

    let later = now + Duration::from_millis(6);
    own.replica.handle_executed(Ok(Bytes::new()), None, later);

    let outputs: Vec<_> = std::iter::from_fn(|| own.replica.poll_output()).collect();
    let outcome = ServiceOutcome::Refused(Why::DeadlinePassed);
    assert!(outputs.contains(&ReplicaOutput::Answer { caller: 1, outcome }), "{outputs:?}");
    let begun = |output: &&ReplicaOutput| matches!(output, ReplicaOutput::Execute { .. });
    assert_eq!(outputs.iter().filter(begun).count(), 1, "the third, and not the second");
}

/// A warm primary alone with its followers' messages, after it has served one request with this state.
fn entries_of(states: &[Vec<u8>]) -> (Vec<usize>, Vec<ReplicaOutput>) {
    let mut robot = Robot::new(3, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.advance_ms(100);
    let (mut lengths, mut others) = (Vec::new(), Vec::new());
    for (sequence, state) in states.iter().enumerate() {
        let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
        let own = robot.members[0].as_mut().unwrap();
        let id = MessageId { sender: 9, sequence: sequence as u64 };
        robot.callers.clear();
        own.replica.handle_request(request(0, id), now);
        while own.replica.poll_output().is_some() {}
        own.replica.handle_executed(Ok(Bytes::new()), Some(Ok(state.clone().into())), now);
        let mut length = 0;
        while let Some(output) = own.replica.poll_output() {
            match output {
                ReplicaOutput::Send { message, .. } => length = length.max(message.len()),
                ReplicaOutput::Load { .. } => own.replica.handle_loaded(),
                ReplicaOutput::Answer { .. } => {}
                other => others.push(other),
            }
        }
        lengths.push(length);
    }
    (lengths, others)
}

#[test]
fn only_what_has_changed_of_a_state_is_shipped() {
    let first = vec![1; 100_000];
    let mut second = first.clone();
    second[7] = 2;

    let (lengths, _) = entries_of(&[first, second.clone(), second]);

    assert!(lengths[0] > 100_000, "{lengths:?}");
    assert!(lengths[1] < 100 && lengths[2] < 100, "{lengths:?}");
}

#[test]
fn a_request_that_makes_the_state_too_large_fails_and_is_undone_and_the_fault_told_once() {
    let large = vec![1; STATE_MAX + 1];
    let (lengths, others) = entries_of(&[vec![1; 8], large.clone(), large, vec![1; 9]]);

    assert!(lengths.iter().all(|length| *length < 200), "{lengths:?}");
    let [ReplicaOutput::Fault { detail, .. }] = &others[..] else { panic!("{others:?}") };
    assert!(detail.contains("too large") || detail.contains("larger"), "{detail}");
}

#[test]
fn replies_are_kept_until_their_callers_have_them_and_no_longer() {
    for kind in [StandbyKind::Warm, StandbyKind::Hot] {
        let mut robot = Robot::new(8, 3, kind, OnPartition::Stop);
        robot.advance_ms(100);
        for _ in 0..50 {
            robot.ask();
            robot.advance_ms(4);
        }
        for member in robot.members.iter().flatten() {
            let kept = (0..50).filter(|sequence| {
                member.replica.table.find(MessageId { sender: 1, sequence: *sequence }).is_some()
            });
            assert!(kept.count() <= 4, "{kind:?}");
        }
        // One that has wandered about is not served again.
        let late = MessageId { sender: 1, sequence: 3 };
        let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
        let own = robot.members[0].as_mut().unwrap();
        own.replica.handle_request(request(0, late), now);
        let outcome = ServiceOutcome::Refused(Why::Expired);
        assert_eq!(own.replica.poll_output(), Some(ReplicaOutput::Answer { caller: 0, outcome }));
    }
}
