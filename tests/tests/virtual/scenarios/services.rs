//! Services with standbys on other nodes, in virtual time.

use blastema::prelude::*;
use blastema::{
    Fault, MemoryMedium, NodeBuilder, NodeState, OnPartition, Role, ServiceSpec, StandbyKind,
    StartError, Stateful,
};
use blastema_testkit::{TestNode, now};
use blastema_tests::{MS, meshed, plug_cable, pull_cable};
use std::time::Duration;

mod configurations;
mod epochs;
mod outage;
mod shown;
mod states;
mod under_replication;

const MEMBERS: [&str; 3] = ["module1", "module2", "module3"];

/// Adds so many, and answers the sum.
#[derive(Clone, Debug, Request)]
#[contract(name = "counter/add", reply = u64)]
struct Add(u64);

#[derive(Default)]
struct Counter {
    sum: u64,
    serves: bool,
}

impl Component for Counter {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Add>();
    }
}

impl Handle<Add> for Counter {
    async fn handle(&mut self, add: Add, _: &mut Context<Self>) -> u64 {
        assert!(add.0 < 1000, "that is too much");
        self.sum += add.0;
        self.sum
    }
}

impl Stateful for Counter {
    fn save(&self) -> Vec<u8> {
        self.sum.to_le_bytes().into()
    }

    fn load(&mut self, state: &[u8]) -> Result<(), Failure> {
        let bytes = state.try_into().map_err(|_| Failure::from("a sum has eight bytes"))?;
        self.sum = u64::from_le_bytes(bytes);
        Ok(())
    }

    fn role_changed(&mut self, epoch: Option<u64>, _: &mut Context<Self>) {
        self.serves = epoch.is_some();
    }
}

fn counter(kind: StandbyKind) -> ServiceSpec<Counter> {
    ServiceSpec::new("counter", MEMBERS, Counter::default).standby(kind).heartbeat_every(10 * MS)
}

/// A node with a link of its own to every other.
fn node(own: &str, medium: &MemoryMedium) -> NodeBuilder {
    let all = ["module0", "module1", "module2", "module3"];
    // A member whose replica fails too often comes to rest as a whole.
    meshed(own, &all, medium, 10 * MS).when_exceeded(WhenExceeded::Escalate)
}

fn serves(node: &TestNode, service: &str) -> bool {
    matches!(node.service_role(service), Some(Role::Primary { .. }))
}

/// The names of the nodes that serve.
fn serving(nodes: &[TestNode]) -> Vec<&str> {
    let serving = nodes.iter().filter(|node| serves(node, "counter"));
    serving.map(|node| node.name().as_str()).collect()
}

struct Robot {
    medium: MemoryMedium,
    /// A node that carries no service, and sends requests.
    asker: TestNode,
    members: Vec<TestNode>,
}

impl Robot {
    async fn start(kind: StandbyKind) -> Self {
        Robot::start_with(|node| node.service(counter(kind))).await
    }

    async fn start_with(carry: impl Fn(NodeBuilder) -> NodeBuilder) -> Self {
        let medium = MemoryMedium::default();
        let asker = TestNode::start(node("module0", &medium)).await;
        let mut members = vec![];
        for own in MEMBERS {
            members.push(TestNode::start(carry(node(own, &medium))).await);
        }
        asker.advance(2000 * MS).await;
        Robot { medium, asker, members }
    }

    fn serving(&self) -> Vec<&str> {
        serving(&self.members)
    }

    fn primary(&self) -> usize {
        let serving = self.serving();
        assert_eq!(serving.len(), 1, "{serving:?}");
        MEMBERS.iter().position(|member| *member == serving[0]).expect("it is a member")
    }

    async fn add(&self, number: u64) -> Result<u64, DeliveryError> {
        let counter = self.asker.service::<Add>("counter").expect("it is a name");
        counter.ask(Add(number)).await.map_err(|error| error.kind)
    }

    fn cut(&self, member: usize) {
        pull_cable(&self.members[member]);
    }

    fn mend(&self, member: usize) {
        plug_cable(&self.members[member]);
    }
}

/// A fault of this kind that stands in this node's record.
async fn standing(node: &TestNode, kind: &FaultKind) -> Option<Fault> {
    let record = node.faults().await;
    let standing = record.entries.into_iter().filter(|entry| entry.stands());
    standing.map(|entry| entry.fault).find(|fault| fault.kind == *kind)
}

#[blastema_testkit::test]
async fn a_caller_of_a_service_need_not_know_its_primary() {
    let robot = Robot::start(StandbyKind::Warm).await;
    assert_eq!(robot.serving().len(), 1);

    assert_eq!(robot.add(3).await, Ok(3));
    for member in &robot.members {
        let counter = member.service::<Add>("counter").unwrap();
        counter.ask(Add(1)).await.unwrap();
    }
    assert_eq!(robot.add(0).await, Ok(6));
    let unserved = robot.asker.service::<Add>("weather").unwrap();
    let unserved = unserved.ask_within(Add(1), 100 * MS).await.unwrap_err();
    assert_eq!(unserved.kind, DeliveryError::DeadlinePassed);
}

#[blastema_testkit::test]
async fn a_standby_answers_soon_after_the_primarys_cable_is_cut_and_forgets_nothing() {
    for (kind, within) in [(StandbyKind::Warm, 100 * MS), (StandbyKind::Hot, 50 * MS)] {
        let robot = Robot::start(kind).await;
        for sum in 1..=10 {
            assert_eq!(robot.add(1).await, Ok(sum));
        }

        let first = robot.primary();
        robot.cut(first);
        let cut_at = now();
        assert_eq!(robot.add(1).await, Ok(11), "{kind:?}");
        assert!(now() - cut_at <= within, "{kind:?}: {:?}", now() - cut_at);
        robot.asker.advance(100 * MS).await;
        assert_eq!(robot.serving().len(), 1, "the old one has stopped by itself");
        let follower = robot.primary();

        robot.mend(first);
        robot.asker.advance(3000 * MS).await;
        assert_eq!(robot.primary(), follower, "the service is not taken back");
        assert_eq!(robot.add(1).await, Ok(12));
        robot.cut(follower);
        assert_eq!(robot.add(1).await, Ok(13), "those that are left are in step");
    }
}

#[blastema_testkit::test]
async fn a_restarted_node_comes_into_step_and_can_take_over() {
    let mut robot = Robot::start(StandbyKind::Hot).await;
    assert_eq!(robot.add(5).await, Ok(5));
    robot.members[0].shutdown().await;
    assert_eq!(robot.add(1).await, Ok(6));
    let again = node("module1", &robot.medium).service(counter(StandbyKind::Hot));
    robot.members[0] = TestNode::start(again).await;
    robot.asker.advance(3000 * MS).await;

    let follower = robot.primary();
    assert_ne!(follower, 0);
    let third = 3 - follower;
    robot.cut(third);
    robot.asker.advance(500 * MS).await;
    assert_eq!(robot.add(1).await, Ok(7));
    robot.mend(third);
    robot.asker.advance(3000 * MS).await;
    robot.cut(follower);
    assert_eq!(robot.add(1).await, Ok(8));
}

#[blastema_testkit::test]
async fn a_failure_is_reported_once_and_the_state_outlives_the_component() {
    for kind in [StandbyKind::Warm, StandbyKind::Hot] {
        let robot = Robot::start(kind).await;
        assert_eq!(robot.add(5).await, Ok(5));

        let died = robot.add(1000).await;
        assert!(matches!(died, Err(DeliveryError::PeerDied { .. })), "{kind:?}: {died:?}");
        robot.asker.advance(1000 * MS).await;
        assert_eq!(robot.add(1).await, Ok(6), "{kind:?}");
    }
}

#[blastema_testkit::test]
async fn a_component_that_panics_while_its_standbys_hear_nothing_costs_no_acknowledged_state() {
    for pause in [5, 20, 40, 60, 150, 400] {
        let robot = Robot::start(StandbyKind::Hot).await;
        for sum in 1..=3 {
            assert_eq!(robot.add(5).await, Ok(sum * 5));
        }
        let first = robot.primary();
        let others: Vec<_> = (0..3).filter(|member| *member != first).collect();
        let counter = robot.members[first].service::<Add>("counter").unwrap();
        let killer = counter.ask_within(Add(1000), 3000 * MS);
        let meanwhile = async {
            robot.asker.advance(Duration::from_micros(300)).await;
            others.iter().for_each(|member| robot.cut(*member));
            robot.asker.advance(pause * MS).await;
            others.iter().for_each(|member| robot.mend(*member));
            robot.asker.advance(2000 * MS).await;
        };
        let (killed, ()) = tokio::join!(killer, meanwhile);
        assert!(killed.is_err(), "{killed:?}");

        assert_eq!(robot.add(1).await, Ok(16), "after {pause} ms");
    }
}

#[blastema_testkit::test]
async fn a_node_at_safe_rest_gives_its_service_away_at_once() {
    if !blastema_doubles::long() {
        return;
    }
    for kind in [StandbyKind::Warm, StandbyKind::Hot, StandbyKind::Cold] {
        let robot = Robot::start(kind).await;
        assert_eq!(robot.add(5).await, Ok(5));
        let first = robot.primary();
        let own = &robot.members[first];
        under_replication::bring_to_rest(own).await;

        robot.asker.advance(30 * MS).await;
        let follower = robot.primary();
        assert_ne!(follower, first, "{kind:?}: within less than a lease");
        let sum = if kind == StandbyKind::Cold { 1 } else { 6 };
        assert_eq!(robot.add(1).await, Ok(sum), "{kind:?}");
        robot.asker.advance(3000 * MS).await;
        assert_eq!(robot.primary(), follower, "{kind:?}");

        // Brought back, it is a member like any other.
        robot.members[first].restart().await.unwrap();
        robot.asker.advance(3000 * MS).await;
        assert_eq!(robot.primary(), follower, "{kind:?}");
        robot.cut(follower);
        robot.cut(3 - first - follower);
        robot.asker.advance(500 * MS).await;
        robot.mend(3 - first - follower);
        robot.asker.advance(3000 * MS).await;
        let sum = if kind == StandbyKind::Cold { 1 } else { 7 };
        assert_eq!(robot.add(1).await, Ok(sum), "{kind:?}");
    }
}

#[blastema_testkit::test]
async fn with_cold_standbys_the_next_begins_afresh() {
    let robot = Robot::start(StandbyKind::Cold).await;
    assert_eq!(robot.add(5).await, Ok(5));
    robot.cut(robot.primary());
    robot.asker.advance(500 * MS).await;
    assert_eq!(robot.add(1).await, Ok(1));
}

#[blastema_testkit::test]
async fn half_a_robot_serves_only_if_it_is_configured_to() {
    for (on_partition, expected) in [(OnPartition::Stop, 0), (OnPartition::Continue, 2)] {
        let names = ["module1", "module2"];
        let spec = move || {
            let spec = ServiceSpec::new("counter", names, Counter::default);
            spec.on_partition(on_partition).heartbeat_every(10 * MS)
        };
        let medium = MemoryMedium::default();
        let one = TestNode::start(node("module1", &medium).service(spec())).await;
        let other = TestNode::start(node("module2", &medium).service(spec())).await;
        one.advance(2000 * MS).await;
        let both = [one, other];
        assert_eq!(serving(&both).len(), 1);

        pull_cable(&both[0]);
        both[0].advance(500 * MS).await;
        assert_eq!(serving(&both).len(), expected, "{on_partition:?}");

        plug_cable(&both[0]);
        both[0].advance(3000 * MS).await;
        assert_eq!(serving(&both).len(), 1, "{on_partition:?}");
    }
}

#[blastema_testkit::test]
async fn a_service_follows_those_that_it_depends_on() {
    let medium = MemoryMedium::default();
    let mut members = vec![];
    for own in MEMBERS {
        let map = ServiceSpec::new("map", MEMBERS, Counter::default);
        // Its standbys take their time.
        let map = map.heartbeat_every(100 * MS);
        let counter = counter(StandbyKind::Warm).depends_on(["map"]);
        members.push(TestNode::start(node(own, &medium).service(counter).service(map)).await);
    }

    let mut order = vec![];
    for _ in 0..3000 {
        members[0].advance(MS).await;
        for name in ["map", "counter"] {
            if members.iter().any(|node| serves(node, name)) && !order.contains(&name) {
                order.push(name);
            }
        }
    }
    assert_eq!(order, ["map", "counter"]);
}

#[blastema_testkit::test]
async fn a_service_of_other_nodes_is_waited_for_before_a_standby_takes_over() {
    // The map's standbys take ten times as long to notice that its primary has gone, and one of the
    // counter's nodes carries no map.
    let map = || {
        let map = ServiceSpec::new("map", ["module1", "module0", "module2"], Counter::default);
        map.heartbeat_every(100 * MS)
    };
    let counter = || {
        let members = ["module1", "module3", "module2"];
        let counter = ServiceSpec::new("counter", members, Counter::default);
        counter.heartbeat_every(10 * MS).depends_on(["map"])
    };
    let medium = MemoryMedium::default();
    let mut nodes = vec![
        TestNode::start(node("module0", &medium).service(map())).await,
        TestNode::start(node("module1", &medium).service(map()).service(counter())).await,
        TestNode::start(node("module2", &medium).service(map()).service(counter())).await,
        TestNode::start(node("module3", &medium).service(counter())).await,
    ];
    let primary = |nodes: &[TestNode], name: &str| nodes.iter().position(|node| serves(node, name));
    nodes[0].advance(2000 * MS).await;
    assert_eq!([primary(&nodes, "map"), primary(&nodes, "counter")], [Some(1), Some(1)]);

    let both = nodes.remove(1);
    pull_cable(&both);
    let cut_at = now();
    while primary(&nodes, "counter").is_none() {
        nodes[0].advance(MS).await;
        assert!(now() - cut_at < 1000 * MS, "it does not take over");
        if primary(&nodes, "map").is_none() {
            assert_eq!(primary(&nodes, "counter"), None, "the map is not there");
        }
    }
    assert!(now() - cut_at > 200 * MS, "the counter's own lease is over after 33 ms");
    let counter = nodes[0].service::<Add>("counter").unwrap();
    assert_eq!(counter.ask(Add(1)).await.unwrap(), 1);
}

#[blastema_testkit::test]
async fn a_service_that_is_described_wrongly_is_refused_at_the_start() {
    let names: Vec<_> = (1..=8).map(|n| format!("module{n}")).collect();
    let many: Vec<_> = names.iter().map(String::as_str).collect();
    let on =
        |members: &[&str]| ServiceSpec::new("counter", members.iter().copied(), Counter::default);
    let every = |interval| {
        (on(&["module1"]).heartbeat_every(interval), "heartbeat_every(..) from 1ms to 3600s")
    };
    for (spec, expected) in [
        (on(&MEMBERS).depends_on(["map"]), "depends on itself"),
        (on(&["module8", "module9"]), "module1 is none of its nodes"),
        (on(&["module1", "module1"]), "twice"),
        every(Duration::ZERO),
        every(Duration::from_micros(999)),
        every(Duration::from_secs(3601)),
        (on(&many), "8 nodes cannot carry it, 7 at most"),
    ] {
        let map = ServiceSpec::new("map", MEMBERS, Counter::default).depends_on(["counter"]);
        let carried = Node::builder("module1").service(spec).service(map);
        let refused = TestNode::try_start(carried).await;
        let Err(StartError::Service { reason, .. }) = refused else { panic!("{expected}") };
        assert!(reason.contains(expected), "{expected}: {reason}");
    }
}
