//! Processes that run the robot's own program: each is a node of its own, joined to the node whose
//! child it is by Unix sockets, and its components are addressed as those of any node.
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
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// The command line by which this program runs the file with these values of its arguments.
pub(crate) fn run_arguments(file: &Path, set: &[(String, String)]) -> Vec<OsString> {
    let set = set.iter().map(|(name, value)| OsString::from(format!("--set={name}={value}")));
    [OsString::from("run"), file.into()].into_iter().chain(set).collect()
}

/// Makes a node of each process that holds components.
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
