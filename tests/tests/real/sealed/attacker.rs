//! An attacker in the middle of two nodes, at the addresses that they send to.

use super::{PATIENCE, ask, end, is_up, node, until};
use blastema::prelude::*;
use blastema::{LinkState, Network};
use blastema_core::net::wire::frame::{Frame, Hello};
use blastema_core::net::wire::hello_state::HelloState;
use blastema_tests::{RobotKeys, free_addresses};
use std::net::{SocketAddr, UdpSocket};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};

const NODES: [&str; 2] = ["left", "right"];
/// So many requests are served while the attacker does each of its things.
const REQUESTS: u32 = 100;
/// Records that are kept to be sent again.
const RECORDED: usize = 400;

/// What is done to the frames from one node to the other.
#[derive(Clone, Copy, Debug)]
enum Attack {
    /// All that was recorded is sent again.
    Repeat,
    /// Each frame is followed by copies with one changed bit.
    Change,
    /// Frames that are not sealed, as the neighbour would send them without keys.
    Forge,
    /// Handshakes that were recorded, also to the node that has sent them.
    Handshakes,
    /// Noise, at the rate at which this computer sends.
    Flood,
}

/// Two sockets between two nodes, each of which takes them for the other. Its threads end with it.
struct Middle {
    sockets: [UdpSocket; 2],
    nodes: [SocketAddr; 2],
    recorded: Mutex<[Vec<Vec<u8>>; 2]>,
}

impl Middle {
    fn start(sockets: [UdpSocket; 2], nodes: [SocketAddr; 2]) -> Arc<Self> {
        let middle = Arc::new(Middle { sockets, nodes, recorded: Mutex::default() });
        for from in 0..2 {
            let middle = Arc::downgrade(&middle);
            thread::spawn(move || {
                let mut frame = [0; 65_536];
                while let Some(middle) = middle.upgrade() {
                    middle.pass_on(from, &mut frame);
                }
            });
        }
        middle
    }

    /// What the node `from` sends to the other arrives at its socket, and leaves from the other.
    fn pass_on(&self, from: usize, frame: &mut [u8]) {
        let Ok(length) = self.sockets[from].recv(frame) else { return };
        let mut recorded = self.recorded.lock().unwrap();
        if recorded[from].len() < RECORDED {
            recorded[from].push(frame[..length].to_vec());
        }
        drop(recorded);
        self.send(from, &frame[..length]);
    }

    /// To the other, from the address that it knows `from` by.
    fn send(&self, from: usize, frame: &[u8]) {
        // A full buffer drops it, as a cable does.
        let _ = self.sockets[1 - from].send_to(frame, self.nodes[1 - from]);
    }

    fn attack(&self, attack: Attack, round: u32) {
        let recorded = self.recorded.lock().unwrap().clone();
        for from in 0..2 {
            let mine = &recorded[from];
            let pick = |step: u32| &mine[(round * 31 + step) as usize % mine.len()];
            match attack {
                Attack::Repeat => (0..20).for_each(|step| self.send(from, pick(step))),
                Attack::Change => (0..20).for_each(|step| {
                    let mut frame = pick(step).clone();
                    let place = (round + step * 7) as usize % frame.len();
                    frame[place] ^= 1 << (step % 8);
                    self.send(from, &frame);
                }),
                Attack::Forge => {
                    for incarnation in [1, u64::MAX / 2] {
                        self.send(from, &hello(NODES[from], incarnation, round));
                    }
                    self.send(from, &Frame::Data(vec![7; 40].into()).encode());
                }
                Attack::Handshakes => {
                    let handshakes = mine.iter().filter(|frame| frame[0] & 0xf0 == 0xb0);
                    for frame in handshakes.take(10) {
                        self.send(from, frame);
                        self.send(1 - from, frame);
                    }
                }
                Attack::Flood => (0..200).for_each(|step| {
                    let seed = round.wrapping_mul(2_654_435_761).wrapping_add(step);
                    let frame: Vec<u8> =
                        (0..64).map(|n| (seed.wrapping_mul(n * n + 7) >> 9) as u8).collect();
                    self.send(from, &frame);
                }),
            }
        }
    }
}

fn hello(of: &str, incarnation: u64, sequence: u32) -> Vec<u8> {
    let hello = Hello {
        node: of.parse().expect("a name"),
        incarnation: blastema::core::Incarnation(incarnation),
        sequence,
        interval_us: 50_000,
        skipped: 0,
        state: HelloState::Down,
        loss_permille: 0,
        echo: None,
    };
    Frame::Hello(hello).encode().to_vec()
}

/// No fault of the node names another node, now or before.
pub(super) async fn accuses_no_node(node: &Node) {
    for entry in node.faults().await.entries {
        let kind = &entry.fault.kind;
        use FaultKind::{LinkDown, NameTaken, NodeFaulty, NodeLost};
        assert!(!matches!(kind, LinkDown | NodeFaulty | NodeLost | NameTaken), "{entry:?}");
    }
}

#[test]
fn an_attacker_that_reads_repeats_changes_and_forges_everything_is_taken_for_no_node() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &NODES, 1);
        let at = free_addresses(2);
        let sockets = [0, 1].map(|_| {
            let socket = UdpSocket::bind("127.0.0.1:0").expect("loopback has a free port");
            socket.set_read_timeout(Some(Duration::from_millis(50))).expect("it is bound");
            socket
        });
        // Each node sends to the socket that the middle receives its frames with.
        let near = [0, 1].map(|n: usize| sockets[n].local_addr().expect("it is bound").to_string());
        let network = |own: usize| {
            let lan = Network::new("lan", &format!("udp://{}", at[own]));
            lan.peer(NODES[1 - own], &near[own])
        };
        let middle = Middle::start(sockets, [at[0], at[1]]);
        let left = node(&keys, "left", network(0)).start().await.expect("it starts");
        let right = node(&keys, "right", network(1)).start().await.expect("it starts");
        assert!(left.connected("right", PATIENCE).await, "{:?}", left.links().await);
        assert!(right.connected("left", PATIENCE).await, "{:?}", right.links().await);
        until(async || middle.recorded.lock().unwrap().iter().all(|of| of.len() > 20), "records")
            .await;

        let mut served = 0;
        use Attack::{Change, Flood, Forge, Handshakes, Repeat};
        for attack in [Repeat, Change, Forge, Handshakes, Flood] {
            for round in 0..REQUESTS {
                middle.attack(attack, round);
                served += 1;
                // Not one is served twice, or in another's place.
                assert_eq!(ask(&left, "right").await, served, "{attack:?}");
                assert_eq!(ask(&right, "left").await, served, "{attack:?}");
            }
        }

        for node in [&left, &right] {
            let link = &node.links().await[0];
            assert_eq!(link.state, LinkState::Up, "{link:?}");
            assert!(link.refusals.total() < 10, "none of it is the neighbour's: {link:?}");
            // A flood takes time of this computer, and no node was given up or accused for it.
            accuses_no_node(node).await;
        }
        end([left, right]).await;
    });
}

/// The preamble of a stream transport: every station that can connect can say it.
async fn claim(port: u16, at: SocketAddr) -> Option<TcpStream> {
    let mut preamble = *b"BLST\x01\0\0\0";
    preamble[6..].copy_from_slice(&port.to_be_bytes());
    let mut stream = TcpSocket::new_v4().ok()?.connect(at).await.ok()?;
    stream.write_all(&preamble).await.ok()?;
    Some(stream)
}

#[test]
fn a_connection_that_claims_to_be_the_neighbours_replaces_none() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &NODES, 1);
        let at = free_addresses(2);
        let network = |own: usize| {
            let lan = Network::new("lan", &format!("tcp://{}", at[own]));
            lan.peer(NODES[1 - own], &at[1 - own].to_string())
        };
        let left = node(&keys, "left", network(0)).start().await.expect("it starts");
        let right = node(&keys, "right", network(1)).start().await.expect("it starts");
        assert!(left.connected("right", PATIENCE).await);

        let mut held = Vec::new();
        for number in 1..=REQUESTS {
            let mut stream = claim(at[1].port(), at[0]).await.expect("it is taken");
            // A hello in its name, and what is no frame.
            let hello = hello("right", u64::MAX / 2, number);
            let _ = stream.write_all(&(hello.len() as u32).to_be_bytes()).await;
            let _ = stream.write_all(&hello).await;
            let _ = stream.write_all(&[0xff; 100]).await;
            held.push(stream);
            assert_eq!(ask(&left, "right").await, number);
        }

        assert!(is_up(&left).await);
        accuses_no_node(&left).await;
        // None of them gets an answer but the preamble, and each is closed.
        for mut stream in held {
            let mut heard = Vec::new();
            // An end and a reset are the same here.
            let read = tokio::time::timeout(PATIENCE, stream.read_to_end(&mut heard)).await;
            assert!(read.is_ok() && heard.len() <= 8, "{heard:?}");
        }
        end([left, right]).await;
    });
}

#[test]
fn a_key_that_two_computers_have_is_a_fault_and_the_first_keeps_its_link() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &NODES, 1);
        let at = free_addresses(3);
        let network = |own: usize, peer: usize| {
            let lan = Network::new("lan", &format!("udp://{}", at[own]));
            lan.peer(NODES[peer], &at[peer].to_string())
        };
        let left = node(&keys, "left", network(0, 1)).start().await.expect("it starts");
        let right = node(&keys, "right", network(1, 0)).start().await.expect("it starts");
        assert!(left.connected("right", PATIENCE).await);
        let known = left.links().await[0].neighbour.clone().expect("it is up");

        // A copy of the right node's disk.
        let copy = node(&keys, "right", network(2, 0)).start().await.expect("it starts");

        until(async || copy.state() == NodeState::Stopped, "the copy stops").await;
        let told = async || {
            let mut entries = left.faults().await.entries.into_iter();
            entries.any(|entry| entry.stands() && entry.fault.kind == FaultKind::NameTaken)
        };
        until(told, "the left node tells it").await;
        assert_eq!(ask(&left, "right").await, 1);
        assert_eq!(left.links().await[0].neighbour, Some(known));
        until(async || !told().await, "it is over when the copy is gone").await;
        end([left, right]).await;
    });
}
