//! Nodes that find each other without being described to each other, on real sockets.

use blastema::prelude::*;
use blastema::{Fault, Network, NodeBuilder};
use blastema_tests::{PATIENCE, free_addresses, next_fault, serves};
use std::net::{SocketAddr, UdpSocket};
use std::sync::mpsc::{self, RecvTimeoutError, channel};
use std::time::Duration;

/// Adds one, and answers the sum.
#[derive(Clone, Debug, Request)]
#[contract(name = "sum/add", reply = u32, idempotent)]
struct Add(u32);

fn free() -> [SocketAddr; 3] {
    free_addresses(3).try_into().expect("three")
}

async fn start(node: NodeBuilder) -> Node {
    let sum = serves("sum", 0, |sum, Add(number), _| {
        *sum += number;
        *sum
    });
    node.child(sum).start().await.expect("it starts")
}

async fn add(node: &Node, to: &str) -> u32 {
    let sum: Sender<Add> = node.sender(to).expect("a name");
    sum.ask_within(Add(1), PATIENCE).await.expect("it is answered")
}

#[test]
fn nodes_that_know_nobody_find_each_other_by_beacons() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let [a, b, group] = free();
        let group = format!("239.255.77.9:{}", group.port());
        let network =
            |medium: &str, own: SocketAddr| Network::new("ethernet", &format!("{medium}://{own}"));
        let one = network("tcp", a).discover(&group, ["module2"]);
        let two = network("tcp", b).discover_all(&group);
        let one = start(Node::builder("module1").network(one)).await;
        let two = start(Node::builder("module2").network(two)).await;

        assert!(one.connected("module2", PATIENCE).await, "{:?}", one.links().await);
        assert_eq!(add(&one, "module2:sum").await, 1);
        one.shutdown().await;
        two.shutdown().await;
    });
}

#[test]
fn a_flood_of_forged_beacons_is_a_fault_and_harms_nobody() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let [a, b, group] = free();
        let group = SocketAddr::from(([239, 255, 77, 10], group.port()));
        let network = |own: SocketAddr| {
            let network = Network::new("ethernet", &format!("udp://{own}"));
            network.discover_all(&group.to_string())
        };
        let one = start(Node::builder("module1").network(network(a))).await;
        let two = start(Node::builder("module2").network(network(b))).await;
        assert!(one.connected("module2", PATIENCE).await);

        let mut faults = one.fault_events();
        let liar = Liar::start(group);
        let is_here = |fault: &Fault| fault.location.to_string() == "module1:net/links/ethernet";
        let fault = next_fault(&mut faults, is_here, "it is named").await;
        drop(liar);
        assert_eq!(fault.kind, FaultKind::CheckFailed);
        assert!(fault.detail.contains("by beacons"), "{}", fault.detail);

        assert!(one.links().await.len() <= 32);
        assert_eq!(add(&one, "module2:sum").await, 1);
        one.shutdown().await;
        two.shutdown().await;
    });
}

/// Says on a thread of its own, until it is dropped, that ever new nodes are at its address.
struct Liar {
    _over: mpsc::Sender<()>,
}

impl Liar {
    fn start(group: SocketAddr) -> Self {
        let (over, told) = channel();
        std::thread::spawn(move || {
            // From the interface on which the nodes listen.
            let socket = UdpSocket::bind("127.0.0.1:0").expect("a free port");
            let mut n = 0_u32;
            while told.recv_timeout(Duration::from_millis(1)) == Err(RecvTimeoutError::Timeout) {
                n += 1;
                let beacon = [b"BLB\x01\x00\x09liar".to_vec(), n.to_string().into()].concat();
                // A buffer that is full now is empty a little later.
                let _ = socket.send_to(&beacon, group);
            }
        });
        Liar { _over: over }
    }
}
