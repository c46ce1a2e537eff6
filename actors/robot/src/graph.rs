//! The supervision trees and connections of a robot as text, for Graphviz and for Mermaid.

use crate::description::{
    ChildDescription, ComponentDescription, RobotDescription, SupervisorDescription,
};
use blastema::core::port::PortAddress;
use blastema::recovery::Strategy;
use std::fmt::{self, Write};

/// How a graph is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum GraphFormat {
    /// An indented tree
    Text,
    /// For Graphviz
    Dot,
    /// For Mermaid
    Mermaid,
}

/// Writes the nodes with their trees, and the connections.
pub(crate) fn graph(robot: &RobotDescription, format: GraphFormat) -> String {
    let mut graph = GraphText { text: String::new(), format, depth: 0 };
    // Writing to a text does not fail.
    let _ = graph.robot(robot);
    graph.text
}

struct GraphText {
    text: String,
    format: GraphFormat,
    depth: usize,
}

fn word(strategy: Strategy) -> &'static str {
    match strategy {
        Strategy::OneForOne => "one-for-one",
        Strategy::OneForAll => "one-for-all",
        Strategy::RestForOne => "rest-for-one",
    }
}

impl GraphText {
    fn line(&mut self, line: fmt::Arguments<'_>) -> fmt::Result {
        writeln!(self.text, "{:indent$}{line}", "", indent = 2 * self.depth)
    }

    fn robot(&mut self, robot: &RobotDescription) -> fmt::Result {
        let name = &robot.name;
        match self.format {
            GraphFormat::Text => self.line(format_args!("robot {name}"))?,
            GraphFormat::Dot => {
                self.line(format_args!("digraph \"{name}\" {{"))?;
                self.line(format_args!("  node [shape=box]; rankdir=LR;"))?;
            }
            GraphFormat::Mermaid => self.line(format_args!("flowchart LR"))?,
        }
        self.depth += 1;
        for node in &robot.nodes {
            let label = format!("node {} ({})", node.name, word(node.root.strategy));
            self.group(&node.name, "", &label, &node.root)?;
        }
        for connection in &robot.connections {
            let (from, to) = (&connection.ports.from, &connection.ports.to);
            let id = |port: &PortAddress| port.component();
            match self.format {
                GraphFormat::Text => self.line(format_args!("{from} -> {to}"))?,
                GraphFormat::Dot => self.line(format_args!(
                    "\"{}\" -> \"{}\" [label=\"{}\"];",
                    id(from),
                    id(to),
                    from.port
                ))?,
                GraphFormat::Mermaid => self.line(format_args!(
                    "{} -- {} --> {}",
                    mermaid_id(&id(from)),
                    from.port,
                    mermaid_id(&id(to))
                ))?,
            }
        }
        self.depth -= 1;
        match self.format {
            GraphFormat::Dot => self.line(format_args!("}}")),
            GraphFormat::Text | GraphFormat::Mermaid => Ok(()),
        }
    }

    /// A node or a supervisor with its children.
    fn group(
        &mut self,
        node: &str,
        name: &str,
        label: &str,
        supervisor: &SupervisorDescription,
    ) -> fmt::Result {
        let id = format!("{node}:{name}");
        match self.format {
            GraphFormat::Text => self.line(format_args!("{label}"))?,
            GraphFormat::Dot => {
                self.line(format_args!("subgraph \"cluster_{id}\" {{ label=\"{label}\";"))?;
            }
            GraphFormat::Mermaid => {
                self.line(format_args!("subgraph {}[\"{label}\"]", mermaid_id(&id)))?;
            }
        }
        self.depth += 1;
        for child in &supervisor.children {
            match child {
                ChildDescription::Component(component) => self.component(node, component)?,
                ChildDescription::Supervisor(below) => {
                    let label = format!("supervisor {} ({})", below.name, word(below.strategy));
                    self.group(node, &below.name, &label, below)?;
                }
            }
        }
        self.depth -= 1;
        match self.format {
            GraphFormat::Text => Ok(()),
            GraphFormat::Dot => self.line(format_args!("}}")),
            GraphFormat::Mermaid => self.line(format_args!("end")),
        }
    }

    fn component(&mut self, node: &str, component: &ComponentDescription) -> fmt::Result {
        let ComponentDescription { name, type_name, rate_hz, .. } = component;
        let rate = rate_hz.map(|rate| format!(", {rate} Hz")).unwrap_or_default();
        let id = format!("{node}:{name}");
        match self.format {
            GraphFormat::Text => self.line(format_args!("{name}: {type_name}{rate}")),
            GraphFormat::Dot => {
                self.line(format_args!("\"{id}\" [label=\"{name}\\n{type_name}{rate}\"];"))
            }
            GraphFormat::Mermaid => {
                let id = mermaid_id(&id);
                self.line(format_args!("{id}[\"{name}<br/>{type_name}{rate}\"]"))
            }
        }
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
