//! Whole networks of link, router and session machines over wires that lose, delay, reorder and
//! double, are cut and restored, between nodes that die and live again: one seed, one run.

use blastema_core::net::OrderingKey;
use blastema_core::net::link::{LinkConfig, LinkOutput, LinkState};
use blastema_core::net::routing::{LinkHealth, LinkStatus, RouterKeys};
use blastema_core::net::seal::SealerConfig;
use blastema_core::net::trust::crypto::Seed;
use blastema_core::net::trust::policy::Role;
use blastema_core::net::trust::roster::{NodeRoster, RosterNode};
use blastema_core::net::{
    Link, LinkId, NodeId, Router, RouterConfig, RouterOutput, Session, SessionConfig, SessionOutput,
};
use blastema_core::random::Random;
use blastema_core::{Incarnation, Instant, Machine, NodeName, TrafficClass};
use bytes::{BufMut, Bytes, BytesMut};
use std::collections::{BTreeMap, BTreeSet};
use std::hash::{DefaultHasher, Hash};
use std::time::Duration;

pub(crate) const MS: Duration = Duration::from_millis(1);

#[derive(Clone, Copy)]
pub(crate) struct Wire {
    /// Which node and which of its links, at both ends.
    pub(crate) ends: [(usize, usize); 2],
    pub(crate) cut: bool,
    /// Loses what this side sends.
    pub(crate) mute: [bool; 2],
    /// Carries so many bytes a second in each direction, and keeps so many that wait.
    pub(crate) rate: Option<(u64, u64)>,
    /// When the last frame of each side has passed.
    passed: [Instant; 2],
    /// How probably it loses a frame, beside the weather.
    pub(crate) loss: f64,
    pub(crate) mtu: usize,
}

/// What wires do to frames, and how probably.
#[derive(Clone, Copy)]
pub(crate) struct Weather {
    pub(crate) loss: f64,
    pub(crate) double: f64,
    pub(crate) delay: (Duration, Duration),
}

pub(crate) const CALM: Weather =
    Weather { loss: 0.0, double: 0.0, delay: (Duration::from_micros(100), MS) };
pub(crate) const STORM: Weather = Weather {
    loss: 0.15,
    double: 0.1,
    delay: (Duration::from_micros(100), Duration::from_millis(8)),
};

pub(crate) struct Node {
    pub(crate) name: NodeName,
    pub(crate) incarnation: u64,
    /// The wire, the side of the wire, the link.
    pub(crate) links: Vec<(usize, usize, Link)>,
    pub(crate) router: Router,
    pub(crate) sessions: BTreeMap<NodeId, Session>,
    pub(crate) reachable: BTreeSet<NodeId>,
}

/// Which message: from whom in which incarnation, to whom, the n-th.
pub(crate) type Key = (usize, u64, usize, u64);
/// Frames on their way: to which wire's which side.
pub(crate) type Frames = BTreeMap<(Instant, u64), (usize, usize, Bytes)>;

pub(crate) struct World {
    pub(crate) now: Instant,
    pub(crate) random: Random,
    pub(crate) weather: Weather,
    /// How probably one bit of a frame is changed on its way.
    pub(crate) flips: f64,
    pub(crate) wires: Vec<Wire>,
    pub(crate) nodes: Vec<Option<Node>>,
    /// When each node wants to be woken.
    pub(crate) due: Vec<Option<Instant>>,
    /// Until when each node is stopped.
    pub(crate) stopped: Vec<Instant>,
    /// How many bytes were put on wires.
    pub(crate) bytes: u64,
    /// How often an end of a wire was found to be down.
    pub(crate) downs: u64,
    /// How many messages of each class arrived.
    arrived: BTreeMap<TrafficClass, u64>,
    pub(crate) incarnations: Vec<u64>,
    /// The nodes' keys: advertisements are signed, and what goes over a relay is sealed.
    pub(crate) roster: Option<NodeRoster>,
    pub(crate) frames: Frames,
    pub(crate) count: u64,
    /// How often some traffic went another way.
    pub(crate) path_changes: u64,
    pub(crate) trace: DefaultHasher,
    pub(crate) sent: BTreeMap<(usize, u64, usize), u64>,
    /// What arrived, and in which incarnation of the receiver.
    pub(crate) delivered: BTreeMap<Key, u64>,
    pub(crate) last: BTreeMap<(usize, u64, usize, u64, TrafficClass), u64>,
    /// When a message of the redundant stream came last, and the longest time between two.
    pub(crate) arrival: Option<Instant>,
    pub(crate) gap: Duration,
    pub(crate) returned: BTreeSet<Key>,
}

pub(crate) fn name(index: usize) -> NodeName {
    NodeName::new(&format!("module{index}")).unwrap()
}

fn secret(index: usize) -> Seed {
    Seed::new([index as u8 + 1; 32])
}

/// A roster of so many nodes.
fn roster(nodes: usize) -> NodeRoster {
    let listed = (0..nodes).map(|index| RosterNode {
        name: name(index),
        keys: secret(index).public_keys(),
        role: Role::Node,
    });
    NodeRoster::new(NodeName::new("ranger").unwrap(), listed).unwrap()
}

impl World {
    /// Every other seed's nodes have keys.
    pub(crate) fn new(seed: u64, nodes: usize, wires: &[(usize, usize)], weather: Weather) -> Self {
        let keys = (seed % 2 == 1).then(|| roster(nodes));
        World::with_roster(seed, nodes, keys, wires, weather)
    }

    pub(crate) fn with_keys(seed: u64, nodes: usize, wires: &[(usize, usize)]) -> Self {
        World::with_roster(seed, nodes, Some(roster(nodes)), wires, CALM)
    }

    fn with_roster(
        seed: u64,
        nodes: usize,
        roster: Option<NodeRoster>,
        wires: &[(usize, usize)],
        weather: Weather,
    ) -> Self {
        let mut links = vec![0; nodes];
        let wire = |&(a, b): &(usize, usize)| {
            let ends = [(a, links[a]), (b, links[b])];
            links[a] += 1;
            links[b] += 1;
            let passed = [Instant::ORIGIN; 2];
            Wire { ends, cut: false, mute: [false; 2], rate: None, passed, loss: 0.0, mtu: 1400 }
        };
        let wires = wires.iter().map(wire).collect();
        let mut world = World {
            now: Instant::from_millis(1_000_000),
            random: Random::new(seed),
            weather,
            flips: 0.0,
            wires,
            nodes: (0..nodes).map(|_| None).collect(),
            due: vec![None; nodes],
            stopped: vec![Instant::ORIGIN; nodes],
            bytes: 0,
            downs: 0,
            arrived: BTreeMap::new(),
            incarnations: vec![0; nodes],
            roster,
            frames: BTreeMap::new(),
            count: 0,
            path_changes: 0,
            trace: DefaultHasher::new(),
            sent: BTreeMap::new(),
            delivered: BTreeMap::new(),
            last: BTreeMap::new(),
            arrival: None,
            gap: Duration::ZERO,
            returned: BTreeSet::new(),
        };
        (0..nodes).for_each(|node| world.start(node));
        world
    }

    pub(crate) fn start(&mut self, index: usize) {
        self.incarnations[index] += 1;
        let incarnation = Incarnation(self.incarnations[index]);
        let now = self.now;
        let mut links = vec![];
        for (number, wire) in self.wires.iter().enumerate() {
            for (side, end) in wire.ends.iter().enumerate() {
                if end.0 == index {
                    let usual = LinkConfig::new(name(index), incarnation);
                    let config = LinkConfig { hello_interval: 20 * MS, ..usual };
                    links.push((number, side, Link::new(config, now)));
                }
            }
        }
        let mut router = Router::new(RouterConfig::new(name(index), incarnation), now);
        if let Some(roster) = &self.roster {
            let config = SealerConfig::new(NodeId::of(&name(index)), incarnation, "ranger");
            let mut random = [index as u8; 32];
            random[..8].copy_from_slice(&incarnation.0.to_be_bytes());
            let keys = RouterKeys::new(&secret(index), roster, config, random, now);
            router = router.with_keys(keys);
        }
        let sessions = (0..self.incarnations.len()).filter(|peer| *peer != index).map(|peer| {
            let config = SessionConfig::new(name(index), incarnation, name(peer));
            (NodeId::of(&name(peer)), Session::new(config, now))
        });
        self.nodes[index] = Some(Node {
            name: name(index),
            incarnation: incarnation.0,
            links,
            router,
            sessions: sessions.collect(),
            reachable: BTreeSet::new(),
        });
        self.settle(index);
    }

    pub(crate) fn kill(&mut self, index: usize) {
        self.nodes[index] = None;
        self.due[index] = None;
    }

    pub(crate) fn send(&mut self, from: usize, to: usize, length: usize) -> bool {
        self.send_on(TrafficClass::Request, from, to, length)
    }

    pub(crate) fn send_on(
        &mut self,
        stream: TrafficClass,
        from: usize,
        to: usize,
        length: usize,
    ) -> bool {
        let now = self.now;
        let Some(node) = &mut self.nodes[from] else { return false };
        let incarnation = node.incarnation;
        let number = self.sent.entry((from, incarnation, to)).or_insert(0);
        let mut message = BytesMut::new();
        message.put_u64(from as u64);
        message.put_u64(incarnation);
        message.put_u64(to as u64);
        message.put_u64(*number);
        message.resize(32 + length, 0xee);
        let session = node.sessions.get_mut(&NodeId::of(&name(to))).unwrap();
        let accepted = session
            .handle_send_along(stream, OrderingKey::default(), message.freeze(), None, now)
            .is_ok();
        *number += u64::from(accepted);
        self.settle(from);
        accepted
    }

    /// Runs until nothing is due before `end`.
    pub(crate) fn run_until(&mut self, end: Instant) {
        loop {
            let frame = self.frames.keys().next().map(|(at, _)| *at);
            let due = |n: usize| Some((self.due[n]?.max(self.stopped[n]), n));
            let timer = (0..self.nodes.len()).filter_map(due).min();
            let next = [frame, timer.map(|(at, _)| at)].into_iter().flatten().min();
            let Some(next) = next.filter(|next| *next <= end) else { break };
            self.now = self.now.max(next);
            let now = self.now;
            if frame.is_some_and(|at| at <= now) {
                let ((_, number), (wire, side, frame)) = self.frames.pop_first().unwrap();
                let (node, link) = self.wires[wire].ends[side];
                if self.stopped[node] > now {
                    // It waits in its socket.
                    self.frames.insert((self.stopped[node], number), (wire, side, frame));
                    continue;
                }
                if let Some(node) = &mut self.nodes[node] {
                    node.links[link].2.handle_frame(frame, now);
                }
                self.settle(node);
            } else if let Some((_, node)) = timer {
                self.nodes[node].as_mut().unwrap().handle_timeout(now);
                self.settle(node);
            }
        }
        self.now = end;
    }

    pub(crate) fn run(&mut self, span: Duration) {
        self.run_until(self.now + span);
    }

    /// Carries out everything that a node's machines want.
    pub(crate) fn settle(&mut self, index: usize) {
        let Some(mut node) = self.nodes[index].take() else { return };
        while self.settle_links(&mut node)
            | self.settle_router(&mut node)
            | self.settle_sessions(index, &mut node)
        {}
        self.due[index] = node.poll_timeout();
        self.nodes[index] = Some(node);
    }

    fn settle_links(&mut self, node: &mut Node) -> bool {
        let mut busy = false;
        for index in 0..node.links.len() {
            let number = LinkId(index as u16);
            let (wire, side, _) = node.links[index];
            while let Some(output) = node.links[index].2.poll_output() {
                busy = true;
                let (link, router) = (&node.links[index].2, &mut node.router);
                match output {
                    LinkOutput::Transmit(frame) => self.throw(wire, side, &frame.into_bytes()),
                    LinkOutput::Changed { .. } | LinkOutput::Quality(_) => {
                        let Some(neighbour) = link.neighbour().cloned() else { continue };
                        let health = match link.state() {
                            LinkState::Up => LinkHealth::Up,
                            LinkState::Suspect if link.is_proving() => LinkHealth::Proving,
                            LinkState::Suspect => LinkHealth::Suspect,
                            LinkState::Down | LinkState::Connecting => LinkHealth::Down,
                        };
                        self.downs += u64::from(health == LinkHealth::Down);
                        let cost = link.quality().cost_percent / 10;
                        let mtu = self.wires[wire].mtu;
                        let status = LinkStatus { neighbour, health, cost, mtu };
                        router.handle_link(number, status, self.now);
                    }
                    LinkOutput::Routing(bytes) => router.handle_routing(number, bytes, self.now),
                    LinkOutput::Packet(packet) => router.handle_packet(number, packet, self.now),
                    LinkOutput::Missing { .. } | LinkOutput::FrameLimit | LinkOutput::Taken(_) => {}
                    LinkOutput::Refused(refusal) => panic!("{refusal}"),
                }
            }
        }
        if node.router.poll_timeout().is_some_and(|due| due <= self.now) {
            node.router.handle_timeout(self.now);
            busy = true;
        }
        busy
    }

    /// Lets the weather have a frame.
    fn throw(&mut self, wire: usize, side: usize, frame: &Bytes) {
        let Wire { cut, mute, mtu, loss: own, .. } = self.wires[wire];
        assert!(frame.len() <= mtu, "{} bytes for an mtu of {mtu}", frame.len());
        (self.now, wire, frame).hash(&mut self.trace);
        self.bytes += frame.len() as u64;
        let Some(waits) = self.queue(wire, side, frame.len()) else { return };
        let Weather { loss, double, delay: (least, most) } = self.weather;
        for _ in 0..1 + u64::from(self.random.chance(double)) {
            let lost = self.random.chance(loss) || own > 0.0 && self.random.chance(own);
            let spread = (most - least).as_nanos() as u64;
            let delay = waits + least + Duration::from_nanos(self.random.below(spread + 1));
            if !lost && !cut && !mute[side] {
                self.count += 1;
                let struck = self.flips > 0.0 && self.random.chance(self.flips);
                let frame = if struck { self.strike(frame) } else { frame.clone() };
                self.frames.insert((self.now + delay, self.count), (wire, 1 - side, frame));
            }
        }
    }

    /// How long a frame takes until it has passed a wire with a rate; nothing where the queue before
    /// it is full.
    fn queue(&mut self, wire: usize, side: usize, bytes: usize) -> Option<Duration> {
        let Wire { rate, passed, .. } = &mut self.wires[wire];
        let Some((rate, room)) = *rate else { return Some(Duration::ZERO) };
        let takes = |bytes: u64| Duration::from_nanos(bytes * 1_000_000_000 / rate);
        let waits = passed[side].max(self.now) - self.now;
        if waits > takes(room) {
            return None;
        }
        passed[side] = self.now + waits + takes(bytes as u64);
        Some(passed[side] - self.now)
    }

    /// Changes one bit. What an application says is for a check of its own: here all of it must be
    /// true.
    fn strike(&mut self, frame: &Bytes) -> Bytes {
        const DATA: u8 = 2;
        const HEADERS: u64 = 11;
        let mut bytes = frame.to_vec();
        let length = bytes.len() as u64;
        let end = if bytes[1] == DATA && length > 60 { HEADERS } else { length };
        let bit = self.random.below(8 * end) as usize;
        bytes[bit / 8] ^= 1 << (bit % 8);
        bytes.into()
    }

    fn settle_router(&mut self, node: &mut Node) -> bool {
        let mut busy = false;
        while let Some(output) = node.router.poll_output() {
            busy = true;
            let now = self.now;
            let sessions = &mut node.sessions;
            match output {
                RouterOutput::Routing { link, bytes } => {
                    node.links[link.0 as usize].2.handle_routing(bytes);
                }
                RouterOutput::Packet { link, packet } => {
                    node.links[link.0 as usize].2.handle_packet(packet);
                }
                RouterOutput::Segment { source, segment, .. } => {
                    if let Some(session) = sessions.get_mut(&source) {
                        session.handle_segment(segment, now);
                    }
                }
                RouterOutput::Reachable { node: peer, incarnation, mtu } => {
                    let id = NodeId::of(&peer);
                    node.reachable.insert(id);
                    let session = sessions.get_mut(&id).unwrap();
                    session.handle_incarnation(incarnation, now);
                    session.handle_path(mtu, now);
                }
                RouterOutput::PathChanged { node: peer, mtu } => {
                    self.path_changes += 1;
                    sessions.get_mut(&peer).unwrap().handle_path(mtu, now);
                }
                RouterOutput::Lost { node: peer, .. } => {
                    let id = NodeId::of(&peer);
                    node.reachable.remove(&id);
                    sessions.get_mut(&id).unwrap().handle_no_path(now);
                }
                RouterOutput::Undelivered { destination, reason } => {
                    if let Some(session) = sessions.get_mut(&destination) {
                        session.handle_undelivered(reason, now);
                    }
                }
                // A node that goes on with its number is found all the same.
                RouterOutput::NameTaken { .. }
                | RouterOutput::KeptOut { .. }
                | RouterOutput::Refuse { .. } => {}
                other => panic!("{other:?}"),
            }
        }
        busy
    }

    fn settle_sessions(&mut self, index: usize, node: &mut Node) -> bool {
        let mut busy = false;
        for (peer, session) in &mut node.sessions {
            while let Some(output) = session.poll_output() {
                busy = true;
                match output {
                    SessionOutput::Transmit { class, segment, everywhere } => {
                        if everywhere {
                            node.router.handle_copies(*peer, class, &segment);
                        } else {
                            node.router.handle_segment(*peer, class, segment);
                        }
                    }
                    SessionOutput::Message { stream, message } => {
                        if stream == TrafficClass::Redundant {
                            let before = self.arrival.replace(self.now).unwrap_or(self.now);
                            self.gap = self.gap.max(self.now - before);
                        }
                        *self.arrived.entry(stream).or_default() += 1;
                        let key = read(&message);
                        let (from, incarnation, to, number) = key;
                        assert_eq!(to, index, "{} got another's message", node.name);
                        assert_eq!(*peer, NodeId::of(&name(from)));
                        let before = self.delivered.insert(key, node.incarnation);
                        assert_eq!(before, None, "doubled: {key:?}");
                        let sequel = (from, incarnation, to, node.incarnation, stream);
                        let last = self.last.entry(sequel).or_insert(0);
                        assert!(number >= *last, "out of order: {key:?}");
                        *last = number;
                        (self.now, key).hash(&mut self.trace);
                    }
                    SessionOutput::Returned { message, sent, .. } => {
                        let key = read(&message);
                        let has_arrived = self.delivered.contains_key(&key);
                        assert!(sent || !has_arrived, "returned, and arrived: {key:?}");
                        self.returned.insert(key);
                    }
                    // The version's own bits may have been struck.
                    SessionOutput::Incompatible { .. } if self.flips > 0.0 => {}
                    SessionOutput::Incompatible { .. } => panic!("one version only"),
                    SessionOutput::Opened { .. }
                    | SessionOutput::Ended { .. }
                    | SessionOutput::Newest { .. } => {}
                }
            }
        }
        busy
    }

    /// Every message that a living sender was allowed to send has arrived or has come back.
    pub(crate) fn check_complete(&self) {
        for (&(from, incarnation, to), &count) in &self.sent {
            let alive =
                self.nodes[from].as_ref().is_some_and(|node| node.incarnation == incarnation);
            let missing: Vec<_> = (0..count)
                .map(|number| (from, incarnation, to, number))
                .filter(|key| !self.delivered.contains_key(key) && !self.returned.contains(key))
                .collect();
            assert!(!alive || missing.is_empty(), "lost: {missing:?}");
        }
    }

    pub(crate) fn delivered_on(&self, class: TrafficClass) -> u64 {
        self.arrived.get(&class).copied().unwrap_or_default()
    }

    pub(crate) fn count_sent(&self) -> u64 {
        self.sent.values().sum()
    }
}

impl Node {
    fn poll_timeout(&self) -> Option<Instant> {
        let links = self.links.iter().filter_map(|(_, _, link)| link.poll_timeout());
        let sessions = self.sessions.values().filter_map(Session::poll_timeout);
        links.chain(sessions).chain(self.router.poll_timeout()).min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        fn wake(machine: &mut impl Machine, now: Instant) {
            if machine.poll_timeout().is_some_and(|due| due <= now) {
                machine.handle_timeout(now);
            }
        }
        self.links.iter_mut().for_each(|(_, _, link)| wake(link, now));
        self.sessions.values_mut().for_each(|session| wake(session, now));
        wake(&mut self.router, now);
    }
}

pub(crate) fn read(message: &Bytes) -> Key {
    let word = |n: usize| u64::from_be_bytes(message[n * 8..][..8].try_into().unwrap());
    assert!(message[32..].iter().all(|byte| *byte == 0xee));
    (word(0) as usize, word(1), word(2) as usize, word(3))
}

/// Whether long lists of cases are run whole, as at night: `BLASTEMA_LONG=1`.
pub(crate) fn long() -> bool {
    std::env::var_os("BLASTEMA_LONG").is_some()
}

/// Runs a scenario for many seeds; the seed of a failure is printed.
pub(crate) fn for_seeds(seeds: impl IntoIterator<Item = u64>, scenario: impl Fn(u64)) {
    struct Tell(u64);
    impl Drop for Tell {
        #[expect(clippy::print_stderr, reason = "a failing test is repeated by its seed")]
        fn drop(&mut self) {
            if std::thread::panicking() {
                eprintln!("the failing seed is {}", self.0);
            }
        }
    }
    // `BLASTEMA_SEED=n` adds one seed to those that every run has.
    let chosen = std::env::var("BLASTEMA_SEED").ok().map(|text| text.parse().expect("a number"));
    for seed in seeds.into_iter().chain(chosen) {
        let tell = Tell(seed);
        scenario(seed);
        drop(tell);
    }
}
