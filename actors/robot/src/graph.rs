//! The supervision trees and connections of a robot as text, for Graphviz and for Mermaid.

use crate::description::{
    ChildDescription, ComponentDescription, ConnectionDescription, LostCommunicationDescription,
    RobotDescription, SupervisorDescription,
};
use crate::reader::{RUNGS, STRATEGIES};
use crate::value::word_of;
use blastema::ProcessSpec;
use blastema::core::port::PortConnection;
use blastema::recovery::Strategy;

/// How a graph is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum GraphFormat {
    /// An indented tree
    Text,
    /// The language of Graphviz
    Dot,
    /// The language of Mermaid
    Mermaid,
}

/// Writes the nodes with their trees, and the connections.
pub(crate) fn graph(robot: &RobotDescription, format: GraphFormat) -> String {
    let (mut graph, name) =
        (GraphText { robot, text: String::new(), format, depth: 0 }, &robot.name);
    let dot = format!("digraph \"{name}\" {{\n  node [shape=box]; rankdir=LR;");
    graph.line([format!("robot {name}"), dot, "flowchart LR".to_owned()]);
    graph.depth += 1;
    for node in &robot.nodes {
        let of = node.process_of.iter().map(|of| format!(", process of {of}"));
        let of = of.collect::<String>();
        let label = format!("node {} ({}{of})", node.name, word(node.root.strategy));
        graph.group(&node.name, &label, &node.root);
        for policy in &node.lost_communication {
            let (id, policy) = (format!("{}/{}", node.name, policy.name), ladder(policy));
            graph.line([
                format!("  {policy}"),
                format!("\"{id}\" [shape=note label=\"{policy}\"];"),
                format!("{}[\"{policy}\"]", mermaid_id(&id)),
            ]);
        }
    }
    for ConnectionDescription { ports: PortConnection { from, to }, .. } in &robot.connections {
        let (one, other, port) = (from.component(), to.component(), &from.port);
        graph.line([
            format!("{from} -> {to}"),
            format!("\"{one}\" -> \"{other}\" [label=\"{port}\"];"),
            format!("{} -- {port} --> {}", mermaid_id(&one), mermaid_id(&other)),
        ]);
    }
    graph.depth -= 1;
    graph.line(["", "}", ""].map(str::to_owned));
    graph.text
}

/// A policy in one line, as in `operator lost: hold after 1s, return after 10s (homing)`.
fn ladder(policy: &LostCommunicationDescription) -> String {
    let rungs = policy.rungs.iter().map(|rung| {
        let run = rung.run.as_ref().map(|run| format!(" ({run})")).unwrap_or_default();
        format!("{} after {:?}{run}", word_of(&RUNGS, rung.action), rung.after)
    });
    format!("{} lost: {}", policy.name, rungs.collect::<Vec<_>>().join(", "))
}

struct GraphText<'a> {
    robot: &'a RobotDescription,
    text: String,
    format: GraphFormat,
    depth: usize,
}

fn word(strategy: Strategy) -> &'static str {
    word_of(&STRATEGIES, strategy)
}

impl GraphText<'_> {
    /// Adds a line, which is written once for each format. An empty one is left out.
    fn line(&mut self, forms: [String; 3]) {
        let line = &forms[self.format as usize];
        if !line.is_empty() {
            self.text += &format!("{:indent$}{line}\n", "", indent = 2 * self.depth);
        }
    }

    /// A node or a supervisor with its children.
    fn group(&mut self, node: &str, label: &str, supervisor: &SupervisorDescription) {
        let id = format!("{node}:{}", supervisor.name);
        self.line([
            label.to_owned(),
            format!("subgraph \"cluster_{id}\" {{ label=\"{label}\";"),
            format!("subgraph {}[\"{label}\"]", mermaid_id(&id)),
        ]);
        self.depth += 1;
        for child in &supervisor.children {
            match child {
                ChildDescription::Component(component) => {
                    let ComponentDescription { name, type_name, tree, rate_hz, device, .. } =
                        &**component;
                    let process = component.process.as_ref().map(ProcessSpec::program);
                    let own = self.robot.node(name).and_then(|own| own.process_of.as_deref());
                    let is_node = own == Some(node);
                    let process = process.map(|program| match is_node {
                        true => format!("process, node {name}"),
                        false => format!("process {}", program.display()),
                    });
                    let rate = rate_hz.map(|rate| format!(", {rate} Hz")).unwrap_or_default();
                    let tree = tree.as_ref().and_then(|file| file.file_name());
                    let tree = tree.map(|file| format!("tree {}", file.display()));
                    let kind = tree.as_ref().or(process.as_ref()).unwrap_or(type_name);
                    let at = device.as_ref().map(|device| format!(", device at {}", device.at));
                    let about = format!("{kind}{rate}{}", at.unwrap_or_default());
                    let id = format!("{node}:{name}");
                    self.line([
                        format!("{name}: {about}"),
                        format!("\"{id}\" [label=\"{name}\\n{about}\"];"),
                        format!("{}[\"{name}<br/>{about}\"]", mermaid_id(&id)),
                    ]);
                }
                ChildDescription::Supervisor(below) => {
                    let label = format!("supervisor {} ({})", below.name, word(below.strategy));
                    self.group(node, &label, below);
                }
            }
        }
        self.depth -= 1;
        self.line(["", "}", "end"].map(str::to_owned));
    }
}

/// A name of letters, digits and `_` alone. What else may stand in names is written as its number,
/// so that two names have two identifiers.
fn mermaid_id(name: &str) -> String {
    let mut id = String::from("n_");
    for c in name.chars() {
        match c {
            c if c.is_ascii_alphanumeric() => id.push(c),
            c => id.push_str(&format!("_{:x}_", u32::from(c))),
        }
    }
    id
}
