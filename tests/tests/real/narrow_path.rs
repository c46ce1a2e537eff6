//! A path that drops large datagrams and says nothing, as a VPN does, between two nodes on real
//! sockets.
//!
//! ```text
//!   left ── UDP of 1,472 bytes ── a relay that drops what is larger ── UDP of 1,472 bytes ── right
//! ```

use blastema::Network;
use blastema::prelude::*;
use blastema_tests::{PATIENCE, RobotKeys, free_addresses, serves, until};
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::SeqCst;
use std::thread;

const NODES: [&str; 2] = ["left", "right"];

/// Replies with how many bytes have come in all.
#[derive(Clone, Debug, Request)]
#[contract(name = "narrow/store", reply = u64, max_size = 200_000)]
struct Store(Vec<u8>);

/// Passes on what comes from each node to the other, in datagrams of so many bytes at most. Returns
/// where each node finds the other.
fn relay(nodes: [SocketAddr; 2], carries: &Arc<AtomicUsize>) -> [SocketAddr; 2] {
    let sockets = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").expect("a free port"));
    let ends = [0, 1].map(|end: usize| sockets[end].local_addr().expect("it is bound"));
    for end in 0..2 {
        let (from, out) = (sockets[end].try_clone(), sockets[1 - end].try_clone());
        let (from, out) = (from.expect("a socket"), out.expect("a socket"));
        let carries = carries.clone();
        thread::spawn(move || {
            let mut bytes = [0; 65_536];
            while let Ok((length, _)) = from.recv_from(&mut bytes) {
                if length <= carries.load(SeqCst) {
                    let _ = out.send_to(&bytes[..length], nodes[1 - end]);
                }
            }
        });
    }
    ends
}

/// A node that listens beyond this computer, where paths may drop what an Ethernet frame carries.
async fn node(keys: &RobotKeys, own: usize, port: u16, other: SocketAddr) -> Node {
    let network = Network::new("vpn", &format!("udp://0.0.0.0:{port}"));
    let shelf = serves("shelf", 0, |stored, Store(bytes), _| {
        *stored += bytes.len() as u64;
        *stored
    });
    Node::builder(NODES[own])
        .keys(keys.of(NODES[own]))
        .network(network.peer(NODES[1 - own], &other.to_string()))
        .child(shelf)
        .start()
        .await
        .expect("it starts")
}

/// Has requests of so many bytes answered, one after the other, and none of them twice. A session
/// that ends fails the request.
async fn store(from: &Node, to: &str, bytes: usize, count: usize, stored: &mut u64) {
    let shelf = from.sender::<Store>(&format!("{to}:shelf")).expect("a name");
    for _ in 0..count {
        *stored += bytes as u64;
        let answer = shelf.ask_within(Store(vec![7; bytes]), PATIENCE).await;
        assert_eq!(answer.ok(), Some(*stored), "{bytes} bytes to {to}");
    }
}

/// What is said of the link, while it is degraded.
async fn fault(node: &Node) -> Option<String> {
    let entries = node.faults().await.entries.into_iter();
    let mut standing = entries.filter(|entry| entry.repaired_at.is_none());
    let fault = standing.find(|entry| entry.fault.kind == FaultKind::LinkDegraded)?.fault;
    Some(format!("{} {}", fault.location, fault.detail))
}

async fn until_named(nodes: [&Node; 2], size: &str) {
    for node in nodes {
        let is_named = async || fault(node).await.is_some_and(|text| text.contains(size));
        until(is_named, size).await;
    }
}

#[test]
fn a_path_that_drops_large_datagrams_is_named_and_carries_large_messages() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &NODES, 1);
        let at: [SocketAddr; 2] = free_addresses(2).try_into().expect("two");
        let carries = Arc::new(AtomicUsize::new(1_300));
        let ends = relay(at, &carries);
        let left = node(&keys, 0, at[0].port(), ends[0]).await;
        let right = node(&keys, 1, at[1].port(), ends[1]).await;
        assert!(left.connected("right", PATIENCE).await && right.connected("left", PATIENCE).await);
        let (mut there, mut back) = (0, 0);

        // Before the path is known, and after.
        store(&left, "right", 3_000, 1, &mut there).await;
        until_named([&left, &right], "mtu=1293").await;
        let text = fault(&left).await.expect("it stands");
        for part in ["left -vpn- right", "1472 bytes", &ends[0].to_string()] {
            assert!(text.contains(part), "{part}: {text}");
        }
        store(&left, "right", 3_000, 100, &mut there).await;
        store(&right, "left", 100_000, 5, &mut back).await;

        // It becomes smaller while it is used.
        carries.store(1_250, SeqCst);
        store(&left, "right", 3_000, 100, &mut there).await;
        store(&right, "left", 100_000, 5, &mut back).await;
        until_named([&left, &right], "mtu=1246").await;

        for node in [&left, &right] {
            let is_less_the_seal = async || node.routes().await[0].mtu == 1_246 - 24;
            until(is_less_the_seal, "the route carries what the path does, less the seal").await;
            assert_eq!(node.dead_letters().counts(), []);
            let entries = node.faults().await.entries;
            let others = entries.iter().filter(|entry| entry.fault.kind != FaultKind::LinkDegraded);
            assert_eq!(others.count(), 0, "{entries:?}");
        }
        left.shutdown().await;
        right.shutdown().await;
    });
}
