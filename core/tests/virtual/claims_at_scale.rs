//! Fifty nodes with ten thousand names: how soon a node that joins knows all of them and is known,
//! and what keeping them costs. Run with `--nocapture` for the figures.
#![allow(clippy::print_stdout, reason = "the figures are the point")]

use blastema_core::directory::{
    ClaimPolicy, ClaimRequest, Directory, DirectoryConfig, DirectoryOutput,
};
use blastema_core::random::Random;
use blastema_core::{Incarnation, Instant, Machine, NodeName, ObjectName};
use bytes::Bytes;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

const NODES: usize = 50;
const NAMES: usize = 10_000;
const LEASE: Duration = Duration::from_secs(1);
/// What one node can send: a tenth of Ethernet's 100 Mbit/s.
const BYTES_PER_SECOND: u64 = 1_250_000;
/// What the layers below put before each message: frame, packet, segment, contract, and its share
/// of acknowledgements.
const OVERHEAD: usize = 60;

/// Nodes whose messages take from 1 to 5 ms, and leave one after the other.
struct Robot {
    now: Instant,
    random: Random,
    nodes: Vec<Option<Directory>>,
    incarnations: Vec<u64>,
    /// When each node wants to be woken.
    due: Vec<Option<Instant>>,
    /// Messages on their way: when they arrive, from whom, to whom.
    wire: BTreeMap<(Instant, u64), (usize, usize, Bytes)>,
    count: u64,
    /// When each node's line is free again, and its last message to each other arrives.
    free: Vec<Instant>,
    arrives: BTreeMap<(usize, usize), Instant>,
    bytes: u64,
    messages: u64,
}

fn name(node: usize) -> NodeName {
    NodeName::new(&format!("module{node:02}")).unwrap()
}

fn number(node: &NodeName) -> usize {
    node.as_str()["module".len()..].parse().unwrap()
}

impl Robot {
    fn new(seed: u64) -> Self {
        let now = Instant::from_millis(1_000_000);
        Robot {
            now,
            random: Random::new(seed),
            nodes: (0..NODES).map(|_| None).collect(),
            incarnations: vec![0; NODES],
            due: vec![None; NODES],
            wire: BTreeMap::new(),
            count: 0,
            free: vec![now; NODES],
            arrives: BTreeMap::new(),
            bytes: 0,
            messages: 0,
        }
    }

    /// A node starts with its names, and its sessions with the others begin.
    fn start(&mut self, node: usize) {
        self.incarnations[node] += 1;
        let incarnation = Incarnation(self.incarnations[node]);
        let (settle, expected) = (Duration::ZERO, BTreeSet::new());
        let node_name = name(node);
        let config =
            DirectoryConfig { node: node_name, incarnation, lease: LEASE, settle, expected };
        let mut claims = Directory::new(config, self.now);
        for n in 0..NAMES / NODES {
            let own = ObjectName::new(&format!("module{node:02}/object{n}")).unwrap();
            claims.handle_claim(ClaimRequest::new(own, ClaimPolicy::Refuse), self.now).unwrap();
        }
        for other in 0..NODES {
            if let Some(theirs) = self.nodes[other].as_mut().filter(|_| other != node) {
                theirs.handle_opened(name(node), incarnation, self.now);
                claims.handle_opened(name(other), Incarnation(self.incarnations[other]), self.now);
            }
        }
        self.nodes[node] = Some(claims);
        (0..NODES).for_each(|node| self.settle(node));
    }

    fn settle(&mut self, node: usize) {
        while let Some(output) = self.nodes[node].as_mut().and_then(Directory::poll_output) {
            let DirectoryOutput::Send { to, message } = output else { continue };
            let size = (message.len() + OVERHEAD) as u64;
            self.bytes += size;
            self.messages += 1;
            let sent = self.free[node].max(self.now)
                + Duration::from_nanos(size * 1_000_000_000 / BYTES_PER_SECOND);
            self.free[node] = sent;
            let delay = Duration::from_micros(1000 + (self.random.unit() * 4000.0) as u64);
            // A session keeps the order.
            let last = self.arrives.entry((node, number(&to))).or_default();
            *last = (sent + delay).max(*last);
            self.count += 1;
            self.wire.insert((*last, self.count), (node, number(&to), message));
        }
        self.due[node] = self.nodes[node].as_ref().and_then(Machine::poll_timeout);
    }

    fn run_until(&mut self, end: Instant, mut done: impl FnMut(&Robot) -> bool) -> Instant {
        let mut look = self.now;
        while self.now < end {
            if self.now >= look {
                if done(self) {
                    break;
                }
                look = self.now + Duration::from_millis(25);
            }
            let arrival = self.wire.keys().next().map(|(at, _)| *at);
            let timers = self.due.iter().flatten().min().copied();
            // Where nothing is due, it is looked again all the same.
            let next = arrival.into_iter().chain(timers).min().unwrap_or(end).min(look);
            self.now = next.max(self.now).min(end);
            while let Some(entry) = self.wire.first_entry()
                && entry.key().0 <= self.now
            {
                let (from, to, message) = entry.remove();
                if let Some(claims) = &mut self.nodes[to] {
                    claims.handle_message(&name(from), &message, self.now);
                }
                self.settle(to);
            }
            for node in 0..NODES {
                if self.due[node].is_some_and(|due| due <= self.now)
                    && let Some(claims) = &mut self.nodes[node]
                {
                    claims.handle_timeout(self.now);
                    self.settle(node);
                }
            }
        }
        self.now
    }

    fn all_known(&self) -> bool {
        self.nodes.iter().flatten().all(|claims| claims.held() == NAMES)
    }
}

#[test]
fn fifty_nodes_with_ten_thousand_names_know_all_of_them_in_less_than_a_second() {
    let mut robot = Robot::new(7);
    let start = robot.now;
    (0..NODES).for_each(|node| robot.start(node));
    let known = robot.run_until(start + Duration::from_secs(10), Robot::all_known);
    let together = known - start;
    println!("all of {NODES} nodes at once: {together:?}, {} kB in all", robot.bytes / 1000);

    let (at, bytes) = (robot.now, robot.bytes);
    let gone = robot.nodes[17].take().is_some();
    robot.due[17] = None;
    for claims in robot.nodes.iter_mut().flatten() {
        claims.handle_ended(&name(17), robot.now);
    }
    (0..NODES).for_each(|node| robot.settle(node));
    let left = NAMES - NAMES / NODES;
    let forgotten = robot.run_until(at + Duration::from_secs(10), |robot| {
        robot.nodes.iter().flatten().all(|claims| claims.held() == left)
    });
    println!("one has gone: its names are free after {:?}", forgotten - at);
    assert!(gone && forgotten - at <= LEASE, "{:?}", forgotten - at);

    let at = robot.now;
    robot.start(17);
    let known = robot.run_until(at + Duration::from_secs(10), Robot::all_known);
    println!("it comes again: {:?}", known - at);
    assert!(robot.bytes > bytes);
    assert!(together < Duration::from_secs(1) && known - at < Duration::from_secs(1));

    robot.run_until(robot.now + Duration::from_secs(1), |_| false);
    let (at, bytes, messages) = (robot.now, robot.bytes, robot.messages);
    robot.run_until(at + Duration::from_secs(2), |_| false);
    let per_node = |total: u64| total / 2 / NODES as u64;
    let (bytes, messages) = (per_node(robot.bytes - bytes), per_node(robot.messages - messages));
    println!("steady: {messages} messages, {bytes} bytes a second from each node");
    assert_eq!((bytes, messages), (0, 0), "nothing has changed");
}
