//! Names of the whole robot, which nodes claim and lose: three nodes that each have a link to each
//! other, in virtual time.

use blastema::prelude::*;
use blastema::{Claim, ClaimError, ClaimPolicy, ClaimState, MemoryMedium, NodeBuilder};
use blastema_testkit::TestNode;
use blastema_tests::{MS, meshed, plug_cable, pull_cable};
use std::time::Duration;

const NODES: [&str; 3] = ["module1", "module2", "module3"];
/// How often hellos are said in these tests.
const HELLO: Duration = Duration::from_millis(50);
/// How long a name is kept for a node that is not heard of.
const LEASE: Duration = Duration::from_secs(1);

/// Says where it is, and how often it was asked.
#[derive(Clone, Debug, Request)]
#[contract(name = "map/where", reply = String)]
struct Where;

/// Has the receiver panic.
#[derive(Clone, Debug, Event)]
#[contract(name = "map/boom")]
struct Boom;

/// Has the receiver end itself.
#[derive(Clone, Debug, Event)]
#[contract(name = "map/enough")]
struct Enough;

struct Map(&'static str);

impl Component for Map {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Where>().accept::<Boom>().accept::<Enough>();
    }
}

impl Handle<Where> for Map {
    async fn handle(&mut self, _: Where, cx: &mut Context<Self>) -> String {
        format!("{}{}", self.0, cx.incarnation())
    }
}

impl Handle<Enough> for Map {
    async fn handle(&mut self, _: Enough, cx: &mut Context<Self>) {
        cx.stop();
    }
}

impl Handle<Boom> for Map {
    async fn handle(&mut self, _: Boom, _: &mut Context<Self>) {
        panic!("boom");
    }
}

fn map(on: &'static str) -> ChildSpec<Map> {
    ChildSpec::new("map", move || Map(on))
}

fn node(own: &str, medium: &MemoryMedium) -> NodeBuilder {
    meshed(own, &NODES, medium, HELLO)
}

struct Robot {
    medium: MemoryMedium,
    nodes: Vec<TestNode>,
}

impl Robot {
    async fn start() -> Self {
        let medium = MemoryMedium::default();
        let mut nodes = vec![];
        for own in NODES {
            nodes.push(TestNode::start(node(own, &medium).child(map(own))).await);
        }
        nodes[0].advance(2000 * MS).await;
        Robot { medium, nodes }
    }

    async fn claim(&self, node: usize, policy: ClaimPolicy) -> Result<Claim, ClaimError> {
        let claimed = self.nodes[node].claim("map", policy).await;
        self.advance(20 * MS).await;
        claimed
    }

    async fn advance(&self, span: Duration) {
        self.nodes[0].advance(span).await;
    }

    /// Who answers to the name, for each of the nodes.
    async fn answers(&self) -> Vec<String> {
        let mut answers = vec![];
        for node in &self.nodes {
            let map = node.sender::<Where>("*:map").expect("it is a name");
            answers.push(match map.ask(Where).await {
                Ok(answer) => answer,
                Err(error) => error.kind.to_string(),
            });
        }
        answers
    }
}

#[blastema_testkit::test]
async fn what_is_sent_to_a_name_reaches_its_holder_and_a_second_claimant_is_told_who_that_is() {
    let robot = Robot::start().await;
    assert_eq!(robot.answers().await, ["the name map has no holder"; 3]);

    let claim = robot.claim(1, ClaimPolicy::Refuse).await.expect("it is free");
    assert_eq!(robot.answers().await, ["module2#1"; 3]);
    for other in [0, 1, 2] {
        let refused = robot.claim(other, ClaimPolicy::Refuse).await.expect_err("it is taken");
        assert!(refused.to_string().contains("map is claimed by module2"), "{refused}");
    }

    drop(claim);
    robot.advance(20 * MS).await;
    let _claim = robot.claim(2, ClaimPolicy::Refuse).await.expect("it is free again");
    assert_eq!(robot.answers().await, ["module3#1"; 3]);
    let rows = robot.nodes[0].claims();
    assert_eq!((rows.len(), rows[0].holder.to_string().as_str()), (1, "module3:map"));
}

#[blastema_testkit::test]
async fn a_standby_has_the_name_when_the_lease_of_a_node_that_died_is_over() {
    let robot = Robot::start().await;
    let first = robot.claim(0, ClaimPolicy::Standby).await.expect("it is free");
    let mut second = robot.claim(1, ClaimPolicy::Standby).await.expect("it stands by");
    assert_eq!(second.state(), ClaimState::StandsBy);

    pull_cable(&robot.nodes[0]);
    robot.advance(LEASE / 2).await;
    assert_eq!(second.state(), ClaimState::StandsBy);
    robot.advance(LEASE / 2 + 20 * MS).await;

    let epoch = second.epoch().expect("it has taken over");
    assert_eq!(second.changed().await, Some(ClaimState::Held { epoch }));
    assert!(first.epoch().expect("it was not told") < epoch);
    assert_eq!(robot.answers().await[1..], ["module2#1", "module2#1"]);
}

#[blastema_testkit::test]
async fn of_two_halves_that_meet_the_later_claim_stays_and_the_other_is_a_fault() {
    for policy in [ClaimPolicy::Refuse, ClaimPolicy::Standby] {
        let mut robot = Robot::start().await;
        let first = robot.claim(0, policy).await.expect("it is free");
        let mut watch = robot.nodes[0].watch_name("map").expect("it is a name");
        assert_eq!(watch.next().await.expect("it is held").node.as_str(), "module1");
        let second = robot.claim(1, ClaimPolicy::Standby).await.expect("it stands by");
        pull_cable(&robot.nodes[0]);
        robot.advance(2 * LEASE).await;
        assert!(first.epoch().is_some() && second.epoch().is_some(), "each half has one");

        plug_cable(&robot.nodes[0]);
        let fault = robot.nodes[0].await_fault(FaultKind::NameTaken, "net/directory").await;

        assert!(fault.detail.contains("the name map is lost to module2"), "{}", fault.detail);
        robot.advance(20 * MS).await;
        assert_eq!(robot.answers().await, ["module2#1"; 3]);
        assert_eq!(watch.next().await.expect("it is held").node.as_str(), "module2");
        match policy {
            ClaimPolicy::Standby => assert_eq!(first.state(), ClaimState::StandsBy),
            ClaimPolicy::Refuse => assert!(matches!(first.state(), ClaimState::Lost { .. })),
        }
    }
}

#[blastema_testkit::test]
async fn a_component_has_its_name_while_it_is_at_work() {
    let medium = MemoryMedium::default();
    let mut nodes = vec![];
    for own in NODES {
        let spec = ChildSpec::new("cartographer", move || Map(own));
        let spec = spec.claim("map", ClaimPolicy::Standby);
        nodes.push(TestNode::start(node(own, &medium).child(spec)).await);
    }
    nodes[0].advance(2000 * MS).await;
    let robot = Robot { medium, nodes };
    assert_eq!(robot.answers().await, ["module1#1"; 3]);
    let before = robot.nodes[2].holder("map").expect("it is held");
    assert_eq!(before.object.as_str(), "cartographer");

    // An incarnation that follows on the spot has the name of the one before it.
    let boom = robot.nodes[2].sender::<Boom>("*:map").expect("it is a name");
    boom.tell(Boom).expect("it is taken");
    robot.advance(20 * MS).await;
    assert_eq!(robot.answers().await, ["module1#2"; 3]);
    assert_eq!(robot.nodes[2].holder("map"), Some(before));

    robot.nodes[0].remove_child("cartographer").await.expect("it is there");
    robot.advance(20 * MS).await;
    assert_eq!(robot.answers().await, ["module2#1"; 3]);

    // A node that ends in order leaves its names to the next at once.
    robot.nodes[1].shutdown().await;
    robot.advance(20 * MS).await;
    assert_eq!(robot.nodes[0].holder("map").expect("it is held").node.as_str(), "module3");
}

#[blastema_testkit::test]
async fn a_component_that_has_to_go_without_its_name_is_a_fault() {
    let robot = Robot::start().await;
    let _claim = robot.claim(1, ClaimPolicy::Refuse).await.expect("it is free");

    let mut nodes = robot.nodes;
    let spec = ChildSpec::new("other", || Map("other")).claim("map", ClaimPolicy::Refuse);
    nodes[0].add_child(spec).await.expect("it is sound");

    let fault = nodes[0].await_fault(FaultKind::NameTaken, "net/directory").await;
    assert!(fault.detail.contains("other goes without the name map"), "{}", fault.detail);
}

#[blastema_testkit::test]
async fn a_node_that_returns_does_not_take_its_name_back_by_force() {
    let robot = Robot::start().await;
    let first = robot.claim(0, ClaimPolicy::Standby).await.expect("it is free");
    let _second = robot.claim(1, ClaimPolicy::Standby).await.expect("it stands by");
    let Robot { medium, mut nodes } = robot;
    drop(first);
    let dead = nodes.remove(0);
    pull_cable(&dead);
    dead.shutdown().await;
    nodes[0].advance(2 * LEASE).await;

    // The newcomer's process is later, and so its own epochs would be.
    let spec = map("module1").claim("map", ClaimPolicy::Standby);
    let again = TestNode::start(node("module1", &medium).child(spec)).await;
    again.advance(2 * LEASE).await;

    assert_eq!(again.holder("map").expect("it is held").node.as_str(), "module2");
    let record = nodes[0].faults().await;
    assert!(record.entries.iter().all(|entry| entry.fault.kind != FaultKind::NameTaken));
}

/// See the manual's page on names: 9 hellos, 10 ms for what follows on a fast medium.
const JOINED: Duration = Duration::from_millis(9 * 50 + 10);

#[blastema_testkit::test]
async fn after_joining_and_rejoining_names_are_known_within_the_stated_bound() {
    let robot = Robot::start().await;
    let _claim = robot.claim(1, ClaimPolicy::Refuse).await.expect("it is free");
    let Robot { medium, mut nodes } = robot;

    // A cable that is restored after its sessions have ended.
    pull_cable(&nodes[0]);
    nodes[0].advance(20 * LEASE).await;
    assert_eq!(nodes[0].holder("map"), None);
    plug_cable(&nodes[0]);
    nodes[0].advance(JOINED).await;
    assert!(nodes[0].holder("map").is_some(), "rejoined");

    // A process that starts again.
    let gone = nodes.remove(0);
    pull_cable(&gone);
    gone.shutdown().await;
    let again = TestNode::start(node("module1", &medium).child(map("module1"))).await;
    again.advance(JOINED).await;
    assert!(again.holder("map").is_some(), "joined");
    let asked = again.sender::<Where>("*:map").expect("it is a name").ask(Where).await;
    assert_eq!(asked.expect("it answers"), "module2#1");
}

/// Whether the fault that a node goes without a name stands here, and its text.
async fn goes_without(node: &TestNode) -> Option<String> {
    let record = node.faults().await;
    let mut open_faults = record.entries.into_iter().filter(|entry| {
        entry.fault.kind == FaultKind::NameTaken && entry.status() == blastema::FaultStatus::Open
    });
    open_faults.next().map(|entry| entry.fault.detail)
}

/// module1's component holds the name, which is refused to those of module2.
async fn refused(restart: Restart) -> (TestNode, TestNode) {
    let medium = MemoryMedium::default();
    let holder = ChildSpec::new("map", || Map("module1")).claim("map", ClaimPolicy::Refuse);
    let first = TestNode::start(node("module1", &medium).child(holder)).await;
    first.advance(2000 * MS).await;
    let brief = |name: &'static str| {
        ChildSpec::new(name, move || Map(name)).claim("map", ClaimPolicy::Refuse)
    };
    let second = node("module2", &medium).child_with(brief("brief"), restart);
    let second = TestNode::start(second.child_with(brief("other"), restart)).await;
    second.advance(2000 * MS).await;
    (first, second)
}

#[blastema_testkit::test]
async fn that_components_go_without_a_name_is_over_when_the_last_of_them_has_ended_however_it_did()
{
    for (ending, restart) in [
        ("stops", Restart::Temporary),
        ("dies", Restart::Temporary),
        ("dies until its node rests", Restart::Permanent),
        ("is removed", Restart::Permanent),
    ] {
        let (_first, second) = refused(restart).await;
        let told = goes_without(&second).await.expect("it is told");
        assert!(told.contains("other goes without the name map"), "{told}");

        for name in ["other", "brief"] {
            match ending {
                "stops" => second.sender::<Enough>(name).unwrap().tell(Enough).unwrap(),
                "is removed" => second.remove_child(name).await.unwrap(),
                _ => {
                    for _ in 0..20 {
                        let _ = second.sender::<Boom>(name).unwrap().tell(Boom);
                        second.advance(5 * MS).await;
                    }
                }
            }
            second.advance(100 * MS).await;
            if name == "other" && !ending.contains("rests") {
                let told = goes_without(&second).await.expect("there is one left");
                assert!(told.contains("brief goes without the name map"), "{ending}: {told}");
            }
        }
        assert_eq!(goes_without(&second).await, None, "{ending}");
    }
}

#[blastema_testkit::test]
async fn a_component_that_goes_without_a_name_that_has_become_free_or_anothers_says_so() {
    let (first, second) = refused(Restart::Permanent).await;
    let told = goes_without(&second).await.expect("it is told");
    assert!(told.contains("map is claimed by module1"), "{told}");

    first.shutdown().await;
    second.advance(100 * MS).await;

    let told = goes_without(&second).await.expect("it still goes without");
    assert!(told.contains("it has no holder now") && !told.contains("module1"), "{told}");
    second.restart_child("other").await.expect("it runs");
    second.advance(100 * MS).await;
    let told = goes_without(&second).await.expect("the other one");
    assert!(
        told.contains("brief goes without the name map: map is claimed by module2:other"),
        "{told}"
    );
}

#[blastema_testkit::test]
async fn every_node_knows_the_objects_of_the_others_until_their_sessions_end() {
    let robot = Robot::start().await;
    let objects = |node: &TestNode| -> Vec<String> {
        let rows = node.neighbourhood().into_iter();
        rows.flat_map(|row| row.objects).map(|object| object.to_string()).collect()
    };
    assert_eq!(objects(&robot.nodes[0]), ["module2:map", "module3:map"]);

    robot.nodes[1].remove_child("map").await.expect("it is there");
    let spec = ChildSpec::new("plan", || Map("module2"));
    robot.nodes[1].add_child(spec).await.expect("it is sound");
    robot.advance(210 * MS).await;
    assert_eq!(objects(&robot.nodes[0]), ["module2:plan", "module3:map"]);

    pull_cable(&robot.nodes[0]);
    robot.advance(20 * LEASE).await;
    assert_eq!(objects(&robot.nodes[0]), [""; 0]);
    plug_cable(&robot.nodes[0]);
    robot.advance(JOINED).await;
    assert_eq!(objects(&robot.nodes[0]), ["module2:plan", "module3:map"]);
}
