//! A robot as plain data: what a robot file is read into, and what code may fill as well.

use blastema::core::port::{PortAddress, PortConnection};
use blastema::detection::Liveness;
use blastema::recovery::{Ladder, Restart, Strategy, WhenExceeded};
use blastema::{ActuatorSettings, ClaimPolicy, Connected, FaultKind, ProcessSpec, WhenFull};
use std::path::PathBuf;
use std::time::Duration;

/// The place of an element in the robot's files. It is no part of what is described: descriptions
/// that differ in their places alone are equal.
#[derive(Clone, Copy, Debug, Default)]
pub struct ElementOrigin {
    /// The file and the byte at which the element begins; `None` for what code describes.
    pub(crate) at: Option<(usize, usize)>,
}

impl PartialEq for ElementOrigin {
    fn eq(&self, _: &ElementOrigin) -> bool {
        true
    }
}

/// A robot: its networks, nodes and connections.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RobotDescription {
    /// The robot's name.
    pub name: String,
    /// The program that has the types of its components.
    pub program: Option<PathBuf>,
    /// The file of each node's key, for nodes that name none.
    pub keys: Option<PathBuf>,
    /// The answers to faults on every node.
    pub plan: Vec<AnswerDescription>,
    /// The networks that join its nodes.
    pub networks: Vec<RobotNetwork>,
    /// The nodes, one process each.
    pub nodes: Vec<NodeDescription>,
    /// The connections between ports.
    pub connections: Vec<ConnectionDescription>,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// What is done about one kind of fault.
#[derive(Clone, Debug, PartialEq)]
pub struct AnswerDescription {
    /// The kind of fault that is answered.
    pub fault: FaultKind,
    /// The recovery actions, tried in this order.
    pub ladder: Ladder,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// A network that joins nodes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RobotNetwork {
    /// The network's name, which no other network of the robot has.
    pub name: String,
    /// See [`Network::insecure`](blastema::Network::insecure).
    pub insecure: bool,
    /// See [`Link::cost`](blastema::Link::cost).
    pub cost: Option<u16>,
    /// See [`Link::hello_every`](blastema::Link::hello_every).
    pub hello_every: Option<Duration>,
    /// See [`Link::expected_within`](blastema::Link::expected_within).
    pub expected_within: Option<Duration>,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// A node's end of a network.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EndpointDescription {
    /// The name of a [`RobotNetwork`].
    pub network: String,
    /// The medium and the own address, as in [`Network::new`](blastema::Network::new).
    pub at: String,
    /// The address that other nodes use; unless it is set, the one of `at`.
    pub reached_at: Option<String>,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// One process of the robot. Its fields are those of the element `node`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NodeDescription {
    /// The node's name, which no other node of the robot has.
    pub name: String,
    /// The root supervisor. It has no name of its own.
    pub root: SupervisorDescription,
    /// The file of the node's key.
    pub keys: Option<PathBuf>,
    /// The registered function that sets the outputs to their safe values.
    pub safe_outputs: Option<String>,
    /// See [`NodeBuilder::work_threads`](blastema::NodeBuilder::work_threads).
    pub work_threads: Option<usize>,
    /// Its absence is no fault for the other nodes. See
    /// [`NodeBuilder::may_be_away`](blastema::NodeBuilder::may_be_away).
    pub may_be_away: bool,
    /// See [`NodeBuilder::locked_memory`](blastema::NodeBuilder::locked_memory).
    pub locked_memory: bool,
    /// See [`NodeBuilder::grace`](blastema::NodeBuilder::grace).
    pub grace: Option<Duration>,
    /// See [`NodeBuilder::inspection_socket`](blastema::NodeBuilder::inspection_socket).
    pub shown_at: Option<PathBuf>,
    /// See [`NodeBuilder::keep_variables`](blastema::NodeBuilder::keep_variables).
    pub keep_variables: Option<PathBuf>,
    /// The answers to faults on this node.
    pub plan: Vec<AnswerDescription>,
    /// Its ends of networks.
    pub endpoints: Vec<EndpointDescription>,
    /// What it does when it loses a commander.
    pub lost_communication: Vec<LostCommunicationDescription>,
    /// The node that starts it as a child of the same name, where one does.
    pub process_of: Option<String>,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// A supervisor and its children.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SupervisorDescription {
    /// Its name; empty for a root.
    pub name: String,
    /// Which children are restarted together.
    pub strategy: Strategy,
    /// The restarts that are allowed in one period.
    pub intensity: Option<u32>,
    /// The period in which the restarts of `intensity` are counted.
    pub period: Option<Duration>,
    /// What happens when restarts exceed the intensity.
    pub when_exceeded: WhenExceeded,
    /// Its own supervisor cannot do without it.
    pub essential: bool,
    /// Its children, in the order in which they start.
    pub children: Vec<ChildDescription>,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// A child of a supervisor.
#[derive(Clone, Debug, PartialEq)]
pub enum ChildDescription {
    /// A component.
    Component(Box<ComponentDescription>),
    /// A supervisor below this one, with its own children.
    Supervisor(SupervisorDescription),
}

/// A component of a node, and the settings of its [`ChildSpec`](blastema::ChildSpec). Its fields are
/// those of the elements `component`, `device` and `process`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ComponentDescription {
    /// The component's name, which no other object of its node has.
    pub name: String,
    /// The name of its type, as the program has registered it; empty for a tree.
    pub type_name: String,
    /// The file of the behaviour tree that it is.
    pub tree: Option<PathBuf>,
    /// Which of its ends are followed by a restart.
    pub restart: Restart,
    /// See [`ChildSpec::rate_hz`](blastema::ChildSpec::rate_hz), and
    /// [`DeviceSpec::period`](blastema::DeviceSpec::period) of a device.
    pub rate_hz: Option<f64>,
    /// See [`ChildSpec::queue`](blastema::ChildSpec::queue).
    pub queue: Option<usize>,
    /// What happens to a message that exceeds the queue's capacity.
    pub when_full: WhenFull,
    /// See [`ChildSpec::on_own_thread`](blastema::ChildSpec::on_own_thread).
    pub own_thread: bool,
    /// See [`ChildSpec::priority`](blastema::ChildSpec::priority).
    pub priority: Option<u8>,
    /// See [`ChildSpec::cpu`](blastema::ChildSpec::cpu).
    pub cpu: Option<usize>,
    /// See [`ChildSpec::depends_on`](blastema::ChildSpec::depends_on).
    pub depends_on: Vec<String>,
    /// See [`ChildSpec::essential`](blastema::ChildSpec::essential).
    pub essential: bool,
    /// See [`ChildSpec::max_block`](blastema::ChildSpec::max_block).
    pub max_block: Option<Duration>,
    /// See [`ChildSpec::max_wait`](blastema::ChildSpec::max_wait).
    pub max_wait: Option<Duration>,
    /// See [`ChildSpec::max_delay`](blastema::ChildSpec::max_delay).
    pub max_delay: Option<Duration>,
    /// See [`ChildSpec::ready_within`](blastema::ChildSpec::ready_within).
    pub ready_within: Option<Duration>,
    /// See [`ChildSpec::shutdown_within`](blastema::ChildSpec::shutdown_within).
    pub shutdown_within: Option<Duration>,
    /// See [`ChildSpec::liveness`](blastema::ChildSpec::liveness).
    pub liveness: Option<Liveness>,
    /// Its parameters, each with its value as it is written.
    pub parameters: Vec<(String, String)>,
    /// Settings of its actuators, by the name of the port.
    pub actuators: Vec<(String, ActuatorSettings)>,
    /// Names of the whole robot that it claims.
    pub claims: Vec<(String, ClaimPolicy)>,
    /// The answers to faults of this component.
    pub plan: Vec<AnswerDescription>,
    /// Where the device is that the component stands for.
    pub device: Option<DeviceSettings>,
    /// The program that the component stands for.
    pub process: Option<ProcessSpec>,
    /// The node that this program is, until it stands among the others.
    #[doc(hidden)]
    pub node: Option<Box<NodeDescription>>,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// Where a device is, and how it is asked for signs of life.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DeviceSettings {
    /// The endpoint, as in [`DeviceSpec::new`](blastema::DeviceSpec::new).
    pub at: String,
    /// See [`DeviceSpec::address`](blastema::DeviceSpec::address).
    pub address: Option<u8>,
    /// See [`DeviceSpec::interval`](blastema::DeviceSpec::interval).
    pub interval: Option<Duration>,
    /// See [`DeviceSpec::tries`](blastema::DeviceSpec::tries).
    pub tries: Option<u8>,
    /// See [`DeviceSpec::deadman`](blastema::DeviceSpec::deadman).
    pub deadman: Option<Duration>,
    /// See [`DeviceSpec::turnaround`](blastema::DeviceSpec::turnaround).
    pub turnaround: Option<Duration>,
}

/// What a node does when it loses a commander: see
/// [`LostCommunicationPolicy`](blastema::LostCommunicationPolicy).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LostCommunicationDescription {
    /// Its name, and that of its condition.
    pub name: String,
    /// The node whose commanders are lost.
    pub commander: Option<String>,
    /// What must be connected.
    pub needs: Vec<NeedDescription>,
    /// How many of these; `None` for all.
    pub at_least: Option<usize>,
    /// The rungs of the ladder, in the order of their times.
    pub rungs: Vec<RungDescription>,
    /// For how long communication must be back before the ladder ends.
    pub stable_for: Option<Duration>,
    /// A person ends the ladder.
    pub acknowledged: bool,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// A channel that must be connected, and how well.
#[derive(Clone, Debug, PartialEq)]
pub struct NeedDescription {
    /// The kind of channel: `heartbeat`, `node`, `session` or `link`.
    pub kind: &'static str,
    /// The topic of the heartbeats, the node or the link.
    pub name: String,
    /// What must hold of it.
    pub needed: Connected,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// What a robot does on a rung.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RungAction {
    /// It holds its place, by commands.
    Hold,
    /// A component brings it back.
    Return,
    /// It stops, by commands.
    Stop,
    /// A component goes on with its work.
    Continue,
}

/// One rung of a ladder.
#[derive(Clone, Debug, PartialEq)]
pub struct RungDescription {
    /// How long after the loss it begins.
    pub after: Duration,
    /// What the robot does.
    pub action: RungAction,
    /// The component of the node that runs while the rung lasts, and not otherwise.
    pub run: Option<String>,
    /// The commands that it gives.
    pub commands: Vec<CommandDescription>,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// A command: the safe command of an actuator, with other values of some fields.
#[derive(Clone, Debug, PartialEq)]
pub struct CommandDescription {
    /// The port of the actuator.
    pub actuator: PortAddress,
    /// The fields with their values, each with its unit, as in `0.2 m/s`.
    pub fields: Vec<(String, String)>,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

/// A connection between an out port and an in port, both with their nodes.
#[derive(Clone, Debug, PartialEq)]
pub struct ConnectionDescription {
    /// The two ports.
    pub ports: PortConnection,
    #[doc(hidden)]
    pub origin: ElementOrigin,
}

impl RobotDescription {
    /// The node of this name.
    pub fn node(&self, name: &str) -> Option<&NodeDescription> {
        self.nodes.iter().find(|node| node.name == name)
    }

    /// The node of which this one is a process, if it is one.
    pub(crate) fn whole_of<'a>(&'a self, node: &'a str) -> &'a str {
        let above = |node: &&'a str| self.node(node)?.process_of.as_deref();
        // A description by code may have a circle.
        let ways = std::iter::successors(Some(node), above).take(self.nodes.len() + 1);
        ways.last().unwrap_or(node)
    }

    /// The file of a node's key.
    pub(crate) fn keys_of<'a>(&'a self, node: &'a NodeDescription) -> Option<&'a PathBuf> {
        node.keys.as_ref().or(self.keys.as_ref())
    }
}

impl NodeDescription {
    /// The components of the node, in the order in which they start.
    pub fn components(&self) -> Vec<&ComponentDescription> {
        let mut components = Vec::new();
        self.root.visit(&mut |child| {
            if let ChildDescription::Component(component) = child {
                components.push(&**component);
            }
        });
        components
    }

    /// The components that run only while a rung lasts.
    pub(crate) fn run_by_rungs(&self) -> impl Iterator<Item = &str> {
        let rungs = self.lost_communication.iter().flat_map(|policy| &policy.rungs);
        rungs.filter_map(|rung| rung.run.as_deref())
    }
}

impl SupervisorDescription {
    /// Visits everything below it, in the order in which it starts.
    pub(crate) fn visit<'a>(&'a self, visit: &mut impl FnMut(&'a ChildDescription)) {
        for child in &self.children {
            visit(child);
            if let ChildDescription::Supervisor(supervisor) = child {
                supervisor.visit(visit);
            }
        }
    }

    /// Whether something below it is so.
    pub(crate) fn any(&self, is_so: &impl Fn(&ChildDescription) -> bool) -> bool {
        self.children.iter().any(|child| match child {
            ChildDescription::Supervisor(below) => is_so(child) || below.any(is_so),
            ChildDescription::Component(_) => is_so(child),
        })
    }

    /// Changes everything below it; what is refused is removed.
    pub(crate) fn retain(&mut self, keep: &mut impl FnMut(&mut ChildDescription) -> bool) {
        self.children.retain_mut(&mut *keep);
        for child in &mut self.children {
            if let ChildDescription::Supervisor(supervisor) = child {
                supervisor.retain(keep);
            }
        }
    }
}

impl ChildDescription {
    /// Its name, and the place of its element.
    pub(crate) fn identity(&self) -> (&str, ElementOrigin) {
        match self {
            ChildDescription::Component(component) => (&component.name, component.origin),
            ChildDescription::Supervisor(supervisor) => (&supervisor.name, supervisor.origin),
        }
    }
}
