//! Objects that give no sign of life, or wait for ever, while their arbiter turns.

use crate::scenarios::puppet::{Deed, Do, Note, Pull, Strings, incarnation};
use blastema::Incarnation;
use blastema::core::detection::Opinion;
use blastema::prelude::*;
use blastema_testkit::{TestNode, now};
use blastema_tests::MS;
use std::time::Duration;

const HOUR: Duration = Duration::from_secs(3600);

/// A laser that gives a sign of life with each of its rounds.
async fn sweeping(strings: &Strings) -> TestNode {
    let spec = strings.spec("laser").rate_hz(10.0).liveness(Liveness::push(100 * MS, 3));
    TestNode::start(Node::builder("module1").child(spec).child(strings.spec("eye"))).await
}

#[blastema_testkit::test]
async fn an_object_that_gives_its_signs_is_trusted_and_a_silent_one_found_in_time_and_replaced() {
    let strings = Strings::default();
    let mut node = sweeping(&strings).await;
    node.advance(HOUR / 60).await;
    node.expect_no_faults().await;
    let row = node.row("laser").await;
    assert_eq!((row.opinion, row.suspicions, row.restarts), (Opinion::Trusted, 0, 0), "{row:?}");
    node.advance(50 * MS).await;
    strings.pull("laser", "on_execute", Pull::Wait(HOUR));
    let (start, last_sign) = (now(), 50 * MS);

    let fault = node.await_fault(FaultKind::Silence, "laser").await;
    let after = fault.found_at - start + last_sign;
    node.await_recovered(FaultKind::Silence, "laser").await;

    assert!(after >= 350 * MS && after <= 480 * MS, "three and a half intervals: {after:?}");
    assert_eq!(fault.incarnation, Incarnation(1));
    assert_eq!(incarnation(&node, "laser").await, 2);
    node.advance(10 * HOUR / 3600).await;
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn an_object_that_stays_silent_ends_where_the_budget_says() {
    let strings = Strings::default();
    let spec = strings.spec("laser").rate_hz(10.0).liveness(Liveness::push(100 * MS, 3));
    let builder = Node::builder("module1")
        .intensity(3, 60 * 1000 * MS)
        .when_exceeded(WhenExceeded::Escalate)
        .child(spec);
    let node = TestNode::start(builder).await;
    (0..99).for_each(|_| strings.pull("laser", "on_execute", Pull::Wait(HOUR)));

    let ended = tokio::time::timeout(60 * 1000 * MS, node.ended()).await;

    assert!(matches!(ended, Ok(NodeState::InSafeState { .. })), "{:?}", node.faults().await);
    assert_eq!(strings.lines("laser").iter().filter(|l| l.ends_with("on_initialize")).count(), 4);
}

#[blastema_testkit::test]
async fn a_handler_that_waits_for_ever_is_a_hang_and_its_queue_goes_to_the_next_incarnation() {
    let strings = Strings::default();
    let spec = strings.spec("arm").max_wait(2000 * MS);
    let builder = Node::builder("module1").child(spec).child(strings.spec("eye"));
    let mut node = TestNode::start(builder).await;
    let arm = node.sender::<Do>("arm").unwrap();
    let start = now();
    let stuck = tokio::task::spawn_local({
        let arm = arm.clone();
        async move { arm.ask_within(Do(Deed::Await(3_600_000)), HOUR).await }
    });
    node.settle().await;
    node.sender::<Note>("arm").unwrap().tell(Note(1)).unwrap();

    let fault = node.await_fault(FaultKind::Hang, "arm").await;
    let after = fault.found_at - start;
    node.await_recovered(FaultKind::Hang, "arm").await;

    assert!(after >= 2000 * MS && after <= 2200 * MS, "{after:?}");
    assert!(fault.detail.starts_with("test/do has been waiting for"), "{}", fault.detail);
    let error = stuck.await.unwrap().expect_err("it was given up");
    assert_eq!(error.kind, DeliveryError::PeerDied { incarnation: Incarnation(1) });
    assert_eq!(incarnation(&node, "arm").await, 2);
    assert_eq!(strings.lines("note"), ["arm#2 note 1"]);
    assert_eq!(incarnation(&node, "eye").await, 1);
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn an_object_that_waits_and_answers_is_trusted_and_an_announced_operation_is_no_hang() {
    let strings = Strings::default();
    let spec = strings.spec("arm").max_wait(2000 * MS).liveness(Liveness::pull(100 * MS, 100 * MS));
    let mut node = TestNode::start(Node::builder("module1").child(spec)).await;
    let arm = node.sender::<Do>("arm").unwrap();
    arm.tell(Do(Deed::Await(800))).unwrap();
    node.advance(700 * MS).await;
    let row = node.row("arm").await;
    assert_eq!((row.opinion, row.suspicions), (Opinion::Trusted, 0), "{row:?}");

    let answer = arm.ask_within(Do(Deed::AwaitAsAnnounced(20_000)), HOUR).await;
    assert_eq!(answer.unwrap(), 1);
    node.expect_no_faults().await;

    let answer = arm.ask_within(Do(Deed::Await(20_000)), HOUR).await;
    assert!(answer.is_err(), "unannounced, it is one");
    node.await_fault(FaultKind::Hang, "arm").await;
}

#[blastema_testkit::test]
async fn a_handler_that_awaits_a_component_that_hangs_is_its_symptom() {
    let strings = Strings::default();
    // A request that says nothing else waits for a second.
    let arm = strings.spec("arm").max_wait(500 * MS).depends_on(["encoder"]);
    let observe = Ladder::first(RecoveryAction::Observe);
    let builder = Node::builder("module1").plan(Plan::default().on(FaultKind::Hang, observe));
    let builder = builder.child(strings.spec("encoder").max_wait(1000 * MS)).child(arm);
    let mut node = TestNode::start(builder).await;
    let encoder = node.sender::<Do>("encoder").unwrap();
    encoder.tell(Do(Deed::Await(3_600_000))).unwrap();
    let encoder = node.await_fault(FaultKind::Hang, "encoder").await;

    node.sender::<Do>("arm").unwrap().tell(Do(Deed::Consult("encoder".into()))).unwrap();
    let arm = node.await_fault(FaultKind::Hang, "arm").await;

    assert_eq!((encoder.symptom_of, arm.symptom_of), (None, Some(encoder.id)), "{arm:?}");
}
