//! A component that keeps one thread after the other, and those who must not suffer from it: on
//! real threads.
//!
//! Nothing here measures time: each test waits for what it says, and counts.

use crate::scenarios::puppet::{Deed, Do, Pull, Strings};
use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use blastema::{
    ActuatorSpec, Hold, Incarnation, NodeBuilder, RestartError, RestartedChild, ThreadState,
};
use blastema_testkit::TestNode;
use blastema_tests::until;
use std::time::Duration;

/// As long as a test may take on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// What is said of a fault that safe stop has answered.
const CONTAINED: &str = "contained by safe stop; service is not restored";

fn robot() -> NodeBuilder {
    Node::builder("module1").work_threads(1).grace(Duration::from_millis(100))
}

/// A `laser` and a `counter` on one thread.
async fn start(builder: NodeBuilder, strings: &Strings) -> TestNode {
    let laser = strings.spec("laser").max_block(Duration::from_millis(150));
    let node = builder.child(laser).child(strings.spec("counter").rate_hz(100.0)).start().await;
    TestNode::of(node.expect("the node starts")).await
}

/// Has the laser keep its thread.
fn fire(node: &Node) {
    node.sender("laser").unwrap().tell(Do(Deed::Block(String::new()))).unwrap();
}

/// Each start of the laser keeps its thread from now on.
fn hang_at_each_start(strings: &Strings) {
    (0..99).for_each(|_| strings.pull("laser", "on_startup", Pull::Block));
}

/// Waits until this incarnation of the laser begins.
async fn until_begun(strings: &Strings, incarnation: u64) {
    let line = format!("laser#{incarnation} on_startup");
    until(async || !strings.lines(&line).is_empty(), &line).await;
}

async fn laser_state(node: &Node) -> ChildState {
    node.tree().await.expect("the node runs").children[0].state
}

/// The counter works, in this incarnation at most, and no fault of it is its own.
async fn expect_unharmed_counter(node: &TestNode, latest: u64) {
    let counter = node.sender::<Do>("counter").unwrap();
    let incarnation = counter.ask_within(Do(Deed::Nothing), LONG).await.expect("it works");
    assert!(incarnation <= latest, "{incarnation}");
    for entry in node.faults().await.entries {
        let at = entry.fault.location.to_string();
        assert!(at != "module1:counter" || entry.fault.symptom_of.is_some(), "{:?}", entry.fault);
    }
    assert_eq!(node.state(), NodeState::Running);
}

#[test]
fn neighbours_of_one_that_hangs_at_each_start_go_on_and_are_blamed_for_nothing() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let strings = Strings::default();
        let mut node = start(robot(), &strings).await;
        hang_at_each_start(&strings);

        fire(&node);
        until_begun(&strings, 3).await;
        // One move to another thread is enough for it.
        expect_unharmed_counter(&node, 2).await;
        node.await_given_up(FaultKind::Hang, "laser").await;
        until(async || laser_state(&node).await == ChildState::Resting, "the safe state").await;

        expect_unharmed_counter(&node, 2).await;
        let by = |row: blastema::ThreadRow| match row.state {
            ThreadState::Abandoned { by } => Some(by.to_string()),
            _ => None,
        };
        let all_lost = || node.threads().into_iter().filter_map(by).collect::<Vec<_>>();
        until(async || all_lost().len() == 4, "all its threads are lost").await;
        assert!(all_lost().iter().all(|by| by == "laser"), "{:?}", all_lost());

        strings.cut_all();
        strings.release();
        until(async || node.abandoned_threads() == 0, "they come back").await;
        let restarted = node.restart_child("laser").await.expect("it starts");
        assert_ne!(restarted, RestartedChild::Finished);
        expect_unharmed_counter(&node, 2).await;
        node.shutdown().await;
    });
}

#[test]
fn a_component_that_hangs_at_each_start_holds_nobody_behind_it_up() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let strings = Strings::default();
        hang_at_each_start(&strings);

        let node = start(robot(), &strings).await;

        expect_unharmed_counter(&node, 1).await;
        assert_eq!(laser_state(&node).await, ChildState::Resting);
        strings.release();
        node.shutdown().await;
    });
}

#[test]
fn a_component_that_keeps_its_share_of_threads_is_given_up_alone() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let strings = Strings::default();
        let builder = robot().intensity(1000, Duration::from_secs(1));
        let mut node = start(builder, &strings).await;

        for incarnation in 1..=4 {
            until_begun(&strings, incarnation).await;
            let stands = async || node.faults().await.entries.iter().any(|entry| entry.stands());
            until(async || !stands().await, "no fault stands").await;
            fire(&node);
        }

        assert_eq!(node.await_given_up(FaultKind::Hang, "laser").await, CONTAINED);
        until(async || laser_state(&node).await == ChildState::Resting, "the safe state").await;
        assert_eq!(strings.lines("laser#5"), [""; 0], "no fifth thread is lost to it");
        let refused = node.restart_child("laser").await;
        let Err(RestartError::ChildGaveUp { name, reason }) = refused else {
            panic!("{refused:?}")
        };
        assert_eq!(name.as_str(), "laser");
        assert!(reason.to_string().contains("4 threads"), "{reason}");
        until(async || node.abandoned_threads() == 4, "all its threads are lost").await;
        expect_unharmed_counter(&node, u64::MAX).await;
        strings.release();
        node.shutdown().await;
    });
}

/// Commands the tray.
#[derive(Clone, Debug, Request)]
#[contract(name = "starving/move", reply = f32)]
struct Move(f32);

/// Its first incarnation blocks when it is stopped.
struct Tray(Strings);

impl Component for Tray {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Move(0.0), Hold));
    }

    async fn on_deactivated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        if cx.incarnation() == Incarnation::FIRST {
            self.0.block();
            self.0.write("it returns".to_owned());
        }
        Ok(())
    }
}

impl Handle<Move> for Tray {
    async fn handle(&mut self, Move(to): Move, _: &mut Context<Self>) -> f32 {
        to
    }
}

#[test]
fn a_hook_that_returns_after_its_incarnation_was_abandoned_says_nothing_of_the_next_one() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let strings = Strings::default();
        let of_tray = strings.clone();
        let tray = ChildSpec::new("tray", move || Tray(of_tray.clone()));
        let builder = robot().child(tray.shutdown_within(Duration::from_millis(100)));
        let node = builder.start().await.expect("the node starts");

        node.restart_child("tray").await.expect("it is abandoned, and another one begins");
        let commander = node.commander::<Move>("tray", "console").expect("it is an actuator");
        commander.claim_within(LONG).await.expect("the second incarnation is active");
        commander.release().await.expect("it is held");
        strings.release();
        until(async || !strings.diary().is_empty(), "the hook of the first returns").await;
        // What follows the hook runs on the same thread right behind it.
        tokio::time::sleep(Duration::from_millis(100)).await;

        commander.claim_within(LONG).await.expect("the second incarnation is active still");
        assert!(commander.command(Move(2.0)).await.is_ok());
        node.shutdown().await;
    });
}
