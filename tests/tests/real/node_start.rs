//! What a node that cannot start says, and what it leaves behind. Its threads are counted in a
//! process of its own, where no other test begins or ends one.

use blastema::prelude::*;
use blastema::{Network, NodeBuilder};
use blastema_tests::{Process, free_addresses, role};
use std::net::{SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

struct Lamp;
impl Component for Lamp {}

fn threads() -> usize {
    std::fs::read_dir("/proc/self/task").expect("Linux lists a process's threads").count()
}

/// Waits for threads that have been told to end; says how many are left.
async fn settled(at_most: usize) -> usize {
    let deadline = Instant::now() + Duration::from_secs(30);
    while threads() > at_most && Instant::now() < deadline {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    threads()
}

/// Waits until no socket of this process has the address.
async fn freed(at: SocketAddr) {
    let deadline = Instant::now() + Duration::from_secs(30);
    while let Err(error) = UdpSocket::bind(at) {
        assert!(Instant::now() < deadline, "{at}: {error}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Starts a node with a network and something wrong, in so many ways, on its own threads and here.
async fn fail_after_a_network(at: SocketAddr) {
    let beside = |network: Network| move |node: NodeBuilder| node.network(network);
    let local = || Network::udp("second", ([127, 0, 0, 1], 0).into());
    for here in [false, true] {
        let needy = ChildSpec::new("lamp", || Lamp).depends_on(["socket"]);
        let wrong: [Box<dyn FnOnce(NodeBuilder) -> NodeBuilder>; 5] = [
            Box::new(beside(Network::new("cable", "serial:///dev/ttyS0?buad=9600"))),
            Box::new(beside(local().peer("n", "nowhere"))),
            Box::new(beside(local().discover("127.0.0.1:7399", ["n"]))),
            Box::new(beside(local().discover("239.255.0.1:7399", ["a name"]))),
            Box::new(move |node| node.child(needy)),
        ];
        for (number, spoil) in wrong.into_iter().enumerate() {
            let node = Node::builder("m").network(Network::udp("lan", at));
            let node = if here { node.on_this_thread() } else { node };
            let started = spoil(node).start().await;
            assert!(started.is_err(), "{number}");
            freed(at).await;
        }
    }
}

#[test]
fn a_node_that_cannot_start_says_why_and_leaves_no_thread() {
    let _turn = blastema_doubles::turn();
    let mut process = Process::start(module_path!(), "counts threads", &[""; 0]);
    assert!(process.succeeds(), "its panic is above");
}

#[test]
fn hosts_have_names_which_a_start_looks_up_and_a_check_does_not() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let ports: Vec<u16> = free_addresses(2).iter().map(SocketAddr::port).collect();
        let node = |own: usize, peer: &str, at: &str| {
            let endpoint = format!("tcp://localhost:{}", ports[own]);
            let network = Network::new("lan", &endpoint).peer(peer, at);
            Node::builder(["left", "right"][own]).network(network)
        };
        let left = node(0, "right", &format!("localhost:{}", ports[1])).start().await;
        let right = node(1, "left", &format!("localhost:{}", ports[0])).start().await;
        let (left, right) = (left.expect("it starts"), right.expect("it starts"));
        assert!(left.connected("right", Duration::from_secs(60)).await, "{:?}", left.links().await);
        left.shutdown().await;
        right.shutdown().await;

        let unknown = || node(0, "right", "arm.invalid:7400");
        assert!(unknown().check().is_empty(), "{:?}", unknown().check());
        let error = unknown().start().await.expect_err("it is reserved for no host").to_string();
        let says = |words: &str| assert!(error.contains(words), "{error}");
        says("network lan: arm.invalid:7400 cannot be looked up");
        says("/etc/hosts");
        let itself = node(0, "right", &format!("localhost:{}", ports[0]));
        let error = itself.start().await.expect_err("it is itself").to_string();
        assert!(error.contains("our own address"), "{error}");
    });
}

#[test]
fn a_process_plays_its_role() {
    if role().is_none() {
        return;
    }
    blastema::run(async {
        let before = threads();

        let stranger = ChildSpec::new("lamp", || Lamp).depends_on(["socket"]);
        let error = Node::builder("m").child(stranger).start().await.expect_err("no such object");
        assert!(matches!(error, StartError::Dependency { .. }), "{error}");
        let narcissus = ChildSpec::new("lamp", || Lamp).depends_on(["m:lamp"]);
        let error = Node::builder("m").child(narcissus).start().await.expect_err("itself");
        assert!(error.to_string().contains("lamp -> lamp"), "{error}");
        let needs = |name, other| ChildSpec::new(name, || Lamp).depends_on([other]);
        let ring = Node::builder("m")
            .child(needs("a", "b"))
            .supervisor(SupervisorSpec::new("s", Strategy::OneForOne).child(needs("b", "m:c")))
            .child(needs("c", "a"));
        let error = ring.start().await.expect_err("each waits for the next");
        assert!(error.to_string().contains("a -> b -> c -> a"), "{error}");
        let twice = Node::builder("m")
            .child(ChildSpec::new("lamp", || Lamp))
            .child(ChildSpec::new("lamp", || Lamp));
        assert!(matches!(twice.start().await, Err(StartError::Spec(_))));
        let endless = ChildSpec::new("lamp", || Lamp).queue(usize::MAX, WhenFull::Refuse);
        assert!(matches!(
            Node::builder("m").child(endless).start().await,
            Err(StartError::Spec(_))
        ));
        let unseen = Node::builder("m")
            .child(ChildSpec::new("lamp", || Lamp))
            .inspection_socket("/no/m.window");
        assert!(matches!(
            unseen.start().await,
            Err(StartError::Setting { setting: "inspection_socket", .. })
        ));
        fail_after_a_network(free_addresses(1)[0]).await;
        assert!(settled(before).await <= before);

        for _ in 0..10 {
            let node = Node::builder("m")
                .child(ChildSpec::new("lamp", || Lamp).on_own_thread())
                .start()
                .await
                .expect("a lamp starts");
            node.shutdown().await;
        }
        assert!(settled(before).await <= before, "{} threads, {before} before", threads());
    });
}
