//! A relay with a key of the robot that is hostile, between two nodes that have no other way. It is
//! made of the machines of the core over real sockets, so that it can do what no node does.

use super::attacker::accuses_no_node;
use super::{PATIENCE, end, is_up, until};
use blastema::prelude::*;
use blastema::{LinkState, Network};
use blastema_core::net::link::{LinkConfig, LinkOutput, LinkState as State};
use blastema_core::net::routing::{LinkHealth, LinkStatus, RouterKeys};
use blastema_core::net::seal::{NoiseCrypto, Sealer, SealerConfig};
use blastema_core::net::trust::key_file::KeyFile;
use blastema_core::net::trust::roster::NodeRoster;
use blastema_core::net::wire::advertisement::{
    Advertisement, AdvertisementId, Edge, RoutingMessage, SIGNATURE_LENGTH,
};
use blastema_core::net::wire::packet::{Packet, Payload};
use blastema_core::net::{
    Link, LinkAddress, LinkId, LinkLayer, LinkLayerOutput, NeighbourKey, NodeId, Router,
    RouterConfig, RouterOutput,
};
use blastema_core::{Incarnation, Instant, Machine, NodeName};
use blastema_tests::{RobotKeys, free_addresses, serves};
use bytes::Bytes;
use std::fs;
use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

const NODES: [&str; 3] = ["left", "relay", "right"];
const ENDS: [&str; 2] = ["left", "right"];
/// So many requests are served each way while the relay does each of its things.
const REQUESTS: u32 = 60;
/// What no node but the two ends may read.
const SECRET: &str = "the code of the door is 4711";
const MTU: usize = 1_400;

/// Says how many have come.
#[derive(Clone, Debug, Request)]
#[contract(name = "sealed/say", reply = u32)]
struct Say(String);

/// What the relay does beside passing packets on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Attack {
    Nothing,
    /// Each packet is preceded by copies with a changed bit.
    Change,
    /// Each packet is passed on three times, with old ones behind it.
    Repeat,
    /// Segments in an end's name that it has not sealed.
    Invent,
    /// Links in the names of the ends: unsigned, and signed with the relay's key.
    Route,
}

/// A neighbour, by its place in [`ENDS`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
struct End(usize);

impl std::fmt::Display for End {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(ENDS[self.0])
    }
}

impl LinkAddress for End {
    fn is_connection(&self) -> bool {
        false
    }
}

struct Relay {
    socket: UdpSocket,
    ends: [SocketAddr; 2],
    began: std::time::Instant,
    links: LinkLayer<NoiseCrypto, End>,
    router: Router,
    /// The packets that were passed on to each end.
    passed: [Vec<Bytes>; 2],
    attack: Arc<Mutex<Attack>>,
    key: KeyFile,
    count: u64,
}

fn named(name: &str) -> NodeName {
    name.parse().expect("a name")
}

impl Relay {
    fn new(
        keys: &RobotKeys,
        socket: UdpSocket,
        ends: [SocketAddr; 2],
        attack: Arc<Mutex<Attack>>,
    ) -> Self {
        let key = fs::read_to_string(keys.of("relay")).expect("it was written");
        let key = KeyFile::parse(&key).expect("a key file");
        let roster = fs::read_to_string(keys.of("relay").with_file_name("ranger.roster"));
        let roster = NodeRoster::parse_signed(&roster.expect("it was written"), &key.signer);
        let roster = roster.expect("a roster");
        let (own, incarnation) = (named("relay"), Incarnation(7));
        let now = Instant::from_millis(1);
        let config = SealerConfig::new(NodeId::of(&own), incarnation, "ranger");
        let sealer = Sealer::new(config.clone(), key.seed.handshakes(), [3; 32], now);
        let mut links = LinkLayer::new(Some(sealer));
        for (place, end) in ENDS.iter().enumerate() {
            let node = NodeId::of(&named(end));
            let listed = roster.node(&named(end)).expect("it is listed");
            let public = *listed.keys.x25519.bytes();
            let link = Link::new(LinkConfig::new(own.clone(), incarnation), now);
            let number = LinkId(place as u16);
            let key = Some(NeighbourKey { node, public });
            links.insert(number, link, End(place), key, now).expect("a key");
        }
        links.handle_mtu(MTU, false);
        let keys = RouterKeys::new(&key.seed, &roster, config, [4; 32], now);
        let router = Router::new(RouterConfig::new(own, incarnation), now).with_keys(keys);
        let passed = [Vec::new(), Vec::new()];
        socket.set_read_timeout(Some(Duration::from_millis(1))).expect("it is bound");
        let began = std::time::Instant::now();
        Relay { socket, ends, began, links, router, passed, attack, key, count: 0 }
    }

    /// Runs until it shall end, and returns what it has passed on.
    fn run(mut self, ends: &AtomicBool) -> Vec<Bytes> {
        let mut frame = [0; 65_536];
        while !ends.load(SeqCst) {
            if let Ok((length, from)) = self.socket.recv_from(&mut frame)
                && let Some(place) = self.ends.iter().position(|end| *end == from)
            {
                let (frame, now) = (Bytes::copy_from_slice(&frame[..length]), self.now());
                self.links.handle_frame(End(place), frame, now);
            }
            let now = self.now();
            if self.links.poll_timeout().is_some_and(|due| due <= now) {
                self.links.handle_timeout(now);
            }
            if self.router.poll_timeout().is_some_and(|due| due <= now) {
                self.router.handle_timeout(now);
            }
            while self.carry_out_links() | self.carry_out_router() {}
        }
        self.passed.into_iter().flatten().collect()
    }

    fn now(&self) -> Instant {
        Instant::from_millis(1) + self.began.elapsed()
    }

    fn carry_out_links(&mut self) -> bool {
        let mut busy = false;
        while let Some(output) = self.links.poll_output() {
            busy = true;
            let now = self.now();
            match output {
                LinkLayerOutput::Transmit { to: End(place), frame, .. } => {
                    // A full buffer drops it, as a cable does.
                    let _ = self.socket.send_to(&frame.into_bytes(), self.ends[place]);
                }
                LinkLayerOutput::Of(link, LinkOutput::Routing(bytes)) => {
                    self.router.handle_routing(link, bytes, now);
                }
                LinkLayerOutput::Of(link, LinkOutput::Packet(packet)) => {
                    self.router.handle_packet(link, packet, now);
                }
                LinkLayerOutput::Of(number, _) => {
                    let link = self.links.get(number).expect("it was added");
                    let health = match link.state() {
                        State::Up => LinkHealth::Up,
                        State::Suspect => LinkHealth::Suspect,
                        State::Down | State::Connecting => LinkHealth::Down,
                    };
                    if let Some(neighbour) = link.neighbour().cloned() {
                        let mtu = MTU - self.links.overhead();
                        let status = LinkStatus { neighbour, health, cost: 10, mtu };
                        self.router.handle_link(number, status, now);
                    }
                }
                _ => {}
            }
        }
        busy
    }

    fn carry_out_router(&mut self) -> bool {
        let mut busy = false;
        while let Some(output) = self.router.poll_output() {
            busy = true;
            match output {
                RouterOutput::Routing { link, bytes } => {
                    let now = self.now();
                    self.links.with_link(link, now, |link| link.handle_routing(bytes));
                }
                RouterOutput::Packet { link, packet } => self.pass(link, packet.into_bytes()),
                _ => {}
            }
        }
        busy
    }

    fn give(&mut self, link: LinkId, packet: Bytes) {
        let now = self.now();
        self.links.with_link(link, now, |link| link.handle_packet(packet));
    }

    fn pass(&mut self, link: LinkId, packet: Bytes) {
        self.count += 1;
        let (place, count) = (usize::from(link.0), self.count);
        let attack = *self.attack.lock().unwrap();
        match attack {
            Attack::Nothing => {}
            Attack::Change => {
                for step in 0..8 {
                    let mut changed = packet.to_vec();
                    let at = (count * 31 + step * 13) as usize % changed.len();
                    changed[at] ^= 1 << step;
                    self.give(link, changed.into());
                }
            }
            Attack::Repeat => {
                let old: Vec<_> = self.passed[place].iter().rev().take(20).cloned().collect();
                [packet.clone(), packet.clone()].into_iter().chain(old).for_each(|old| {
                    self.give(link, old);
                });
            }
            Attack::Invent => self.invent(link, &packet),
            Attack::Route => self.lie(link),
        }
        self.passed[place].push(packet.clone());
        self.give(link, packet);
    }

    /// Segments of all kinds, as the other end's session would send them without a seal.
    fn invent(&mut self, link: LinkId, like: &Bytes) {
        let Ok(like) = Packet::decode(like.clone()) else { return };
        for kind in 0..8_u8 {
            let segment = [&[kind << 5][..], &self.count.to_be_bytes(), &[1; 40]].concat();
            let payload = Payload::Segment(Bytes::from(segment).into());
            self.give(link, Packet { payload, ..like.clone() }.encode());
        }
    }

    fn lie(&mut self, link: LinkId) {
        let lies = ENDS.iter().flat_map(|end| {
            let (node, sequence) = (named(end), u64::MAX - self.count % 1_000);
            let to = NodeId::of(&named("relay"));
            let mut lie = Advertisement {
                id: AdvertisementId { origin: NodeId::of(&node), sequence },
                incarnation: Incarnation(u64::MAX / 2),
                node,
                edges: vec![Edge { to, incarnation: 7, cost: 1, mtu: 1_400 }],
                signature: None,
            };
            let unsigned = lie.clone();
            lie.signature = Some([0; SIGNATURE_LENGTH]);
            let signed = RoutingMessage::Announce(vec![lie.clone()]).encode();
            let part = &signed[1..signed.len() - SIGNATURE_LENGTH];
            let message = [b"blastema advertisement 1\0ranger\0", part].concat();
            lie.signature = Some(self.key.seed.advertisement_signer().sign(&message));
            [unsigned, lie]
        });
        let bytes = RoutingMessage::Announce(lies.collect()).encode();
        let now = self.now();
        self.links.with_link(link, now, |link| link.handle_routing(bytes));
    }
}

/// Ends the relay with the test.
struct Running(Arc<AtomicBool>, Option<JoinHandle<Vec<Bytes>>>);

impl Running {
    fn end(&mut self) -> Vec<Bytes> {
        self.0.store(true, SeqCst);
        self.1.take().map_or_else(Vec::new, |relay| relay.join().expect("it does not panic"))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.0.store(true, SeqCst);
    }
}

async fn says(node: &Node, to: &str) -> u32 {
    let listener = node.sender::<Say>(&format!("{to}:{to}-listener")).expect("a name");
    listener.ask_within(Say(SECRET.into()), PATIENCE).await.expect("it answers")
}

#[test]
fn a_relay_with_a_key_can_neither_read_change_repeat_nor_invent_what_it_passes_on() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &NODES, 1);
        let at: [SocketAddr; 2] = free_addresses(2).try_into().expect("two");
        let socket = UdpSocket::bind("127.0.0.1:0").expect("loopback has a free port");
        let middle = socket.local_addr().expect("it is bound").to_string();
        let attack = Arc::new(Mutex::new(Attack::Nothing));
        let relay = Relay::new(&keys, socket, at, attack.clone());
        let ends = Arc::new(AtomicBool::new(false));
        let running = {
            let ends = ends.clone();
            thread::spawn(move || relay.run(&ends))
        };
        let mut relay = Running(ends, Some(running));
        let start = async |own: usize| {
            let listener = serves(&format!("{}-listener", ENDS[own]), 0, |count, say: Say, _| {
                assert_eq!(say.0, SECRET);
                *count += 1;
                *count
            });
            let network = Network::new("lan", &format!("udp://{}", at[own])).peer("relay", &middle);
            let builder = Node::builder(ENDS[own]).work_threads(1).keys(keys.of(ENDS[own]));
            builder.network(network).child(listener).start().await.expect("it starts")
        };
        let (left, right) = (start(0).await, start(1).await);
        until(async || is_up(&left).await && is_up(&right).await, "the links with the relay").await;
        assert!(left.connected("right", PATIENCE).await && right.connected("left", PATIENCE).await);

        let mut served = 0;
        use Attack::{Change, Invent, Nothing, Repeat, Route};
        for next in [Nothing, Change, Repeat, Invent, Route, Nothing] {
            *attack.lock().unwrap() = next;
            for _ in 0..REQUESTS {
                served += 1;
                // Not one is served twice, or lost.
                assert_eq!(says(&left, "right").await, served, "{next:?}");
                assert_eq!(says(&right, "left").await, served, "{next:?}");
            }
        }

        for node in [&left, &right] {
            let link = &node.links().await[0];
            assert_eq!(link.state, LinkState::Up, "{link:?}");
            accuses_no_node(node).await;
        }
        end([left, right]).await;
        let passed = relay.end();
        assert!(passed.len() > 8 * REQUESTS as usize, "{} packets", passed.len());
        let part = &SECRET.as_bytes()[..12];
        let readable = |packet: &&Bytes| packet.windows(part.len()).any(|bytes| bytes == part);
        assert_eq!(passed.iter().filter(readable).count(), 0, "it read them");
    });
}
