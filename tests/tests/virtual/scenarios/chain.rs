//! Faults in the middleware itself, as far as an application can provoke them.

use crate::scenarios::puppet::{Deed, Strings, ask, incarnation, strike};
use blastema::prelude::*;
use blastema_testkit::TestNode;
use std::time::Duration;

#[blastema_testkit::test]
async fn the_chain_shows_itself_and_forgets_a_reader_of_fault_events_that_goes_away() {
    let (_, mut node) = Strings::robot(["laser"]).await;
    drop(node.fault_events());
    for name in ["chain/detection", "chain/recoverer", "root"] {
        assert_eq!(node.row(name).await.restarts, 0, "{name}");
    }

    for _ in 0..3 {
        strike(&node, "laser").await;
        node.await_recovered(FaultKind::Panic, "laser").await;
    }

    assert_eq!(incarnation(&node, "laser").await, 4);
}

#[blastema_testkit::test]
async fn a_reader_that_never_reads_loses_events_and_is_told_how_many() {
    let strings = Strings::default();
    let plan = Plan::default().on(FaultKind::CheckFailed, Ladder::first(RecoveryAction::Restart));
    let builder = Node::builder("module1")
        .plan(plan)
        .intensity(1000, Duration::from_secs(10))
        .child(strings.spec("laser"));
    let node = TestNode::start(builder).await;
    let slow = node.fault_events();

    for _ in 0..600 {
        let _ = ask(&node, "laser", Deed::Panic("again".into())).await;
        node.settle().await;
    }

    assert!(slow.missed() > 0);
    assert_eq!(incarnation(&node, "laser").await, 601);
    let record = node.faults().await;
    assert!(record.entries.len() + usize::try_from(record.dropped).unwrap() == 600);
}

#[blastema_testkit::test]
async fn safe_outputs_that_panic_do_not_keep_the_node_from_its_rest() {
    let strings = Strings::default();
    let builder = Node::builder("module1")
        .intensity(1, Duration::from_secs(10))
        .when_exceeded(WhenExceeded::Escalate)
        .safe_outputs(|_| panic!("no brakes"))
        .child(strings.spec("laser"));
    let node = TestNode::start(builder).await;

    strike(&node, "laser").await;
    strike(&node, "laser").await;

    assert!(matches!(node.ended().await, NodeState::InSafeState { .. }));
}
