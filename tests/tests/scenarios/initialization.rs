//! A component does not come up.

use crate::puppet::{Pull, Strings, life, strike};
use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use blastema::{Fault, Incarnation, NodeBuilder};
use blastema_testkit::TestNode;
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[blastema_testkit::test]
async fn a_failed_initialisation_is_tried_again_and_the_node_comes_up() {
    let strings = Strings::default();
    strings.pull("camera", "on_initialize", Pull::Fail("no device"));
    let builder = Node::builder("module1").child(strings.spec("camera"));

    let mut node = TestNode::start(builder.child(strings.spec("eye"))).await;

    assert_eq!(node.state(), NodeState::Running);
    let fault = node.await_fault(FaultKind::InitializationFailed, "camera").await;
    node.await_recovered(FaultKind::InitializationFailed, "camera").await;
    assert_eq!((fault.detail.as_str(), fault.incarnation), ("no device", Incarnation(1)));
    assert_eq!((life(&node, "camera").await, life(&node, "eye").await), (2, 1));
    let eye = strings.diary().iter().position(|line| line == "eye#1 on_initialize");
    assert!(eye.is_some());
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn later_children_wait_until_the_one_before_them_is_at_work() {
    let strings = Strings::default();
    strings.pull("camera", "on_initialize", Pull::Fail("no device"));
    let builder = Node::builder("module1").child(strings.spec("camera"));

    TestNode::start(builder.child(strings.spec("eye"))).await;

    let diary = strings.diary();
    let at = |line: &str| diary.iter().position(|l| l == line).expect(line);
    assert!(at("camera#2 on_activated") < at("eye#1 on_initialize"), "{diary:?}");
}

#[blastema_testkit::test]
async fn every_way_of_not_coming_up_is_answered_by_a_new_life() {
    let day = Duration::from_secs(86_400);
    let cases = [
        ("on_initialize", Pull::Fatal("broken"), FaultKind::InitializationFailed),
        ("on_initialize", Pull::Panic("broken"), FaultKind::Panic),
        ("on_initialize", Pull::Wait(day), FaultKind::InitializationFailed),
        ("factory", Pull::Panic("broken"), FaultKind::Panic),
        ("on_startup", Pull::Fail("broken"), FaultKind::ErrorState),
        ("on_activated", Pull::Fail("broken"), FaultKind::ErrorState),
        ("on_activated", Pull::Wait(day), FaultKind::Fatal),
    ];
    for (hook, pull, kind) in cases {
        let strings = Strings::default();
        strings.pull("camera", hook, pull.clone());

        let mut node =
            TestNode::start(Node::builder("module1").child(strings.spec("camera"))).await;
        node.await_fault(kind.clone(), "camera").await;
        node.await_recovered(kind, "camera").await;

        assert_eq!(node.state(), NodeState::Running, "{hook} {pull:?}");
        assert!(life(&node, "camera").await <= 2, "{hook} {pull:?}");
        let tree = node.tree().await.unwrap();
        assert_eq!(tree.children[0].state, ChildState::Running, "{hook} {pull:?}");
    }
}

/// A node with wheels, and a camera that never comes up; and what its safe outputs were told.
fn hopeless(strings: &Strings) -> (NodeBuilder, Arc<Mutex<Vec<Fault>>>) {
    (0..99).for_each(|_| strings.pull("camera", "on_initialize", Pull::Fail("no device")));
    let rested: Arc<Mutex<Vec<Fault>>> = Arc::default();
    let outputs = rested.clone();
    let builder = Node::builder("module1")
        .safe_outputs(move |fault| outputs.lock().unwrap().push(fault.clone()))
        .child(strings.spec("wheels"))
        .child(strings.spec("camera"));
    (builder, rested)
}

#[blastema_testkit::test]
async fn a_component_that_never_comes_up_is_put_to_safe_rest_and_the_node_serves_without_it() {
    let strings = Strings::default();
    let (builder, rested) = hopeless(&strings);

    let mut node = TestNode::start(builder).await;

    assert_eq!(node.state(), NodeState::Running);
    assert_eq!(life(&node, "wheels").await, 1);
    let fault = node.await_fault(FaultKind::InitializationFailed, "camera").await;
    let reason = node.await_given_up(FaultKind::InitializationFailed, "camera").await;
    assert!(reason.contains("service is not restored"), "{reason}");
    assert_eq!(node.tree().await.unwrap().children[1].state, ChildState::Resting);
    let rested: Vec<_> = rested.lock().unwrap().iter().map(|fault| fault.id).collect();
    assert_eq!(rested, [fault.id]);
    assert_eq!(strings.lines("camera").len(), 4 * 2, "four lives: on_initialize and on_finalize");
}

#[blastema_testkit::test]
async fn a_node_that_may_not_try_again_does_not_start_and_comes_to_safe_rest() {
    let strings = Strings::default();
    let (builder, rested) = hopeless(&strings);

    let started = TestNode::try_start(builder.intensity(2, Duration::from_secs(10))).await;

    let Err(StartError::GaveUp { reason }) = started else { panic!("it started") };
    assert!(reason.contains("camera needed more than 2 restarts"), "{reason}");
    let rested: Vec<_> = rested.lock().unwrap().iter().map(|f| f.kind.clone()).collect();
    assert_eq!(rested[0], FaultKind::RestartStorm, "the safe outputs were applied");
    let diary = strings.diary();
    assert!(diary.iter().any(|line| line == "wheels#1 on_finalize"), "{diary:?}");
}

#[blastema_testkit::test]
async fn a_new_life_that_fails_to_come_up_is_tried_again_as_one_and_the_same_fault() {
    let strings = Strings::default();
    let mut node = TestNode::start(Node::builder("module1").child(strings.spec("camera"))).await;
    (0..2).for_each(|_| strings.pull("camera", "on_initialize", Pull::Fail("no device")));

    strike(&node, "camera").await;
    node.await_fault(FaultKind::Panic, "camera").await;
    node.await_fault(FaultKind::InitializationFailed, "camera").await;
    node.await_recovered(FaultKind::InitializationFailed, "camera").await;

    assert_eq!(life(&node, "camera").await, 4);
    assert_eq!(node.faults().await.entries[1].fault.count, 2);
    node.expect_no_faults().await;
}
