//! A node that is isolated: refused by the node that decides so, and by no other; in virtual time.

use crate::scenarios::puppet::{Deed, Do, Strings, ask};
use blastema::prelude::*;
use blastema::{IsolateError, MemoryMedium, NodeBuilder};
use blastema_testkit::TestNode;
use blastema_tests::{MS, meshed, plug_cable, pull_cable};

const NODES: [&str; 3] = ["module1", "module2", "module3"];

fn node(own: &str, medium: &MemoryMedium) -> NodeBuilder {
    meshed(own, &NODES, medium, 50 * MS)
}

struct Robot {
    nodes: Vec<TestNode>,
}

impl Robot {
    /// With a puppet on each node: `puppet1` on `module1`, and so on.
    async fn start(strings: &Strings) -> Self {
        Robot::of(strings, node).await
    }

    async fn of(strings: &Strings, node: impl Fn(&str, &MemoryMedium) -> NodeBuilder) -> Self {
        let medium = MemoryMedium::default();
        let mut nodes = vec![];
        for (own, puppet) in NODES.iter().zip(["puppet1", "puppet2", "puppet3"]) {
            let puppet = strings.spec(puppet);
            nodes.push(TestNode::start(node(own, &medium).child(puppet)).await);
        }
        nodes[0].advance(2000 * MS).await;
        Robot { nodes }
    }

    /// The node of this number asks the puppet of the other.
    async fn asks(&self, from: usize, to: usize) -> Result<u64, DeliveryError> {
        let name = format!("module{to}:puppet{to}");
        ask(&self.nodes[from - 1], &name, Deed::Nothing).await.map_err(|error| error.kind)
    }
}

/// The answer to a request to this node while it is isolated.
fn isolated(node: &str) -> Result<u64, DeliveryError> {
    Err(DeliveryError::isolated(node))
}

#[blastema_testkit::test]
async fn an_isolated_node_is_refused_by_the_node_that_decides_so_and_by_no_other() {
    let strings = Strings::default();
    let robot = Robot::start(&strings).await;
    assert_eq!(robot.asks(3, 1).await, Ok(1));

    robot.nodes[0].isolate("module3").unwrap();
    robot.nodes[0].isolate("module3").unwrap();
    robot.nodes[0].advance(3000 * MS).await;

    assert_eq!(robot.asks(1, 3).await, isolated("module3"));
    let refused = robot.asks(3, 1).await;
    assert!(refused.is_err(), "{refused:?}");
    ask(&robot.nodes[2], "puppet3", Deed::Publish(7)).await.unwrap();
    robot.nodes[0].advance(100 * MS).await;
    let mut listeners = strings.lines("news 7");
    listeners.sort();
    assert_eq!(listeners, ["puppet2#1 news 7", "puppet3#1 news 7"]);
    assert_eq!(robot.asks(1, 2).await, Ok(1), "the others are well");
    assert_eq!((robot.asks(2, 3).await, robot.asks(3, 2).await), (Ok(1), Ok(1)));

    robot.nodes[0].admit("module3").unwrap();
    robot.nodes[0].advance(3000 * MS).await;
    assert_eq!((robot.asks(1, 3).await, robot.asks(3, 1).await), (Ok(1), Ok(1)));
}

#[blastema_testkit::test]
async fn only_others_that_are_known_are_isolated_and_a_slip_of_the_pen_is_told() {
    let strings = Strings::default();
    let robot = Robot::start(&strings).await;
    let node = &robot.nodes[0];

    let oneself = node.isolate("module1").expect_err("it has no say on itself");
    assert!(matches!(oneself, IsolateError::Oneself { .. }), "{oneself}");
    let misspelt = node.isolate("modul3").expect_err("no node is called so");
    assert!(misspelt.to_string().ends_with("it knows module2, module3"), "{misspelt}");
    let unlike = node.admit("gripper").expect_err("no node is called so");
    assert!(unlike.to_string().contains("it knows module2, module3"), "{unlike}");
    let wrong = node.isolate("module 3").expect_err("it is no name");
    assert!(matches!(wrong, IsolateError::Name(_)), "{wrong}");

    node.advance(1000 * MS).await;
    assert_eq!(robot.asks(1, 3).await, Ok(1), "no node was isolated");
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn what_was_under_way_with_an_isolated_node_is_resolved() {
    let strings = Strings::default();
    let robot = Robot::start(&strings).await;
    let puppet = robot.nodes[0].sender::<Do>("module3:puppet3").unwrap();
    let asking = puppet.ask_within(Do(Deed::Await(60_000)), 100_000 * MS);
    let isolate = async {
        robot.nodes[0].advance(100 * MS).await;
        robot.nodes[0].isolate("module3").unwrap();
        robot.nodes[0].advance(100 * MS).await;
    };
    let (asked, ()) = tokio::join!(asking, isolate);
    let why = asked.expect_err("the node is isolated").kind;
    assert!(
        matches!(why, DeliveryError::Isolated { .. } | DeliveryError::OutcomeUnknown { .. }),
        "{why}"
    );
}

#[blastema_testkit::test]
async fn who_is_isolated_stands_in_the_fault_list_with_the_cause_until_it_is_admitted() {
    let strings = Strings::default();
    let robot = Robot::start(&strings).await;
    let node = &robot.nodes[0];
    node.isolate("module3").unwrap();
    node.advance(1000 * MS).await;

    let record = node.faults().await;
    let [entry] = &record.entries[..] else {
        panic!("that it cannot be reached is no second fault")
    };
    assert_eq!(entry.fault.kind, FaultKind::NodeFaulty);
    assert_eq!(entry.fault.location.to_string(), "module3");
    assert!(entry.fault.detail.contains("the application says so"), "{}", entry.fault.detail);
    let contained = entry.given_up.as_ref().is_some_and(|(_, reason)| reason.contains("isolate"));
    assert!(contained, "{entry:?}");
    let table = node.table().await;
    assert!(table.iter().any(|row| row.location == entry.fault.location && row.isolated));
    robot.nodes[1].expect_no_faults().await;

    let puppet = robot.nodes[0].sender::<Do>("module2:puppet2").unwrap();
    let asking = puppet.ask_within(Do(Deed::Await(2000)), 10_000 * MS);
    let admit = async {
        robot.nodes[0].advance(100 * MS).await;
        robot.nodes[0].admit("module3").unwrap();
        robot.nodes[0].advance(3000 * MS).await;
    };
    let (asked, ()) = tokio::join!(asking, admit);
    asked.expect("the session between the others has gone on");
    let record = node.faults().await;
    assert!(record.entries.iter().all(|entry| !entry.stands() && entry.recovered_at.is_none()));
}

#[blastema_testkit::test]
async fn a_strategy_isolates_a_node_whose_ladder_says_so_and_its_return_changes_nothing() {
    let strings = Strings::default();
    let plan = || Plan::default().on(FaultKind::NodeLost, Ladder::first(RecoveryAction::Isolate));
    let robot = Robot::of(&strings, |own, medium| node(own, medium).plan(plan())).await;
    pull_cable(&robot.nodes[2]);
    robot.nodes[0].advance(5000 * MS).await;
    plug_cable(&robot.nodes[2]);
    robot.nodes[0].advance(5000 * MS).await;

    assert_eq!(robot.asks(1, 2).await, Ok(1));
    for own in [1, 2] {
        assert_eq!(robot.asks(own, 3).await, isolated("module3"));
        let reason = robot.nodes[own - 1].faults().await;
        assert!(format!("{reason:?}").contains("node lost"), "the cause is told");
    }
}
