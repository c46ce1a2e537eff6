//! Reads a robot file, and the files that it includes, into a description.

use crate::description::{
    AnswerDescription, ChildDescription, CommandDescription, ComponentDescription,
    ConnectionDescription, DeviceSettings, EndpointDescription, LostCommunicationDescription,
    NeedDescription, NodeDescription, RobotDescription, RobotNetwork, RungAction, RungDescription,
    SupervisorDescription,
};
use crate::element::{ArgumentValues, FileReading, RobotElement};
use crate::finding::{FilePlace, RobotFinding, RobotSources};
use crate::own_process::make_nodes;
use crate::value::{self, ParsedValue, ValueError, hint};
use blastema::core::port::{ConnectError, PortAddress, PortConnection};
use blastema::detection::{Liveness, Pull, Push};
use blastema::recovery::{Backoff, Ladder, RecoveryAction, Restart, Strategy, WhenExceeded};
use blastema::trees::byte_at;
use blastema::{ActuatorSettings, ClaimPolicy, Connected, NodeName, ProcessSpec, WhenFull};
use roxmltree::{Document, Error, ParsingOptions};
use std::cell::{Cell, RefCell};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{env, fmt, fs};

/// A file that is written by hand has a hundred kilobytes at most.
const FILE_MAX: usize = 1 << 20;
/// Findings show whole lines.
const LINE_MAX: usize = 4096;
const FILES_MAX: usize = 64;
const DEPTH_MAX: usize = 8;
/// Ten thousand components with all their attributes.
const NODES_MAX: u32 = 200_000;
/// Of the whole robot: as many as one computer starts in seconds.
const COMPONENTS_MAX: usize = 10_000;
/// Elements within each other: more than a tree of components that a person can follow.
const NESTED_MAX: usize = 64;
/// The version of the format.
const SCHEMA: u32 = 1;

/// A robot file that was read.
#[derive(Debug, Default)]
pub(crate) struct RobotReading {
    pub(crate) robot: RobotDescription,
    pub(crate) sources: RobotSources,
    pub(crate) findings: Vec<RobotFinding>,
}

/// Reads a file with these values of its arguments.
pub(crate) fn read(path: &Path, set: &[(String, String)]) -> Result<RobotReading, String> {
    let unreadable = |error: &dyn fmt::Display| format!("{}: {error}", path.display());
    let absolute = fs::canonicalize(path).map_err(|error| unreadable(&error))?;
    let text = read_text(&absolute).map_err(|error| unreadable(&error))?;
    let folder = absolute.parent().unwrap_or(Path::new("/")).to_owned();
    let (findings, components) = Default::default();
    let mut reader = RobotReader {
        robot: RobotDescription::default(),
        sources: RobotSources::default(),
        findings: &findings,
        components: &components,
        root: folder,
        open: Vec::new(),
    };
    reader.read_file(
        path.display().to_string(),
        absolute.clone(),
        text.into(),
        &ArgumentSource { given: set, is_outer: true },
    );
    let RobotReader { mut robot, sources, .. } = reader;
    make_nodes(&mut robot, &absolute, set);
    Ok(RobotReading { robot, sources, findings: findings.into_inner() })
}

fn read_text(path: &Path) -> Result<String, String> {
    let about = fs::metadata(path).map_err(|error| error.to_string())?;
    if !about.is_file() {
        return Err("it is no regular file".to_owned());
    }
    if about.len() > FILE_MAX as u64 {
        return Err("it has more than 1 MiB: divide it by `<include file=…/>`".to_owned());
    }
    let text = fs::read_to_string(path).map_err(|error| error.to_string())?;
    match text.lines().position(|line| line.len() > LINE_MAX) {
        Some(at) => Err(format!("line {} has more than {LINE_MAX} bytes: break it", at + 1)),
        None => Ok(text),
    }
}

/// Where the values of a file's arguments come from, beside their defaults.
struct ArgumentSource<'a> {
    /// Those of the command line, or of the element `include`.
    given: &'a [(String, String)],
    /// The file is the outermost one: the environment gives values too.
    is_outer: bool,
}

struct RobotReader<'a> {
    robot: RobotDescription,
    sources: RobotSources,
    findings: &'a RefCell<Vec<RobotFinding>>,
    components: &'a Cell<usize>,
    /// The folder of the outermost file.
    root: PathBuf,
    /// The files that include each other, the outermost first.
    open: Vec<PathBuf>,
}

impl RobotReader<'_> {
    fn read_file(&mut self, name: String, path: PathBuf, text: Arc<str>, set: &ArgumentSource<'_>) {
        let file = self.sources.files.len();
        self.sources.files.push((name, text.clone()));
        let options = ParsingOptions { nodes_limit: NODES_MAX, ..ParsingOptions::default() };
        let document = match Document::parse_with_options(&text, options) {
            Ok(document) => document,
            Err(error) => {
                return self.findings.borrow_mut().push(syntax_finding(file, &text, &error));
            }
        };
        let folder = self.root.clone();
        let reading = FileReading {
            file,
            text: &text,
            root: &folder,
            findings: self.findings,
            arguments: RefCell::default(),
            components: self.components,
        };
        let root = RobotElement::new(document.root_element(), &reading, None);
        let namespace = root.node.tag_name().namespace();
        if root.name() != "robot" || namespace.is_some() {
            let namespace = namespace.map(|of| format!(" of the namespace `{of}`"));
            let (name, namespace) = (root.name(), namespace.unwrap_or_default());
            let sentence =
                format!("a robot file begins with `robot`, not with `{name}`{namespace}");
            let error = ValueError::new(sentence, "here", "write `<robot …>`");
            root.find_at("robot::schema", "", error);
            return root.leave();
        }
        self.open.push(path);
        self.robot(&root, &reading, set);
        self.open.pop();
    }

    fn robot(
        &mut self,
        root: &RobotElement<'_>,
        reading: &FileReading<'_>,
        set: &ArgumentSource<'_>,
    ) {
        let schema = root.need("schema", value::count::<u32>);
        if let Some(schema) = schema.filter(|schema| *schema != SCHEMA) {
            let sentence =
                format!("this file has schema {schema}, and this program reads {SCHEMA}");
            let help = format!("write `{SCHEMA}`, and what that schema has");
            let error = ValueError::new(sentence, "written for another version", help);
            root.find_at("robot::schema", "schema", error);
            return root.leave();
        }
        *reading.arguments.borrow_mut() = arguments(root, set);
        let name = root.need("name", value::node_name).unwrap_or_default();
        if set.is_outer {
            self.robot.name = name;
            self.robot.program = root.path("program");
            self.robot.keys = root.path("keys");
            self.robot.origin = root.origin();
        }
        for element in root.children("include network plan node connect") {
            match element.name() {
                "include" => self.include(&element),
                "network" => self.robot.networks.push(network(&element)),
                "plan" => self.robot.plan.extend(answers(&element)),
                "node" => self.node(&element),
                _ => self.robot.connections.extend(connection(&element, None)),
            }
        }
    }

    fn include(&mut self, element: &RobotElement<'_>) {
        let set = texts(element.distinct("set", "argument"), ["argument", "value"]);
        let Some(name) = element.need("file", value::text) else { return };
        let wrong = |sentence: String, help: &str| {
            element.find_at("robot::include", "file", ValueError::new(sentence, "here", help));
        };
        let from = self.open.last().and_then(|open| open.parent()).unwrap_or(&self.root);
        let path = match fs::canonicalize(from.join(&name)) {
            Ok(path) => path,
            Err(error) => return wrong(format!("`{name}`: {error}"), "correct the path"),
        };
        if !path.starts_with(&self.root) {
            let help = "move it there: a robot's files stand below the folder of the outermost one";
            return wrong(format!("`{name}` is not below the folder of the robot"), help);
        }
        if self.open.contains(&path) {
            return wrong(format!("`{name}` includes itself"), "delete one of the includes");
        }
        if self.open.len() >= DEPTH_MAX || self.sources.files.len() >= FILES_MAX {
            let sentence = format!("more than {FILES_MAX} files, or {DEPTH_MAX} within each other");
            return wrong(sentence, "join some of them");
        }
        let shown = path.strip_prefix(&self.root).unwrap_or(&path).display().to_string();
        match read_text(&path) {
            Ok(text) => {
                let set = ArgumentSource { given: &set, is_outer: false };
                self.read_file(shown, path, text.into(), &set);
            }
            Err(error) => wrong(format!("`{name}`: {error}"), "correct the file"),
        }
    }

    fn node(&mut self, element: &RobotElement<'_>) {
        let name = element.need("name", value::node_name).unwrap_or_default();
        let mut node = NodeDescription {
            keys: element.path("keys"),
            safe_outputs: element.take("safe-outputs", value::text),
            work_threads: element.take("work-threads", value::count),
            may_be_away: element.take("may-be-away", value::flag).unwrap_or_default(),
            locked_memory: element.take("locked-memory", value::flag).unwrap_or_default(),
            grace: element.take("grace", value::duration),
            shown_at: element.path("shown-at"),
            keep_variables: element.path("keep-variables"),
            origin: element.origin(),
            root: SupervisorDescription { origin: element.origin(), ..rules(element) },
            name,
            ..NodeDescription::default()
        };
        for element in element.children(NODE_CHILDREN) {
            match element.name() {
                "lost-communication" => {
                    node.lost_communication.push(lost_communication(&element, &node.name));
                }
                "endpoint" => node.endpoints.push(endpoint(&element)),
                "plan" => node.plan.extend(answers(&element)),
                "connect" => self.robot.connections.extend(connection(&element, Some(&node.name))),
                _ => child(&element, &mut node.root.children),
            }
        }
        self.robot.nodes.push(node);
    }
}

/// Whether a text is a value of a type of arguments.
type CheckValue = fn(&str) -> ParsedValue<()>;

/// The arguments of a file with their values.
fn arguments(root: &RobotElement<'_>, set: &ArgumentSource<'_>) -> ArgumentValues {
    let mut arguments = ArgumentValues::default();
    let ArgumentSource { given, is_outer } = *set;
    for element in root.distinct("argument", "name") {
        let kinds: [(&str, CheckValue); 5] = [
            ("text", |_| Ok(())),
            ("count", |text| value::count::<u64>(text).map(drop)),
            ("number", |text| value::number(text).map(drop)),
            ("duration", |text| value::duration(text).map(drop)),
            ("rate", |text| value::rate(text).map(drop)),
        ];
        let kind = element.take("type", |text| value::word("a type of arguments", &kinds, text));
        element.take("help", value::text);
        let default = element.take("default", value::text);
        let Some(name) = element.need("name", value::node_name) else { continue };
        let variable = format!("BLASTEMA_ARG_{}", name.to_uppercase().replace(['-', '.'], "_"));
        let told = given.iter().rev().find(|(key, _)| *key == name).map(|(_, value)| value.clone());
        let environment = || env::var(&variable).ok().filter(|_| is_outer);
        let value = told.or_else(environment).or(default);
        match value.map(|value| (kind.map_or(Ok(()), |check| check(&value)), value)) {
            Some((Ok(()), value)) => drop(arguments.values.insert(name, value)),
            Some((Err(error), value)) => {
                let part = if element.node.attribute("default") == Some(&value) {
                    "default"
                } else {
                    "name"
                };
                element.find_at("robot::value", part, error);
                arguments.missing.push(name);
            }
            None => {
                let how = match is_outer {
                    true => format!("`--set {name}=…` or {variable}"),
                    false => format!("`<set argument=\"{name}\" value=…/>` in the `include`"),
                };
                let help = format!("give it by {how}, or add `default`");
                let sentence = format!("`{name}` has no value");
                let error = ValueError::new(sentence, "without a value", help);
                element.find_at("robot::argument", "name", error);
                arguments.missing.push(name);
            }
        }
    }
    for (name, _) in given {
        let declared = arguments.values.keys().chain(&arguments.missing).map(String::as_str);
        if !declared.clone().any(|known| known == name) {
            let help = hint(name, declared);
            let sentence = format!("there is no argument `{name}` to set");
            root.find_at("robot::argument", "name", ValueError::new(sentence, "this file", help));
        }
    }
    arguments
}

fn network(element: &RobotElement<'_>) -> RobotNetwork {
    RobotNetwork {
        name: element.need("name", value::node_name).unwrap_or_default(),
        insecure: element.take("insecure", value::flag).unwrap_or_default(),
        cost: element.take("cost", value::count),
        hello_every: element.take("hello-every", value::duration),
        expected_within: element.take("expected-within", value::limit),
        origin: element.origin(),
    }
}

fn endpoint(element: &RobotElement<'_>) -> EndpointDescription {
    EndpointDescription {
        network: element.need("network", value::text).unwrap_or_default(),
        at: element.need("at", value::text).unwrap_or_default(),
        reached_at: element.take("reached-at", value::text),
        origin: element.origin(),
    }
}

/// The address of a port; on a node, one without a node is that node's.
fn port(text: &str, node: Option<&str>) -> ParsedValue<PortAddress> {
    let refused = |error: ConnectError| {
        let help = match text.rsplit_once('.') {
            Some((object, port)) if !text.contains('#') => format!("write `{object}#{port}`"),
            _ => "write `component#port`, or `node:component#port`".to_owned(),
        };
        ValueError::new(error.to_string(), "a port", help)
    };
    let mut address: PortAddress = text.parse().map_err(refused)?;
    if address.node.is_none() {
        address.node = node.and_then(|node| NodeName::new(node).ok());
    }
    if address.node.is_none() && node.is_none() {
        let help = format!("write `node:{text}`, or put `connect` into the node");
        return Err(ValueError::new(format!("`{text}` names no node"), "a port", help));
    }
    Ok(address)
}

/// A connection; on a node, ports without a node are that node's.
fn connection(element: &RobotElement<'_>, node: Option<&str>) -> Option<ConnectionDescription> {
    let port = |text: &str| port(text, node);
    let (from, to) = (element.need("from", port), element.need("to", port));
    let ports = PortConnection { from: from?, to: to? };
    Some(ConnectionDescription { ports, origin: element.origin() })
}

pub(crate) const STRATEGIES: [(&str, Strategy); 3] = [
    ("one-for-one", Strategy::OneForOne),
    ("one-for-all", Strategy::OneForAll),
    ("rest-for-one", Strategy::RestForOne),
];
pub(crate) const EXCEEDED: [(&str, WhenExceeded); 2] =
    [("stop-child", WhenExceeded::StopChild), ("escalate", WhenExceeded::Escalate)];
pub(crate) const RESTARTS: [(&str, Restart); 3] = [
    ("permanent", Restart::Permanent),
    ("transient", Restart::Transient),
    ("temporary", Restart::Temporary),
];
pub(crate) const WHEN_FULL: [(&str, WhenFull); 4] = [
    ("refuse", WhenFull::Refuse),
    ("drop-oldest", WhenFull::DropOldest),
    ("drop-newest", WhenFull::DropNewest),
    ("wait", WhenFull::Wait),
];

pub(crate) const RUNGS: [(&str, RungAction); 4] = [
    ("hold", RungAction::Hold),
    ("return", RungAction::Return),
    ("stop", RungAction::Stop),
    ("continue", RungAction::Continue),
];

/// What a node does when it loses a commander.
fn lost_communication(element: &RobotElement<'_>, node: &str) -> LostCommunicationDescription {
    let rungs = element.children("after").into_iter().filter_map(|after| {
        let commands = after.children("command").into_iter().filter_map(|command| {
            let actuator = command.need("actuator", |text| port(text, Some(node)));
            let (fields, origin) = (fields(&command), command.origin());
            Some(CommandDescription { actuator: actuator?, fields, origin })
        });
        let commands = commands.collect();
        let action = after.need("do", |text| value::word("a step of a ladder", &RUNGS, text));
        let (time, run) = (after.need("time", value::duration), after.take("run", value::text));
        let origin = after.origin();
        Some(RungDescription { after: time?, action: action?, run, commands, origin })
    });
    let rungs = rungs.collect();
    let ends = element.child("ends");
    let ends = ends.as_ref();
    LostCommunicationDescription {
        name: element.need("name", value::object_name).unwrap_or_default(),
        commander: element.take("commander", value::node_name),
        needs: element.children("needs").iter().filter_map(needs).collect(),
        at_least: element.take("at-least", value::count),
        rungs,
        stable_for: ends.and_then(|ends| ends.take("stable-for", value::duration)),
        acknowledged: ends.and_then(|ends| ends.take("acknowledged", value::flag)).unwrap_or(false),
        origin: element.origin(),
    }
}

/// The kinds of channels: how each is written, and what it means.
type NeedKind = (&'static str, fn(&str) -> ParsedValue<String>, fn(&str) -> Connected);
const NEED_KINDS: [NeedKind; 4] = [
    ("heartbeat", value::text, Connected::heartbeat),
    ("node", value::node_name, Connected::node),
    ("session", value::node_name, Connected::session),
    ("link", value::text, Connected::link),
];

/// A channel that must be connected: one attribute says which.
fn needs(element: &RobotElement<'_>) -> Option<NeedDescription> {
    let written = NEED_KINDS.map(|(kind, parse, of)| Some((kind, element.take(kind, parse)?, of)));
    let mut written = written.into_iter().flatten();
    let channel = written.next();
    if channel.is_none() || written.next().is_some() {
        let sentence = "`needs` names one channel";
        let help = "write `heartbeat`, `node`, `session` or `link`, and one `needs` for each";
        element.find_at("robot::lost", "", ValueError::new(sentence, "here", help));
    }
    // Without a channel the other attributes are known all the same.
    let (kind, name, of) = channel.unwrap_or(("", String::new(), Connected::heartbeat));
    let mut needed = of(&name);
    needed = element.take("timeout", value::duration).into_iter().fold(needed, Connected::timeout);
    let rate = element.take("rate", value::rate);
    if element.node.has_attribute("rate") {
        let rate = rate.zip(element.need("window", value::duration));
        needed = rate.into_iter().fold(needed, |needed, (hz, window)| needed.at_rate(hz, window));
    }
    let latency = element.take("max-latency", value::duration);
    needed = latency.into_iter().fold(needed, Connected::max_latency);
    let jitter = element.take("max-jitter", value::duration);
    needed = jitter.into_iter().fold(needed, Connected::max_jitter);
    needed = element.take("max-loss", value::number).into_iter().fold(needed, Connected::max_loss);
    let origin = element.origin();
    (!kind.is_empty()).then_some(NeedDescription { kind, name, needed, origin })
}

/// What supervisors and nodes have in common.
fn rules(element: &RobotElement<'_>) -> SupervisorDescription {
    let strategy = element.take("strategy", |text| value::word("a strategy", &STRATEGIES, text));
    let exceeded = element.take("when-exceeded", |text| value::word("a measure", &EXCEEDED, text));
    SupervisorDescription {
        strategy: strategy.unwrap_or_default(),
        intensity: element.take("intensity", value::count),
        period: element.take("period", value::duration),
        when_exceeded: exceeded.unwrap_or_default(),
        ..SupervisorDescription::default()
    }
}

/// What supervisors and processes hold.
const CHILDREN: &str = "component device process supervisor";
const NODE_CHILDREN: &str =
    "endpoint plan connect lost-communication component device process supervisor";

/// A component, device or process, once for each copy, or a supervisor with what is below it.
fn child(element: &RobotElement<'_>, children: &mut Vec<ChildDescription>) {
    if element.node.ancestors().nth(NESTED_MAX).is_some() {
        let sentence = format!("more than {NESTED_MAX} elements stand within each other");
        let help = "make the tree flatter";
        element.find_at("robot::limit", "name", ValueError::new(sentence, "one too many", help));
        return element.leave();
    }
    if element.name() != "supervisor" {
        // The attribute is the same for each copy, and is read before there is one.
        let copies = element.take("copies", value::copies);
        if !element.count_components(copies.as_ref().map_or(1, Vec::len), COMPONENTS_MAX) {
            return element.leave();
        }
        // Of one whose copies are wrong, the rest is read as that of a single copy.
        let is_wrong = copies.is_none() && element.node.has_attribute("copies");
        let copies = copies.or_else(|| is_wrong.then(|| vec!["0".to_owned()]));
        let read = if element.name() == "process" { process } else { component };
        let Some(copies) = copies else { return children.push(read(element)) };
        for copy in &copies {
            let copied = element.copy(copy);
            copied.take("copies", value::text);
            children.push(read(&copied));
        }
        return element.leave();
    }
    let mut supervisor = SupervisorDescription {
        name: element.need("name", value::object_name).unwrap_or_default(),
        essential: element.take("essential", value::flag).unwrap_or_default(),
        origin: element.origin(),
        ..rules(element)
    };
    for element in element.children(CHILDREN) {
        child(&element, &mut supervisor.children);
    }
    children.push(ChildDescription::Supervisor(supervisor));
}

/// What components, devices and processes have in common.
fn common(element: &RobotElement<'_>) -> ComponentDescription {
    let restart = element.take("restart", |text| value::word("a restart type", &RESTARTS, text));
    ComponentDescription {
        restart: restart.unwrap_or_default(),
        depends_on: element.take("depends-on", value::words).unwrap_or_default(),
        essential: element.take("essential", value::flag).unwrap_or_default(),
        ready_within: element.take("ready-within", value::duration),
        shutdown_within: element.take("shutdown-within", value::duration),
        plan: answers(element),
        origin: element.origin(),
        ..ComponentDescription::default()
    }
}

fn component(element: &RobotElement<'_>) -> ChildDescription {
    let threads = [("shared", false), ("own", true)];
    let when_full = element.take("when-full", |text| value::word("a policy", &WHEN_FULL, text));
    let thread = element.take("thread", |text| value::word("a kind of thread", &threads, text));
    let is_device = element.name() == "device";
    let parameters = match is_device {
        true => Vec::new(),
        false => texts(element.distinct("param", "name"), ["name", "value"]),
    };
    let actuators = element.distinct("actuator", "port").iter().filter_map(actuator).collect();
    let claims = element.distinct("claim", "name").into_iter().filter_map(|claim| {
        let policies = [("refuse", ClaimPolicy::Refuse), ("standby", ClaimPolicy::Standby)];
        let policy = claim.take("policy", |text| value::word("a policy", &policies, text));
        Some((claim.need("name", value::object_name)?, policy.unwrap_or(ClaimPolicy::Refuse)))
    });
    let claims = claims.collect();
    let tree = if is_device { None } else { element.path("tree") };
    let type_name = match !is_device && element.node.has_attribute("tree") {
        false => element.need("type", value::filled),
        true => element.take("type", |text| {
            let (sentence, help) = ("a component has a `type` or a `tree`", "delete one");
            Err(ValueError::new(sentence, format!("{text}, beside a tree"), help))
        }),
    };
    ChildDescription::Component(Box::new(ComponentDescription {
        name: element.need("name", value::object_name).unwrap_or_default(),
        type_name: type_name.unwrap_or_default(),
        tree,
        rate_hz: element.take("rate", value::rate),
        queue: element.take("queue", value::count),
        when_full: when_full.unwrap_or_default(),
        own_thread: thread.unwrap_or_default(),
        priority: element.take("priority", value::count),
        cpu: element.take("cpu", value::count),
        max_block: element.take("max-block", value::duration),
        max_wait: element.take("max-wait", value::duration),
        max_delay: element.take("max-delay", value::duration),
        liveness: element
            .child("liveness")
            .and_then(|liveness_element| liveness(&liveness_element)),
        parameters,
        actuators,
        claims,
        device: is_device.then(|| device(element)),
        ..common(element)
    }))
}

/// When a process is at work.
const READINESS: [(&str, bool); 2] = [("notify", false), ("started", true)];

/// A program, which has few of the settings of a component; or the robot's own program, with
/// components of its own.
fn process(element: &RobotElement<'_>) -> ChildDescription {
    let has_children = element
        .node
        .children()
        .any(|child| CHILDREN.split(' ').any(|name| name == child.tag_name().name()));
    let is_own = has_children && !element.node.has_attribute("program");
    let (mut ready, mut node) = (None, None);
    let (name, mut spec);
    if is_own {
        name = element.need("name", value::node_name).unwrap_or_default();
        let program = env::current_exe().unwrap_or_default();
        spec = ProcessSpec::new(&name, program);
        let mut root = SupervisorDescription { origin: element.origin(), ..rules(element) };
        // As in OTP: what gives up tells its parent, here by the end of the process.
        if !element.node.has_attribute("when-exceeded") {
            root.when_exceeded = WhenExceeded::Escalate;
        }
        for element in element.children(CHILDREN) {
            child(&element, &mut root.children);
        }
        let (name, origin) = (name.clone(), element.origin());
        node = Some(Box::new(NodeDescription { name, root, origin, ..NodeDescription::default() }));
    } else {
        ready = element.take("ready", |text| value::word("a time to be ready", &READINESS, text));
        let mut arguments = element.take("arguments", value::words).unwrap_or_default();
        let more = element.children("arg");
        arguments.extend(more.iter().filter_map(|argument| argument.need("value", value::text)));
        name = element.need("name", value::object_name).unwrap_or_default();
        let program = element.need("program", value::filled).unwrap_or_default();
        spec = ProcessSpec::new(&name, program).arguments(arguments).folder(element.folder());
    }
    for (name, value) in texts(element.distinct("env", "name"), ["name", "value"]) {
        spec = spec.variable(&name, value);
    }
    let watchdog = element.take("watchdog", value::duration);
    spec = watchdog.into_iter().fold(spec, ProcessSpec::watchdog);
    let limit = element.take("memory-limit", value::size);
    spec = limit.into_iter().fold(spec, ProcessSpec::memory_limit);
    ChildDescription::Component(Box::new(ComponentDescription {
        name,
        process: Some(if ready == Some(true) { spec.ready_at_start() } else { spec }),
        node,
        ..common(element)
    }))
}

/// What a device has beside what it has as a component.
fn device(element: &RobotElement<'_>) -> DeviceSettings {
    DeviceSettings {
        at: element.need("at", value::filled).unwrap_or_default(),
        address: element.take("address", value::count),
        interval: element.take("interval", value::duration),
        tries: element.take("tries", value::count),
        deadman: element.take("deadman", value::duration),
        turnaround: element.take("turnaround", value::duration),
    }
}

/// The signs of life of a component. Each model has attributes of its own.
fn liveness(element: &RobotElement<'_>) -> Option<Liveness> {
    #[derive(Clone, Copy)]
    enum Model {
        Guard,
        Push,
        Pull,
    }
    let models = [("guard", Model::Guard), ("push", Model::Push), ("pull", Model::Pull)];
    let Some(model) = element.need("model", |text| value::word("a model", &models, text)) else {
        element.leave();
        return None;
    };
    let interval = || element.take("interval", value::duration);
    let tolerance = || element.take("tolerance", value::count);
    Some(match model {
        Model::Guard => Liveness::Guard,
        Model::Push => {
            let usual = Push::default();
            Liveness::Push(Push {
                interval: interval().unwrap_or(usual.interval),
                tolerance: tolerance().unwrap_or(usual.tolerance),
                start_up: element.take("start-up", value::duration).unwrap_or(usual.start_up),
            })
        }
        Model::Pull => {
            let usual = Pull::default();
            Liveness::Pull(Pull {
                interval: interval().unwrap_or(usual.interval),
                within: element.take("within", value::duration).unwrap_or(usual.within),
                tolerance: tolerance().unwrap_or(usual.tolerance),
            })
        }
    })
}

fn actuator(element: &RobotElement<'_>) -> Option<(String, ActuatorSettings)> {
    let lease = element.take("lease", value::duration);
    let command_timeout = element.take("command-timeout", value::command_timeout);
    let safe = element.child("safe").map(|safe| fields(&safe));
    let settings = ActuatorSettings { lease, command_timeout, safe: safe.unwrap_or_default() };
    Some((element.need("port", value::text)?, settings))
}

/// Fields of a command, each with its value as it is written.
fn fields(element: &RobotElement<'_>) -> Vec<(String, String)> {
    texts(element.distinct("field", "name"), ["name", "value"])
}

/// Two attributes of each of these elements.
fn texts(
    elements: Vec<RobotElement<'_>>,
    [one, other]: [&'static str; 2],
) -> Vec<(String, String)> {
    let both = elements
        .iter()
        .map(|element| (element.need(one, value::text), element.need(other, value::text)));
    both.filter_map(|(one, other)| one.zip(other)).collect()
}

/// The elements `on` of a plan, or of a component.
fn answers(element: &RobotElement<'_>) -> Vec<AnswerDescription> {
    element.children("on").iter().filter_map(answer).collect()
}

fn answer(element: &RobotElement<'_>) -> Option<AnswerDescription> {
    let steps = element.children("step");
    let mut ladder: Option<Ladder> = None;
    for step in &steps {
        let name = step.take("strategy", value::text);
        let action = step.need("action", value::action);
        let action = match (action, name) {
            (Some(Some(action)), None) => Some(action),
            (Some(None), Some(name)) => Some(RecoveryAction::Custom(name.as_str().into())),
            (Some(None), None) => {
                step.need("strategy", value::text);
                None
            }
            (Some(Some(_)), Some(_)) => {
                let sentence = "only the action `strategy` has a `strategy`";
                let error = ValueError::new(sentence, "of no use", "delete it");
                step.find_at("robot::plan", "strategy", error);
                None
            }
            (None, _) => None,
        };
        let usual = Backoff::default();
        let times = step.take("times", value::count);
        let within = step.take("within", value::duration);
        let backoff = Backoff {
            first: step.take("pause", value::duration).unwrap_or(usual.first),
            factor: step.take("pause-factor", value::count).unwrap_or(usual.factor),
            limit: step.take("pause-limit", value::duration).unwrap_or(usual.limit),
            ..usual
        };
        let Some(action) = action else { continue };
        let next = match ladder {
            Some(ladder) => ladder.then(action),
            None => Ladder::first(action),
        };
        let next = next.times(times.unwrap_or(1)).backoff(backoff);
        ladder = Some(within.into_iter().fold(next, Ladder::within));
    }
    let fault = element.need("fault", value::fault);
    if steps.is_empty() {
        let (sentence, help) = ("a fault without an answer", "add `<step action=…/>`");
        element.find_at("robot::plan", "fault", ValueError::new(sentence, "without a step", help));
    }
    Some(AnswerDescription { fault: fault?, ladder: ladder?, origin: element.origin() })
}

/// What the parser says of a file that is no XML.
fn syntax_finding(file: usize, text: &str, error: &Error) -> RobotFinding {
    let position = error.pos();
    let at = byte_at(text, position.row as usize, position.col as usize);
    let (sentence, help) = match error {
        Error::UnexpectedCloseTag(expected, actual, _) => (
            format!("`</{expected}>` is missing before `</{actual}>`"),
            format!("write `</{expected}>`, or `<{expected} …/>`"),
        ),
        Error::DtdDetected => (
            "a robot file has no document type".to_owned(),
            "delete it; `<argument>` is for what repeats, `<include>` for other files".to_owned(),
        ),
        error => {
            (format!("no XML: {error}"), "correct what stands here, or just before".to_owned())
        }
    };
    let range = at.min(text.len())..(at + 1).min(text.len());
    let labels = vec![(FilePlace { file, range }, "here".to_owned())];
    RobotFinding { code: "robot::xml", sentence, help, labels }
}
