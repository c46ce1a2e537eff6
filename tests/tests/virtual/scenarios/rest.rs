//! A node in the safe state: what goes on, who is told, and how it is brought back.

use crate::scenarios::puppet::{Deed, Do, Note, Pull, Strings, ask, incarnation, strike};
use blastema::core::delivery::dead_letters::DeadReason;
use blastema::core::recovery::{Ladder, Plan, RecoveryAction};
use blastema::prelude::*;
use blastema::{
    ActuatorSpec, Fault, FaultTransition, Hold, Link, MemoryMedium, Network, NodeBuilder, Outcome,
    RestartError, RestartedChild,
};
use blastema_testkit::TestNode;
use blastema_tests::{MS, Notes, moves};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A node that enters the safe state when a component needs more than one restart, and whom its
/// outputs were called for.
fn robot(strings: &Strings) -> (NodeBuilder, Arc<Mutex<Vec<Fault>>>) {
    let applied: Arc<Mutex<Vec<Fault>>> = Arc::default();
    let outputs = applied.clone();
    let builder = Node::builder("module1")
        .child(strings.spec("lamp"))
        .child(strings.spec("motors"))
        .intensity(1, Duration::from_secs(10))
        .when_exceeded(WhenExceeded::Escalate)
        .safe_outputs(move |fault| outputs.lock().unwrap().push(fault.clone()));
    (builder, applied)
}

async fn bring_to_rest(node: &TestNode) {
    for _ in 0..2 {
        strike(node, "motors").await;
        node.advance(500 * MS).await;
    }
    assert!(matches!(node.state(), NodeState::InSafeState { .. }), "{:?}", node.state());
}

async fn open_faults(node: &TestNode) -> Vec<(FaultKind, String)> {
    let record = node.faults().await;
    let open_faults =
        record.entries.into_iter().filter(|entry| entry.status() == blastema::FaultStatus::Open);
    open_faults.map(|entry| (entry.fault.kind, entry.fault.location.to_string())).collect()
}

fn networked(builder: NodeBuilder, own: &str, far: &str, medium: &MemoryMedium) -> NodeBuilder {
    let link = Link::to(far, far).hello_every(10 * MS);
    builder.network(Network::memory("ethernet", medium, own).link(link))
}

#[blastema_testkit::test]
async fn at_rest_nothing_is_treated_any_more_and_the_outputs_are_applied_once() {
    let strings = Strings::default();
    let (builder, applied) = robot(&strings);
    let node = TestNode::start(builder).await;
    let mut events = node.fault_events();
    bring_to_rest(&node).await;
    let rested_at = applied.lock().unwrap()[0].found_at;
    node.advance(Duration::from_secs(60)).await;

    assert_eq!(applied.lock().unwrap().len(), 1, "{applied:?}");
    node.shutdown().await;
    let mut actions = 0;
    while let Some(event) = events.next().await {
        if let FaultTransition::Decided { action } = event.turn {
            assert!(event.at <= rested_at || action == "observe", "{action}");
            actions += 1;
        }
    }
    assert!(actions > 0);
}

#[blastema_testkit::test]
async fn whoever_asks_a_node_at_rest_from_another_one_is_told_that_it_is_stopped() {
    let (strings, medium) = (Strings::default(), MemoryMedium::default());
    let (builder, _) = robot(&strings);
    let resting = TestNode::start(networked(builder, "module1", "module2", &medium)).await;
    let mut peer =
        TestNode::start(networked(Node::builder("module2"), "module2", "module1", &medium)).await;
    assert!(peer.connected("module1", 2000 * MS).await);
    let motors = peer.sender::<Do>("module1:motors").unwrap();
    motors.ask(Do(Deed::Nothing)).await.unwrap();

    bring_to_rest(&resting).await;
    for _ in 0..10 {
        assert_eq!(motors.ask(Do(Deed::Nothing)).await.unwrap_err().kind, DeliveryError::Stopped);
        peer.advance(500 * MS).await;
    }

    // And that is no mystery there.
    let record = peer.faults().await;
    let told = record.entries.iter().find(|entry| entry.fault.kind == FaultKind::NodeInSafeState);
    let told = told.expect("its peers are told");
    assert_eq!(told.fault.location.to_string(), "module1");
    assert!(told.fault.detail.contains("motors needed more than 1 restarts"), "{told:?}");
    assert_eq!(told.status(), blastema::FaultStatus::Open);

    resting.restart().await.unwrap();
    peer.advance(500 * MS).await;
    assert_eq!(open_faults(&peer).await, []);
    assert_eq!(motors.ask(Do(Deed::Nothing)).await.map(drop).map_err(|error| error.kind), Ok(()));
    peer.await_fault(FaultKind::NodeInSafeState, "module1").await;
}

#[blastema_testkit::test]
async fn who_meets_a_node_at_rest_is_told_as_well_and_its_next_incarnation_is_at_work() {
    let (strings, medium) = (Strings::default(), MemoryMedium::default());
    let (builder, _) = robot(&strings);
    let resting = TestNode::start(networked(builder, "module1", "module2", &medium)).await;
    bring_to_rest(&resting).await;

    let peer = Node::builder("module2");
    let peer = TestNode::start(networked(peer, "module2", "module1", &medium)).await;
    assert!(peer.connected("module1", 2000 * MS).await);
    peer.advance(500 * MS).await;
    assert_eq!(open_faults(&peer).await, [(FaultKind::NodeInSafeState, "module1".to_owned())]);

    resting.shutdown().await;
    let (builder, _) = robot(&strings);
    let _next = TestNode::start(networked(builder, "module1", "module2", &medium)).await;
    peer.advance(3000 * MS).await;
    assert_eq!(open_faults(&peer).await, []);
}

#[blastema_testkit::test]
async fn a_node_is_brought_back_from_rest_with_the_next_incarnations_of_its_components() {
    let strings = Strings::default();
    let (builder, applied) = robot(&strings);
    let node = TestNode::start(builder).await;
    bring_to_rest(&node).await;
    strings.diary();
    let lamp = node.sender::<Do>("lamp").unwrap();
    assert_eq!(lamp.ask(Do(Deed::Nothing)).await.unwrap_err().kind, DeliveryError::Stopped);

    node.restart().await.unwrap();

    assert_eq!(node.state(), NodeState::Running);
    let begun = strings.lines("on_initialize");
    assert_eq!(begun.len(), 2, "{begun:?}");
    assert!(begun[0].starts_with("lamp#") && begun[1].starts_with("motors#"), "{begun:?}");
    assert_eq!((incarnation(&node, "lamp").await, incarnation(&node, "motors").await), (2, 3));
    lamp.ask(Do(Deed::Nothing)).await.unwrap();
    ask(&node, "motors", Deed::Nothing).await.unwrap();
    node.advance(MS).await;
    assert_eq!(open_faults(&node).await, [], "their next incarnations are at work");

    // With a budget of its own, and with outputs that are applied again.
    strike(&node, "motors").await;
    node.advance(500 * MS).await;
    assert_eq!(node.state(), NodeState::Running);
    strike(&node, "motors").await;
    node.advance(500 * MS).await;
    assert!(matches!(node.state(), NodeState::InSafeState { .. }));
    assert_eq!(applied.lock().unwrap().len(), 2);
    node.restart().await.unwrap();
    lamp.ask(Do(Deed::Nothing)).await.unwrap();
}

#[blastema_testkit::test]
async fn only_a_node_at_rest_is_restarted() {
    let strings = Strings::default();
    let (builder, _) = robot(&strings);
    let node = TestNode::start(builder).await;
    let refused = node.restart().await;
    assert_eq!(refused, Err(RestartError::NotInSafeState { state: NodeState::Running }));
    assert_eq!(incarnation(&node, "lamp").await, 1);

    bring_to_rest(&node).await;
    let child = node.restart_child("lamp").await.unwrap_err();
    assert!(matches!(child, RestartError::SupervisorRests { .. }), "{child}");
    node.shutdown().await;
    assert_eq!(node.restart().await, Err(RestartError::ShutDown));
}

#[blastema_testkit::test]
async fn a_component_that_was_brought_to_rest_comes_back_when_it_is_asked_for() {
    let strings = Strings::default();
    let (builder, applied) = robot(&strings);
    let plan = Plan::default().on(FaultKind::Panic, Ladder::first(RecoveryAction::SafeStop));
    let node = TestNode::start(builder.plan(plan)).await;
    strike(&node, "motors").await;
    node.advance(500 * MS).await;
    assert_eq!(node.state(), NodeState::Running, "the rest of it works");
    let refused = ask(&node, "motors", Deed::Nothing).await.unwrap_err().kind.to_string();
    let fault = &node.faults().await.entries[0].fault;
    assert!(refused.ends_with(&format!(": {}", fault.as_reason())), "{refused}");

    let restarted = node.restart_child("motors").await.unwrap();

    assert_eq!(restarted, RestartedChild::Running(blastema::Incarnation(2)));
    ask(&node, "motors", Deed::Nothing).await.unwrap();
    node.advance(MS).await;
    assert_eq!(open_faults(&node).await, []);
    // No fault follows, also where it is at work.
    for next in 3..10 {
        let restarted = node.restart_child("motors").await.unwrap();
        assert_eq!(restarted, RestartedChild::Running(blastema::Incarnation(next)));
    }
    assert_eq!(node.tree().await.unwrap().restarts_left, 1);
    assert_eq!(applied.lock().unwrap().len(), 1);
    let unknown = node.restart_child("mtors").await;
    let nearest = Some("motors".parse().unwrap());
    assert_eq!(unknown, Err(RestartError::Unknown { name: "mtors".into(), nearest }));
}

#[blastema_testkit::test]
async fn what_waits_for_a_component_that_is_given_up_because_it_hangs_is_refused_at_once() {
    let (strings, medium) = (Strings::default(), MemoryMedium::default());
    let arm = strings.spec("arm").max_wait(Duration::from_secs(2)).queue(64, WhenFull::Refuse);
    let builder = Node::builder("module1").intensity(1, Duration::from_secs(60)).child(arm);
    let mut node = TestNode::start(networked(builder, "module1", "module2", &medium)).await;
    let peer =
        TestNode::start(networked(Node::builder("module2"), "module2", "module1", &medium)).await;
    assert!(peer.connected("module1", 2000 * MS).await);
    let far = peer.sender::<Do>("module1:arm").unwrap();
    let (arm, note) = (node.sender::<Do>("arm").unwrap(), node.sender::<Note>("arm").unwrap());
    let ask_all = || {
        let request = |arm: Sender<Do>| async move {
            arm.ask_within(Do(Deed::Nothing), Duration::from_secs(3600)).await
        };
        let asks = [&arm, &far, &arm, &far].map(|arm| request(arm.clone()));
        asks.map(tokio::task::spawn_local)
    };

    // While restarts last, the successor takes the queue.
    arm.tell(Do(Deed::Await(3_600_000))).unwrap();
    node.settle().await;
    let waiting = ask_all();
    node.await_recovered(FaultKind::Hang, "arm").await;
    for request in waiting {
        assert_eq!(request.await.unwrap().expect("it is served"), 2);
    }
    arm.tell(Do(Deed::Await(3_600_000))).unwrap();
    node.settle().await;
    let waiting = ask_all();
    node.advance(50 * MS).await;
    (0..20).for_each(|n| note.tell(Note(n)).unwrap());
    node.await_given_up(FaultKind::Hang, "arm").await;
    node.advance(50 * MS).await;

    let entries = node.faults().await.entries;
    let fault = &entries.last().expect("the last hang").fault;
    assert_eq!(fault.kind, FaultKind::Hang);
    let isolated = DeliveryError::Isolated { object: "arm".into(), reason: fault.as_reason() };
    for request in waiting {
        assert!(request.is_finished(), "it waits for its deadline");
        let error = request.await.unwrap().expect_err("none serves it");
        assert_eq!((error.outcome(), error.kind), (Outcome::NotTaken, isolated.clone()));
    }
    let arm = "arm".parse().unwrap();
    assert_eq!(node.dead_letters().count(&arm, DeadReason::Isolated), 24);
    strings.diary();
    node.restart_child("arm").await.unwrap();
    assert_eq!(incarnation(&node, "arm").await, 3);
    assert_eq!(strings.lines("note"), [""; 0], "it serves what is new");
}

#[blastema_testkit::test]
async fn what_does_not_start_after_a_rest_brings_the_node_to_rest_again() {
    let strings = Strings::default();
    let (builder, _) = robot(&strings);
    let node = TestNode::start(builder).await;
    bring_to_rest(&node).await;
    (0..8).for_each(|_| strings.pull("lamp", "on_initialize", Pull::Fail("no power")));

    let failed = node.restart().await.unwrap_err();
    assert!(
        matches!(&failed, RestartError::GaveUp { reason } if reason.contains("lamp")),
        "{failed}"
    );
    assert!(matches!(node.state(), NodeState::InSafeState { .. }));

    strings.cut_all();
    node.restart().await.unwrap();
    ask(&node, "lamp", Deed::Nothing).await.unwrap();
}

#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/drive", reply = f32)]
struct Drive(f32);

#[blastema_testkit::test]
async fn the_safe_outputs_wait_for_no_component_to_stop_and_nobody_commands_any_more() {
    let (strings, track) = (Strings::default(), Notes::<f32>::default());
    let (builder, applied) = robot(&strings);
    let safe = ActuatorSpec::new(Drive(0.0), Hold).lease(Duration::from_secs(60));
    let wheels = moves("wheels", safe, track.clone(), |track, Drive(speed), _| {
        track.note(speed);
        speed
    });
    // The last to start is the first to stop, and it is slow.
    let arm = strings.spec("arm").shutdown_within(Duration::from_secs(10));
    strings.pull("arm", "on_shutdown", Pull::Wait(Duration::from_secs(4)));
    let node = TestNode::start(builder.child(wheels).child(arm)).await;
    let commander = node.commander::<Drive>("wheels", "console").unwrap();
    commander.claim().await.unwrap();
    commander.command(Drive(2.0)).await.unwrap();

    strike(&node, "motors").await;
    node.advance(500 * MS).await;
    strike(&node, "motors").await;
    node.advance(10 * MS).await;

    assert!(matches!(node.state(), NodeState::InSafeState { .. }), "{:?}", node.state());
    assert_eq!(applied.lock().unwrap().len(), 1, "at once");
    assert_eq!(track.all(), [2.0, 0.0]);
    assert!(commander.command(Drive(3.0)).await.is_err());
    assert_eq!(commander.claim().await, Err(DeliveryError::Stopped));

    node.advance(Duration::from_secs(30)).await;
    node.restart().await.unwrap();
    assert!(commander.command(Drive(4.0)).await.is_err(), "that lease has ended");
    commander.claim().await.unwrap();
    commander.command(Drive(5.0)).await.unwrap();
    assert_eq!(track.all().last(), Some(&5.0));
    assert_eq!(applied.lock().unwrap().len(), 1);
}
