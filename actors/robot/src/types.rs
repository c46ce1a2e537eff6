//! What a program registers by name, and the nodes that descriptions become with it.

use crate::description::{
    AnswerDescription, ChildDescription, ComponentDescription, EndpointDescription,
    LostCommunicationDescription, NodeDescription, RobotDescription, RobotNetwork,
    SupervisorDescription,
};
use crate::own_process::candidates;
use crate::reader::RUNGS;
use crate::value::{ParsedValue, ValueError, hint, word_of};
use blastema::core::port::{
    PortAddress, PortConnection, PortDescription, TypeDescription, resolve,
};
use blastema::core::recovery::SupervisorRules;
use blastema::prelude::*;
use blastema::trees::{BehaviorTree, TreeLeaves};
use blastema::{
    Connected, DeviceDescription, DeviceSpec, Fault, Link, LostCommunicationPolicy, Network,
    NodeBuilder, RecoveryStrategy, Rung, SupervisedProcess,
};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

/// The component types, recovery strategies and safe outputs of a program, by the names that robot
/// files use.
///
/// ```no_run
/// use blastema::prelude::*;
///
/// #[derive(Default)]
/// struct Laser;
/// impl Component for Laser {}
///
/// struct Motors {
///     device: &'static str,
/// }
/// impl Component for Motors {}
///
/// fn main() -> std::process::ExitCode {
///     blastema_robot::Types::new()
///         .component::<Laser>("Laser")
///         .component_with("Motors", || Motors { device: "/dev/ttyUSB0" })
///         .safe_outputs("brakes", |fault| eprintln!("brakes on: {fault}"))
///         .main()
/// }
/// ```
#[derive(Default)]
pub struct Types {
    components: BTreeMap<String, RegisteredComponent>,
    strategies: BTreeMap<String, Box<dyn Fn(NodeBuilder) -> NodeBuilder>>,
    safe_outputs: BTreeMap<String, SafeOutputsFn>,
    /// The leaves of its behaviour trees.
    pub(crate) leaves: TreeLeaves,
    /// The names that were registered twice.
    pub(crate) twice: Vec<String>,
}

/// Sets the outputs of a node to their safe values.
type SafeOutputsFn = Arc<dyn Fn(&Fault) + Send + Sync>;
/// Adds a component with the settings of its description.
type AddComponent = Box<dyn Fn(SupervisorSpec, &ComponentDescription) -> SupervisorSpec>;
/// Makes the rung of this name that runs a component with the settings of its description.
type RunComponent = Box<dyn Fn(&str, &ComponentDescription) -> Rung>;

struct RegisteredComponent {
    add: AddComponent,
    run: RunComponent,
    description: Result<TypeDescription, String>,
    /// The contract of a type of devices.
    device: Option<Result<DeviceDescription, String>>,
}

impl RegisteredComponent {
    /// Components that `make` describes.
    fn of<C: Component>(
        make: impl Fn(&ComponentDescription) -> ChildSpec<C> + Clone + Send + 'static,
        description: Result<TypeDescription, String>,
        device: Option<Result<DeviceDescription, String>>,
    ) -> Self {
        let run = make.clone();
        RegisteredComponent {
            add: Box::new(move |supervisor, component| {
                supervisor.child_with(make(component), component.restart)
            }),
            run: Box::new(move |rung, component| {
                let (make, component) = (run.clone(), component.clone());
                Rung::run(rung, move || make(&component))
            }),
            description,
            device,
        }
    }
}

impl fmt::Debug for Types {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_set().entries(self.components.keys()).finish()
    }
}

impl Types {
    /// Creates a table without types.
    pub fn new() -> Self {
        Types::default()
    }

    /// Registers a type of components that `Default` makes. Its parameters and ports are those that
    /// its [`ports`](Component::ports) declare.
    #[must_use]
    pub fn component<C: Component + Default>(self, name: &str) -> Self {
        self.component_with(name, C::default)
    }

    /// Registers a type of components that `make` makes, once for each incarnation. It opens no
    /// device: `on_initialize` does.
    #[must_use]
    pub fn component_with<C: Component>(
        self,
        name: &str,
        make: impl Fn() -> C + Send + Sync + 'static,
    ) -> Self {
        let make = Arc::new(make);
        let spec = move |component: &ComponentDescription| {
            let make = make.clone();
            let spec = ChildSpec::new(&component.name, move || make());
            component.rate_hz.into_iter().fold(spec, ChildSpec::rate_hz)
        };
        self.register(name, blastema::describe::<C>(), None, spec)
    }

    /// Registers a type of devices: its number, which the firmware has too, and its ports. The
    /// file says where a device is. A topic that each device of the type has to itself begins with
    /// its [`name`](DeviceSpec::name).
    ///
    /// ```no_run
    /// use blastema::prelude::*;
    ///
    /// #[derive(Clone, Debug, Event)]
    /// #[contract(name = "bumper/contact")]
    /// struct Contact {
    ///     pressed: bool,
    /// }
    ///
    /// fn main() -> std::process::ExitCode {
    ///     // <device name="bumper" type="Bumper" at="serial:///dev/ttyUSB0?baud=115200"/>
    ///     blastema_robot::Types::new()
    ///         .device("Bumper", 0x6275_6d70, |bumper| {
    ///             bumper.publishes::<Contact>(0, "bumper/contact")
    ///         })
    ///         .main()
    /// }
    /// ```
    #[must_use]
    pub fn device(
        self,
        name: &str,
        device_type: u32,
        ports: impl Fn(DeviceSpec) -> DeviceSpec + Send + Sync + 'static,
    ) -> Self {
        let ports = Arc::new(ports);
        let some = || ports(DeviceSpec::new(name, "serial:///dev/null", device_type));
        let (description, device) = (some().describe_component(), some().describe());
        let spec = move |component: &ComponentDescription| {
            let settings = component.device.clone().unwrap_or_default();
            let mut spec = DeviceSpec::new(&component.name, &settings.at, device_type);
            spec = settings.address.into_iter().fold(spec, DeviceSpec::address);
            spec = settings.interval.into_iter().fold(spec, DeviceSpec::interval);
            spec = settings.tries.into_iter().fold(spec, DeviceSpec::tries);
            spec = settings.deadman.into_iter().fold(spec, DeviceSpec::deadman);
            spec = settings.turnaround.into_iter().fold(spec, DeviceSpec::turnaround);
            if let Some(rate_hz) = component.rate_hz {
                let period = Duration::try_from_secs_f64(1.0 / rate_hz);
                spec = spec.period(period.unwrap_or(Duration::MAX));
            }
            ports(spec).child()
        };
        self.register(name, Ok(description), Some(device), spec)
    }

    fn register<C: Component>(
        mut self,
        name: &str,
        description: Result<TypeDescription, String>,
        device: Option<Result<DeviceDescription, String>>,
        spec: impl Fn(&ComponentDescription) -> ChildSpec<C> + Clone + Send + 'static,
    ) -> Self {
        let ports = description.clone().map(|description| description.takes).unwrap_or_default();
        let make = move |component: &ComponentDescription| {
            let mut spec = configured(spec(component), component);
            for (port, settings) in &component.actuators {
                // A port is called by its contract's name unless it has one of its own.
                let named = ports.iter().find(|known| known.name == *port);
                let contract = named.map_or(port.as_str(), |port| &port.contract.name);
                spec = spec.actuator(contract, settings.clone());
            }
            spec
        };
        let registered = RegisteredComponent::of(make, description, device);
        if self.components.insert(name.to_owned(), registered).is_some() {
            self.twice.push(name.to_owned());
        }
        self
    }

    /// Sets the leaves of the robot's behaviour trees; those that come with every tree are there
    /// without it.
    #[must_use]
    pub fn leaves(mut self, leaves: TreeLeaves) -> Self {
        self.leaves = leaves;
        self
    }

    /// Registers a recovery strategy of the application's own.
    #[must_use]
    pub fn strategy<S: RecoveryStrategy>(
        mut self,
        name: &str,
        make: impl Fn() -> S + Send + Sync + 'static,
    ) -> Self {
        let (make, of) = (Arc::new(make), name.to_owned());
        let add = move |node: NodeBuilder| {
            let make = make.clone();
            node.recovery(&of, move || make())
        };
        if self.strategies.insert(name.to_owned(), Box::new(add)).is_some() {
            self.twice.push(name.to_owned());
        }
        self
    }

    /// Registers a function that sets the outputs of a node to their safe values. See
    /// [`NodeBuilder::safe_outputs`].
    #[must_use]
    pub fn safe_outputs(
        mut self,
        name: &str,
        apply: impl Fn(&Fault) + Send + Sync + 'static,
    ) -> Self {
        if self.safe_outputs.insert(name.to_owned(), Arc::new(apply)).is_some() {
            self.twice.push(name.to_owned());
        }
        self
    }

    /// Returns the node of this name of a robot, to be started, or added to in code.
    ///
    /// # Errors
    /// The robot has no such node, or names what is not registered. Other mistakes are those of
    /// [`NodeBuilder::start`].
    ///
    /// ```
    /// use blastema::prelude::*;
    /// use blastema_robot::Types;
    /// # #[derive(Default)]
    /// # struct Laser;
    /// # impl Component for Laser {}
    ///
    /// # let folder = std::env::temp_dir().join(format!("robot-{}", std::process::id()));
    /// # std::fs::create_dir_all(&folder)?;
    /// # let file = folder.join("a.robot.xml");
    /// # std::fs::write(&file, r#"<robot schema="1" name="a">
    /// #   <node name="base"><component name="laser" type="Laser"/></node></robot>"#)?;
    /// let types = Types::new().component::<Laser>("Laser");
    /// blastema::run(async {
    ///     let robot = types.load(&file, &[])?;
    ///     let node = types.node(&robot, "base")?.start().await?;
    ///     node.shutdown().await;
    ///     Ok::<(), Box<dyn std::error::Error>>(())
    /// })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn node(&self, robot: &RobotDescription, name: &str) -> Result<NodeBuilder, String> {
        let node = robot.node(name).ok_or_else(|| {
            let nodes: Vec<&str> = robot.nodes.iter().map(|node| node.name.as_str()).collect();
            format!("{} has no node `{name}`: its nodes are {}", robot.name, nodes.join(", "))
        })?;
        let mut builder = Node::builder(name).plan(plan_of(robot, node));
        builder = node.work_threads.into_iter().fold(builder, NodeBuilder::work_threads);
        if node.locked_memory {
            builder = builder.locked_memory();
        }
        builder = node.grace.into_iter().fold(builder, NodeBuilder::grace);
        builder = node.shown_at.iter().fold(builder, NodeBuilder::inspection_socket);
        builder = node.keep_variables.iter().fold(builder, NodeBuilder::keep_variables);
        for policy in &node.lost_communication {
            builder = builder.lost_communication(self.policy(robot, node, policy)?);
        }
        let rungs: Vec<&str> = node.run_by_rungs().collect();
        builder = builder.root(self.supervisor(&node.root, &rungs)?);
        builder = self.strategies.values().fold(builder, |builder, add| add(builder));
        if let Some(name) = &node.safe_outputs {
            let unknown = || format!("no safe outputs `{name}` are registered");
            let apply = self.safe_outputs.get(name).ok_or_else(unknown)?.clone();
            builder = builder.safe_outputs(move |fault| apply(fault));
        }
        for endpoint in &node.endpoints {
            builder = builder.network(network_of(robot, node, endpoint)?);
        }
        if !node.endpoints.is_empty() {
            let away = robot.nodes.iter().filter(|other| other.may_be_away && other.name != name);
            builder = away.fold(builder, |builder, other| builder.may_be_away(&other.name));
        }
        if let Some(keys) = robot.keys_of(node) {
            builder = builder.keys(keys);
        }
        for PortConnection { from, to } in self.connections_at(robot, name) {
            builder = builder.connect(&from.to_string(), &to.to_string());
        }
        Ok(builder)
    }

    fn policy(
        &self,
        robot: &RobotDescription,
        node: &NodeDescription,
        described: &LostCommunicationDescription,
    ) -> Result<LostCommunicationPolicy, String> {
        let needs: Vec<_> = described.needs.iter().map(|need| need.needed.clone()).collect();
        let needs = Connected::at_least(described.at_least.unwrap_or(needs.len()), needs);
        let mut policy = LostCommunicationPolicy::new(&described.name, needs);
        policy = described.commander.iter().fold(policy, |policy, node| policy.commander(node));
        let stable = described.stable_for.unwrap_or(LostCommunicationPolicy::STABLE);
        policy = policy.until_stable_for(stable);
        if described.acknowledged {
            policy = policy.until_acknowledged();
        }
        for rung in &described.rungs {
            let name = word_of(&RUNGS, rung.action);
            let mut made = Rung::new(name);
            if let Some(run) = &rung.run {
                let components = node.components();
                let component = components.iter().find(|known| known.name == *run);
                let component =
                    component.ok_or_else(|| format!("there is no component `{run}`"))?;
                made = self.registered(component, |of| (of.run)(name, component))?;
            }
            for command in &rung.commands {
                let address = &command.actuator;
                let port = self.port(robot, address, false).unwrap_or_default();
                let contract = port.map_or(address.port.as_str(), |port| &port.contract.name);
                let is_own = address.node.as_ref().is_none_or(|of| of.as_str() == node.name);
                let of = if is_own { address.object.to_string() } else { address.component() };
                made = made.and_fields(&of, contract, &command.fields);
            }
            policy = policy.after(rung.after, made);
        }
        Ok(policy)
    }

    /// What is done with the type of a component, or with its tree or program.
    fn registered<T>(
        &self,
        component: &ComponentDescription,
        use_it: impl FnOnce(&RegisteredComponent) -> T,
    ) -> Result<T, String> {
        if let Some(process) = component.process.clone() {
            let make = move |component: &ComponentDescription| {
                configured(process.clone().child(), component)
            };
            let description = blastema::describe::<SupervisedProcess>();
            return Ok(use_it(&RegisteredComponent::of(make, description, None)));
        }
        let Some(file) = &component.tree else {
            let unknown = || format!("no type `{}` is registered", component.type_name);
            return Ok(use_it(self.components.get(&component.type_name).ok_or_else(unknown)?));
        };
        let make = BehaviorTree::read(&self.leaves, file).map_err(|error| error.to_string())?;
        let make = move |component: &ComponentDescription| {
            let spec = make(&component.name);
            let spec = component.rate_hz.into_iter().fold(spec, ChildSpec::rate_hz);
            configured(spec, component)
        };
        let description = blastema::describe::<BehaviorTree>();
        Ok(use_it(&RegisteredComponent::of(make, description, None)))
    }

    /// A supervisor with its children, but for those that rungs run.
    fn supervisor(
        &self,
        supervisor: &SupervisorDescription,
        rungs: &[&str],
    ) -> Result<SupervisorSpec, String> {
        let mut spec = SupervisorSpec::new(&supervisor.name, supervisor.strategy);
        spec = spec.when_exceeded(supervisor.when_exceeded).whole_start();
        if supervisor.intensity.is_some() || supervisor.period.is_some() {
            let usual = SupervisorRules::default();
            let times = supervisor.intensity.unwrap_or(usual.intensity);
            spec = spec.intensity(times, supervisor.period.unwrap_or(usual.period));
        }
        if supervisor.essential {
            spec = spec.essential();
        }
        for child in &supervisor.children {
            spec = match child {
                ChildDescription::Component(component) if rungs.contains(&&*component.name) => spec,
                ChildDescription::Component(component) => {
                    self.registered(component, |of| (of.add)(spec, component))?
                }
                ChildDescription::Supervisor(below) => {
                    spec.supervisor(self.supervisor(below, rungs)?)
                }
            };
        }
        Ok(spec)
    }

    /// The connections that this node makes.
    fn connections_at<'a>(
        &'a self,
        robot: &'a RobotDescription,
        node: &'a str,
    ) -> impl Iterator<Item = &'a PortConnection> {
        let connections = robot.connections.iter().map(|connection| &connection.ports);
        connections.filter(move |ports| {
            let port = |address: &_, is_out| {
                Ok(self.port(robot, address, is_out).unwrap_or_default().map(Cow::Borrowed))
            };
            let end = resolve(ports, port).map_or(&ports.to, |end| ports.end(end));
            end.node.as_ref().is_some_and(|end| end.as_str() == node)
        })
    }

    /// The port at an address with a node: an out port where a connection begins, another one where
    /// it ends. `None` where the type of its component is not registered.
    pub(crate) fn port(
        &self,
        robot: &RobotDescription,
        address: &PortAddress,
        is_out: bool,
    ) -> ParsedValue<Option<&PortDescription>> {
        let name = address.node.as_ref().map_or("", |node| node.as_str());
        let node = robot.node(name).ok_or_else(|| {
            let known = robot.nodes.iter().map(|node| node.name.as_str());
            unknown(format!("the robot has no node `{name}`"), name, known)
        })?;
        let (components, object) = (node.components(), address.object.as_str());
        let component = components.iter().find(|known| known.name == object).ok_or_else(|| {
            let known = components.iter().map(|known| known.name.as_str());
            let sentence = format!("node {name} has no component `{object}`");
            match &candidates(robot, name, object)[..] {
                [] => unknown(sentence, object, known),
                several => {
                    let places = several.iter().map(|node| format!("`{node}:{object}`"));
                    let help = format!("write {}", places.collect::<Vec<_>>().join(" or "));
                    ValueError::new(sentence, "in several processes", help)
                }
            }
        })?;
        for (is_it, label, help) in [
            (component.tree.is_some(), "a tree", "let its leaves name what they use"),
            (component.process.is_some(), "a process", "connect components, or write a node"),
        ] {
            if is_it {
                let sentence = format!("{object} is {label}, and has no ports");
                return Err(ValueError::new(sentence, label, help));
            }
        }
        let Some(of) = self.description(&component.type_name) else { return Ok(None) };
        of.port(address, is_out).map(Some).map_err(|error| {
            let known = of.ports(is_out).iter().map(|port| port.name.as_str());
            let unknown = unknown(error.to_string(), address.port.as_str(), known);
            ValueError { label: "no such port".to_owned(), ..unknown }
        })
    }

    /// What a type takes and gives; `None` where it is not registered, or its `ports` panicked.
    pub(crate) fn description(&self, name: &str) -> Option<&TypeDescription> {
        self.components.get(name)?.description.as_ref().ok()
    }

    /// The registered types: those of devices, or the others.
    pub(crate) fn kinds(&self, devices: bool) -> Vec<&str> {
        let kinds = self.components.iter().filter(|(_, of)| of.device.is_some() == devices);
        kinds.map(|(name, _)| name.as_str()).collect()
    }

    /// The contract of a type of devices.
    pub(crate) fn device_description(
        &self,
        name: &str,
    ) -> Option<&Result<DeviceDescription, String>> {
        self.components.get(name)?.device.as_ref()
    }

    /// The registered names: of component types, strategies and safe outputs.
    pub(crate) fn names(&self) -> [Vec<&str>; 3] {
        [
            self.components.keys().map(String::as_str).collect(),
            self.strategies.keys().map(String::as_str).collect(),
            self.safe_outputs.keys().map(String::as_str).collect(),
        ]
    }
}

/// A name in the address of a port is not among these.
fn unknown<'w>(
    sentence: String,
    wrong: &str,
    known: impl Iterator<Item = &'w str> + Clone,
) -> ValueError {
    ValueError::new(sentence, "unknown", hint(wrong, known))
}

/// Gives a component the settings of its description.
fn configured<C: Component>(spec: ChildSpec<C>, component: &ComponentDescription) -> ChildSpec<C> {
    let mut spec = spec.depends_on(component.depends_on.iter().map(String::as_str));
    if component.queue.is_some() || component.when_full != WhenFull::default() {
        // The default of the capacity stands in the settings of a component.
        let capacity = component.queue.unwrap_or(ChildSpec::<C>::QUEUE);
        spec = spec.queue(capacity, component.when_full);
    }
    spec = component.max_block.into_iter().fold(spec, ChildSpec::max_block);
    spec = component.max_wait.into_iter().fold(spec, ChildSpec::max_wait);
    spec = component.max_delay.into_iter().fold(spec, ChildSpec::max_delay);
    spec = component.ready_within.into_iter().fold(spec, ChildSpec::ready_within);
    spec = component.shutdown_within.into_iter().fold(spec, ChildSpec::shutdown_within);
    spec = component.liveness.into_iter().fold(spec, ChildSpec::liveness);
    for (name, value) in &component.parameters {
        spec = spec.parameter(name, value);
    }
    for (name, policy) in &component.claims {
        spec = spec.claim(name, *policy);
    }
    if component.own_thread {
        spec = spec.on_own_thread();
    }
    spec = component.priority.into_iter().fold(spec, ChildSpec::priority);
    spec = component.cpu.into_iter().fold(spec, ChildSpec::cpu);
    if component.essential {
        spec = spec.essential();
    }
    spec
}

/// The plan of a node: the built-in one, the robot's, the node's, and those of its components.
fn plan_of(robot: &RobotDescription, node: &NodeDescription) -> Plan {
    let answers = robot.plan.iter().chain(&node.plan);
    let plan = answers.fold(Plan::default(), |plan, AnswerDescription { fault, ladder, .. }| {
        plan.on(fault.clone(), ladder.clone())
    });
    let components = node.components().into_iter();
    components.fold(plan, |plan, component| {
        let Ok(name) = blastema::ObjectName::new(&component.name) else { return plan };
        component.plan.iter().fold(plan, |plan, AnswerDescription { fault, ladder, .. }| {
            plan.on_component(name.clone(), fault.clone(), ladder.clone())
        })
    })
}

/// A network with its own end alone.
pub(crate) fn end_of(network: &RobotNetwork, endpoint: &EndpointDescription) -> Network {
    let end = Network::new(&network.name, &endpoint.at);
    if network.insecure { end.insecure() } else { end }
}

/// A network as this node has it: every other node with an endpoint of it is a neighbour.
pub(crate) fn network_of(
    robot: &RobotDescription,
    node: &NodeDescription,
    endpoint: &EndpointDescription,
) -> Result<Network, String> {
    let unknown = || format!("there is no network `{}`", endpoint.network);
    let described = robot.networks.iter().find(|network| network.name == endpoint.network);
    let described = described.ok_or_else(unknown)?;
    let RobotNetwork { name, cost, hello_every, expected_within, .. } = described;
    let mut network = end_of(described, endpoint);
    for other in robot.nodes.iter().filter(|other| other.name != node.name) {
        for end in other.endpoints.iter().filter(|end| end.network == *name) {
            let mut link = Link::to(&other.name, &address_of(end));
            link = cost.iter().fold(link, |link, cost| link.cost(*cost));
            link = hello_every.iter().fold(link, |link, every| link.hello_every(*every));
            link = expected_within.iter().fold(link, |link, span| link.expected_within(*span));
            network = network.link(link);
        }
    }
    Ok(network)
}

/// The address at which other nodes reach an endpoint, as its medium writes addresses.
pub(crate) fn address_of(endpoint: &EndpointDescription) -> String {
    if let Some(address) = &endpoint.reached_at {
        return address.clone();
    }
    let (medium, rest) = endpoint.at.split_once("://").unwrap_or(("", &endpoint.at));
    let (place, query) = rest.split_once('?').unwrap_or((rest, ""));
    let setting = |key: &str| {
        let mut pairs = query.split('&').filter_map(|pair| pair.split_once('='));
        pairs.find(|(known, _)| *known == key).map(|(_, value)| value.to_owned())
    };
    match medium {
        // Where the endpoint is a group's, `own` is the address that it sends from.
        "udp" => setting("own").unwrap_or_else(|| place.to_owned()),
        "serial" => String::new(),
        "can" | "slcan" => setting("address").unwrap_or_else(|| "0".to_owned()),
        _ => place.to_owned(),
    }
}
