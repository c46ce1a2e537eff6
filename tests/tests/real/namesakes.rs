//! Two nodes of one name on one network, on real sockets.
//!
//! ```text
//!   arm ───── base ───── head ───── arm (another)
//! ```

use blastema::prelude::*;
use blastema::{Fault, FaultEvents, LinkState, Network, NodeBuilder};
use blastema_tests::{
    PATIENCE, Part, Process, RobotKeys, addresses, found, free_addresses, next_fault, role, serves,
    until,
};
use std::fs::File;
use std::net::SocketAddr;
use std::path::Path;

/// Adds one, and answers the sum.
#[derive(Clone, Debug, Request)]
#[contract(name = "sum/add", reply = u32)]
struct Add(u32);

/// Begins with this sum.
fn sum(first: u32) -> ChildSpec<Part<u32, Add>> {
    serves("sum", first, |sum, Add(number), _| {
        *sum += number;
        *sum
    })
}

fn free<const N: usize>() -> [SocketAddr; N] {
    free_addresses(N).try_into().expect("so many")
}

fn node(name: &str, own: SocketAddr, peers: &[(&str, SocketAddr)]) -> NodeBuilder {
    let mut network = Network::new("ethernet", &format!("udp://{own}"));
    for (name, address) in peers {
        network = network.peer(name, &address.to_string());
    }
    Node::builder(name).network(network)
}

async fn start_arm(own: SocketAddr, beside: (&str, SocketAddr), sum: u32) -> Node {
    let arm = node("arm", own, &[beside]).child(self::sum(sum));
    arm.start().await.expect("the arm starts")
}

async fn taken(mut faults: FaultEvents) -> Fault {
    next_fault(&mut faults, |fault| fault.kind == FaultKind::NameTaken, "the fault is found").await
}

/// Asks this sender until there is an answer.
async fn first_answer(sum: &Sender<Add>) -> u32 {
    found(async || sum.ask_within(Add(1), PATIENCE).await.ok(), "an answer").await
}

#[test]
fn a_second_node_of_a_name_stops_and_the_first_ones_traffic_is_unharmed() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let [arm, base, head, other] = free::<4>();
        let middle = node("base", base, &[("arm", arm), ("head", head)]);
        let middle = middle.start().await.expect("the base starts");
        let far = node("head", head, &[("base", base), ("arm", other)]);
        let far = far.start().await.expect("the head starts");
        let first = start_arm(arm, ("base", base), 0).await;
        assert!(far.connected("arm", PATIENCE).await && middle.connected("arm", PATIENCE).await);
        let sum: Sender<Add> = far.sender("arm:sum").expect("a name");
        let mut expected = 0;
        let mut add = async || {
            expected += 1;
            // Each is answered, by the same arm as the one before: nothing is asked again.
            let answer = sum.ask_within(Add(1), PATIENCE).await;
            assert_eq!(answer.expect("it is answered"), expected);
        };
        add().await;

        let of_far = far.fault_events();
        let second = start_arm(other, ("head", head), 1_000).await;
        let stops = async || {
            add().await;
            second.state() == NodeState::Stopped
        };
        until(stops, "the second stops").await;
        let of_far = taken(of_far).await;
        for _ in 0..100 {
            add().await;
        }

        assert_eq!(of_far.location.to_string(), "head:net/stack");
        let parts = [
            format!("has come up at {other}"),
            "reached at an address that is not known".to_owned(),
            "told to stop; end one of them".to_owned(),
        ];
        assert!(parts.iter().all(|part| of_far.detail.contains(part)), "{}", of_far.detail);
        assert_eq!(first.state(), NodeState::Running);
        drop((first, second));

        // When the first has gone, the next one is the arm.
        let next = start_arm(other, ("head", head), 1_000).await;
        assert_eq!(first_answer(&sum).await, 1_001);
        for node in [next, far, middle] {
            node.shutdown().await;
        }
    });
}

/// The base is on two networks, the arm on one of them, and a second arm on the other.
async fn second_on_the_other_network(keys: Option<&RobotKeys>) {
    let [on_ethernet, on_wifi, arm, other] = free::<4>();
    let with_keys = |name: &str| match keys {
        Some(keys) => Node::builder(name).keys(keys.of(name)),
        None => Node::builder(name),
    };
    let network = |name: &str, own: SocketAddr, peer: &str, at: SocketAddr| {
        Network::new(name, &format!("udp://{own}")).peer(peer, &at.to_string())
    };
    let base = with_keys("base").network(network("ethernet", on_ethernet, "arm", arm));
    let base = base.network(network("wifi", on_wifi, "arm", other));
    let base = base.start().await.expect("the base starts");
    let start_arm = async |network: Network, sum: u32| {
        let arm = with_keys("arm").network(network).child(self::sum(sum));
        arm.start().await.expect("an arm starts")
    };
    let first = start_arm(network("ethernet", arm, "base", on_ethernet), 0).await;
    assert!(base.connected("arm", PATIENCE).await);
    let sum: Sender<Add> = base.sender("arm:sum").expect("a name");
    let mut expected = 0;
    let mut add = async || {
        expected += 1;
        // Each is answered, by the same arm as the one before.
        assert_eq!(sum.ask_within(Add(1), PATIENCE).await.expect("it is answered"), expected);
    };
    add().await;

    let of_base = base.fault_events();
    let second = start_arm(network("wifi", other, "base", on_wifi), 1_000).await;
    let stops = async || {
        add().await;
        second.state() == NodeState::Stopped
    };
    until(stops, "the second stops").await;
    let of_base = taken(of_base).await;
    for _ in 0..100 {
        add().await;
    }
    for part in [arm.to_string(), other.to_string()] {
        assert!(of_base.detail.contains(&part), "{}", of_base.detail);
    }
    assert_eq!(first.state(), NodeState::Running);
    drop((first, second));

    let next = start_arm(network("wifi", other, "base", on_wifi), 1_000).await;
    assert_eq!(first_answer(&sum).await, 1_001);
    for node in [next, base] {
        node.shutdown().await;
    }
}

#[test]
fn a_second_node_on_the_other_of_two_networks_takes_no_request_from_the_first() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &["base", "arm"], 1);
        for keys in [None, Some(&keys)] {
            second_on_the_other_network(keys).await;
        }
    });
}

/// Is an arm: with the address of the base, its own, and the file of its keys, if it has any.
#[test]
fn a_process_plays_its_role() {
    let Some(scheme) = role() else { return };
    let at = addresses::<String>();
    blastema::run(async {
        let mut arm = Node::builder("arm").work_threads(1).child(sum(0));
        if !at[2].is_empty() {
            arm = arm.keys(&at[2]);
        }
        let network = Network::new("lan", &format!("{scheme}://{}", at[1])).peer("base", &at[0]);
        let arm = arm.network(network).start().await.expect("it starts");
        arm.run_until_signal().await.expect("the system tells of signals");
    });
}

/// A second arm has the name while the first is stopped; the base has a network with each.
async fn first_is_stopped_for_a_while(scheme: &str, folder: &Path, keys: Option<&RobotKeys>) {
    let at: [String; 4] = match scheme {
        "unix" => [0, 1, 2, 3].map(|end| folder.join(end.to_string()).display().to_string()),
        _ => free_addresses(4)
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>()
            .try_into()
            .unwrap(),
    };
    let [on_one, on_two, first, second] = &at;
    let mut base = Node::builder("base");
    if let Some(keys) = keys {
        base = base.keys(keys.of("base"));
    }
    for (name, own, arm) in [("one", on_one, first), ("two", on_two, second)] {
        base = base.network(Network::new(name, &format!("{scheme}://{own}")).peer("arm", arm));
    }
    let base = base.start().await.expect("the base starts");
    let key = keys.map(|keys| keys.of("arm").display().to_string()).unwrap_or_default();
    let errors = folder.join("errors");
    let start = |on: &String, own: &String| {
        let errors = File::create(&errors).expect("a folder");
        Process::start_into(errors, module_path!(), scheme, &[on.clone(), own.clone(), key.clone()])
    };
    let mut stopped = start(on_one, first);
    assert!(base.connected("arm", PATIENCE).await, "{scheme}");
    let sum: Sender<Add> = base.sender("arm:sum").expect("a name");
    assert_eq!(first_answer(&sum).await, 1);

    stopped.signal("-STOP");
    let is_up = async |link: usize| base.links().await[link].state == LinkState::Up;
    until(async || !is_up(0).await, "the base finds it silent").await;
    std::fs::rename(&errors, folder.join("first")).expect("it was made");
    let mut other = start(on_two, second);
    until(async || is_up(1).await, "the other is there").await;
    let mut expected = first_answer(&sum).await;
    assert_eq!(expected, 1, "{scheme}: it is the other that serves");
    stopped.signal("-CONT");
    let mut status = None;
    let ends = async || {
        expected += 1;
        let answer = sum.ask_within(Add(1), PATIENCE).await;
        assert_eq!(answer.expect("it is answered"), expected);
        status = stopped.exit_status();
        status.is_some()
    };
    until(ends, "the first stops").await;

    let text = std::fs::read_to_string(folder.join("first")).expect("it was made");
    assert_eq!(status, Some(3), "{scheme}: {text}");
    for part in [first, second, "base reaches another process called arm"] {
        assert!(text.contains(part), "{scheme}: {part} is not in {text}");
    }
    assert_eq!(other.exit_status(), None, "{scheme}");
    base.shutdown().await;
}

#[test]
fn a_process_that_was_stopped_while_another_took_its_name_is_the_one_that_stops() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        for scheme in ["udp", "tcp", "unix"] {
            let folder = tempfile::tempdir().expect("a folder");
            let keys = RobotKeys::new(folder.path(), &["base", "arm"], 1);
            for keys in [None, Some(&keys)] {
                first_is_stopped_for_a_while(scheme, folder.path(), keys).await;
            }
        }
    });
}

#[test]
fn neighbours_of_one_name_are_told_so_until_one_is_called_otherwise() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let [left, right] = free::<2>();
        let start = async |name, own, far| {
            let mut builder = node(name, own, &[("base", far)]);
            let faults = builder.fault_events();
            (builder.start().await.expect("it starts"), faults)
        };
        let (arm, of_arm) = start("arm", left, right).await;
        let (other, of_other) = start("arm", right, left).await;

        let faults = [taken(of_arm).await, taken(of_other).await];

        for fault in faults {
            assert_eq!(fault.location.to_string(), "arm:net/links/ethernet");
            assert!(fault.detail.contains("also called arm"), "{}", fault.detail);
        }
        other.shutdown().await;
        let base = node("base", right, &[("arm", left)]).start().await.expect("it starts");
        assert!(arm.connected("base", PATIENCE).await);
        let stands = async || arm.faults().await.entries.iter().any(|entry| entry.stands());
        until(async || !stands().await, "all is as it should be").await;
        for node in [arm, base] {
            node.shutdown().await;
        }
    });
}

#[test]
fn a_node_that_begins_anew_is_the_same_node_and_no_dispute() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let [arm, base] = free::<2>();
        let middle = node("base", base, &[("arm", arm)]).start().await.expect("the base starts");
        drop(start_arm(arm, ("base", base), 0).await);
        for incarnation in 1..=2 {
            let again = start_arm(arm, ("base", base), incarnation * 100).await;
            let sum: Sender<Add> = middle.sender("arm:sum").expect("a name");
            let is_new = async || {
                let answer = sum.ask_within(Add(1), PATIENCE).await;
                answer.is_ok_and(|answer| answer / 100 == incarnation)
            };
            until(is_new, "the new incarnation answers").await;
            for node in [&middle, &again] {
                let record = node.faults().await;
                let mut kinds = record.entries.into_iter().map(|entry| entry.fault.kind);
                assert!(kinds.all(|kind| kind != FaultKind::NameTaken));
            }
            drop(again);
        }
        middle.shutdown().await;
    });
}
