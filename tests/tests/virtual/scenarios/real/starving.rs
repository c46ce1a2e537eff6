//! A component that keeps one thread after the other, and those who must not suffer from it: on
//! real threads.
//!
//! Nothing here measures time: each test waits for what it says, and counts.

use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use blastema::{
    ActuatorSpec, Hold, Incarnation, NodeBuilder, RestartError, RestartedChild, ThreadState,
};
use blastema_tests::{found, until};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

/// As long as a test may take on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// What is said of a fault that safe stop has answered.
const CONTAINED: &str = "contained by safe stop; service is not restored";

/// Blocks the laser that is asked.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "starving/fire")]
struct Fire;

/// What the lasers and counters of one test share with it.
#[derive(Clone, Default)]
struct Bench(Arc<Inner>);

#[derive(Default)]
struct Inner {
    open: Mutex<bool>,
    opened: Condvar,
    /// From which incarnation on a laser blocks at start.
    blocks_from: AtomicU64,
    /// The latest incarnation of the laser whose start has begun.
    incarnation: AtomicU64,
    count: AtomicU64,
}

impl Bench {
    fn new(blocks_from: u64) -> Self {
        let bench = Bench::default();
        bench.0.blocks_from.store(blocks_from, Relaxed);
        bench
    }

    fn block(&self) {
        let open = self.0.open.lock().unwrap();
        drop(self.0.opened.wait_while(open, |open| !*open).unwrap());
    }

    fn release(&self) {
        *self.0.open.lock().unwrap() = true;
        self.0.opened.notify_all();
    }

    fn laser(&self, name: &str) -> ChildSpec<Laser> {
        let bench = self.clone();
        ChildSpec::new(name, move || Laser(bench.clone())).max_block(Duration::from_millis(150))
    }

    fn counter(&self, name: &str) -> ChildSpec<Counter> {
        let bench = self.clone();
        ChildSpec::new(name, move || Counter(bench.clone())).rate_hz(100.0)
    }
}

/// Keeps its thread at start, and when it is told to fire.
struct Laser(Bench);

impl Component for Laser {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Fire>();
    }

    async fn on_startup(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.0.0.incarnation.fetch_max(cx.incarnation().0, Relaxed);
        if cx.incarnation().0 >= self.0.0.blocks_from.load(Relaxed) {
            self.0.block();
        }
        Ok(())
    }
}

impl Handle<Fire> for Laser {
    async fn handle(&mut self, Fire: Fire, _: &mut Context<Self>) {
        self.0.block();
    }
}

/// Counts its rounds.
struct Counter(Bench);

impl Component for Counter {
    fn ports(_: &mut Ports<Self>) {}

    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.0.0.count.fetch_add(1, Relaxed);
        Ok(())
    }
}

fn robot() -> NodeBuilder {
    Node::builder("module1").work_threads(1).grace(Duration::from_millis(100))
}

async fn start(builder: NodeBuilder) -> Node {
    builder.start().await.expect("the node starts")
}

async fn state_of(node: &Node, name: &str) -> ChildState {
    let tree = node.tree().await.expect("the node runs");
    let child = tree.children.iter().find(|child| child.name.as_str() == name);
    child.unwrap_or_else(|| panic!("no {name} in {tree:?}")).state
}

/// Waits until the component is in the safe state.
async fn until_at_rest(node: &Node, name: &str) {
    until(async || state_of(node, name).await == ChildState::Resting, "the safe state").await;
}

/// Waits until the hang of the component is given up, and says why.
async fn until_given_up(node: &Node, name: &str) -> String {
    let location = format!("module1:{name}");
    let reason = async || {
        let entries = node.faults().await.entries;
        let here = |f: &blastema::Fault| f.location.to_string() == location;
        let mut hangs = entries.into_iter().filter(|entry| here(&entry.fault));
        hangs.find_map(|entry| entry.given_up).map(|(_, reason)| reason)
    };
    found(reason, "it is given up").await
}

/// Waits until every fault is over.
async fn until_none_stands(node: &Node) {
    let none_stands = async || !node.faults().await.entries.iter().any(|entry| entry.stands());
    until(none_stands, "no fault stands").await;
}

/// In which incarnation the component is.
async fn incarnation_of(node: &Node, name: &str) -> Incarnation {
    let location = format!("module1:{name}");
    let row = node.table().await.into_iter().find(|row| row.location.to_string() == location);
    row.expect("it is watched").incarnation
}

/// No fault of the component is its own.
async fn assert_no_root(node: &Node, name: &str) {
    let location = format!("module1:{name}");
    for entry in node.faults().await.entries {
        let at = entry.fault.location.to_string();
        assert!(at != location || entry.fault.symptom_of.is_some(), "{:?}", entry.fault);
    }
}

#[test]
fn neighbours_of_one_that_hangs_at_each_start_go_on_and_are_blamed_for_nothing() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let bench = Bench::new(2);
        let builder = robot().child(bench.laser("laser")).child(bench.counter("counter"));
        let node = start(builder).await;
        let incarnation = || bench.0.incarnation.load(Relaxed);

        node.sender("laser").unwrap().tell(Fire).unwrap();
        until(async || incarnation() >= 2, "its next incarnation hangs").await;
        until(async || incarnation() >= 3, "the one after that").await;
        let before = bench.0.count.load(Relaxed);
        until_given_up(&node, "laser").await;
        until_at_rest(&node, "laser").await;

        assert!(bench.0.count.load(Relaxed) > before, "it counts while the laser hangs");
        assert_no_root(&node, "counter").await;
        assert!(incarnation_of(&node, "counter").await <= Incarnation(2), "it moved once");
        assert_eq!(node.state(), NodeState::Running);
        let by = |row: blastema::ThreadRow| match row.state {
            ThreadState::Abandoned { by } => Some(by.to_string()),
            _ => None,
        };
        let all_lost = || node.threads().into_iter().filter_map(by).collect::<Vec<_>>();
        until(async || all_lost().len() == 4, "all its threads are lost").await;
        assert!(all_lost().iter().all(|by| by == "laser"), "{:?}", all_lost());

        bench.release();
        until(async || node.abandoned_threads() == 0, "they come back").await;
        let before = bench.0.count.load(Relaxed);
        let restarted = node.restart_child("laser").await.expect("it starts");
        assert_ne!(restarted, RestartedChild::Finished);
        until(async || bench.0.count.load(Relaxed) > before, "the counter goes on").await;
        assert_eq!(node.state(), NodeState::Running);
        node.shutdown().await;
    });
}

#[test]
fn a_component_that_hangs_at_each_start_holds_nobody_behind_it_up() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let bench = Bench::new(1);
        let builder = robot().child(bench.laser("laser")).child(bench.counter("counter"));

        let node = start(builder).await;

        until(async || bench.0.count.load(Relaxed) > 0, "it counts").await;
        assert_eq!(incarnation_of(&node, "counter").await, Incarnation(1));
        assert_eq!(state_of(&node, "laser").await, ChildState::Resting);
        assert_no_root(&node, "counter").await;
        assert_eq!(node.state(), NodeState::Running);
        bench.release();
        node.shutdown().await;
    });
}

#[test]
fn a_component_that_keeps_its_share_of_threads_is_given_up_alone() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let bench = Bench::new(u64::MAX);
        let builder = robot()
            .intensity(1000, Duration::from_secs(1))
            .child(bench.laser("laser"))
            .child(bench.counter("counter"));
        let node = start(builder).await;

        for incarnation in 1..=4 {
            let is_next = async || bench.0.incarnation.load(Relaxed) == incarnation;
            until(is_next, "it is in its next incarnation").await;
            until_none_stands(&node).await;
            node.sender("laser").unwrap().tell(Fire).unwrap();
        }
        until_at_rest(&node, "laser").await;

        assert_eq!(until_given_up(&node, "laser").await, CONTAINED);
        assert_eq!(bench.0.incarnation.load(Relaxed), 4, "no fifth thread is lost to it");
        let refused = node.restart_child("laser").await;
        let Err(RestartError::ChildGaveUp { name, reason }) = refused else {
            panic!("{refused:?}")
        };
        assert_eq!(name.as_str(), "laser");
        assert!(reason.to_string().contains("4 threads"), "{reason}");
        until(async || node.abandoned_threads() == 4, "all its threads are lost").await;
        assert_eq!(node.state(), NodeState::Running);
        let before = bench.0.count.load(Relaxed);
        until(async || bench.0.count.load(Relaxed) > before, "the counter goes on").await;
        bench.release();
        node.shutdown().await;
    });
}

/// Commands the tray.
#[derive(Clone, Debug, Request)]
#[contract(name = "starving/move", reply = f32)]
struct Move(f32);

/// Its first incarnation blocks when it is stopped.
struct Tray(Bench);

impl Component for Tray {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Move(0.0), Hold));
    }

    async fn on_deactivated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        if cx.incarnation() == Incarnation::FIRST {
            self.0.block();
            self.0.0.count.fetch_add(1, Relaxed);
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
        let bench = Bench::default();
        let of_tray = bench.clone();
        let tray = ChildSpec::new("tray", move || Tray(of_tray.clone()));
        let node = start(robot().child(tray.shutdown_within(Duration::from_millis(100)))).await;

        node.restart_child("tray").await.expect("it is abandoned, and another one begins");
        let commander = node.commander::<Move>("tray", "console").expect("it is an actuator");
        commander.claim_within(LONG).await.expect("the second incarnation is active");
        commander.release().await.expect("it is held");
        bench.release();
        until(async || bench.0.count.load(Relaxed) == 1, "the hook of the first returns").await;
        // What follows the hook runs on the same thread right behind it.
        tokio::time::sleep(Duration::from_millis(100)).await;

        commander.claim_within(LONG).await.expect("the second incarnation is active still");
        assert!(commander.command(Move(2.0)).await.is_ok());
        node.shutdown().await;
    });
}
