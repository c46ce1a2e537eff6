//! A component says that it is in error.

use crate::scenarios::puppet::{Deed, Pull, Strings, ask, incarnation};
use blastema::core::detection::FaultRecord;
use blastema::prelude::*;
use blastema::{Incarnation, Lifecycle, Severity};
use blastema_testkit::TestNode;
use std::time::Duration;

async fn node_of(strings: &Strings) -> TestNode {
    TestNode::start(Node::builder("module1").child(strings.spec("arm").rate_hz(100.0))).await
}

async fn fail(node: &TestNode, why: &str) {
    ask(node, "arm", Deed::Fail(why.into())).await.expect("it answers before it fails");
}

/// What was decided last about each fault, in the order in which they were found.
fn decided(record: &FaultRecord) -> Vec<&str> {
    let action = |entry: &blastema::core::detection::FaultEntry| entry.decided.is_some();
    assert!(record.entries.iter().all(action), "{record:?}");
    record.entries.iter().filter_map(|e| e.decided.as_ref()).map(|(_, m)| m.as_str()).collect()
}

#[blastema_testkit::test]
async fn an_error_is_reset_within_the_same_incarnation() {
    let strings = Strings::default();
    let mut node = node_of(&strings).await;
    strings.diary();

    fail(&node, "the gripper slips").await;
    let fault = node.await_fault(FaultKind::ErrorState, "arm").await;
    node.await_recovered(FaultKind::ErrorState, "arm").await;

    assert_eq!((fault.detail.as_str(), fault.incarnation), ("the gripper slips", Incarnation(1)));
    let hooks = ["arm#1 on_aborting", "arm#1 on_error", "arm#1 on_reset", "arm#1 on_activated"];
    assert_eq!(strings.diary(), hooks);
    assert_eq!(incarnation(&node, "arm").await, 1);
    assert_eq!(decided(&node.faults().await), ["reset"]);
    assert_eq!(node.row("arm").await.state, Some(Lifecycle::Active));
}

#[blastema_testkit::test]
async fn an_error_that_comes_back_climbs_the_ladder_to_a_restart() {
    let strings = Strings::default();
    let mut node = node_of(&strings).await;

    for _ in 0..2 {
        fail(&node, "it slips again").await;
        node.await_recovered(FaultKind::ErrorState, "arm").await;
        node.advance(Duration::from_secs(1)).await;
    }

    assert_eq!(decided(&node.faults().await), ["reset", "restart"]);
    assert_eq!(incarnation(&node, "arm").await, 2);

    // Long after, it is treated from the beginning.
    node.advance(Duration::from_secs(60)).await;
    fail(&node, "it slips").await;
    node.await_recovered(FaultKind::ErrorState, "arm").await;
    assert_eq!(decided(&node.faults().await), ["reset", "restart", "reset"]);
}

#[blastema_testkit::test]
async fn a_reset_that_fails_is_followed_by_a_restart() {
    let strings = Strings::default();
    let mut node = node_of(&strings).await;
    strings.pull("arm", "on_reset", Pull::Fail("it is bent"));
    strings.diary();

    fail(&node, "the gripper slips").await;
    node.await_recovered(FaultKind::ErrorState, "arm").await;

    assert_eq!(incarnation(&node, "arm").await, 2);
    let finalized = strings.diary().iter().position(|line| line == "arm#1 on_finalize");
    assert!(finalized.is_some(), "the old incarnation had its last word");
    let record = node.faults().await;
    assert_eq!(decided(&record)[0], "restart");
    let ended = |e: &blastema::core::detection::FaultEntry| e.recovered_at.is_some();
    assert!(record.entries.iter().all(ended), "{record:?}");
}

#[blastema_testkit::test]
async fn a_fatal_failure_is_answered_by_a_new_incarnation() {
    let strings = Strings::default();
    let mut node = node_of(&strings).await;

    ask(&node, "arm", Deed::FailFatally("it burns".into())).await.unwrap();
    let fault = node.await_fault(FaultKind::Fatal, "arm").await;
    node.await_recovered(FaultKind::Fatal, "arm").await;

    assert_eq!((fault.detail.as_str(), fault.severity), ("it burns", Severity::Critical));
    assert_eq!(incarnation(&node, "arm").await, 2);
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn the_health_of_a_node_shows_what_stands_and_what_was_recovered() {
    let strings = Strings::default();
    let mut node = node_of(&strings).await;
    let health = node.health().await;
    assert!(health.is_well() && health.last_recovery.is_none(), "{health:?}");

    fail(&node, "the gripper slips").await;
    node.await_recovered(FaultKind::ErrorState, "arm").await;
    let health = node.health().await;
    assert!(health.is_well() && health.degraded.is_empty(), "{health:?}");
    let last = health.last_recovery.expect("the arm was reset");
    assert_eq!((last.part.as_str(), last.action.as_deref()), ("module1:arm", Some("reset")));

    node.advance(Duration::from_secs(60)).await;
    ask(&node, "arm", Deed::Check(7.5)).await.unwrap();
    node.await_fault(FaultKind::CheckFailed, "arm").await;
    node.advance(Duration::from_millis(250)).await;
    let health = node.health().await;
    assert!(health.is_well(), "a warning stands, and service goes on: {health:?}");
    let shown = serde_json::to_value(&health).expect("it serializes");
    assert_eq!(shown["node"], "module1");
    assert_eq!(shown["state"], "running");
    assert_eq!(shown["faults"], serde_json::json!({"critical": 0, "error": 0, "warning": 1}));
    let arm = &shown["degraded"][0];
    assert_eq!((&arm["part"], &arm["severity"]), (&"module1:arm".into(), &"warning".into()));
    assert_eq!(arm["fault"], "check failed: the value is 7.5, outside of 0.0..=1.0");
    assert_eq!(shown["last_recovery"]["fault"], "error state");

    ask(&node, "arm", Deed::FailFatally("the motor burns".into())).await.unwrap();
    node.shutdown().await;
    assert!(!node.health().await.is_well(), "a node that was shut down is not well");
}
