//! Restarts that are not worth it any more.

use crate::scenarios::puppet::{Deed, Do, Pull, Strings, ask, incarnation, strike};
use blastema::core::recovery::{Backoff, ChildState};
use blastema::prelude::*;
use blastema::{Fault, FaultLocation, NodeBuilder};
use blastema_testkit::TestNode;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const PERIOD: Duration = Duration::from_secs(10);

/// A supervisor `drive` with `motors` that allows one restart, beside a `lamp`.
fn robot(strings: &Strings) -> NodeBuilder {
    let drive = SupervisorSpec::new("drive", Strategy::OneForOne)
        .intensity(1, PERIOD)
        .when_exceeded(WhenExceeded::Escalate)
        .child(strings.spec("motors"));
    Node::builder("module1").child(strings.spec("lamp")).supervisor(drive)
}

#[blastema_testkit::test]
async fn a_supervisor_that_gives_up_is_begun_anew_by_its_parent() {
    let strings = Strings::default();
    let mut node = TestNode::start(robot(&strings)).await;

    strike(&node, "motors").await;
    node.await_recovered(FaultKind::Panic, "motors").await;
    strike(&node, "motors").await;
    node.await_recovered(FaultKind::Panic, "motors").await;
    let storm = node.await_fault(FaultKind::RestartStorm, "drive").await;
    node.await_recovered(FaultKind::RestartStorm, "drive").await;

    assert!(storm.detail.contains("motors needed more than 1 restarts"), "{}", storm.detail);
    assert_eq!(node.state(), NodeState::Running);
    assert_eq!((incarnation(&node, "motors").await, incarnation(&node, "lamp").await), (3, 1));
    let tree = node.tree().await.unwrap();
    assert_eq!((tree.restarts_left, tree.children[1].incarnation.0), (2, 2));
    let record = node.faults().await;
    assert!(
        record.entries.iter().all(|entry| entry.status() != blastema::FaultStatus::Open),
        "{record:?}"
    );
}

/// Everything as it is unless told otherwise, but for who decides in the end.
#[blastema_testkit::test]
async fn a_child_that_fails_again_and_again_is_escalated_from_each_supervisor_to_the_next() {
    for pull in [Pull::Fail("no encoder"), Pull::Fatal("no encoder"), Pull::Panic("no encoder")] {
        let strings = Strings::default();
        let escalating = |name| {
            let spec = SupervisorSpec::new(name, Strategy::OneForOne);
            spec.when_exceeded(WhenExceeded::Escalate)
        };
        let drive = escalating("drive").child(strings.spec("laser")).child(strings.spec("motors"));
        let base = escalating("base").child(strings.spec("lamp")).supervisor(drive);
        let builder = Node::builder("module1").child(strings.spec("horn")).supervisor(base);
        let node = TestNode::start(builder.when_exceeded(WhenExceeded::Escalate)).await;
        for _ in 0..1000 {
            strings.pull("motors", "on_initialize", pull.clone());
        }

        strike(&node, "motors").await;
        node.advance(Duration::from_secs(60)).await;

        let NodeState::InSafeState { reason } = node.state() else { panic!("{:?}", node.state()) };
        assert!(reason.contains("base"), "{reason}");
        let diary = strings.diary();
        let begun = |name: &str| {
            let is_one = |line: &&String| line.starts_with(name) && line.ends_with("on_initialize");
            diary.iter().filter(is_one).count()
        };
        // Each supervisor is restarted three times within each incarnation of the one above it.
        assert_eq!((begun("horn"), begun("lamp"), begun("laser")), (1, 4, 16), "{pull:?}");
        // And so is the child, but where the plan's last attempt at it was under way meanwhile.
        let begun = begun("motors");
        assert!((32..=64).contains(&begun), "{pull:?}: {begun}");
    }
}

#[blastema_testkit::test]
async fn a_root_that_gives_up_brings_the_node_to_safe_rest() {
    let strings = Strings::default();
    let rested: Arc<Mutex<Vec<Fault>>> = Arc::default();
    let outputs = rested.clone();
    let builder = robot(&strings)
        .intensity(1, PERIOD)
        .when_exceeded(WhenExceeded::Escalate)
        .safe_outputs(move |fault| outputs.lock().unwrap().push(fault.clone()));
    let node = TestNode::start(builder).await;
    strings.diary();

    for _ in 0..4 {
        assert_eq!(node.state(), NodeState::Running);
        strike(&node, "motors").await;
        node.advance(Duration::from_millis(500)).await;
    }

    let NodeState::InSafeState { reason } = node.ended().await else {
        panic!("{:?}", node.state())
    };
    assert!(reason.contains("drive"), "{reason}");
    let rested = rested.lock().unwrap().clone();
    assert_eq!(rested[0].kind, FaultKind::RestartStorm);
    assert_eq!(rested[0].location, FaultLocation::Node(node.name().clone()));
    assert!(strings.diary().contains(&"lamp#1 on_finalize".into()), "everything was stopped");
    let refused = ask(&node, "lamp", Deed::Nothing).await.expect_err("it is in the safe state");
    assert_eq!(refused.kind, DeliveryError::Stopped);
}

#[blastema_testkit::test]
async fn a_component_that_fails_too_often_is_stopped_alone_unless_it_is_essential() {
    for essential in [false, true] {
        let strings = Strings::default();
        let motors = strings.spec("motors");
        let motors = if essential { motors.essential() } else { motors };
        let builder = Node::builder("module1").child(strings.spec("lamp")).child(motors);
        let mut node = TestNode::start(builder.intensity(2, PERIOD)).await;

        for _ in 0..3 {
            strike(&node, "motors").await;
        }
        node.advance(Duration::from_secs(2)).await;

        if essential {
            let NodeState::InSafeState { reason } = node.state() else {
                panic!("{:?}", node.state())
            };
            assert!(reason.contains("motors"), "{reason}");
            continue;
        }
        assert_eq!(node.state(), NodeState::Running);
        let reason = node.await_given_up(FaultKind::Panic, "motors").await;
        assert!(reason.contains("safe stop"), "{reason}");
        assert_eq!(incarnation(&node, "lamp").await, 1);
        strike(&node, "lamp").await;
        node.await_recovered(FaultKind::Panic, "lamp").await;
        node.restart_child("motors").await.expect("a person brings it back");
        assert_eq!(incarnation(&node, "motors").await, 4);
    }
}

#[blastema_testkit::test]
async fn a_component_that_fails_too_often_is_stopped_at_once_however_patient_its_plan() {
    let backoff = Backoff { first: Duration::from_secs(1), ..Backoff::default() };
    let patient = Ladder::first(RecoveryAction::Restart).times(5).backoff(backoff);
    for plan in [Plan::default(), Plan::default().on(FaultKind::Panic, patient)] {
        let strings = Strings::default();
        let applied: Arc<Mutex<Vec<Fault>>> = Arc::default();
        let outputs = applied.clone();
        let builder = Node::builder("module1")
            .child(strings.spec("motors"))
            .plan(plan)
            .safe_outputs(move |fault| outputs.lock().unwrap().push(fault.clone()));
        let node = TestNode::start(builder).await;

        for _ in 0..4 {
            strike(&node, "motors").await;
        }
        node.advance(Duration::from_millis(5)).await;
        assert_eq!(applied.lock().unwrap().len(), 1, "no attempt that cannot succeed is made");
        node.advance(Duration::from_secs(60)).await;

        let leaf = &node.tree().await.unwrap().children[0];
        assert_eq!((leaf.incarnation.0, leaf.state), (4, ChildState::Resting));
        assert_eq!(applied.lock().unwrap().len(), 1);
    }
}

#[blastema_testkit::test]
async fn a_supervisor_that_escalates_too_often_is_stopped_alone() {
    let strings = Strings::default();
    let builder = robot(&strings).intensity(1, PERIOD);
    let mut node = TestNode::start(builder).await;

    // The second storm of the drive is one too many for the root.
    for _ in 0..4 {
        strike(&node, "motors").await;
        node.advance(Duration::from_millis(500)).await;
    }
    node.await_given_up(FaultKind::UnexpectedExit, "drive").await;

    assert_eq!(node.state(), NodeState::Running);
    assert_eq!(incarnation(&node, "lamp").await, 1);
    assert!(ask(&node, "motors", Deed::Nothing).await.is_err());
    node.restart_child("drive").await.expect("a person brings it back");
    assert_eq!(incarnation(&node, "motors").await, 5);
}

#[blastema_testkit::test]
async fn a_thousand_components_that_fail_at_once_are_all_treated() {
    const COUNT: u64 = 1000;
    // Some are restarted by their guards, the others by the whole chain.
    for kind in [FaultKind::Panic, FaultKind::Fatal] {
        let strings = Strings::default();
        let names: Vec<&'static str> =
            (0..COUNT).map(|n| &*Box::leak(format!("c{n}").into_boxed_str())).collect();
        let builder = names.iter().fold(Node::builder("module1"), |builder, name| {
            builder.child(strings.spec(name).queue(1, WhenFull::Refuse))
        });
        let node = TestNode::start(builder).await;

        for name in &names {
            let deed = match kind {
                FaultKind::Panic => Deed::Panic("struck".into()),
                _ => Deed::FailFatally("broken".into()),
            };
            node.sender::<Do>(name).unwrap().tell(Do(deed)).unwrap();
        }
        node.advance(Duration::from_secs(60)).await;

        let tree = node.tree().await.expect("it runs");
        for leaf in &tree.children {
            let (incarnation, state) = (leaf.incarnation.0, leaf.state);
            assert_eq!((incarnation, state), (2, ChildState::Running), "{kind}: {leaf:?}");
        }
        let record = node.faults().await;
        let told = record.entries.len() as u64 + record.dropped;
        assert_eq!(told, COUNT, "{kind}");
        assert!(record.entries.iter().all(|entry| !entry.stands()), "{kind}");
    }
}
