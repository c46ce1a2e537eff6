//! A component does not come up.

use crate::scenarios::puppet::{Deed, Pull, Strings, ask, incarnation, strike};
use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use blastema::{Fault, Incarnation, NodeBuilder, RestartedChild};
use blastema_testkit::TestNode;
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[blastema_testkit::test]
async fn a_failed_initialisation_is_tried_again_and_later_children_wait_for_it() {
    let strings = Strings::default();
    strings.pull("camera", "on_initialize", Pull::Fail("no device"));
    let builder = Node::builder("module1").child(strings.spec("camera"));

    let mut node = TestNode::start(builder.child(strings.spec("eye"))).await;

    assert_eq!(node.state(), NodeState::Running);
    let fault = node.await_fault(FaultKind::InitializationFailed, "camera").await;
    node.await_recovered(FaultKind::InitializationFailed, "camera").await;
    assert_eq!((fault.detail.as_str(), fault.incarnation), ("no device", Incarnation(1)));
    assert_eq!((incarnation(&node, "camera").await, incarnation(&node, "eye").await), (2, 1));
    let diary = strings.diary();
    let at = |line: &str| diary.iter().position(|l| l == line).expect(line);
    assert!(at("camera#2 on_activated") < at("eye#1 on_initialize"), "{diary:?}");
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn every_way_of_not_coming_up_is_answered_by_a_new_incarnation() {
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
        assert!(incarnation(&node, "camera").await <= 2, "{hook} {pull:?}");
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
    assert_eq!(incarnation(&node, "wheels").await, 1);
    let fault = node.await_fault(FaultKind::InitializationFailed, "camera").await;
    let reason = node.await_given_up(FaultKind::InitializationFailed, "camera").await;
    assert!(reason.contains("service is not restored"), "{reason}");
    assert_eq!(node.tree().await.unwrap().children[1].state, ChildState::Resting);
    assert_eq!(
        strings.lines("camera").len(),
        4 * 2,
        "four incarnations: on_initialize and on_finalize"
    );

    strike(&node, "wheels").await;
    let panic = node.await_fault(FaultKind::Panic, "wheels").await;
    node.await_recovered(FaultKind::Panic, "wheels").await;
    assert_eq!(node.state(), NodeState::Running);
    assert_eq!(incarnation(&node, "wheels").await, 2);
    assert_eq!(panic.symptom_of, None, "each is blamed for its own");
    let rested: Vec<_> = rested.lock().unwrap().iter().map(|fault| fault.id).collect();
    assert_eq!(rested, [fault.id], "safe state is the camera's alone");
    assert_eq!(node.faults().await.entries.len(), 2);
}

#[blastema_testkit::test]
async fn a_node_that_may_not_try_again_does_not_start_and_comes_to_safe_rest() {
    let strings = Strings::default();
    let (builder, rested) = hopeless(&strings);

    let builder = builder.intensity(2, Duration::from_secs(10));
    let started = TestNode::try_start(builder.when_exceeded(WhenExceeded::Escalate)).await;

    let Err(StartError::GaveUp { reason }) = started else { panic!("it started") };
    assert!(reason.contains("camera needed more than 2 restarts"), "{reason}");
    let rested: Vec<_> = rested.lock().unwrap().iter().map(|f| f.kind.clone()).collect();
    assert_eq!(rested[0], FaultKind::RestartStorm, "the safe outputs were applied");
    let diary = strings.diary();
    assert!(diary.iter().any(|line| line == "wheels#1 on_finalize"), "{diary:?}");
}

#[blastema_testkit::test]
async fn a_start_that_fails_returns_when_nothing_runs_any_more() {
    // The second wait is longer than a stop may take.
    for wait in [Duration::from_millis(300), Duration::from_secs(60)] {
        let strings = Strings::default();
        strings.pull("wheels", "on_deactivated", Pull::Wait(wait));
        let (builder, rested) = hopeless(&strings);

        let builder = builder.intensity(0, Duration::from_secs(10));
        let builder = builder.when_exceeded(WhenExceeded::Escalate);
        let started = TestNode::try_start(builder).await;

        assert!(matches!(started, Err(StartError::GaveUp { .. })), "{wait:?}");
        assert_eq!(rested.lock().unwrap().len(), 1, "{wait:?}: the safe outputs were applied");
        let diary = strings.lines("wheels");
        let last =
            if wait.as_secs() < 1 { "wheels#1 on_finalize" } else { "wheels#1 on_deactivated" };
        assert_eq!(diary.last().map(String::as_str), Some(last), "{diary:?}");
        blastema_testkit::advance(2 * wait).await;
        assert_eq!(strings.diary(), Vec::<String>::new(), "{wait:?}");
    }
}

#[blastema_testkit::test]
async fn a_new_incarnation_that_fails_to_come_up_is_tried_again_as_one_and_the_same_fault() {
    let (strings, mut node) = Strings::robot(["camera"]).await;
    (0..2).for_each(|_| strings.pull("camera", "on_initialize", Pull::Fail("no device")));

    strike(&node, "camera").await;
    node.await_fault(FaultKind::Panic, "camera").await;
    node.await_fault(FaultKind::InitializationFailed, "camera").await;
    node.await_recovered(FaultKind::InitializationFailed, "camera").await;

    assert_eq!(incarnation(&node, "camera").await, 4);
    assert_eq!(node.faults().await.entries[1].fault.count, 2);
    node.expect_no_faults().await;
}

/// What stands against the camera.
async fn open_faults(node: &TestNode) -> Vec<FaultKind> {
    let record = node.faults().await;
    let open_faults = record.entries.into_iter().filter(|entry| entry.stands());
    open_faults.map(|entry| entry.fault.kind).collect()
}

#[blastema_testkit::test]
async fn a_device_that_comes_late_is_waited_for_and_nobody_pays() {
    for hook in ["on_initialize", "on_startup", "on_activated"] {
        let strings = Strings::default();
        (0..40).for_each(|_| strings.pull("camera", hook, Pull::Unavailable("no camera")));
        let builder = Node::builder("module1").intensity(0, Duration::from_secs(10));
        let builder = builder.child(strings.spec("camera")).child(strings.spec("eye"));

        let node = TestNode::start(builder).await;

        assert_eq!(node.state(), NodeState::Running, "{hook}");
        assert_eq!(incarnation(&node, "eye").await, 1, "no component waits for a camera");
        node.advance(Duration::from_secs(60)).await;
        assert_eq!(open_faults(&node).await, [FaultKind::Unavailable], "{hook}");
        let tree = node.tree().await.unwrap();
        assert_eq!(tree.children[0].state, ChildState::Unavailable, "{hook}");
        assert_eq!(node.row("camera").await.note.as_deref(), Some("no camera"), "{hook}");
        let tries = strings.lines(&format!("camera#1 {hook}")).len();
        assert!((12..20).contains(&tries), "ever later, up to five seconds: {tries} for {hook}");

        node.advance(Duration::from_secs(200)).await;
        assert_eq!(open_faults(&node).await, [], "{hook}: it is plugged in");
        assert_eq!(incarnation(&node, "camera").await, 1, "{hook}");
        let tree = node.tree().await.unwrap();
        let leaf = &tree.children[0];
        assert_eq!((leaf.state, leaf.restarts), (ChildState::Running, 0), "{hook}");
        assert_eq!(node.faults().await.entries.len(), 1, "{hook}");
    }
}

#[blastema_testkit::test]
async fn a_device_that_goes_and_comes_is_one_error_and_one_wait() {
    let (strings, mut node) = Strings::robot(["camera"]).await;
    (0..10).for_each(|_| strings.pull("camera", "on_reset", Pull::Unavailable("unplugged")));

    ask(&node, "camera", Deed::Fail("unplugged".into())).await.unwrap();
    node.await_fault(FaultKind::ErrorState, "camera").await;
    node.await_fault(FaultKind::Unavailable, "camera").await;
    node.advance(Duration::from_secs(60)).await;

    assert_eq!(open_faults(&node).await, []);
    assert_eq!(incarnation(&node, "camera").await, 1, "its incarnation went on");
    node.await_recovered(FaultKind::Unavailable, "camera").await;
    assert_eq!(node.tree().await.unwrap().children[0].state, ChildState::Running);
}

#[blastema_testkit::test]
async fn those_who_depend_on_a_missing_device_wait_for_it_and_the_node_runs() {
    let strings = Strings::default();
    (0..8).for_each(|_| strings.pull("camera", "on_initialize", Pull::Unavailable("no camera")));
    let vision = SupervisorSpec::new("vision", Strategy::RestForOne)
        .child(strings.spec("camera"))
        .child(strings.spec("eye"));
    let builder = Node::builder("module1").supervisor(vision).child(strings.spec("wheels"));

    let node = TestNode::start(builder).await;

    assert_eq!(incarnation(&node, "wheels").await, 1);
    assert_eq!(strings.lines("eye").len(), 0);
    assert_eq!(node.tree().await.unwrap().children[0].state, ChildState::Unavailable);
    node.advance(Duration::from_secs(60)).await;
    assert_eq!((incarnation(&node, "camera").await, incarnation(&node, "eye").await), (1, 1));
    assert_eq!(node.tree().await.unwrap().children[0].state, ChildState::Running);
    node.shutdown().await;
}

#[blastema_testkit::test]
async fn one_that_waits_for_its_device_can_panic_be_restarted_and_stopped() {
    let strings = Strings::default();
    (0..3).for_each(|_| strings.pull("camera", "on_initialize", Pull::Unavailable("no camera")));
    strings.pull("camera", "on_initialize", Pull::Panic("struck"));
    (0..99).for_each(|_| strings.pull("camera", "on_initialize", Pull::Unavailable("no camera")));
    let mut node = TestNode::start(Node::builder("module1").child(strings.spec("camera"))).await;

    node.await_fault(FaultKind::Panic, "camera").await;
    node.advance(Duration::from_secs(5)).await;
    let camera = node.tree().await.unwrap().children[0].clone();
    assert_eq!((camera.incarnation, camera.state), (Incarnation(2), ChildState::Unavailable));
    let both = [FaultKind::Panic, FaultKind::Unavailable];
    assert_eq!(open_faults(&node).await, both, "the next incarnation waits, and has not recovered");
    let restarted = node.restart_child("camera").await.expect("it is stopped, and begins again");
    assert_eq!(restarted, RestartedChild::Unavailable(Incarnation(3)), "it says that it waits");
    strings.cut_all();
    let restarted = node.restart_child("camera").await.expect("it is stopped, and begins again");
    assert_eq!(restarted, RestartedChild::Running(Incarnation(4)));
    node.await_recovered(FaultKind::Panic, "camera").await;
    assert_eq!(open_faults(&node).await, []);
    assert_eq!(incarnation(&node, "camera").await, 4);
    strings.pull("camera", "on_initialize", Pull::Unavailable("no camera"));
    node.shutdown().await;
    assert_eq!(node.state(), NodeState::Stopped);
}

#[blastema_testkit::test]
async fn a_supervisor_has_the_time_that_its_children_have_together() {
    let strings = Strings::default();
    let minute = Duration::from_secs(60);
    let slow = |name| {
        strings.pull(name, "on_initialize", Pull::Wait(minute));
        strings.pull(name, "on_finalize", Pull::Wait(minute));
        strings.spec(name).ready_within(2 * minute).shutdown_within(2 * minute).max_wait(3 * minute)
    };
    let maps = SupervisorSpec::new("maps", Strategy::OneForOne).child(slow("a")).child(slow("b"));

    let node = TestNode::start(Node::builder("module1").supervisor(maps)).await;
    assert_eq!((incarnation(&node, "a").await, incarnation(&node, "b").await), (1, 1));
    strings.diary();
    node.expect_no_faults().await;
    node.shutdown().await;

    assert_eq!(strings.lines("on_finalize"), ["b#1 on_finalize", "a#1 on_finalize"]);
}

#[blastema_testkit::test]
async fn a_supervisor_that_cannot_start_escalates_and_is_recovered_when_it_works() {
    let strings = Strings::default();
    (0..5).for_each(|_| strings.pull("wheel", "on_initialize", Pull::Fail("jammed")));
    let drive = SupervisorSpec::new("drive", Strategy::RestForOne)
        .intensity(1, Duration::from_secs(10))
        .child(strings.spec("wheel"))
        .child(strings.spec("odometry"));
    let builder = Node::builder("module1").supervisor(drive).child(strings.spec("lamp"));

    let mut node = TestNode::start(builder).await;
    node.await_fault(FaultKind::RestartStorm, "drive").await;
    node.await_recovered(FaultKind::RestartStorm, "drive").await;

    assert_eq!(node.state(), NodeState::Running);
    assert_eq!((incarnation(&node, "wheel").await, incarnation(&node, "odometry").await), (6, 1));
    node.advance(Duration::from_secs(1)).await;
    assert_eq!(open_faults(&node).await, []);
}

#[blastema_testkit::test]
async fn a_fault_is_recovered_when_the_replacement_has_started() {
    for hook in ["on_aborting", "on_error", "on_reset"] {
        let (strings, mut node) = Strings::robot(["arm"]).await;
        let start = Duration::from_millis(500);
        strings.pull("arm", hook, Pull::Panic("boom"));
        strings.pull("arm", "on_initialize", Pull::Wait(start));

        ask(&node, "arm", Deed::Fail("bent".into())).await.unwrap();
        node.await_fault(FaultKind::Panic, "arm").await;
        let within = node.await_recovered(FaultKind::Panic, "arm").await;

        assert!(within >= start, "{hook}: {within:?}");
        assert_eq!(incarnation(&node, "arm").await, 2, "{hook}");
        assert_eq!(open_faults(&node).await, [], "{hook}");
    }
}
