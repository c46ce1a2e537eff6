//! Actuators that are stopped in order, in virtual time: none keeps its last command.

use blastema::prelude::*;
use blastema::{ActuatorSpec, Commander, Hold, StartError};
use blastema_testkit::TestNode;
use blastema_tests::{MS, Notes};
use std::time::Duration;

/// Moves the machine. Some commands do more than that.
#[derive(Clone, Debug, Request)]
#[contract(name = "stops/drive", reply = ())]
struct Drive(f32);

const SAFE: Drive = Drive(0.0);
/// Sinks by one in each round, and has settled after three.
const LAND: Drive = Drive(-1.0);
const WAIT_FOR_EVER: Drive = Drive(-4.0);
/// Lands, and panics on the way, fails on the way, or never settles.
const LAND_AND_PANIC: Drive = Drive(-5.0);
const LAND_AND_FAIL: Drive = Drive(-6.0);
const NEVER_SETTLE: Drive = Drive(-7.0);
/// Goes on, and panics when it is deactivated.
const PANIC_AT_THE_END: Drive = Drive(-8.0);

/// Keeps the machine for 50 ms.
#[derive(Clone, Debug, Event)]
struct Nap;

/// What happened, in order.
type Log = Notes<String>;

struct Machine {
    log: Log,
    height: i32,
    last: f32,
}

impl Component for Machine {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Nap>();
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        if self.height > 0 {
            self.height -= 1;
            self.log.note(format!("at {}", self.height));
            if self.height == 0 {
                cx.settled();
            }
            match (self.height, self.last) {
                (1, -5.0) => panic!("a gust"),
                (1, -6.0) => return Err("a gust".into()),
                _ => {}
            }
        }
        Ok(())
    }

    async fn on_deactivated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.log.note("deactivated");
        assert!(self.last != PANIC_AT_THE_END.0, "it jams");
        Ok(())
    }
}

impl Handle<Drive> for Machine {
    async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) {
        self.log.note(format!("drive {}", drive.0));
        self.last = drive.0;
        match drive.0 {
            -1.0 | -5.0 | -6.0 => self.height = 3,
            -4.0 => std::future::pending().await,
            _ => {}
        }
    }
}

impl Handle<Nap> for Machine {
    async fn handle(&mut self, _: Nap, _: &mut Context<Self>) {
        blastema::sleep(50 * MS).await;
        self.log.note("nap");
    }
}

type Spec = fn(ActuatorSpec<Drive>) -> ActuatorSpec<Drive>;

fn machine(log: &Log, spec: Spec) -> ChildSpec<Machine> {
    let (log, cut) = (log.clone(), log.clone());
    ChildSpec::new("machine", move || Machine { log: log.clone(), height: 0, last: 0.0 })
        .shutdown_within(Duration::from_secs(1))
        .rate_hz(100.0)
        .with_ports(move |ports| {
            let actuator = ActuatorSpec::new(SAFE, Hold).cut_off(move || cut.note("cut off"));
            ports.actuator(spec(actuator));
        })
}

async fn start(log: &Log, spec: Spec) -> TestNode {
    TestNode::start(Node::builder("module1").child(machine(log, spec))).await
}

async fn driving(node: &TestNode) -> Commander<Drive> {
    let commander = node.commander::<Drive>("machine", "console").unwrap();
    commander.claim().await.unwrap();
    commander.command(Drive(1.0)).await.unwrap();
    commander
}

/// Drives, ends in order, and says what happened.
async fn drive_and_stop(spec: Spec) -> Vec<String> {
    let log = Log::default();
    let node = start(&log, spec).await;
    let _commander = driving(&node).await;
    node.shutdown().await;
    log.all()
}

#[blastema_testkit::test]
async fn what_moves_is_stopped_before_it_is_deactivated_in_whichever_way_it_ends_in_order() {
    for way in ["shutdown", "remove", "restart", "deactivate"] {
        let log = Log::default();
        let node = start(&log, |spec| spec).await;
        let commander = driving(&node).await;

        match way {
            "shutdown" => node.shutdown().await,
            "remove" => node.remove_child("machine").await.unwrap(),
            "restart" => drop(node.restart_child("machine").await.unwrap()),
            _ => node.actor::<Machine>("machine").unwrap().deactivate(),
        }
        node.advance(50 * MS).await;

        assert_eq!(log.all(), ["drive 1", "drive 0", "deactivated"], "{way}");
        assert!(commander.command(Drive(2.0)).await.is_err(), "{way}: the lease has ended");
        assert_eq!(log.all().len(), 3, "{way}");
    }
}

#[blastema_testkit::test]
async fn what_has_been_deactivated_is_claimed_again_once_it_is_active() {
    let log = Log::default();
    let node = start(&log, |spec| spec).await;
    let commander = driving(&node).await;
    let actor = node.actor::<Machine>("machine").unwrap();

    actor.deactivate();
    node.settle().await;
    let claimed = commander.claim_within(Duration::ZERO).await;
    assert_eq!(claimed, Err(DeliveryError::Restarting));
    actor.activate();
    commander.claim().await.unwrap();
    commander.command(Drive(2.0)).await.unwrap();

    assert_eq!(log.all(), ["drive 1", "drive 0", "deactivated", "drive 2"]);
}

#[blastema_testkit::test]
async fn a_drone_lands_and_is_deactivated_when_it_has_settled_or_its_time_is_over() {
    let lands: Spec = |spec| spec.on_stop(LAND).settle_within(500 * MS);
    let landed = ["drive 1", "drive -1", "at 2", "at 1", "at 0", "deactivated"];
    assert_eq!(drive_and_stop(lands).await, landed);

    let short: Spec = |spec| spec.on_stop(LAND).settle_within(12 * MS);
    let stopped = drive_and_stop(short).await;
    assert!(!stopped.contains(&"at 0".to_owned()), "{stopped:?}");
    assert_eq!(stopped.last().unwrap(), "deactivated");
    assert!(!stopped.contains(&"cut off".to_owned()), "it was stopped in order: {stopped:?}");
}

#[blastema_testkit::test]
async fn a_drone_that_does_not_come_to_the_ground_in_order_is_cut_off_however_it_ends() {
    let cases: [Spec; 3] = [
        |spec| spec.on_stop(LAND_AND_PANIC).settle_within(500 * MS),
        |spec| spec.on_stop(LAND_AND_FAIL).settle_within(500 * MS),
        |spec| spec.on_stop(NEVER_SETTLE).settle_within(Duration::from_secs(1)),
    ];
    for (case, spec) in cases.into_iter().enumerate() {
        for way in ["shutdown", "restart", "deactivate"] {
            let log = Log::default();
            let node = start(&log, spec).await;
            let _commander = driving(&node).await;

            match way {
                "shutdown" => node.shutdown().await,
                "restart" => drop(node.restart_child("machine").await.unwrap()),
                // It has a time to settle, and none to end.
                _ if case == 2 => continue,
                _ => node.actor::<Machine>("machine").unwrap().deactivate(),
            }
            node.advance(100 * MS).await;

            let done = log.all();
            let cut_offs = done.iter().filter(|what| *what == "cut off").count();
            assert_eq!(cut_offs, 1, "case {case}, {way}: {done:?}");
        }
    }
}

#[blastema_testkit::test]
async fn an_actuator_whose_hook_panics_is_cut_off_and_claimed_again_from_the_next_incarnation() {
    let log = Log::default();
    let node = start(&log, |spec| spec.on_stop_by_hook()).await;
    let commander = driving(&node).await;
    commander.command(PANIC_AT_THE_END).await.unwrap();

    node.actor::<Machine>("machine").unwrap().deactivate();
    node.advance(50 * MS).await;

    assert_eq!(log.all(), ["drive 1", "drive -8", "deactivated", "cut off"]);
    commander.claim().await.unwrap();
    commander.command(Drive(2.0)).await.unwrap();
}

#[blastema_testkit::test]
async fn a_handler_that_waits_for_ever_has_its_actuator_cut_off_when_it_is_stopped() {
    let log = Log::default();
    let node = start(&log, |spec| spec).await;
    let commander = driving(&node).await;
    assert!(commander.command(WAIT_FOR_EVER).await.is_err());
    commander.claim().await.unwrap();

    node.shutdown().await;

    assert_eq!(log.all(), ["drive 1", "drive -4", "cut off"]);
}

#[blastema_testkit::test]
async fn a_stop_command_needs_no_room_in_the_queue_and_no_command_that_waits_follows_it() {
    let log = Log::default();
    let child = machine(&log, |spec| spec).queue(2, WhenFull::Refuse);
    let node = TestNode::start(Node::builder("module1").child(child)).await;
    let commander = driving(&node).await;
    let naps = node.sender::<Nap>("machine").unwrap();
    naps.tell(Nap).unwrap();
    node.settle().await;
    let waits = commander.clone();
    let waits = tokio::task::spawn_local(async move { waits.command(Drive(2.0)).await });
    node.settle().await;
    naps.tell(Nap).unwrap();
    assert!(naps.tell(Nap).is_err(), "the queue is full");
    let actor = node.actor::<Machine>("machine").unwrap();

    actor.deactivate();
    node.advance(60 * MS).await;
    assert_eq!(log.all(), ["drive 1", "nap", "drive 0", "deactivated"]);
    assert!(matches!(waits.await.unwrap(), Err(DeliveryError::Expired)));

    actor.activate();
    node.advance(100 * MS).await;
    assert_eq!(log.all(), ["drive 1", "nap", "drive 0", "deactivated", "nap"]);
}

#[blastema_testkit::test]
async fn a_machine_that_may_settle_for_longer_than_it_may_take_to_stop_is_refused() {
    let child = machine(&Log::default(), |spec| spec.settle_within(Duration::from_secs(2)));
    let refused = TestNode::try_start(Node::builder("module1").child(child)).await;
    let Err(error @ StartError::Spec(_)) = refused else { panic!("it is started") };
    let text = error.to_string();
    assert!(text.contains("settle_within") && text.contains("shutdown_within"), "{text}");
}
