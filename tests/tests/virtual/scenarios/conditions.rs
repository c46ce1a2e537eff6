//! Conditions: whether an operator, a node, a topic, a link or a commander is connected, and how
//! well, in virtual time.

use blastema::prelude::*;
use blastema::{
    ActuatorSpec, Condition, ConditionError, ConditionState, Connected, Direction, Heartbeats,
    Hold, Impairment, Link, MediumKind, MemoryMedium, Network,
};
use blastema_testkit::{TestNode, now};
use blastema_tests::{MS, Part, moves};
use std::cell::RefCell;
use std::rc::Rc;
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);
/// How often hellos are sent where nothing is said.
const HELLO: Duration = Duration::from_millis(50);
const BEAT: &str = "operator/beat";

use ConditionState::{Connected as Well, Degraded, Lost};

/// A rover and its operator, with a radio between them.
struct Robot {
    rover: TestNode,
    operator: TestNode,
}

impl Robot {
    async fn start() -> Self {
        Robot::over(HELLO, |network| network).await
    }

    async fn over(hello: Duration, radio: impl Fn(Network) -> Network) -> Self {
        let medium = MemoryMedium::default();
        let node = |own: &str, other: &str| {
            let link = Link::to(other, other).hello_every(hello);
            let network = Network::memory("radio", &medium, own).link(link);
            Node::builder(own).network(radio(network).with_faults(7)).child(wheels("wheels"))
        };
        let operator = TestNode::start(node("operator", "rover")).await;
        let rover = TestNode::start(node("rover", "operator")).await;
        rover.advance(2 * SECOND).await;
        Robot { rover, operator }
    }

    fn beat(&self) -> Heartbeats {
        self.operator.heartbeat(BEAT, 100 * MS).unwrap()
    }

    fn condition(&self, name: &str, needs: Connected) -> Condition {
        self.rover.condition(name, needs).unwrap()
    }

    fn impair(&self, direction: Direction, impairment: Impairment) {
        self.rover.cable("radio").unwrap().impair(direction, impairment);
    }

    fn cut(&self) {
        self.rover.cable("radio").unwrap().cut(Direction::Both, false);
    }

    fn restore(&self) {
        self.rover.cable("radio").unwrap().restore();
    }

    /// How many faults of this kind a condition has had, and whether they are over.
    async fn faults(&self, kind: FaultKind, condition: &str) -> Vec<bool> {
        let place = format!("rover:conditions/{condition}");
        let entries = self.rover.faults().await.entries.into_iter();
        let of_it = entries
            .filter(|entry| entry.fault.kind == kind && entry.fault.location.to_string() == place);
        of_it.map(|entry| entry.repaired_at.is_some()).collect()
    }

    async fn after(&self, span: Duration) {
        self.rover.advance(span).await;
    }
}

/// Moves when it is told to.
#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/drive", reply = ())]
struct Drive(f32);

type Wheels = Part<(), Drive>;

fn wheels(name: &str) -> ChildSpec<Wheels> {
    let spec = ActuatorSpec::new(Drive(0.0), Hold).lease(100 * MS);
    moves(name, spec, (), |_, _, _| {}).with_ports(|ports| {
        ports.commands::<Drive>("trailer");
    })
}

/// The states that a condition reaches, with the time of each.
fn recorded(condition: &Condition) -> Rc<RefCell<Vec<(ConditionState, Duration)>>> {
    let (begun, record) = (now(), Rc::<RefCell<Vec<_>>>::default());
    let (mut changes, kept) = (condition.changes(), record.clone());
    tokio::task::spawn_local(async move {
        while let Some(status) = changes.next().await {
            kept.borrow_mut().push((status.state, status.since - begun));
        }
    });
    record
}

fn states(record: &Rc<RefCell<Vec<(ConditionState, Duration)>>>) -> Vec<ConditionState> {
    record.borrow().iter().map(|(state, _)| *state).collect()
}

#[blastema_testkit::test]
async fn heartbeats_that_cease_are_lost_after_their_timeout_and_each_change_is_a_fault() {
    let mut robot = Robot::start().await;
    let condition = robot.condition("operator", Connected::heartbeat(BEAT).timeout(3 * SECOND));
    assert!(!condition.is_connected());
    let record = recorded(&condition);
    let never = robot.rover.await_fault(FaultKind::ConnectionLost, "conditions/operator").await;
    assert_eq!(never.detail, "operator/beat: never heard");

    let beats = robot.beat();
    condition.connected().await;
    robot.after(10 * SECOND).await;
    assert_eq!(robot.faults(FaultKind::ConnectionLost, "operator").await, [true]);
    assert_eq!(states(&record), [Well], "{}", condition.status().cause);

    drop(beats);
    let ceased = now();
    condition.lost().await;
    let silence = now() - ceased;
    assert!((2900 * MS..=3100 * MS).contains(&silence), "{silence:?}");
    let lost = robot.rover.await_fault(FaultKind::ConnectionLost, "conditions/operator").await;
    assert_eq!(lost.detail, "operator/beat: silent for 3.0s, at most 3s");

    let _beats = robot.beat();
    robot.after(SECOND).await;
    assert_eq!(states(&record), [Well, Lost, Well]);
    assert_eq!(robot.faults(FaultKind::ConnectionLost, "operator").await, [true; 2]);
}

#[blastema_testkit::test]
async fn heartbeats_at_ten_hertz_outlast_thirty_percent_loss() {
    let robot = Robot::start().await;
    let _beats = robot.beat();
    let condition = robot.condition("operator", Connected::heartbeat(BEAT).timeout(3 * SECOND));
    condition.connected().await;
    let record = recorded(&condition);
    robot.impair(Direction::Both, Impairment { loss: 0.3, ..Impairment::default() });

    // The machine alone judges an hour in each run.
    let long = std::env::var_os("BLASTEMA_LONG").is_some();
    robot.after(if long { 3600 } else { 300 } * SECOND).await;

    assert_eq!(states(&record), [], "{}", condition.status().cause);
}

#[blastema_testkit::test]
async fn a_topic_that_arrives_too_seldom_is_lost_while_its_heartbeats_would_do() {
    let robot = Robot::start().await;
    let beats = robot.beat();
    let rate = |hz| Connected::rate::<blastema::Heartbeat>(BEAT, hz, SECOND);
    let fast = robot.condition("fast", rate(9.0));
    let slow = robot.condition("slow", rate(1.0).max_loss(0.5));
    robot.after(3 * SECOND).await;
    assert_eq!((fast.state(), slow.state()), (Well, Well), "{}", fast.status().cause);

    drop(beats);
    let _seldom = robot.operator.heartbeat(BEAT, 500 * MS).unwrap();
    robot.after(5 * SECOND).await;
    assert_eq!((fast.state(), slow.state()), (Lost, Well), "{}", slow.status().cause);
    let cause = fast.status().cause;
    assert!(cause.ends_with("messages a second, of 9"), "{cause}");
}

#[blastema_testkit::test]
async fn a_channel_that_was_never_heard_fails_all_and_not_one_of_two() {
    let robot = Robot::start().await;
    let _beats = robot.beat();
    let two = || [BEAT, "base/beat"].map(Connected::heartbeat);
    let all = robot.condition("all", Connected::all(two()).timeout(3 * SECOND));
    let any = robot.condition("any", Connected::any(two()).timeout(3 * SECOND));
    let node = Connected::node("operator");
    let most = robot.condition("most", Connected::at_least(2, two().into_iter().chain([node])));
    robot.after(5 * SECOND).await;

    assert_eq!([&all, &any, &most].map(Condition::state), [Lost, Well, Well]);
    assert_eq!(all.status().cause, "1 of 2 connected, 2 needed: base/beat: never heard");
}

#[blastema_testkit::test]
async fn a_node_its_session_its_link_and_its_lease_are_lost_with_the_cable_and_come_back() {
    let robot = Robot::start().await;
    let commander = robot.operator.commander::<Drive>("rover:wheels", "console").unwrap();
    commander.claim().await.unwrap();
    let conditions = [
        robot.condition("node", Connected::node("operator")),
        robot.condition("session", Connected::session("operator")),
        robot.condition("link", Connected::link("radio")),
        robot.condition("commander", Connected::commander("wheels")),
    ];
    let records = conditions.each_ref().map(recorded);
    robot.after(SECOND).await;
    assert_eq!(conditions.each_ref().map(Condition::state), [Well; 4], "{conditions:?}");

    robot.cut();
    robot.after(SECOND).await;
    assert_eq!(conditions.each_ref().map(Condition::state), [Well, Well, Well, Lost]);
    robot.after(SECOND).await;
    assert_eq!(conditions.each_ref().map(Condition::state), [Lost; 4], "after 1.5 s of silence");

    robot.restore();
    robot.after(10 * SECOND).await;
    assert_eq!(commander.claim().await.map(|_| ()), Ok(()));
    robot.after(SECOND).await;
    for (record, condition) in records.iter().zip(&conditions) {
        assert_eq!(states(record), [Well, Lost, Well], "{condition:?}");
    }

    robot.operator.shutdown().await;
    robot.after(3 * SECOND).await;
    assert_eq!(conditions.each_ref().map(Condition::state), [Lost; 4], "it has left");
    let misspelt = robot.rover.condition("misspelt", Connected::link("radoi")).unwrap_err();
    assert!(misspelt.to_string().ends_with("did you mean radio?"), "{misspelt}");
}

#[blastema_testkit::test]
async fn timeouts_follow_the_medium_unless_they_are_written() {
    for (kind, lost_after) in [
        (MediumKind::Wired, 1500 * MS),
        (MediumKind::Wireless, 4 * SECOND),
        (MediumKind::Satellite, 30 * SECOND),
    ] {
        let robot = Robot::over(HELLO, |network| network.medium(kind)).await;
        let beats = robot.beat();
        let condition = robot.condition("operator", Connected::heartbeat(BEAT));
        condition.connected().await;
        drop(beats);
        let ceased = now();
        condition.lost().await;
        let silence = now() - ceased;
        assert!(silence.abs_diff(lost_after) <= 100 * MS, "{kind:?}: {silence:?}");
    }
    let alone = TestNode::start(Node::builder("alone")).await;
    let beats = alone.heartbeat(BEAT, 100 * MS).unwrap();
    let condition = alone.condition("operator", Connected::heartbeat(BEAT)).unwrap();
    condition.connected().await;
    drop(beats);
    let ceased = now();
    condition.lost().await;
    let silence = now() - ceased;
    assert!(silence.abs_diff(3 * SECOND) <= 100 * MS, "{silence:?}");
}

#[blastema_testkit::test]
async fn a_slow_and_lossy_radio_degrades_the_connection_once_and_restores_it_once() {
    // With hellos that are further apart than the radio spreads them, its link stays up.
    let mut robot = Robot::over(200 * MS, |network| network).await;
    let _beats = robot.beat();
    let beat = || Connected::heartbeat(BEAT).timeout(3 * SECOND);
    let latency = robot.condition("latency", beat().max_latency(500 * MS));
    let loss = robot.condition("loss", beat().max_loss(0.1));
    let node = Connected::node("operator").max_latency(500 * MS);
    let round_trip = robot.condition("round-trip", node);
    robot.after(10 * SECOND).await;
    let conditions = [&latency, &loss, &round_trip];
    assert_eq!(conditions.map(Condition::state), [Well; 3], "{conditions:?}");
    let records = conditions.map(recorded);

    let slow = Impairment { delay: 300 * MS, jitter: 40 * MS, ..Impairment::default() };
    robot.impair(Direction::Both, slow);
    robot.after(60 * SECOND).await;
    assert_eq!(records.each_ref().map(states), [vec![Degraded], vec![], vec![Degraded]]);
    let fault = robot.rover.await_fault(FaultKind::CheckFailed, "conditions/latency").await;
    assert!(fault.detail.starts_with("operator/beat: latency "), "{}", fault.detail);
    assert!(fault.detail.ends_with(", limit 500ms"), "{}", fault.detail);

    robot.restore();
    robot.after(60 * SECOND).await;
    assert_eq!(
        records.each_ref().map(states),
        [vec![Degraded, Well], vec![], vec![Degraded, Well]]
    );
    robot.impair(Direction::Both, Impairment { loss: 0.3, ..Impairment::default() });
    robot.after(120 * SECOND).await;
    assert_eq!(states(&records[1]), [Degraded], "{}", loss.status().cause);
    robot.restore();
    robot.after(60 * SECOND).await;
    assert_eq!(states(&records[1]), [Degraded, Well], "{}", loss.status().cause);
    assert_eq!(robot.faults(FaultKind::CheckFailed, "loss").await, [true]);
}

#[blastema_testkit::test]
async fn silence_within_the_timeout_changes_no_quality() {
    let robot = Robot::start().await;
    let _beats = robot.operator.heartbeat(BEAT, 2 * SECOND).unwrap();
    let needs = Connected::heartbeat(BEAT).timeout(3 * SECOND).max_latency(100 * MS).max_loss(0.1);
    let condition = robot.condition("radio", needs);
    condition.acceptable().await;
    let record = recorded(&condition);

    robot.after(600 * SECOND).await;

    assert_eq!(states(&record), []);
}

#[blastema_testkit::test]
async fn a_latency_is_bounded_without_common_clocks_and_exact_with_them() {
    let robot = Robot::start().await;
    let _beats = robot.beat();
    // The way to the operator is short: half a round trip is less than what a heartbeat takes.
    robot.impair(Direction::Incoming, Impairment { delay: 200 * MS, ..Impairment::default() });
    let beat = |limit| Connected::heartbeat(BEAT).max_latency(limit);
    robot.condition("listens", beat(SECOND));
    // By then no heartbeat is compared with those that came before.
    robot.after(30 * SECOND).await;
    let within = robot.condition("within", beat(250 * MS));
    let below = robot.condition("below", beat(190 * MS));
    let agreed = robot.condition("agreed", beat(250 * MS).clocks_agree_within(MS));
    robot.after(60 * SECOND).await;

    assert_eq!((within.state(), below.state()), (Well, Degraded), "{}", below.status().cause);
    let cause = agreed.status().cause;
    assert!(cause.contains("latency 200."), "{cause}");
    assert!(cause.contains("± 1.0ms"), "{cause}");
}

#[blastema_testkit::test]
async fn a_guarded_commander_gives_its_lease_back_and_a_guarded_child_runs_while_it_holds() {
    let robot = Robot::start().await;
    let beats = robot.beat();
    let condition = robot.condition("operator", Connected::heartbeat(BEAT).timeout(SECOND));
    let planner = robot.rover.commander::<Drive>("wheels", "planner").unwrap();
    planner.only_while(&condition);
    robot.after(100 * MS).await;
    let refused = planner.claim().await.unwrap_err();
    assert!(
        matches!(&refused, DeliveryError::CheckFailed { reason } if reason.contains("never heard"))
    );
    condition.connected().await;
    robot.rover.add_child_while(&condition, || wheels("helper")).await.unwrap();
    planner.claim().await.unwrap();
    planner.command(Drive(1.0)).await.unwrap();
    let runs = || robot.rover.actor::<Wheels>("helper").is_ok();
    assert!(runs());
    robot.rover.connect("helper#trailer", "wheels#wheels/drive").unwrap();

    drop(beats);
    condition.lost().await;
    robot.after(100 * MS).await;
    assert!(!planner.holds() && !runs());
    assert_eq!(robot.rover.connections(), []);
    assert_eq!(robot.rover.actuators()[0].status, blastema::LeaseStatus::Free);

    let _beats = robot.beat();
    condition.connected().await;
    robot.after(100 * MS).await;
    assert!(runs());
    let connections = robot.rover.connections();
    assert_eq!(connections.len(), 1, "it is made again: {connections:?}");
    planner.claim().await.unwrap();
    robot.after(SECOND).await;
    assert!(planner.holds());
}

#[blastema_testkit::test]
async fn a_commander_has_as_long_to_come_as_others_and_is_no_policy() {
    let robot = Robot::start().await;
    let condition = robot.condition("commander", Connected::commander("wheels"));
    robot.after(SECOND).await;
    assert_eq!(robot.faults(FaultKind::ConnectionLost, "commander").await, [false; 0]);
    robot.after(SECOND).await;
    assert_eq!(robot.faults(FaultKind::ConnectionLost, "commander").await, [false]);

    let commander = robot.operator.commander::<Drive>("rover:wheels", "console").unwrap();
    commander.claim().await.unwrap();
    robot.after(10 * SECOND).await;
    assert_eq!(condition.state(), Well);
    commander.release().await.unwrap();
    robot.after(200 * MS).await;
    assert_eq!(condition.state(), Lost);
}

#[blastema_testkit::test]
async fn two_senders_of_one_topic_lose_nothing_and_one_that_leaves_stays_as_slow() {
    let robot = Robot::start().await;
    let (first, second) = (robot.beat(), robot.beat());
    robot.impair(Direction::Incoming, Impairment { delay: 200 * MS, ..Impairment::default() });
    let beat = || Connected::heartbeat(BEAT).timeout(10 * SECOND);
    let loss = robot.condition("loss", beat().max_loss(0.05));
    let latency = robot.condition("latency", beat().max_latency(150 * MS));
    robot.after(30 * SECOND).await;
    assert_eq!((loss.state(), latency.state()), (Well, Degraded), "{}", loss.status().cause);

    drop((first, second));
    let changes = recorded(&latency);
    robot.after(5 * SECOND).await;
    assert_eq!(states(&changes), [], "{}", latency.status().cause);
}

#[blastema_testkit::test]
async fn what_is_wrong_with_a_condition_is_said_where_it_is_declared() {
    let node = TestNode::start(Node::builder("alone")).await;
    let refused =
        |name: &str, needs: Connected| node.condition(name, needs).unwrap_err().to_string();
    let beat = || Connected::heartbeat(BEAT);

    node.condition("operator", beat()).unwrap();
    assert!(node.condition("operator", beat()).is_ok(), "it is the same");
    let taken = node.condition("operator", beat().timeout(SECOND)).unwrap_err();
    assert_eq!(taken, ConditionError::Taken { condition: "operator".into() });
    assert!(node.condition("operator", Connected::all([beat()])).is_err(), "it has more to say");
    assert!(refused("an operator", beat()).contains("' '"));
    assert!(refused("none", Connected::all([])).contains("0 of 0 channels"));
    assert!(refused("more", Connected::at_least(2, [beat()])).contains("2 of 1 channels"));
    let lossy = refused("lossy", Connected::node("operator").max_jitter(SECOND));
    assert!(lossy.contains("the jitter of node operator is not measured"), "{lossy}");
    let long = refused("long", beat().timeout(Duration::MAX));
    assert!(long.ends_with("write 10 ms to an hour"), "{long}");
    assert!(refused("never", beat().timeout(Duration::ZERO)).ends_with("write 10 ms to an hour"));
    let own = refused("own", Connected::any([beat(), Connected::session("alone")]));
    assert!(own.contains("session with alone, which is this node: name another one"), "{own}");
    assert!(refused("own", Connected::node("alone")).contains("is this node"));
    for percent in [10.0, -0.1, f64::NAN] {
        assert!(refused("share", beat().max_loss(percent)).ends_with("write 0.0 to 1.0"));
    }
    let link = refused("link", Connected::link("radoi"));
    assert!(link.contains("no link radoi, as it has no networks"), "{link}");
    let seldom = refused("seldom", beat().min_rate(0.5, SECOND));
    assert!(seldom.contains("a longer window"), "{seldom}");
    let other = || Connected::topic::<Other>(BEAT);
    assert!(refused("other", other()).contains("two contracts"));
    assert!(refused("both", Connected::all([beat(), other()])).contains("two contracts"));
    assert!(refused("name", Connected::all([beat(), Connected::node("a b")])).contains("' '"));
    let topics = node.topics();
    let beats = topics.iter().find(|row| row.topic == BEAT).expect("it is listened to");
    assert_eq!(beats.listeners.len(), 1, "by what was declared: {:?}", beats.listeners);
    node.shutdown().await;
    assert!(refused("operator", beat()).ends_with("the node has ended"));
}

#[derive(Clone, Debug, Event)]
struct Other;
