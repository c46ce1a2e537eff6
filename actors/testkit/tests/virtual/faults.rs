//! Faults that are put into components by name, and doubles of their partners.

use blastema::detection::{Liveness, Push};
use blastema::prelude::*;
use blastema_testkit::{Harness, Probe, TestNode, owner};
use std::process::{Command, Stdio};
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

#[derive(Debug, Request)]
#[contract(name = "arm/where", reply = u64)]
struct Where;

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "wheels/drive")]
struct Drive(i32);

#[derive(Clone, Debug, PartialEq, Request)]
#[contract(name = "steering/turn", reply = i32)]
struct Turn(i32);

#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "arm/limit")]
struct Limit(u32);

/// Knows nothing of any test.
struct Arm;

impl Component for Arm {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Where>();
    }

    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        Ok(())
    }
}

impl Handle<Where> for Arm {
    async fn handle(&mut self, _: Where, cx: &mut Context<Self>) -> u64 {
        cx.incarnation().0
    }
}

async fn node() -> TestNode {
    let arm = ChildSpec::new("arm", || Arm)
        .rate_hz(10.0)
        .max_wait(Duration::from_millis(200))
        .liveness(Liveness::Push(Push {
            interval: Duration::from_millis(100),
            tolerance: 3,
            start_up: SECOND,
        }));
    TestNode::start(Node::builder("module1").child(arm)).await
}

async fn incarnation(node: &TestNode) -> u64 {
    node.sender("arm").unwrap().ask(Where).await.unwrap()
}

#[blastema_testkit::test]
async fn a_component_that_hangs_is_replaced() {
    let mut node = node().await;

    node.hang("arm");

    node.await_fault(FaultKind::Hang, "arm").await;
    node.await_recovered(FaultKind::Hang, "arm").await;
    assert_eq!(incarnation(&node).await, 2);
}

#[blastema_testkit::test]
async fn a_component_that_is_silenced_is_taken_for_silent() {
    let mut node = node().await;
    node.advance(2 * SECOND).await;
    node.expect_no_faults().await;

    node.silence("arm");

    node.await_fault(FaultKind::Silence, "arm").await;
    node.heal("arm");
    node.await_recovered(FaultKind::Silence, "arm").await;
}

#[blastema_testkit::test]
async fn a_component_that_is_silenced_and_not_watched_for_signs_misses_no_round() {
    let spec = ChildSpec::new("arm", || Arm).rate_hz(20.0);
    let node = TestNode::start(Node::builder("module1").child(spec)).await;

    node.silence("arm");
    node.advance(10 * SECOND).await;

    node.expect_no_faults().await;
    assert_eq!(node.row("arm").await.missed_rounds, 0);
}

#[blastema_testkit::test]
async fn initialisations_fail_as_often_as_they_are_told_to() {
    let mut node = node().await;

    node.fail_init("arm", 2);
    node.kill("arm");

    node.await_fault(FaultKind::InitializationFailed, "arm").await;
    node.advance(10 * SECOND).await;
    assert_eq!(incarnation(&node).await, 4);
}

#[blastema_testkit::test]
async fn a_component_that_is_slowed_answers_later_until_it_is_healed() {
    let node = node().await;
    let arm = node.sender("arm").unwrap();

    node.slow("arm", Duration::from_millis(150));
    let late = arm.ask_within(Where, Duration::from_millis(100)).await;
    assert_eq!(late.unwrap_err().kind, DeliveryError::DeadlinePassed);
    node.heal("arm");
    node.advance(2 * SECOND).await;

    assert!(arm.ask_within(Where, Duration::from_millis(100)).await.is_ok());
}

#[blastema_testkit::test]
#[should_panic(expected = "did you mean `arm`?")]
async fn a_fault_for_nobody_fails_the_test() {
    node().await.kill("amr");
}

#[blastema_testkit::test]
async fn an_actuator_and_a_variable_have_doubles() {
    let drives = Probe::<Drive>::new();
    let builder = Node::builder("module1")
        .child(drives.actuator("wheels", Drive(0)))
        .child(owner("arm", Limit(3)));
    let node = TestNode::start(builder).await;

    let wheels = node.commander::<Drive>("wheels", "test").unwrap();
    wheels.claim().await.unwrap();
    wheels.command(Drive(5)).await.unwrap();
    drop(wheels);
    let limit = node.variable::<Limit>("arm").unwrap();
    limit.write(Limit(4)).await.unwrap();

    assert_eq!(drives.wait(|drive| *drive != Drive(0)).await, Drive(5));
    assert_eq!(drives.expect().await, Drive(0), "its commander has gone");
    assert_eq!(limit.read().await.unwrap().value, Limit(4));
}

#[blastema_testkit::test]
async fn an_actuator_whose_commands_have_replies_has_a_double() {
    let turns = Probe::<Turn>::new();
    let steering = turns.answering_actuator("steering", Turn(0), |Turn(degrees)| 2 * degrees);
    let node = TestNode::start(Node::builder("module1").child(steering)).await;

    let commander = node.commander::<Turn>("steering", "test").unwrap();
    let refused = commander.command(Turn(1)).await.unwrap_err();
    assert_eq!(refused, DeliveryError::LeaseEnded { actuator: "steering".into() });
    commander.claim().await.unwrap();
    assert_eq!(commander.command(Turn(5)).await, Ok(10));
    drop(commander);

    assert_eq!(turns.wait(|turn| *turn != Turn(0)).await, Turn(5));
    assert_eq!(turns.expect().await, Turn(0), "its commander has gone");
}

/// Names the hook that is to hang, in the program that a test starts for that.
const HANGS: &str = "BLASTEMA_TEST_HANGS";

/// Never returns, where it is told so.
fn hang_in(hook: &str) {
    while std::env::var(HANGS).as_deref() == Ok(hook) {
        std::thread::park();
    }
}

struct Stuck;

impl Component for Stuck {
    fn ports(_: &mut Ports<Self>) {
        hang_in("ports");
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        hang_in("on_initialize");
        Ok(())
    }

    async fn on_activated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        hang_in("on_activated");
        Ok(())
    }

    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        hang_in("on_execute");
        Ok(())
    }
}

#[blastema_testkit::test]
async fn a_handler_that_never_returns() {
    let lidar = ChildSpec::new("lidar", || Stuck).rate_hz(10.0);
    let node = TestNode::start(Node::builder("module1").child(lidar)).await;
    node.advance(SECOND).await;
}

#[blastema_testkit::test]
async fn an_added_component_that_never_returns() {
    let node = TestNode::start(Node::builder("module1")).await;
    node.add_child(ChildSpec::new("lidar", || Stuck)).await.unwrap();
    node.settle().await;
}

#[test]
fn a_test_that_hangs_ends_with_the_name_of_the_component() {
    let program = std::env::current_exe().expect("this program");
    let hook = |test: &'static str, hook: &'static str| {
        // Without `--nocapture`, as a user runs it.
        let mut again = Command::new(&program);
        again.args(["--exact", test]).env(HANGS, hook).stderr(Stdio::piped());
        (test, hook, again.spawn().expect("this program again"))
    };

    let hanging = ["ports", "on_initialize", "on_activated", "on_execute"]
        .map(|name| hook("faults::a_handler_that_never_returns", name));
    let added = hook("faults::an_added_component_that_never_returns", "on_activated");

    for (test, hook, program) in hanging.into_iter().chain([added]) {
        let ended = program.wait_with_output().expect("this program ends");
        let said = String::from_utf8_lossy(&ended.stderr);
        assert_eq!(ended.status.code(), Some(101), "{hook}: {said}");
        let wanted = format!("{test} hangs: lidar has kept its thread in {hook}");
        assert!(said.contains(&wanted), "{said}");
    }
}

/// Finds no lens.
struct Blind;

impl Component for Blind {
    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        Err("no lens".into())
    }
}

#[test]
#[should_panic(expected = "the component was not started: initialisation failed")]
fn a_harness_says_that_its_component_does_not_start() {
    blastema_testkit::run(async {
        Harness::start(ChildSpec::new("camera", || Blind)).await;
    });
}

/// Its device is not there yet.
struct Patient;

impl Component for Patient {
    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        Err(Failure::unavailable("/dev/video0 is not there"))
    }
}

#[blastema_testkit::test]
async fn a_harness_takes_a_component_that_waits_for_its_device() {
    let camera = Harness::start(ChildSpec::new("camera", || Patient)).await;
    assert_eq!(camera.state(), blastema::Lifecycle::Created);
}
