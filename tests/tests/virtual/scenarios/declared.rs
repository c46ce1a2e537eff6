//! Faults that a component declares: checks, its application's own list, storms, symptoms.

use crate::scenarios::puppet::{Deed, Pull, Strings, ask, incarnation, strike};
use blastema::core::detection::FaultTransition;
use blastema::core::recovery::{ChildState, RecoveryDone, RecoveryFailed, RecoveryOrder};
use blastema::prelude::*;
use blastema::{RecoveryStrategy, Severity, StrategyContext};
use blastema_testkit::TestNode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

#[blastema_testkit::test]
async fn a_failed_check_is_answered_as_the_plan_says() {
    let strings = Strings::default();
    let restart =
        Plan::default().on(FaultKind::CheckFailed, Ladder::first(RecoveryAction::Restart));
    for (plan, then) in [(Plan::default(), 1), (restart, 2)] {
        let builder = Node::builder("module1").plan(plan).child(strings.spec("odometry"));
        let mut node = TestNode::start(builder).await;

        ask(&node, "odometry", Deed::Check(0.5)).await.unwrap();
        node.expect_no_faults().await;
        ask(&node, "odometry", Deed::Check(7.5)).await.unwrap();

        let fault = node.await_fault(FaultKind::CheckFailed, "odometry").await;
        assert_eq!(fault.detail, "the value is 7.5, outside of 0.0..=1.0");
        assert_eq!(fault.severity, Severity::Warning);
        node.advance(Duration::from_secs(1)).await;
        assert_eq!(incarnation(&node, "odometry").await, then);
    }
}

#[blastema_testkit::test]
async fn a_check_that_passes_again_ends_its_fault_and_what_is_not_declared_again_ends_in_time() {
    let strings = Strings::default();
    let builder = Node::builder("module1")
        .fault_kind("GRIP")
        .plan(Plan::default().on(grip(), Ladder::first(RecoveryAction::Observe)))
        .child(strings.spec("arm"));
    let node = TestNode::start(builder).await;
    let minutes = |count: u64| Duration::from_secs(60 * count);
    let standing = async || {
        node.settle().await;
        let entries = node.faults().await.entries.into_iter().filter(|entry| entry.stands());
        entries.map(|entry| entry.fault.detail).collect::<Vec<_>>()
    };
    ask(&node, "arm", Deed::Check(7.5)).await.unwrap();
    ask(&node, "arm", Deed::Check(8.5)).await.unwrap();
    assert_eq!(standing().await, ["the value is 8.5, outside of 0.0..=1.0"]);
    let first = node.faults().await.entries[0].first_detail.clone();
    assert_eq!(first.as_deref(), Some("the value is 7.5, outside of 0.0..=1.0"));
    ask(&node, "arm", Deed::Check(0.5)).await.unwrap();
    assert_eq!(standing().await, [""; 0]);

    ask(&node, "arm", Deed::Declare("GRIP".into())).await.unwrap();
    node.advance(minutes(6)).await;
    ask(&node, "arm", Deed::Declare("GRIP".into())).await.unwrap();
    node.advance(minutes(6)).await;
    assert_eq!(standing().await, ["as it was told"]);
    node.advance(minutes(5)).await;
    assert_eq!(standing().await, [""; 0]);
}

#[blastema_testkit::test]
async fn a_storm_of_one_fault_is_one_fault_one_report_and_a_count() {
    let strings = Strings::default();
    let plan = Plan::default().on(FaultKind::CheckFailed, Ladder::first(RecoveryAction::Observe));
    let builder = Node::builder("module1").plan(plan).child(strings.spec("odometry"));
    let node = TestNode::start(builder).await;
    let mut events = node.fault_events();

    // More in a second are not told.
    for _ in 0..1500 {
        ask(&node, "odometry", Deed::Check(7.5)).await.unwrap();
    }
    node.settle().await;

    let record = node.faults().await;
    assert_eq!((record.entries.len(), record.entries[0].fault.count), (1, 1000));
    let mut turns = Vec::new();
    while let Ok(Some(event)) = tokio::time::timeout(Duration::from_secs(1), events.next()).await {
        turns.push(event.turn);
    }
    let told = |wanted: &FaultTransition| turns.iter().filter(|turn| *turn == wanted).count();
    assert_eq!(told(&FaultTransition::Found), 1);
    assert_eq!(told(&FaultTransition::Repeated), 9, "at 2, 4, 8 .. 512");
    assert_eq!((turns.len(), events.missed()), (11, 0), "and one decision: {turns:?}");
}

#[blastema_testkit::test]
async fn a_storm_of_panics_ends_in_the_objects_safe_rest_with_few_words() {
    let strings = Strings::default();
    let group = SupervisorSpec::new("group", Strategy::OneForOne).child(strings.spec("mad"));
    let node = TestNode::start(Node::builder("module1").supervisor(group)).await;
    (0..1000).for_each(|_| strings.pull("mad", "on_activated", Pull::Panic("mad")));

    strike(&node, "mad").await;
    node.advance(Duration::from_secs(60)).await;

    let group = node.tree().await.unwrap().children[0].below.clone().unwrap();
    assert_eq!(group.children[0].state, ChildState::Resting);
    let record = node.faults().await;
    assert!(record.entries.len() <= 10, "{record:?}");
    assert!(strings.lines("on_activated").len() <= 10);
    assert_eq!(node.state(), NodeState::Running, "the others go on");
}

/// A fault of the application's own, and its cure.
struct OpenGripper;

impl RecoveryStrategy for OpenGripper {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        context: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        tokio::time::sleep(Duration::from_millis(40)).await;
        context.restart(&order.fault).await
    }
}

fn grip() -> FaultKind {
    FaultKind::Custom("GRIP".into())
}

#[blastema_testkit::test]
async fn a_fault_of_the_applications_own_is_found_and_answered_by_its_own_strategy() {
    let strings = Strings::default();
    let ladder = Ladder::first(RecoveryAction::Custom("open gripper".into()));
    let builder = Node::builder("module1")
        .fault_kind("GRIP")
        .plan(Plan::default().on(grip(), ladder))
        .recovery("open gripper", || OpenGripper)
        .child(strings.spec("arm"));
    let mut node = TestNode::start(builder).await;

    ask(&node, "arm", Deed::Declare("GRIP".into())).await.unwrap();

    let fault = node.await_fault(grip(), "arm").await;
    assert_eq!((fault.kind.code(), fault.detail.as_str()), ("GRIP", "as it was told"));
    assert_eq!(node.await_recovered(grip(), "arm").await, Duration::from_millis(40));
    assert_eq!(incarnation(&node, "arm").await, 2);
    let record = node.faults().await;
    let decided = record.entries[0].decided.as_ref().map(|(_, action)| action.as_str());
    assert_eq!(decided, Some("open gripper"));
}

#[blastema_testkit::test]
async fn a_code_that_nobody_declared_says_so_and_brakes_nothing() {
    let strings = Strings::default();
    let braked = Arc::new(AtomicBool::new(false));
    let brakes = braked.clone();
    let builder = Node::builder("module1")
        .fault_kind("GRIP")
        .plan(Plan::default().on(grip(), Ladder::first(RecoveryAction::SafeStop)))
        .safe_outputs(move |_| brakes.store(true, Relaxed))
        .child(strings.spec("arm"));
    let mut node = TestNode::start(builder).await;

    ask(&node, "arm", Deed::Declare("GRlP".into())).await.unwrap();

    let fault = node.await_fault(FaultKind::Custom("GRlP".into()), "arm").await;
    assert_eq!(
        fault.detail,
        "as it was told (the code \"GRlP\" was never declared, declared are GRIP; did you mean \
         \"GRIP\"?)"
    );
    assert_eq!(fault.severity, Severity::Error);
    node.advance(Duration::from_secs(1)).await;
    let record = node.faults().await;
    let decided = record.entries[0].decided.as_ref().map(|(_, action)| action.as_str());
    assert_eq!(decided, Some("observe"));
    assert!(!braked.load(Relaxed), "the robot goes on");
    assert_eq!(incarnation(&node, "arm").await, 1);
}

#[blastema_testkit::test]
async fn a_fault_of_the_applications_own_without_an_answer_is_refused_at_start() {
    let strings = Strings::default();
    let builder = Node::builder("module1").fault_kind("GRIP").child(strings.spec("arm"));

    let Err(error) = TestNode::try_start(builder).await else { panic!("it started") };

    assert!(matches!(error, StartError::Plan(_)), "{error}");
    assert!(error.to_string().contains("GRIP"), "{error}");
    assert_eq!(strings.diary(), [""; 0], "nothing was started");
}

#[blastema_testkit::test]
async fn what_is_found_downstream_of_a_dead_part_is_marked_as_its_symptom() {
    let strings = Strings::default();
    // A laser that takes long to come back, so that the planner has time to complain.
    let group = SupervisorSpec::new("group", Strategy::RestForOne).child(strings.spec("laser"));
    let builder = Node::builder("module1")
        .supervisor(group)
        .child(strings.spec("planner").depends_on(["laser"]))
        .child(strings.spec("speech"));
    let mut node = TestNode::start(builder).await;
    strings.pull("laser", "on_initialize", Pull::Wait(Duration::from_secs(2)));

    strike(&node, "laser").await;
    ask(&node, "planner", Deed::Check(7.5)).await.unwrap();
    ask(&node, "speech", Deed::Check(7.5)).await.unwrap();
    let root = node.await_fault(FaultKind::Panic, "laser").await;
    let symptom = node.await_fault(FaultKind::CheckFailed, "planner").await;
    let other = node.await_fault(FaultKind::CheckFailed, "speech").await;

    assert_eq!((root.symptom_of, symptom.symptom_of), (None, Some(root.id)));
    assert_eq!(other.symptom_of, None, "it does not depend on the laser");
    let record = node.faults().await;
    let order: Vec<_> = record.entries.iter().map(|entry| entry.fault.id).collect();
    assert_eq!(order, [root.id, symptom.id, other.id], "roots first, symptoms behind theirs");
    node.await_recovered(FaultKind::Panic, "laser").await;
    assert_eq!(incarnation(&node, "planner").await, 1, "the victim was not restarted");
}

#[blastema_testkit::test]
async fn an_error_of_a_victim_passes_with_its_root_or_is_treated_then() {
    let strings = Strings::default();
    let group = SupervisorSpec::new("group", Strategy::RestForOne).child(strings.spec("laser"));
    let builder = Node::builder("module1")
        .supervisor(group)
        .child(strings.spec("planner").depends_on(["laser"]));
    let mut node = TestNode::start(builder).await;
    strings.pull("laser", "on_initialize", Pull::Wait(Duration::from_secs(2)));

    strike(&node, "laser").await;
    ask(&node, "planner", Deed::Fail("no scans".into())).await.unwrap();
    node.advance(Duration::from_secs(1)).await;
    assert_eq!(strings.lines("planner#1 on_reset"), [""; 0], "it waits for its root");
    let took = node.await_recovered(FaultKind::ErrorState, "planner").await;

    assert!(took > Duration::from_secs(2), "{took:?}");
    assert_eq!(incarnation(&node, "planner").await, 1, "a reset has helped");
    let record = node.faults().await;
    let ended = |entry: &blastema::core::detection::FaultEntry| entry.recovered_at.is_some();
    assert!(record.entries.iter().all(ended), "{record:?}");
}
