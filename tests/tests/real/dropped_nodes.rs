//! A node in virtual time may be dropped without a shutdown, as most tests do: its process says
//! nothing of that on standard error. One with threads of its own says why its outputs are safe.

use blastema::prelude::*;
use blastema::{ActuatorSpec, Hold, MemoryMedium, NodeBuilder};
use blastema_testkit::{TestNode, advance};
use blastema_tests::{MS, Process, on_ethernet, role};
use std::fs::File;
use std::future::pending;
use std::time::Duration;

#[derive(Clone, Debug, Request)]
#[contract(name = "dropped/drive", reply = f32)]
struct Drive(f32);

#[derive(Clone, Debug, Event)]
#[contract(name = "dropped/turned")]
struct Turned;

/// An actuator, with all that outlasts a handler: rounds, a timer, a task.
struct Wheels;

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive(0.0), Hold).lease(Duration::from_secs(10)));
        ports.publishes::<Turned>("turned");
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.every(Duration::from_secs(1), |_, cx| cx.publish(Turned));
        Ok(())
    }

    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        Ok(())
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) -> f32 {
        drive.0
    }
}

/// Holds the lease of the wheels, and awaits something for ever.
struct Driver(Option<blastema::Commander<Drive>>);

impl Component for Driver {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Turned>();
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let commander = cx.commander::<Drive>("wheels")?;
        commander.claim().await?;
        self.0 = Some(commander);
        Ok(())
    }
}

impl Handle<Turned> for Driver {
    async fn handle(&mut self, _: Turned, _: &mut Context<Self>) {
        pending().await
    }
}

fn robot() -> NodeBuilder {
    with_robot(Node::builder("module1"))
}

fn with_robot(node: NodeBuilder) -> NodeBuilder {
    let wheels = ChildSpec::new("wheels", || Wheels).rate_hz(10.0);
    let driver = ChildSpec::new("driver", || Driver(None)).depends_on(["wheels"]);
    node.child(wheels).child(driver).safe_outputs(|_| {})
}

async fn started() -> TestNode {
    let node = TestNode::start(robot()).await;
    advance(1500 * MS).await;
    node
}

/// Two nodes that are connected, while a component of one has died and another one is held.
async fn pair() -> [TestNode; 2] {
    let medium = MemoryMedium::default();
    let one = TestNode::start(with_robot(on_ethernet("module1", "module2", &medium))).await;
    let other = TestNode::start(on_ethernet("module2", "module1", &medium)).await;
    advance(1500 * MS).await;
    one.kill("wheels");
    one.hang("driver");
    [one, other]
}

#[test]
fn a_process_plays_its_role() {
    match role().as_deref() {
        Some("within") => blastema_testkit::run(async { drop(started().await) }),
        Some("at the end") => blastema_testkit::run(async {
            let _node = started().await;
        }),
        Some("after") => drop(blastema_testkit::run(started())),
        Some("two at the end") => blastema_testkit::run(async {
            let _nodes = pair().await;
        }),
        // Its actors are dropped before they have begun.
        Some("refused") => blastema_testkit::run(async {
            let nameless = ChildSpec::new("nameless", || Wheels).with_ports(|ports| {
                ports.publishes::<Turned>("no name");
            });
            assert!(TestNode::try_start(robot().child(nameless)).await.is_err());
        }),
        Some("two after") => drop(blastema_testkit::run(pair())),
        Some("with a task") => blastema_testkit::run(async {
            let node = started().await;
            tokio::task::spawn_local(async move {
                let _node = node;
                pending::<()>().await;
            });
            advance(MS).await;
        }),
        Some("threads") => blastema::run(async { drop(robot().start().await.expect("it starts")) }),
        _ => {}
    }
}

fn said(role: &str) -> String {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("errors");
    let errors = File::create(&path).expect("a file");
    let mut process = Process::start_into(errors, module_path!(), role, &[""; 0]);
    assert!(process.succeeds(), "{role}");
    std::fs::read_to_string(&path).expect("it is text")
}

#[test]
fn a_node_in_virtual_time_that_is_dropped_says_nothing_and_one_with_threads_does() {
    let _turn = blastema_doubles::turn();
    for role in
        ["refused", "within", "at the end", "after", "two at the end", "two after", "with a task"]
    {
        assert_eq!(said(role), "", "{role}");
    }
    assert!(said("threads").contains("node module1: the node was dropped while it ran"));
}
