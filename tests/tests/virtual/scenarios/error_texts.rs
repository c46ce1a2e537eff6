//! What errors and faults tell a user who has to act on them.

use crate::scenarios::puppet::{Deed, Do, News, Pull, Puppet, Strings};
use blastema::prelude::*;
use blastema::{ActuatorSpec, FaultTransition, Hold, SpecError, VariableSpec};
use blastema_testkit::TestNode;
use blastema_tests::{MS, moves, part};
use std::time::Duration;

/// A component of another type than those of the node.
struct Radar;

impl Component for Radar {}

#[blastema_testkit::test]
async fn an_actor_of_another_type_is_told_from_one_that_is_not_there() {
    let (_, node) = Strings::robot(["laser"]).await;

    let told = node.actor::<Radar>("laser").expect_err("it is a puppet").to_string();
    for part in ["`laser`", "puppet::Puppet", "error_texts::Radar"] {
        assert!(told.contains(part), "{part} is missing in {told}");
    }

    let misspelt = node.actor::<Puppet>("lasr").expect_err("none is called so").to_string();
    assert!(misspelt.contains("did you mean `laser`?"), "{misspelt}");
}

#[blastema_testkit::test]
async fn who_asks_a_component_that_waits_for_its_device_is_told_that_and_since_when() {
    let strings = Strings::default();
    for _ in 0..100 {
        strings.pull("laser", "on_initialize", Pull::Unavailable("/dev/laser is not there"));
    }
    let node = TestNode::start(Node::builder("module1").child(strings.spec("laser"))).await;
    let laser = node.sender::<Do>("laser").unwrap();
    node.advance(1500 * MS).await;

    let late = laser.ask(Do(Deed::Nothing)).await.expect_err("its device is not there");

    assert_eq!(late.kind, DeliveryError::DeadlinePassed);
    let told = late.to_string();
    for part in ["module1:laser", "/dev/laser is not there", "for 2.5 s"] {
        assert!(told.contains(part), "{part} is missing in {told}");
    }

    strings.cut_all();
    node.advance(Duration::from_secs(6)).await;
    laser.ask(Do(Deed::Nothing)).await.expect("its device has come");
    let late = laser.ask_within(Do(Deed::Await(5000)), 100 * MS).await.unwrap_err();
    assert!(!late.to_string().contains("/dev/laser"), "{late}");
    assert!(late.to_string().ends_with("failed: no reply within 100ms"), "{late}");
}

#[blastema_testkit::test]
async fn a_hook_that_hangs_while_its_node_ends_is_a_fault_about_which_nothing_is_decided() {
    let strings = Strings::default();
    strings.pull("arm", "on_finalize", Pull::Wait(Duration::from_secs(3600)));
    let arm = strings.spec("arm").max_wait(200 * MS);
    let node = TestNode::start(Node::builder("module1").child(arm)).await;
    let mut events = node.fault_events();

    node.shutdown().await;

    let (mut hangs, mut decided) = (0, Vec::new());
    while let Some(event) = events.next().await {
        match event.turn {
            FaultTransition::Found => hangs += usize::from(event.fault.kind == FaultKind::Hang),
            turn @ FaultTransition::Decided { .. } => decided.push(turn),
            _ => {}
        }
    }
    assert!(hangs > 0, "it is told");
    assert_eq!(decided, []);
}

#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/drive", reply = ())]
struct Drive(f32);

#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "wheels/limit")]
struct Limit(f32);

#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "wheels/colour")]
struct Colour(u32);

/// What a user is told to write for a variable that a component has not.
const DECLARE: &str =
    "write `ports.variable(…)`, or `ports.parameters::<…>()` for parameters, in its `fn ports`";

/// Why something was refused, as it is printed.
#[track_caller]
fn text<T>(refused: Result<T, DeliveryError>) -> String {
    match refused {
        Ok(_) => panic!("it is not refused"),
        Err(why) => why.to_string(),
    }
}

#[blastema_testkit::test]
async fn what_is_looked_for_in_the_wrong_place_is_told_with_what_is_there() {
    let strings = Strings::default();
    let wheels = moves("wheels", ActuatorSpec::new(Drive(0.0), Hold), (), |_, _, _| {});
    let wheels = wheels.with_ports(|ports| {
        ports.variable(VariableSpec::new(Limit(1.0)));
    });
    let builder = Node::builder("module1").child(strings.spec("laser")).child(wheels);
    let node = TestNode::start(builder).await;

    let misspelt = text(node.sender::<Do>("modul1:laser"));
    assert!(misspelt.contains("did you mean `module1:laser`?"), "{misspelt}");
    let elsewhere = text(node.sender::<Do>("gripper:laser"));
    assert!(elsewhere.contains("node gripper cannot be reached"), "{elsewhere}");
    let actuator = text(node.sender::<Drive>("wheels"));
    assert!(actuator.contains("wheels does not serve `wheels/drive`"), "{actuator}");
    assert!(actuator.ends_with("it is an actuator: command it by `commander`"), "{actuator}");
    assert!(!actuator.contains("blastema/"), "{actuator}");
    let none = text(node.commander::<Drive>("laser", "console"));
    assert!(none.starts_with("laser is no actuator: it serves `"), "{none}");
    let commander = node.commander::<Drive>("wheels", "console").unwrap();
    let unclaimed = text(commander.command(Drive(1.0)).await);
    assert!(unclaimed.contains("holds no lease"), "{unclaimed}");
    let colour = text(node.variable::<Colour>("wheels").unwrap().read().await);
    assert_eq!(
        colour,
        format!("wheels has no variable `wheels/colour`: it has `wheels/limit`; {DECLARE}")
    );
    let none = text(node.variable::<Colour>("laser"));
    assert_eq!(none, format!("laser has no variable `wheels/colour`: it has none; {DECLARE}"));
    let nothing = text(node.sender::<Do>(""));
    assert!(!nothing.contains("did you mean"), "{nothing}");
    let news = node.publisher::<News>("test/news").unwrap();
    news.publish(News(0)).unwrap();

    node.shutdown().await;
    assert_eq!(text(node.sender::<Do>("laser")), "node module1 was shut down");
    assert_eq!(text(node.publisher::<News>("test/news")), "node module1 was shut down");
    let unpublished = news.publish(News(1)).expect_err("its node was shut down");
    assert_eq!(unpublished.kind, DeliveryError::ShutDown { node: "module1".into() });
    assert_eq!(unpublished.message.0, 1);
}

#[blastema_testkit::test]
async fn an_injected_panic_is_told_without_a_place() {
    let (_, mut node) = Strings::robot(["arm"]).await;

    node.kill("arm");

    let fault = node.await_fault(FaultKind::Panic, "arm").await;
    assert_eq!(fault.detail, "it was told to panic, in an injected fault");
    let printed = "error: panic of module1:arm: it was told to panic, in an injected fault";
    assert_eq!(fault.to_string(), printed);
}

#[derive(Clone, Debug, PartialEq, Parameters)]
#[contract(name = "arm/reach")]
struct Reach {
    #[parameter(default = 5.0, range = 0.0..=1.0, unit = "m")]
    length: f64,
}

/// Reads parameters that it has not declared.
struct Undeclared;

impl Component for Undeclared {
    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        Err(text(cx.parameters::<Reach>()).as_str().into())
    }
}

#[blastema_testkit::test]
async fn what_a_component_declares_wrongly_is_told_with_what_to_write() {
    let (strings, mut node) = Strings::robot(["laser"]).await;
    let told = |refused: Result<_, SpecError>| refused.map(drop).unwrap_err().to_string();

    let overlong = part("arm", (), |_, _: Reach, _| {}).with_ports(|ports| {
        ports.parameters::<Reach>();
    });
    let overlong = told(node.add_child(overlong).await.map(drop));
    let default = "the default of `length` in the code is 5.0, and must be in 0.0..=1.0 m";
    assert!(overlong.ends_with(default), "{overlong}");
    let needs = strings.spec("hand").depends_on(["a b"]);
    let needs = told(node.add_child(needs).await.map(drop));
    assert!(needs.starts_with("what hand depends on: \"a b\" holds ' '"), "{needs}");
    let taken = told(node.add_child(strings.spec("laser")).await.map(drop));
    assert!(taken.contains("the name laser is taken by a component"), "{taken}");
    let taken = told(node.add_child(strings.spec("root")).await.map(drop));
    assert!(taken.contains("the name root is taken by a supervisor"), "{taken}");
    let never = told(node.add_child(strings.spec("hand").rate_hz(1e-300)).await.map(drop));
    assert!(never.contains("rate_hz of hand is 1e-300"), "{never}");

    node.add_child(ChildSpec::new("leg", || Undeclared)).await.unwrap();
    let fault = node.await_fault(FaultKind::InitializationFailed, "leg").await;
    assert!(fault.detail.contains("leg has no variable `arm/reach`"), "{}", fault.detail);
    assert!(fault.detail.contains("`ports.parameters::<…>()`"), "{}", fault.detail);
}
