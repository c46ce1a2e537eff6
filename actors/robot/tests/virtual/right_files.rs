//! Right files: the descriptions that they are read into, and the nodes that these become.

use crate::program::{Laser, Motors, types};
use blastema::core::port::PortConnection;
use blastema::detection::{Liveness, Pull, Push};
use blastema::prelude::*;
use blastema::recovery::Backoff;
use blastema::{
    ActuatorSettings, ClaimPolicy, CommandTimeout, Connected, ProcessSpec, SupervisionTree,
};
use blastema_robot::RobotDescription;
use blastema_robot::description::{
    AnswerDescription, ChildDescription, CommandDescription, ComponentDescription,
    ConnectionDescription, DeviceSettings, ElementOrigin, EndpointDescription,
    LostCommunicationDescription, NeedDescription, NodeDescription, RobotNetwork, RungAction,
    RungDescription, SupervisorDescription,
};
use std::path::Path;
use std::time::Duration;

const MS: Duration = Duration::from_millis(1);
const SECOND: Duration = Duration::from_secs(1);

fn load(file: &str, set: &[(&str, &str)]) -> RobotDescription {
    let loaded = blastema::run(async { types().load(Path::new(file), set) });
    loaded.unwrap_or_else(|error| panic!("{error}"))
}

fn answer(fault: FaultKind, ladder: Ladder) -> AnswerDescription {
    AnswerDescription { fault, ladder, origin: ElementOrigin::default() }
}

fn connection(from: &str, to: &str) -> ConnectionDescription {
    let port = |text: &str| text.parse().expect("an address of a port");
    let ports = PortConnection { from: port(from), to: port(to) };
    ConnectionDescription { ports, origin: ElementOrigin::default() }
}

fn endpoint(network: &str, at: &str) -> EndpointDescription {
    EndpointDescription { network: network.into(), at: at.into(), ..Default::default() }
}

fn cell(name: &str) -> ChildDescription {
    let type_name = "Cell".to_owned();
    let cell = ComponentDescription { name: name.into(), type_name, ..Default::default() };
    ChildDescription::Component(Box::new(cell))
}

fn need(kind: &'static str, name: &str, needed: Connected) -> NeedDescription {
    NeedDescription { kind, name: name.into(), needed, origin: ElementOrigin::default() }
}

fn rung(after: Duration, action: RungAction, speeds: &[&[(&str, &str)]]) -> RungDescription {
    let own = |(name, value): &(&str, &str)| ((*name).to_owned(), (*value).to_owned());
    let commands = speeds.iter().map(|fields| CommandDescription {
        actuator: "base:motors#drive".parse().expect("an address of a port"),
        fields: fields.iter().map(own).collect(),
        origin: ElementOrigin::default(),
    });
    let (run, commands, origin) = (None, commands.collect(), ElementOrigin::default());
    RungDescription { after, action, run, commands, origin }
}

/// What `base` of `whole.robot.xml` does when it loses `arm`.
fn pilot() -> LostCommunicationDescription {
    let homing = Some("homing".to_owned());
    LostCommunicationDescription {
        name: "pilot".into(),
        commander: Some("arm".into()),
        needs: vec![
            need(
                "heartbeat",
                "arm/beat",
                Connected::heartbeat("arm/beat")
                    .timeout(SECOND)
                    .max_latency(200 * MS)
                    .max_jitter(50 * MS)
                    .max_loss(0.2),
            ),
            need(
                "heartbeat",
                "eye/beat",
                Connected::heartbeat("eye/beat").at_rate(10.0, 2 * SECOND),
            ),
            need("node", "arm", Connected::node("arm")),
            need("session", "arm", Connected::session("arm")),
            need("link", "ether", Connected::link("ether")),
        ],
        at_least: Some(2),
        rungs: vec![
            rung(SECOND, RungAction::Hold, &[&[]]),
            RungDescription { run: homing, ..rung(10 * SECOND, RungAction::Return, &[]) },
            rung(60 * SECOND, RungAction::Stop, &[&[("speed", "-0.1 m/s")]]),
        ],
        stable_for: Some(2 * SECOND),
        acknowledged: true,
        origin: ElementOrigin::default(),
    }
}

/// The robot of `whole.robot.xml`, in code.
fn whole() -> RobotDescription {
    let folder = std::fs::canonicalize("tests/right").expect("it is there");
    let laser = ComponentDescription {
        name: "laser".into(),
        type_name: "Laser".into(),
        rate_hz: Some(20.0),
        restart: Restart::Transient,
        queue: Some(8),
        when_full: WhenFull::DropOldest,
        own_thread: true,
        priority: Some(80),
        cpu: Some(1),
        max_block: Some(150 * MS),
        max_wait: Some(2 * SECOND),
        max_delay: Some(500 * MS),
        ready_within: Some(3 * SECOND),
        shutdown_within: Some(SECOND),
        parameters: vec![("reach".into(), "12 m".into()), ("device".into(), "/dev/ttyUSB0".into())],
        liveness: Some(Liveness::Push(Push {
            interval: 100 * MS,
            tolerance: 3,
            start_up: 2 * SECOND,
        })),
        claims: vec![("eyes".into(), ClaimPolicy::Standby)],
        plan: vec![answer(FaultKind::Silence, Ladder::first(RecoveryAction::SafeStop))],
        ..Default::default()
    };
    let motors = ComponentDescription {
        name: "motors".into(),
        type_name: "Motors".into(),
        rate_hz: Some(100.0),
        depends_on: vec!["laser".into(), "eye:camera".into()],
        essential: true,
        liveness: Some(Liveness::Pull(Pull { interval: 200 * MS, within: 100 * MS, tolerance: 2 })),
        actuators: vec![(
            "drive".into(),
            ActuatorSettings {
                lease: Some(100 * MS),
                command_timeout: Some(CommandTimeout::After(150 * MS)),
                safe: vec![("speed".into(), "0.5 m/s".into())],
            },
        )],
        ..Default::default()
    };
    let wheels = SupervisorDescription {
        name: "wheels".into(),
        children: vec![ChildDescription::Component(Box::new(motors))],
        ..Default::default()
    };
    let drive = SupervisorDescription {
        name: "drive".into(),
        strategy: Strategy::OneForAll,
        intensity: Some(5),
        period: Some(10 * SECOND),
        when_exceeded: WhenExceeded::Escalate,
        essential: true,
        children: vec![
            ChildDescription::Component(Box::new(laser)),
            ChildDescription::Supervisor(wheels),
        ],
        ..Default::default()
    };
    let mut children = vec![ChildDescription::Supervisor(drive)];
    children.extend(["skin/08", "skin/09", "skin/10"].map(cell));
    children.push(ChildDescription::Component(Box::new(ComponentDescription {
        name: "homing".into(),
        tree: Some(folder.join("trees/homing.tree.xml")),
        rate_hz: Some(5.0),
        depends_on: vec!["motors".into()],
        ..Default::default()
    })));
    let base = NodeDescription {
        name: "base".into(),
        root: SupervisorDescription {
            strategy: Strategy::RestForOne,
            intensity: Some(5),
            period: Some(60 * SECOND),
            when_exceeded: WhenExceeded::Escalate,
            children,
            ..Default::default()
        },
        work_threads: Some(2),
        locked_memory: true,
        grace: Some(100 * MS),
        safe_outputs: Some("brakes".into()),
        shown_at: Some("/tmp/base.sock".into()),
        keep_variables: Some("/tmp/base.variables".into()),
        plan: vec![answer(FaultKind::Silence, Ladder::first(RecoveryAction::Restart))],
        lost_communication: vec![pilot()],
        endpoints: vec![
            endpoint("cable", "unix:///tmp/base.cable"),
            EndpointDescription {
                reached_at: Some("192.168.0.1:7400".into()),
                ..endpoint("ether", "udp://0.0.0.0:7400?interface=eth0")
            },
        ],
        ..Default::default()
    };
    let gripper = ComponentDescription {
        name: "gripper".into(),
        type_name: "Cell".into(),
        liveness: Some(Liveness::Guard),
        ..Default::default()
    };
    let lease = ActuatorSettings { lease: Some(100 * MS), ..Default::default() };
    let hand = ComponentDescription {
        name: "hand".into(),
        type_name: "Gripper".into(),
        rate_hz: Some(50.0),
        liveness: Some(Liveness::Guard),
        actuators: vec![("robot/grasp".into(), lease)],
        claims: vec![("hand".into(), ClaimPolicy::Refuse)],
        plan: vec![answer(FaultKind::Silence, Ladder::first(RecoveryAction::SafeStop))],
        device: Some(DeviceSettings {
            at: "serial:///dev/ttyUSB1?baud=115200".into(),
            address: Some(7),
            interval: Some(20 * MS),
            tries: Some(5),
            deadman: Some(200 * MS),
            turnaround: Some(5 * MS),
        }),
        ..Default::default()
    };
    let [vision, second] = ["0", "1"].map(|copy| ComponentDescription {
        name: format!("vision/{copy}"),
        restart: Restart::Transient,
        depends_on: vec!["gripper".into()],
        essential: true,
        ready_within: Some(3 * SECOND),
        shutdown_within: Some(SECOND),
        plan: vec![answer(FaultKind::Fatal, Ladder::first(RecoveryAction::Restart).times(5))],
        process: Some(
            ProcessSpec::new(&format!("vision/{copy}"), "sh")
                .arguments(["-u".to_owned(), "vision.sh".to_owned(), format!("--camera {copy}")])
                .variable("HELLO", "20ms")
                .folder(Path::new("tests/right").canonicalize().expect("it is there"))
                .watchdog(2 * SECOND)
                .memory_limit(512 << 20)
                .ready_at_start(),
        ),
        ..Default::default()
    });
    let arm = NodeDescription {
        name: "arm".into(),
        root: SupervisorDescription {
            children: [gripper, vision, second, hand]
                .map(|it| ChildDescription::Component(Box::new(it)))
                .into(),
            ..Default::default()
        },
        endpoints: vec![
            endpoint("cable", "unix:///tmp/arm.cable"),
            endpoint("ether", "udp://192.168.0.2:7400?interface=eth0"),
        ],
        may_be_away: true,
        ..Default::default()
    };
    let eye = NodeDescription {
        name: "eye".into(),
        root: SupervisorDescription {
            children: vec![ChildDescription::Component(Box::new(ComponentDescription {
                name: "camera".into(),
                type_name: "Camera".into(),
                rate_hz: Some(15.0),
                ..Default::default()
            }))],
            ..Default::default()
        },
        endpoints: vec![endpoint("cable", "unix:///tmp/eye.cable")],
        ..Default::default()
    };
    let error_state =
        Ladder::first(RecoveryAction::Reset).times(2).within(20 * MS).then(RecoveryAction::Restart);
    let pauses = Backoff { first: 20 * MS, factor: 2, limit: SECOND, ..Backoff::default() };
    let slip = Ladder::first(RecoveryAction::Custom("oil".into()))
        .times(2)
        .within(5 * SECOND)
        .backoff(pauses)
        .then(RecoveryAction::Observe);
    RobotDescription {
        name: "whole".into(),
        program: Some(folder.join("./whole")),
        networks: vec![
            RobotNetwork {
                name: "cable".into(),
                cost: Some(10),
                hello_every: Some(20 * MS),
                expected_within: Some(Duration::MAX),
                ..Default::default()
            },
            RobotNetwork { name: "ether".into(), insecure: true, ..Default::default() },
        ],
        plan: vec![
            answer(FaultKind::ErrorState, error_state.times(3)),
            answer(FaultKind::Custom("SLIP".into()), slip),
        ],
        nodes: vec![eye, base, arm],
        connections: vec![
            connection("base:laser#scan", "base:motors#scan"),
            connection("base:laser#scan", "eye:camera#scan"),
        ],
        ..Default::default()
    }
}

#[test]
fn a_robot_from_a_file_and_the_same_from_code_have_equal_descriptions() {
    let mut robot = load("tests/right/whole.robot.xml", &[]);
    // A process of the robot's own is a node of its own, and a child of its node.
    let fingers = robot.nodes.pop().expect("it is the last");
    assert_eq!((&*fingers.name, fingers.process_of.as_deref()), ("fingers", Some("arm")));
    let [end] = &fingers.endpoints[..] else { panic!("{:?}", fingers.endpoints) };
    assert!(
        end.at.starts_with("unix://") && end.at.ends_with("-whole-arm:fingers.sock"),
        "{}",
        end.at
    );
    let [thumb] = &fingers.components()[..] else { panic!("{fingers:?}") };
    assert_eq!((&*thumb.name, &thumb.depends_on[..]), ("thumb", &["arm:gripper".to_owned()][..]));
    assert_eq!(fingers.root.strategy, Strategy::OneForAll);
    let arm = robot.nodes.last_mut().expect("it is its node");
    assert_eq!(arm.endpoints.pop().expect("to its process").network, end.network);
    assert_eq!(robot.networks.pop().expect("of both").name, end.network);
    let is_process = |child: &ChildDescription| match child {
        ChildDescription::Component(component) => component.name == "fingers",
        ChildDescription::Supervisor(_) => false,
    };
    let at = arm.root.children.iter().position(is_process).expect("it is a child");
    arm.root.children.remove(at);
    assert_eq!(robot, whole());
}

#[test]
fn the_file_of_the_manual_is_right() {
    let page = std::fs::read_to_string("../src/manual/robot_file.md").expect("it is there");
    let shown = page.split("```xml\n").nth(1).and_then(|rest| rest.split("```").next());
    let shown = shown.expect("the manual shows a robot file");
    let file = std::fs::read_to_string("tests/right/manual.robot.xml").expect("it is there");
    assert_eq!(shown, file, "copy the one of the manual");
    assert_eq!(load("tests/right/manual.robot.xml", &[]).connections.len(), 1);
}

#[test]
fn arguments_that_are_set_prevail_over_defaults() {
    let robot = load("tests/right/whole.robot.xml", &[("hello", "5ms"), ("folder", "/run")]);

    assert_eq!(robot.networks[0].hello_every, Some(5 * MS));
    assert_eq!(robot.node("base").expect("a node").endpoints[0].at, "unix:///run/base.cable");
}

/// The tree of a node that is started and stopped.
async fn tree(builder: blastema::NodeBuilder) -> SupervisionTree {
    let node = builder.on_this_thread().start().await.expect("it starts");
    let tree = node.tree().await.expect("it runs");
    node.shutdown().await;
    tree
}

#[test]
fn a_node_from_a_file_has_the_tree_of_one_that_code_composes() {
    let types = types();
    let robot = load("tests/right/one.robot.xml", &[]);
    let composed = Node::builder("base")
        .root(SupervisorSpec::new("", Strategy::RestForOne))
        .supervisor(
            SupervisorSpec::new("drive", Strategy::OneForAll)
                .intensity(5, 10 * SECOND)
                .child(ChildSpec::new("laser", || Laser).parameter("reach", "12 m"))
                .child_with(ChildSpec::new("motors", || Motors), Restart::Transient),
        )
        .child(ChildSpec::new("spare", || Laser));

    let (from_file, from_code) = blastema::run(async {
        let builder = types.node(&robot, "base").expect("it is there");
        (tree(builder).await, tree(composed).await)
    });

    assert_eq!(format!("{from_file:?}"), format!("{from_code:?}"));
}
