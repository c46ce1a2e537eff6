//! How long a command counts, and how old the data may be that it is made from, in virtual time.

use blastema::prelude::*;
use blastema::{
    ActuatorSpec, CommandTimeout, Commander, Direction, Hold, Impairment, LeaseStatus, MemoryMedium,
};
use blastema_testkit::{TestNode, now};
use blastema_tests::{MS, Notes, on_ethernet};
use std::time::Duration;

const TIMEOUT: Duration = Duration::from_millis(200);
const SECOND: Duration = Duration::from_secs(1);

/// Turns the wheels.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(name = "timeouts/drive", reply = ())]
struct Drive(f32);

/// The handler of this command never returns.
const JAM: Drive = Drive(-1.0);
const FAIL: Drive = Drive(-2.0);
const PANIC: Drive = Drive(-3.0);

/// The same, made from data that may be so old.
#[derive(Clone, Debug, Request)]
#[contract(name = "timeouts/follow", reply = (), max_age = "200ms")]
struct Follow(f32);

/// Keeps the wheels for so long.
#[derive(Clone, Debug, Event)]
struct Nap(u64);

type Log = Notes<String>;

struct Wheels(Log);

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Nap>();
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, drive: Drive, cx: &mut Context<Self>) {
        self.0.note(format!("drive {}", drive.0));
        match drive {
            JAM => std::future::pending().await,
            FAIL => cx.fail("the brake is worn"),
            PANIC => panic!("a wheel is off"),
            _ => {}
        }
    }
}

impl Handle<Follow> for Wheels {
    async fn handle(&mut self, follow: Follow, _: &mut Context<Self>) {
        self.0.note(format!("follow {}", follow.0));
    }
}

impl Handle<Nap> for Wheels {
    async fn handle(&mut self, nap: Nap, cx: &mut Context<Self>) {
        let first = cx.incarnation().0 == 1;
        blastema::sleep(if first { MS * u32::try_from(nap.0).unwrap() } else { MS }).await;
        self.0.note("nap");
    }
}

fn wheels(log: &Log) -> ChildSpec<Wheels> {
    wheels_that_stop_by(log, Drive(0.0), TIMEOUT.into())
}

fn wheels_that_stop_by(log: &Log, safe: Drive, timeout: CommandTimeout) -> ChildSpec<Wheels> {
    let (log, cut) = (log.clone(), log.clone());
    ChildSpec::new("wheels", move || Wheels(log.clone())).with_ports(move |ports| {
        let cut_off = move || cut.note("cut off");
        ports
            .actuator(ActuatorSpec::new(safe.clone(), timeout).cut_off(cut_off))
            .actuator(ActuatorSpec::new(Follow(0.0), Hold));
    })
}

async fn driving(node: &TestNode) -> Commander<Drive> {
    let commander = node.commander::<Drive>("wheels", "console").unwrap();
    commander.claim().await.unwrap();
    commander.command(Drive(1.0)).await.unwrap();
    commander
}

#[blastema_testkit::test]
async fn wheels_stop_once_when_commands_cease_though_their_commander_holds_its_lease() {
    let log = Log::default();
    let node = TestNode::start(Node::builder("module1").child(wheels(&log))).await;
    let commander = driving(&node).await;

    node.advance(TIMEOUT + 10 * MS).await;
    assert_eq!(log.all(), ["drive 1", "drive 0"], "within the timeout and one beat");
    node.advance(5 * SECOND).await;
    assert_eq!(log.all().len(), 2, "once");
    let status = node.actuators().remove(0).status;
    assert!(matches!(status, LeaseStatus::Held { .. }), "{status:?}");
    node.expect_no_faults().await;

    commander.command(Drive(2.0)).await.unwrap();
    assert_eq!(log.all().last().unwrap(), "drive 2", "the next command counts");
}

#[blastema_testkit::test]
async fn the_cut_off_is_called_where_a_handler_in_service_keeps_the_safe_command_waiting() {
    let short = (5, vec!["drive 1", "nap", "drive 0"], 0);
    let long = (500, vec!["drive 1", "cut off"], 1);
    for (nap, then, cut_offs) in [short, long] {
        let log = Log::default();
        let node = Node::builder("module1").child(wheels(&log).max_wait(60 * SECOND));
        let node = TestNode::start(node).await;
        let _commander = driving(&node).await;
        node.advance(TIMEOUT - 3 * MS).await;
        node.sender::<Nap>("wheels").unwrap().tell(Nap(nap)).unwrap();
        node.advance(30 * MS).await;

        assert_eq!(log.all(), then);
        node.advance(SECOND).await;
        assert_eq!(log.all().last().unwrap(), "drive 0");
        assert_eq!(log.all().iter().filter(|what| *what == "cut off").count(), cut_offs);
    }
}

#[blastema_testkit::test]
async fn a_component_that_awaits_for_longer_than_a_command_counts_hangs_and_its_successor_stops() {
    let log = Log::default();
    let mut node = TestNode::start(Node::builder("module1").child(wheels(&log))).await;
    let commander = driving(&node).await;
    node.sender::<Nap>("wheels").unwrap().tell(Nap(60_000)).unwrap();

    node.await_recovered(FaultKind::Hang, "wheels").await;
    node.advance(10 * MS).await;

    assert_eq!(log.all(), ["drive 1", "cut off", "drive 0"]);
    commander.command(Drive(2.0)).await.unwrap();
    assert_eq!(log.all().last().unwrap(), "drive 2");
}

#[blastema_testkit::test]
async fn an_actuator_that_holds_its_command_gets_the_safe_one_however_its_component_fails() {
    for (end, is_cut_off) in [(PANIC, false), (PANIC, true), (FAIL, false), (JAM, true)] {
        let log = Log::default();
        let spec = wheels_that_stop_by(&log, Drive(0.0), Hold).max_wait(SECOND);
        let mut node = Node::builder("module1");
        if is_cut_off {
            // Its successor does not follow on the spot.
            node = node.supervisor(SupervisorSpec::new("base", Strategy::OneForAll).child(spec));
        } else {
            node = node.child(spec);
        }
        let node = TestNode::start(node).await;
        let commander = driving(&node).await;

        let (moves, last) = (commander.clone(), end.clone());
        tokio::task::spawn_local(async move { moves.command(last).await });
        node.advance(10 * SECOND).await;

        let done: Vec<_> =
            log.all()[2..].iter().filter(|what| *what != "cut off").cloned().collect();
        assert_eq!(done, ["drive 0"], "{end:?}: {:?}", log.all());
        let cut_offs = log.all().iter().filter(|what| *what == "cut off").count();
        assert_eq!(cut_offs, usize::from(is_cut_off), "{end:?}: {:?}", log.all());
        commander.command(Drive(2.0)).await.unwrap();
        assert_eq!(log.all().last().unwrap(), "drive 2");
    }
}

#[blastema_testkit::test]
async fn a_command_that_is_to_hold_counts_until_the_next_one() {
    let log = Log::default();
    let node = TestNode::start(Node::builder("module1").child(wheels(&log))).await;
    let commander = node.commander::<Follow>("wheels", "console").unwrap();
    commander.claim().await.unwrap();
    commander.command_from(now(), Follow(1.0)).await.unwrap();

    node.advance(60 * SECOND).await;

    assert_eq!(log.all(), ["follow 1"]);
}

#[blastema_testkit::test]
async fn a_command_made_from_old_data_is_refused_and_one_of_unknown_age_is_an_error() {
    let log = Log::default();
    let node = Node::builder("module1").child(wheels(&log).max_wait(60 * SECOND));
    let node = TestNode::start(node).await;
    let commander = node.commander::<Follow>("wheels", "console").unwrap();
    commander.claim().await.unwrap();
    node.advance(SECOND).await;
    let captured_at = now();

    commander.command_from(captured_at, Follow(1.0)).await.unwrap();
    node.advance(200 * MS).await;
    commander.command_from(Some(captured_at), Follow(2.0)).await.unwrap();
    node.advance(MS).await;
    let late = commander.command_from(captured_at, Follow(3.0)).await;
    assert_eq!(late, Err(DeliveryError::Expired));
    for refused in
        [commander.command(Follow(4.0)).await, commander.command_from(None, Follow(4.0)).await]
    {
        let text = refused.unwrap_err().to_string();
        assert!(text.contains("timeouts/follow") && text.contains("command_from(cx.captured_at()"));
    }
    assert!(commander.holds(), "it is alive");
    assert_eq!(log.all(), ["follow 1", "follow 2"]);

    // Data that grows too old while the command waits in the queue is not used either.
    let captured_at = now();
    node.advance(20 * MS).await;
    node.sender::<Nap>("wheels").unwrap().tell(Nap(190)).unwrap();
    node.settle().await;
    let waits = commander.clone();
    let waits = async move { waits.command_from(captured_at, Follow(5.0)).await };
    let waits = tokio::task::spawn_local(waits);
    node.advance(195 * MS).await;
    assert_eq!(waits.await.unwrap(), Err(DeliveryError::Expired));
    assert_eq!(log.all(), ["follow 1", "follow 2", "nap"]);
}

#[blastema_testkit::test]
async fn between_nodes_the_age_grows_by_the_upper_bound_of_the_way() {
    let (log, medium) = (Log::default(), MemoryMedium::default());
    let here = TestNode::start(on_ethernet("module1", "module2", &medium)).await;
    let there = on_ethernet("module2", "module1", &medium).child(wheels(&log));
    let there = TestNode::start(there).await;
    here.advance(2 * SECOND).await;
    for node in [&here, &there] {
        let long = Impairment { delay: 30 * MS, ..Impairment::default() };
        node.cable("ethernet").unwrap().impair(Direction::Outgoing, long);
    }
    let commander = here.commander::<Follow>("module2:wheels", "console").unwrap();
    commander.claim().await.unwrap();
    here.advance(SECOND).await;

    // One way takes 30 ms, and 60 ms at most as far as the nodes can know.
    let fresh = commander.command_from(now(), Follow(1.0)).await;
    assert_eq!(fresh, Ok(()));
    let captured_at = now();
    here.advance(150 * MS).await;
    let old = commander.command_from(captured_at, Follow(2.0)).await;
    assert_eq!(old, Err(DeliveryError::Expired));

    assert_eq!(log.all(), ["follow 1"]);
}
