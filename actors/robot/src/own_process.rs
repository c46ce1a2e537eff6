//! Processes that run the robot's own program: each is a node of its own, joined to the node whose
//! child it is by Unix sockets, and its components are found by their names alone.
//!
//! ```text
//! <node name="base">                       node base ── component motors, the process
//!   <process name="motors">                    ║ unix sockets
//!     <component name="wheels"/>     ─►    node motors ── component wheels
//!   </process>
//! </node>
//! ```

use crate::description::{
    ChildDescription, ComponentDescription, EndpointDescription, NodeDescription, RobotDescription,
    RobotNetwork, SupervisorDescription,
};
use blastema::NodeName;
use blastema::core::port::PortAddress;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// The command line by which this program runs the file with these values of its arguments.
pub(crate) fn run_arguments(file: &Path, set: &[(String, String)]) -> Vec<OsString> {
    let set = set.iter().map(|(name, value)| OsString::from(format!("--set={name}={value}")));
    [OsString::from("run"), file.into()].into_iter().chain(set).collect()
}

/// Makes a node of each process that holds components, and has addresses follow these.
///
/// The processes run this program again with this file and these values of its arguments.
pub(crate) fn make_nodes(robot: &mut RobotDescription, file: &Path, set: &[(String, String)]) {
    let run = run_arguments(file, set);
    // Those of a process are behind it, and are found in their turn.
    let mut at = 0;
    while at < robot.nodes.len() {
        let (mut held, parent) = (Vec::new(), &mut robot.nodes[at]);
        take_nodes(&mut parent.root, &mut held);
        at += 1;
        if held.is_empty() {
            continue;
        }
        let network = format!("{}-processes", parent.name);
        // One that is a process and has some is in two of these networks.
        let socket = |node: &str| match node == parent.name {
            true => socket_of(&robot.name, node),
            false => socket_of(&robot.name, &format!("{}:{node}", parent.name)),
        };
        let endpoint = |node: &str, origin| EndpointDescription {
            network: network.clone(),
            at: format!("unix://{}", socket(node).display()),
            origin,
            ..EndpointDescription::default()
        };
        parent.endpoints.push(endpoint(&parent.name, parent.origin));
        let origin = parent.origin;
        let mut made = Vec::new();
        for (component, mut node) in held {
            let arguments = run.iter().cloned().chain(["--node".into(), node.name.clone().into()]);
            component.process =
                component.process.take().map(|process| process.arguments(arguments));
            node.process_of = Some(parent.name.clone());
            node.endpoints = vec![endpoint(&node.name, node.origin)];
            node.safe_outputs.clone_from(&parent.safe_outputs);
            node.plan.clone_from(&parent.plan);
            // The key of a process lies beside that of its node.
            let keys = parent.keys.as_ref().or(robot.keys.as_ref());
            node.keys = keys.map(|key| key.with_file_name(format!("{}.key", node.name)));
            made.push(node);
        }
        robot.nodes.extend(made);
        robot.networks.push(RobotNetwork { name: network, origin, ..RobotNetwork::default() });
    }
    follow(robot);
}

/// Takes the nodes of processes out of a tree, each with the component that stands for it.
fn take_nodes<'a>(
    supervisor: &'a mut SupervisorDescription,
    held: &mut Vec<(&'a mut ComponentDescription, NodeDescription)>,
) {
    for child in &mut supervisor.children {
        match child {
            ChildDescription::Component(component) => {
                if let Some(node) = component.node.take() {
                    held.push((component, *node));
                }
            }
            ChildDescription::Supervisor(below) => take_nodes(below, held),
        }
    }
}

/// In the runtime directory of the user. Only processes of this user are heard there.
fn socket_of(robot: &str, node: &str) -> PathBuf {
    let user = rustix::process::geteuid().as_raw();
    blastema::runtime_folder().join(format!("blastema-{user}-{robot}-{node}.sock"))
}

/// Has addresses name the node, or the process of it, in which their component stands.
fn follow(robot: &mut RobotDescription) {
    let known = robot.clone();
    let node_of = |node: &str, object: &str| match candidates(&known, node, object)[..] {
        [only] if only != node => Some(only.to_owned()),
        _ => None,
    };
    let port = |address: &mut PortAddress| {
        let Some(node) = &address.node else { return };
        let other = node_of(node.as_str(), address.object.as_str());
        address.node = other.and_then(|other| NodeName::new(&other).ok()).or(address.node.take());
    };
    for connection in &mut robot.connections {
        port(&mut connection.ports.from);
        port(&mut connection.ports.to);
    }
    for node in &mut robot.nodes {
        let rungs = node.lost_communication.iter_mut().flat_map(|policy| &mut policy.rungs);
        rungs.flat_map(|rung| &mut rung.commands).for_each(|command| port(&mut command.actuator));
        let own = node.name.clone();
        node.root.retain(&mut |child| {
            let ChildDescription::Component(component) = child else { return true };
            for needed in &mut component.depends_on {
                let (node, object) = needed.split_once(':').unwrap_or((&own, needed));
                let is_it = |child: &ChildDescription| child.identity().0 == object;
                if known.node(node).is_some_and(|node| node.root.any(&is_it)) {
                    continue;
                }
                if let Some(other) = node_of(node, object) {
                    *needed = format!("{other}:{object}");
                }
            }
            true
        });
    }
}

/// The node, if it has a component of this name with ports, or else those of its family that have
/// one: the processes of one node, and that node.
pub(crate) fn candidates<'r>(
    robot: &'r RobotDescription,
    node: &'r str,
    object: &str,
) -> Vec<&'r str> {
    let is_it = |child: &ChildDescription| match child {
        ChildDescription::Component(known) => known.name == object && known.process.is_none(),
        ChildDescription::Supervisor(_) => false,
    };
    let whole = robot.whole_of(node);
    let having = robot.nodes.iter().filter(|known| known.root.any(&is_it));
    let names = having.map(|known| &*known.name).filter(|of| robot.whole_of(of) == whole);
    let names: Vec<_> = names.collect();
    if names.contains(&node) { vec![node] } else { names }
}
