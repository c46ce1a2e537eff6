//! What the robot's policy lets nodes do, while they run, and after it was changed.
//!
//! ```text
//!   arm ───── base ───── head      the base has wheels, the others want to use them
//! ```

use super::{PATIENCE, end, until};
use blastema::core::net::trust::policy::Role;
use blastema::prelude::*;
use blastema::{
    ActuatorSpec, ClaimError, ClaimPolicy, ClaimRefused, ClaimState, DeadReason, FaultKind, Hold,
    Network, NodeBuilder, ServiceSpec, Stateful, VariableSpec,
};
use blastema_tests::{Notes, RobotKeys, free_addresses, listens};
use std::fs;
use std::net::SocketAddr;
use tempfile::TempDir;

/// Turns the wheels.
#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/drive", reply = f32)]
struct Drive(f32);

/// Asks who has asked so far.
#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/hello", reply = Vec<String>)]
struct Hello(String);

/// Is written down.
#[derive(Clone, Debug, Event)]
#[contract(name = "wheels/note")]
struct Note(String);

/// How fast the wheels may turn.
#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "wheels/limit")]
struct Limit(f32);

/// An event on each topic.
#[derive(Clone, Debug, Event)]
#[contract(name = "wheels/report")]
struct Report(String);

mod services;

type Log = Notes<String>;

struct Wheels(Log);

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive(0.0), Hold)).variable(VariableSpec::new(Limit(1.0)));
        ports.serve::<Hello>().accept::<Note>();
        ports.listen::<Report>().on("orders");
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, Drive(speed): Drive, _: &mut Context<Self>) -> f32 {
        if speed != 0.0 {
            self.0.note(format!("driven {speed}"));
        }
        speed
    }
}

impl Handle<Hello> for Wheels {
    async fn handle(&mut self, Hello(who): Hello, _: &mut Context<Self>) -> Vec<String> {
        self.0.note(format!("asked by {who}"));
        self.0.all()
    }
}

impl Handle<Note> for Wheels {
    async fn handle(&mut self, Note(who): Note, _: &mut Context<Self>) {
        self.0.note(format!("told by {who}"));
    }
}

impl Handle<Report> for Wheels {
    async fn handle(&mut self, Report(who): Report, _: &mut Context<Self>) {
        self.0.note(format!("ordered by {who}"));
    }
}

const NODES: [&str; 3] = ["base", "arm", "head"];

struct Robot {
    folder: TempDir,
    at: Vec<SocketAddr>,
    wheels: Log,
    ears: [Log; 3],
}

/// All that is closed to others than `who`.
fn lines(who: &str) -> Vec<String> {
    vec![
        format!("only {who} may lease set ask tell on base/wheels"),
        format!("only {who} may listen on odometry"),
        format!("only base {who} may publish on orders"),
    ]
}

impl Robot {
    fn new(nodes: &[(&str, Role)], policy: &[String]) -> Self {
        let robot = Robot {
            folder: tempfile::tempdir().expect("a folder"),
            at: free_addresses(3),
            wheels: Log::default(),
            ears: <[Log; 3]>::default(),
        };
        RobotKeys::new(robot.folder.path(), &NODES, 1);
        robot.put(nodes, policy, 1);
        robot
    }

    /// Puts a roster beside the keys of all.
    fn put(&self, nodes: &[(&str, Role)], policy: &[String], serial: u64) {
        let lines: Vec<_> = policy.iter().map(String::as_str).collect();
        let text = RobotKeys::roster_with(nodes, &lines, 1, serial);
        let new = self.folder.path().join("copied");
        fs::write(&new, text).expect("a folder");
        fs::rename(&new, self.folder.path().join("ranger.roster")).expect("a folder");
    }

    async fn start_with(&self, own: usize, carry: impl Fn(NodeBuilder) -> NodeBuilder) -> Node {
        let keys = RobotKeys::there(self.folder.path());
        let network = Network::new("lan", &format!("udp://{}", self.at[own]));
        let peers: &[usize] = if own == 0 { &[1, 2] } else { &[0] };
        let network = peers
            .iter()
            .fold(network, |network, peer| network.peer(NODES[*peer], &self.at[*peer].to_string()));
        let (wheels, ear) = (self.wheels.clone(), self.ears[own].clone());
        let node = Node::builder(NODES[own]).work_threads(1).keys(keys.of(NODES[own]));
        let node = node.network(network);
        let node = match own {
            0 => node.child(ChildSpec::new("wheels", move || Wheels(wheels.clone()))),
            _ => node.child(listens("ear", "odometry", ear, |ear, Report(what), _| ear.note(what))),
        };
        carry(node).start().await.expect("it starts")
    }

    async fn start_all(&self) -> [Node; 3] {
        self.start_all_with(|_, builder| builder).await
    }

    async fn start_all_with(&self, carry: impl Fn(usize, NodeBuilder) -> NodeBuilder) -> [Node; 3] {
        let nodes = [
            self.start_with(0, |builder| carry(0, builder)).await,
            self.start_with(1, |builder| carry(1, builder)).await,
            self.start_with(2, |builder| carry(2, builder)).await,
        ];
        for (own, node) in nodes.iter().enumerate() {
            for (_, other) in NODES.iter().enumerate().filter(|(other, _)| *other != own) {
                assert!(node.connected(other, PATIENCE).await, "{} to {other}", NODES[own]);
            }
        }
        nodes
    }

    fn wheels(&self) -> Vec<String> {
        self.wheels.all()
    }
}

fn is_forbidden<T>(result: &Result<T, DeliveryError>, verb: &str) -> bool {
    matches!(result, Err(DeliveryError::Forbidden { verb: refused, .. }) if refused == verb)
}

/// Asks until it is not, or no longer, forbidden.
async fn may_ask(node: &Node, may: bool) {
    let name = node.name().to_string();
    let wheels = node.sender::<Hello>("base:wheels").expect("a name");
    let is_so = async || match wheels.ask(Hello(name.clone())).await {
        Ok(_) => may,
        Err(why) => !may && matches!(why.kind, DeliveryError::Forbidden { .. }),
    };
    until(is_so, &format!("{name} may ask: {may}")).await;
}

/// Does all that it can with the wheels, and says which of it was refused by the policy.
async fn use_wheels(node: &Node) -> Vec<&'static str> {
    let name = node.name().to_string();
    let mut refused = Vec::new();
    let wheels = node.sender::<Hello>("base:wheels").expect("a name");
    let asked = wheels.ask(Hello(name.clone())).await.map_err(|error| error.kind);
    refused.extend(is_forbidden(&asked, "ask").then_some("ask"));
    // A message that is refused is a dead letter of its sender.
    let _ = node.sender::<Note>("base:wheels").expect("a name").tell(Note(name));

    let limit = node.variable::<Limit>("base:wheels").expect("a name");
    assert_eq!(limit.read().await.expect("reading is open to all").value, Limit(1.0));
    let set = limit.write(Limit(1.0)).await;
    refused.extend(is_forbidden(&set, "set").then_some("set"));

    let commander = node.commander::<Drive>("base:wheels", "hand").expect("a name");
    match commander.claim().await {
        Ok(_) => assert_eq!(commander.command(Drive(2.0)).await.expect("it holds them"), 2.0),
        other => refused.extend(is_forbidden(&other, "lease").then_some("lease")),
    }
    commander.release().await.expect("it is given back, or was never had");
    refused
}

#[test]
fn only_who_is_named_may_use_the_wheels_and_another_roster_changes_it_while_all_run() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let open: Vec<_> = NODES.map(|node| (node, Role::Node)).into();
        let robot = Robot::new(&open, &lines("arm"));
        let [base, arm, head] = robot.start_all().await;
        assert_eq!(use_wheels(&arm).await, Vec::<&str>::new());
        assert_eq!(use_wheels(&head).await, ["ask", "set", "lease"]);

        // Topics: the base hears the arm alone, and the arm alone hears the base.
        let odometry = base.publisher::<Report>("odometry").expect("a name");
        until(async || odometry.matched() == 1, "the arm listens").await;
        odometry.publish(Report("first".into())).expect("it is sent");
        let orders = [&arm, &head].map(|node| node.publisher::<Report>("orders").expect("a name"));
        until(async || orders[0].matched() == 1, "the base listens to the arm").await;
        for (publisher, by) in orders.iter().zip(["arm", "head"]) {
            publisher.publish(Report(by.into())).expect("it is sent to all that listen");
        }
        let heard = |own: usize| robot.ears[own].all();
        until(async || heard(1) == ["first"], "the arm hears the base").await;
        until(async || robot.wheels().contains(&"ordered by arm".into()), "and the base it").await;
        assert_eq!(orders[1].matched(), 0);
        let expected = ["asked by arm", "told by arm", "driven 2", "ordered by arm"];
        assert_eq!(robot.wheels(), expected);

        // Both ends show it.
        let refusals = base.refusals();
        let verbs: Vec<_> = refusals.iter().map(|row| (row.node.as_str(), row.verb)).collect();
        for verb in ["ask", "set", "lease", "listen"] {
            assert!(verbs.contains(&("head", verb)), "{refusals:?}");
        }
        assert!(refusals.iter().all(|row| row.node.as_str() == "head"), "{refusals:?}");
        for node in [&base, &head] {
            let stands = async || {
                let faults = node.faults().await;
                faults.entries.iter().any(|fault| fault.fault.kind == FaultKind::Forbidden)
            };
            until(stands, "the fault forbidden").await;
        }

        // The arm holds the wheels when it loses the right to.
        let held = arm.commander::<Drive>("base:wheels", "hand").expect("a name");
        held.claim().await.expect("it may");
        robot.put(&open, &lines("head"), 2);
        may_ask(&head, true).await;
        may_ask(&arm, false).await;
        assert!(held.command(Drive(3.0)).await.is_err());
        let is_free = async || {
            let commander = head.commander::<Drive>("base:wheels", "hand").expect("a name");
            commander.claim().await.is_ok() && commander.command(Drive(4.0)).await.is_ok()
        };
        until(is_free, "the head gets the wheels").await;
        assert!(!robot.wheels().contains(&"driven 3".to_owned()));
        until(async || odometry.matched() == 1, "the head listens").await;
        odometry.publish(Report("second".into())).expect("it is sent");
        until(async || heard(2) == ["second"], "the head hears the base").await;
        assert_eq!(heard(1), ["first"]);
        let is_mended = async || {
            let faults = head.faults().await;
            let mut standing = faults.entries.iter().filter(|fault| fault.stands());
            standing.all(|fault| fault.fault.kind != FaultKind::Forbidden)
        };
        until(is_mended, "the head is refused nothing any more").await;
        end([base, arm, head]).await;
    });
}

#[test]
fn a_guest_may_do_what_a_line_gives_it_and_nothing_else() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let nodes = [("base", Role::Node), ("arm", Role::Node), ("head", Role::Guest)];
        let policy = ["only arm head may read ask on base/wheels".to_owned()];
        let robot = Robot::new(&nodes, &policy);
        let [base, arm, head] = robot.start_all().await;
        may_ask(&head, true).await;
        may_ask(&arm, true).await;
        assert_eq!(use_wheels(&head).await, ["set", "lease"]);
        assert!(!robot.wheels().contains(&"told by head".to_owned()), "{:?}", robot.wheels());
        let wheels = "wheels".parse().expect("a name");
        let is_dead = async || head.dead_letters().count(&wheels, DeadReason::Forbidden) == 1;
        until(is_dead, "the message is a dead letter of its sender").await;
        let verbs: Vec<_> = base.refusals().iter().map(|row| row.verb).collect();
        for verb in ["tell", "set", "lease", "listen"] {
            assert!(verbs.contains(&verb), "{verbs:?}");
        }
        end([base, arm, head]).await;
    });
}

#[test]
fn a_name_is_had_only_by_a_node_that_may_claim_it_and_until_it_may_no_more() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let open: Vec<_> = NODES.map(|node| (node, Role::Node)).into();
        let robot = Robot::new(&open, &["only arm may claim on map".to_owned()]);
        let [base, arm, head] = robot.start_all().await;
        let refused = head.claim("map", ClaimPolicy::Standby).await;
        assert!(
            matches!(refused, Err(ClaimError::Refused(ClaimRefused::Forbidden { .. }))),
            "{refused:?}"
        );
        let claim = arm.claim("map", ClaimPolicy::Refuse).await.expect("it may");
        let is = |node: Option<&str>| {
            let holder = base.holder("map");
            holder.as_ref().map(|holder| holder.node.as_str()) == node
        };
        until(async || is(Some("arm")), "the arm has the name").await;

        robot.put(&open, &["only head may claim on map".to_owned()], 2);
        until(async || is(None), "it has no holder").await;
        let is_over = async || matches!(claim.state(), ClaimState::Refused(_));
        until(is_over, "the arm is told").await;
        let mut claimed = None;
        let claims = async || {
            claimed = head.claim("map", ClaimPolicy::Standby).await.ok();
            claimed.is_some()
        };
        until(claims, "the head may").await;
        until(async || is(Some("head")), "the head has the name").await;
        end([base, arm, head]).await;
    });
}

#[test]
fn a_component_has_its_name_as_soon_as_the_roster_lets_it() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let open: Vec<_> = NODES.map(|node| (node, Role::Node)).into();
        let robot = Robot::new(&open, &["only arm may claim on map".to_owned()]);
        let with_mapper = |own, builder: NodeBuilder| match own {
            2 => {
                let mapper = listens("mapper", "odometry", (), |_, _: Report, _| {});
                builder.child(mapper.claim("map", ClaimPolicy::Refuse))
            }
            _ => builder,
        };
        let [base, arm, head] = robot.start_all_with(with_mapper).await;
        let goes_without = async || {
            let faults = head.faults().await.entries;
            let kinds = faults.iter().filter(|entry| entry.stands());
            kinds.map(|entry| entry.fault.kind.clone()).any(|kind| kind == FaultKind::NameTaken)
        };
        until(goes_without, "that the mapper goes without its name is a fault").await;
        for (serial, may) in [(2, true), (3, false), (4, true)] {
            let line = format!("only arm {} may claim on map", if may { "head" } else { "base" });
            robot.put(&open, &[line], serial);
            let is_held = async || base.holder("map").is_some() == may;
            until(is_held, &format!("by roster {serial} it is held: {may}")).await;
            until(async || goes_without().await != may, "the fault tells the same").await;
        }
        end([base, arm, head]).await;
    });
}
