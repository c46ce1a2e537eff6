//! The rules of a robot: names, references, order, types, and what a node's start would refuse.
//!
//! Rules about one object are those of [`NodeBuilder::check`](blastema::NodeBuilder::check), which
//! a start applies too; this file adds the place.

mod lost_communication;

use self::lost_communication::place_of;

use crate::description::{
    AnswerDescription, ChildDescription, ComponentDescription, ConnectionDescription,
    ElementOrigin, EndpointDescription, NodeDescription, RobotDescription,
};
use crate::finding::{ElementPart, ElementPlaces, FilePlace, RobotFinding, RobotSources};
use crate::types::{Types, end_of};
use crate::value::{ValueError, fault_word, hint};
use blastema::core::detection::dependencies::circle;
use blastema::core::port::{ConnectionRole, PortAddress, resolve};
use blastema::core::sorted::SortedMap;
use blastema::prelude::*;
use blastema::recovery::PlanError;
use blastema::trees::{BehaviorTree, TreeErrors, byte_at};
use blastema::{ParameterError, SpecError};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::sync::Arc;

/// Finds what is wrong with a robot, with the types that a program has registered, beside what its
/// reader has found. The files of its trees are added to the sources.
pub(crate) fn check(
    robot: &RobotDescription,
    sources: &mut RobotSources,
    types: &Types,
    findings: Vec<RobotFinding>,
) -> Vec<RobotFinding> {
    let files = sources.files.clone();
    let places = ElementPlaces::of(sources);
    let untried = BTreeSet::new();
    let mut checker = RobotChecker { robot, types, places, files, findings, untried };
    checker.names("node", "robot", robot.nodes.iter().map(|node| (&*node.name, node.origin)));
    let networks = robot.networks.iter().map(|network| (&*network.name, network.origin));
    checker.names("network", "robot", networks);
    checker.answers(&robot.plan);
    if robot.nodes.is_empty() {
        let at = (robot.origin, "name");
        checker.find("robot::missing", "the robot has no node", at, "add `<node name=…>`", "here");
    }
    let groups = checker.joined();
    for node in &robot.nodes {
        checker.lost_communication(node, &groups);
        checker.node(node);
    }
    checker.networks();
    checker.dependencies(&groups);
    checker.connections(&groups);
    checker.try_nodes();
    let RobotChecker { files, findings, .. } = checker;
    sources.files = files;
    findings
}

/// The medium of an endpoint, as other nodes must have it, where it is one.
fn medium(at: &str) -> Option<&str> {
    match at.split(':').next()? {
        // An adapter is on the bus as a controller is.
        "slcan" => Some("can"),
        medium @ ("can" | "memory" | "serial" | "tcp" | "udp" | "unix") => Some(medium),
        _ => None,
    }
}

/// What helps against a wrong endpoint.
const MEDIA: &str = "see the manual's page on media";

struct RobotChecker<'a> {
    robot: &'a RobotDescription,
    types: &'a Types,
    places: ElementPlaces<'a>,
    /// The robot's files, and those of its trees.
    files: Vec<(String, Arc<str>)>,
    findings: Vec<RobotFinding>,
    /// The components that cannot be tried, each behind its node.
    untried: BTreeSet<(&'a str, &'a str)>,
}

impl<'a> RobotChecker<'a> {
    /// Adds a finding about a part of an element.
    fn find(
        &mut self,
        code: &'static str,
        sentence: impl Into<String>,
        at: (ElementOrigin, impl Into<ElementPart>),
        help: impl Into<String>,
        label: &str,
    ) {
        let (origin, part) = (at.0, at.1.into());
        let place = self.places.find(origin, &part).map(|place| (place, label.to_owned()));
        let (sentence, help) = (sentence.into(), help.into());
        self.add(RobotFinding { code, sentence, help, labels: place.into_iter().collect() });
    }

    /// Finds a name that is none of those that there are.
    fn known<'n>(
        &mut self,
        code: &'static str,
        what: &str,
        name: &str,
        mut known: impl Iterator<Item = &'n str> + Clone,
        at: (ElementOrigin, &str),
    ) {
        let help = hint(name, known.clone());
        if !known.any(|known| known == name) {
            self.find(code, format!("there is no {what} `{name}`"), at, help, "unknown");
        }
    }

    /// Adds a finding about one attribute of two elements.
    fn twice(
        &mut self,
        sentence: String,
        part: impl Into<ElementPart>,
        at: [ElementOrigin; 2],
        help: &str,
    ) {
        let part = part.into();
        let labels = at.into_iter().zip(["first", "again"]).filter_map(|(origin, label)| {
            Some((self.places.find(origin, &part)?, label.to_owned()))
        });
        let (labels, help) = (labels.collect(), help.to_owned());
        self.add(RobotFinding { code: "robot::twice", sentence, help, labels });
    }

    /// The copies of a component have its mistakes.
    fn add(&mut self, finding: RobotFinding) {
        if !self.findings.contains(&finding) {
            self.findings.push(finding);
        }
    }

    /// Finds names that two have.
    fn names<'n>(
        &mut self,
        what: &str,
        of: &str,
        names: impl Iterator<Item = (&'n str, ElementOrigin)>,
    ) {
        let mut known = BTreeMap::new();
        for (name, again) in names.filter(|(name, _)| !name.is_empty()) {
            if let Some(first) = known.insert(name, again) {
                let sentence = format!("`{name}` is the name of two {what}s of {of}");
                self.twice(sentence, "name", [first, again], "rename one");
            }
        }
    }

    fn answers(&mut self, answers: &[AnswerDescription]) {
        for (at, answer) in answers.iter().enumerate() {
            if let Some(first) = answers[..at].iter().find(|known| known.fault == answer.fault) {
                let sentence = format!("`{}` is answered twice", fault_word(&answer.fault));
                let help = "delete one, or join their steps";
                self.twice(sentence, "fault", [first.origin, answer.origin], help);
            }
            let [_, strategies, _] = self.types.names();
            let plan = Plan::default().on(answer.fault.clone(), answer.ladder.clone());
            let Err(error) = plan.check([], [], strategies.iter().copied()) else { continue };
            let (part, help) = match &error {
                PlanError::NoSuchStrategy { strategy, .. } => {
                    let part = ElementPart::below("step", "strategy", strategy, "strategy");
                    (part, hint(strategy, strategies))
                }
                _ => ("fault".into(), "change the step, or the fault".to_owned()),
            };
            self.find("robot::plan", error.to_string(), (answer.origin, part), help, "here");
        }
    }

    fn node(&mut self, node: &'a NodeDescription) {
        let [_, _, safe_outputs] = self.types.names();
        let types = self.types;
        let mut objects = Vec::new();
        node.root.visit(&mut |child| objects.push(child.identity()));
        self.names("object", &format!("node {}", node.name), objects.iter().copied());
        self.answers(&node.plan);
        let parent = node.process_of.as_deref().and_then(|of| self.robot.node(of));
        if let (Some(of_parent), Some(key)) =
            (parent.and_then(|parent| self.robot.keys_of(parent)), &node.keys)
            && of_parent.exists()
            && !key.exists()
        {
            let name = &node.name;
            let sentence = format!("there is no {name}.key beside the key of its node");
            let help = format!("make it by `blastema keys add {name}`, and copy it there");
            self.find("robot::keys", sentence, (node.origin, "name"), help, "without a key");
        }
        if node.may_be_away && node.endpoints.is_empty() {
            let sentence = format!("node {} may be away, and is on no network", node.name);
            let help = "give it an `endpoint`, or delete `may-be-away`".to_owned();
            let at = (node.origin, "may-be-away");
            self.find("robot::network", sentence, at, help, "no other node sees it");
        }
        if let Some(name) = node.safe_outputs.as_deref().filter(|name| !safe_outputs.contains(name))
        {
            let sentence = format!("no safe outputs `{name}` are registered");
            let help = hint(name, safe_outputs);
            self.find("robot::type", sentence, (node.origin, "safe-outputs"), help, "unknown");
        }
        for component in node.components() {
            let name = component.type_name.as_str();
            let known = types.kinds(component.device.is_some());
            let is_known = match (&component.tree, &component.process) {
                (Some(file), _) => self.tree(component, file),
                (None, Some(process)) => process.program() != Path::new(""),
                (None, None) => known.contains(&name),
            };
            let has_endpoint = component.device.as_ref().is_none_or(|device| !device.at.is_empty());
            if !is_known || !has_endpoint {
                self.untried.insert((&node.name, &component.name));
            }
            if !name.is_empty() && !is_known {
                let what = if component.device.is_some() { "type of devices" } else { "type" };
                let sentence = format!("no {what} `{name}` is registered");
                let help = hint(name, known);
                self.find("robot::type", sentence, (component.origin, "type"), help, "unknown");
            }
            self.answers(&component.plan);
        }
        let claims = node.components().into_iter().flat_map(|component| {
            component.claims.iter().map(|(name, _)| (name, component.origin))
        });
        let mut known = BTreeMap::new();
        for (name, again) in claims {
            if let Some(first) = known.insert(name, again) {
                let sentence = format!("two components of node {} claim `{name}`", node.name);
                let part = ElementPart::below("claim", "name", name, "name");
                self.twice(sentence, part, [first, again], "delete one");
            }
        }
    }

    /// Shows what a start would refuse, at this place where the error names no other.
    fn refused(
        &mut self,
        node: &'a NodeDescription,
        error: StartError,
        code: &'static str,
        at: (ElementOrigin, &str),
        help: &str,
    ) {
        let text = error.to_string();
        let sentence = text.lines().next().unwrap_or_default().to_owned();
        let origin_of = |object: &str| {
            let mut found = None;
            node.root.visit(&mut |child| {
                if child.identity().0 == object {
                    found.get_or_insert(child.identity().1);
                }
            });
            found.unwrap_or(node.origin)
        };
        let origin_of_network = |name: &str| {
            let mut networks = self.robot.networks.iter();
            networks.find(|of| of.name == name).map_or(node.origin, |of| of.origin)
        };
        let (code, at, sentence, help) = match error {
            StartError::Spec(SpecError::Setting { name, setting, value, cure }) => {
                let part = ElementPart::of_setting(setting);
                let is_actuators = setting.starts_with("actuator.");
                let code = if is_actuators { "robot::actuator" } else { "robot::setting" };
                let sentence = format!("`{}` of {name} is {value}", part.attribute);
                (code, (origin_of(&name), part), sentence, cure.to_owned())
            }
            StartError::Spec(SpecError::Parameters { name, error, .. }) => {
                let key = error.key().to_owned();
                let is_unknown = matches!(error, ParameterError::Unknown { .. });
                let attribute = if is_unknown { "name" } else { "value" };
                let sentence = format!("of {name}, {error}");
                let help = "correct it; the command `describe` prints what there is".to_owned();
                let part = ElementPart::below("param", "name", &key, attribute);
                ("robot::parameter", (origin_of(name.as_str()), part), sentence, help)
            }
            StartError::Spec(SpecError::Device { name, setting, why }) => {
                let part = match setting {
                    "endpoint" => "at",
                    "period" => "rate",
                    "ports" => "type",
                    other => other,
                };
                let help = "correct it; see the manual's page on small devices".to_owned();
                let at = (origin_of(name.as_str()), part.into());
                ("robot::setting", at, format!("of {name}, {why}"), help)
            }
            StartError::Spec(SpecError::Process { name, setting, why }) => {
                let part = if setting == "launcher" { "name" } else { "program" };
                let (sentence, help) = why.split_once(": ").unwrap_or((&why, ""));
                let at = (origin_of(name.as_str()), part.into());
                ("robot::setting", at, sentence.to_owned(), help.to_owned())
            }
            StartError::Spec(SpecError::Reserved { name }) => {
                let (sentence, help) = sentence.split_once(": ").unwrap_or((&sentence, ""));
                let at = (origin_of(name.as_str()), "name".into());
                ("robot::value", at, sentence.to_owned(), help.to_owned())
            }
            StartError::Spec(SpecError::ActuatorSettings { name, contract, field, why }) => {
                let (sentence, part, help) =
                    self.actuator(node, name.as_str(), &contract, field.as_deref(), &why);
                ("robot::actuator", (origin_of(name.as_str()), part), sentence, help)
            }
            StartError::Spec(SpecError::Ports { name, .. }) => {
                let at = (origin_of(name.as_str()), "type".into());
                ("robot::setting", at, sentence, "mend its `ports`".to_owned())
            }
            StartError::Setting { setting, value, cure } => {
                let setting = if setting == "inspection_socket" { "shown_at" } else { setting };
                let part = ElementPart::of_setting(setting);
                let sentence = format!("`{}` of node {} is {value}", part.attribute, node.name);
                ("robot::setting", (node.origin, part), sentence, cure)
            }
            StartError::Endpoint { network, neighbour, error } => {
                let of = neighbour.as_ref().and_then(|other| self.robot.node(other.as_str()));
                let mut ends = of.unwrap_or(node).endpoints.iter();
                let at = ends.find(|end| end.network == network).map(|end| {
                    let is_told = of.is_some() && end.reached_at.is_some();
                    (end.origin, if is_told { "reached-at" } else { "at" }.into())
                });
                let at = at.unwrap_or((node.origin, "name".into()));
                ("robot::network", at, error.problem().to_owned(), MEDIA.to_owned())
            }
            StartError::Insecure { network, .. } => {
                let sentence = format!("`{network}` leaves the computer without keys");
                let help = "add `keys=\"…\"` to `robot`, or `insecure=\"true\"` here if every station \
                            on it may command this robot";
                (
                    "robot::network",
                    (origin_of_network(&network), "name".into()),
                    sentence,
                    help.to_owned(),
                )
            }
            StartError::Link { network, setting, value, cure, .. } => {
                let part = ElementPart::of_setting(setting);
                let sentence = format!("`{}` of network {network} is {value}", part.attribute);
                ("robot::network", (origin_of_network(&network), part), sentence, cure.to_owned())
            }
            StartError::LostCommunication { policy, part, reason } => {
                let mut policies = node.lost_communication.iter();
                let at = policies.find(|of| of.name == policy).map(|of| place_of(of, &part));
                let at = at.unwrap_or((node.origin, "name".into()));
                ("robot::lost", at, format!("of `{policy}`, {reason}"), "correct it".to_owned())
            }
            _ => (code, (at.0, at.1.into()), sentence, help.to_owned()),
        };
        self.find(code, sentence, at, help, "here");
    }

    /// Finds what is wrong with a tree, at its places in the tree's files. False: something is.
    fn tree(&mut self, component: &ComponentDescription, file: &Path) -> bool {
        let Err(error) = BehaviorTree::read(&self.types.leaves, file) else { return true };
        let Some(errors) = error.get_ref().and_then(|error| error.downcast_ref::<TreeErrors>())
        else {
            let (at, help) = ((component.origin, "tree"), "correct the path, or the file");
            let name = file.display().to_string();
            let sentence = error.to_string().replace(&name, &self.shown(&name));
            self.find("robot::tree", sentence, at, help, "here");
            return false;
        };
        for error in errors.iter() {
            let shown = self.shown(&error.file);
            let known = self.files.iter().position(|(name, _)| *name == shown);
            let file = known.unwrap_or_else(|| {
                // It was read a moment ago.
                let text = fs::read_to_string(&error.file).unwrap_or_default();
                self.files.push((shown, text.into()));
                self.files.len() - 1
            });
            let start = byte_at(&self.files[file].1, error.line, error.column);
            let (sentence, help) = (error.problem.to_string(), error.suggestion.as_ref());
            let help = help.map_or("correct the tree".into(), |near| format!("write `{near}`"));
            let labels = vec![(FilePlace { file, range: start..start + 1 }, "here".to_owned())];
            self.add(RobotFinding { code: "robot::tree", sentence, help, labels });
        }
        false
    }

    /// A path as it is shown: from the folder of the outermost file.
    fn shown(&self, path: &str) -> String {
        let outermost = self.files.first().and_then(|(name, _)| fs::canonicalize(name).ok());
        let folder = outermost.as_deref().and_then(Path::parent);
        let below = folder.and_then(|folder| Path::new(path).strip_prefix(folder).ok());
        below.map_or(path.to_owned(), |below| below.display().to_string())
    }

    /// What is wrong with the settings of an actuator, which are of this contract: the sentence, the
    /// port or the field, and what to write.
    fn actuator(
        &self,
        node: &NodeDescription,
        name: &str,
        contract: &str,
        field: Option<&str>,
        why: &str,
    ) -> (String, ElementPart, String) {
        let components = node.components();
        let component = components.iter().find(|component| component.name == name);
        let of = component.and_then(|component| self.types.description(&component.type_name));
        let ports = of.into_iter().flat_map(|of| &of.takes);
        let ports = ports.filter(|port| port.role == ConnectionRole::Commanded);
        let named = |port: &str| {
            let known = ports.clone().find(|known| known.name == port);
            known.map_or(contract == port, |known| known.contract.name == contract)
        };
        let mut written = component.into_iter().flat_map(|component| &component.actuators);
        let written = written.find(|(port, _)| named(port));
        let port = written.map_or(contract, |(port, _)| port.as_str());
        let known: Vec<&str> = ports.clone().map(|port| port.name.as_str()).collect();
        let at_port = ElementPart::below("actuator", "port", port, "port");
        let sentence = format!("of {name}, {why}");
        match field {
            _ if !known.contains(&port) => {
                let sentence = format!("{name} is commanded at no port `{port}`");
                (sentence, at_port, hint(port, known))
            }
            Some(field) => {
                let part = ElementPart::below("field", "name", field, "value");
                (sentence, part, "correct the field".to_owned())
            }
            None => (sentence, at_port, "correct the settings".to_owned()),
        }
    }

    fn networks(&mut self) {
        let names = self.robot.networks.iter().map(|network| network.name.as_str());
        let mut ends: BTreeMap<&str, Vec<(&'a NodeDescription, &EndpointDescription)>> =
            names.clone().map(|name| (name, Vec::new())).collect();
        for node in &self.robot.nodes {
            for end in &node.endpoints {
                match ends.get_mut(end.network.as_str()) {
                    Some(known) => known.push((node, end)),
                    None if end.network.is_empty() => {}
                    None => {
                        let at = (end.origin, "network");
                        self.known("robot::network", "network", &end.network, names.clone(), at);
                    }
                }
            }
        }
        for (name, ends) in ends {
            if let [(node, end)] = ends[..] {
                let sentence = format!("only node `{}` has an endpoint of `{name}`", node.name);
                let help = "add an endpoint to another node, or delete this one";
                let at = (end.origin, "network");
                self.find("robot::network", sentence, at, help, "without a partner");
            }
            for (at, &(node, end)) in ends.iter().enumerate() {
                let mut others = ends[..at].iter();
                if let Some((other, _)) =
                    others.find(|(_, other)| other.at == end.at && other.origin.at != end.origin.at)
                {
                    let sentence = format!("`{}` is the endpoint of `{}` too", end.at, other.name);
                    let help = "give each node an address of its own";
                    self.find("robot::network", sentence, (end.origin, "at"), help, "again");
                }
                if at == 2 && end.at.starts_with("serial:") {
                    let sentence =
                        format!("`{name}` has three endpoints, and a serial line joins two");
                    let (at, help) = ((end.origin, "network"), "make it a network of its own");
                    self.find("robot::network", sentence, at, help, "the third");
                }
                if let (Some(first), Some(other)) = (medium(&ends[0].1.at), medium(&end.at))
                    && first != other
                {
                    let sentence = format!("`{name}` has endpoints on {first} and on {other}");
                    let help = "write endpoints of one medium, or make it two networks";
                    self.find("robot::network", sentence, (end.origin, "at"), help, "on another");
                }
                self.endpoint(node, end);
            }
        }
    }

    fn endpoint(&mut self, node: &'a NodeDescription, end: &EndpointDescription) {
        let (code, at) = ("robot::network", (end.origin, "at"));
        let place = end.at.split_once("://").map_or("", |(_, place)| place);
        let unspecified = place.starts_with("0.0.0.0:") || place.starts_with("[::]:");
        if unspecified && end.reached_at.is_none() {
            let (host, port) = place.rsplit_once(':').unwrap_or((place, ""));
            let port = port.split('?').next().unwrap_or_default();
            let sentence = format!("other nodes cannot reach {} at {host}", node.name);
            let help = format!(
                "add `reached-at=\"192.168.0.1:{port}\"`, with the address of {}",
                node.name
            );
            return self.find(code, sentence, at, help, "every address of its computer");
        }
        let mut networks = self.robot.networks.iter();
        let Some(described) = networks.find(|known| known.name == end.network) else { return };
        let origin = described.origin;
        // Keys need not be on the computer that checks.
        let has_keys = self.robot.keys_of(node).is_some();
        let network = end_of(described, end);
        let network = if has_keys { network.insecure() } else { network };
        for error in Node::builder(&node.name).network(network).check() {
            self.refused(node, error, code, at, MEDIA);
        }
        if has_keys && described.insecure {
            let sentence =
                format!("`{}` is insecure, and node `{}` has keys", end.network, node.name);
            self.find(code, sentence, (origin, "insecure"), "delete `insecure`", "insecure");
        }
    }

    /// Tries each node as its start does, without what was found to be wrong.
    fn try_nodes(&mut self) {
        let mut robot = self.robot.clone();
        // Plans and dependencies have rules of their own, and keys need not be here.
        let has_keys = robot.nodes.iter().any(|node| robot.keys_of(node).is_some());
        robot.networks.iter_mut().for_each(|network| network.insecure |= has_keys);
        (robot.keys, robot.plan) = Default::default();
        let labels = self.findings.iter().flat_map(|finding| &finding.labels);
        let is_right = |origin| !labels.clone().any(|(place, _)| self.places.holds(origin, place));
        let mut whole = BTreeSet::new();
        for node in &mut robot.nodes {
            (node.keys, node.safe_outputs, node.plan) = Default::default();
            node.endpoints.retain(|end| is_right(end.origin));
            let (own, mut names, mut is_whole) =
                (&node.name, BTreeSet::from([String::new()]), true);
            node.root.retain(&mut |child| {
                let is_new = names.insert(child.identity().0.to_owned());
                let ChildDescription::Component(component) = child else { return is_new };
                (component.depends_on, component.plan) = Default::default();
                let is_refused = self.untried.contains(&(own.as_str(), component.name.as_str()));
                is_whole &= is_new && !is_refused;
                is_new && !is_refused
            });
            let has_networks = !node.endpoints.is_empty();
            node.lost_communication.retain(|policy| {
                let can_be_lost =
                    has_networks || policy.commander.as_ref().is_none_or(|of| of == own);
                is_whole && can_be_lost && is_right(policy.origin)
            });
            if is_whole {
                whole.insert(own.clone());
            }
        }
        let is_whole =
            |end: &PortAddress| end.node.as_ref().is_some_and(|node| whole.contains(node.as_str()));
        robot.connections.retain(|ConnectionDescription { ports, origin }| {
            is_right(*origin) && is_whole(&ports.from) && is_whole(&ports.to)
        });
        for node in &self.robot.nodes {
            let at = (node.origin, "name");
            match self.types.node(&robot, &node.name) {
                Ok(builder) => builder.check().into_iter().for_each(|error| {
                    let help = "change the description of the node";
                    self.refused(node, error, "robot::node", at, help);
                }),
                Err(error) => self.find("robot::node", error, at, "", ""),
            }
        }
    }

    /// Which nodes have a path to each other: those with equal numbers.
    fn joined(&self) -> BTreeMap<&'a str, usize> {
        let nodes = self.robot.nodes.iter().enumerate();
        let mut groups: BTreeMap<&str, usize> = nodes.map(|(at, node)| (&*node.name, at)).collect();
        let mut ends: BTreeMap<&str, usize> = BTreeMap::new();
        for node in &self.robot.nodes {
            for end in &node.endpoints {
                let own = groups[&*node.name];
                let other = *ends.entry(&end.network).or_insert(own);
                let all = groups.values_mut().chain(ends.values_mut());
                all.filter(|group| **group == other).for_each(|group| *group = own);
            }
        }
        groups
    }

    /// Finds nodes that are to exchange messages, and cannot.
    fn reach(
        &mut self,
        groups: &BTreeMap<&str, usize>,
        one: &str,
        other: &str,
        at: (ElementOrigin, &str),
    ) {
        if groups.get(one) != groups.get(other) {
            let sentence = format!("nodes `{one}` and `{other}` have no path between them");
            let help = "give both an endpoint of one network";
            self.find("robot::reach", sentence, at, help, "cannot be reached");
        }
    }

    /// Everything that is needed is there and starts before, and nothing needs itself.
    fn dependencies(&mut self, groups: &BTreeMap<&str, usize>) {
        // The place of each object in the order of its node; a supervisor has that of its last
        // child.
        let mut order: BTreeMap<String, (usize, usize)> = BTreeMap::new();
        let mut needs: BTreeMap<String, Vec<(String, &ComponentDescription)>> = BTreeMap::new();
        for (at, node) in self.robot.nodes.iter().enumerate() {
            let rungs: Vec<&str> = node.run_by_rungs().collect();
            let full = |name: &str| match name.contains(':') {
                true => name.to_owned(),
                false => format!("{}:{name}", node.name),
            };
            let mut started = 0;
            number(&node.root.children, &mut started, &mut |name, place| {
                // One that a rung runs is not there as a rule.
                if !rungs.contains(&name) {
                    order.insert(full(name), (at, place));
                }
            });
            for component in node.components() {
                let of = component.depends_on.iter().map(|name| (full(name), component));
                needs.entry(full(&component.name)).or_default().extend(of);
            }
        }
        let edges = needs.iter().map(|(object, needed)| {
            (object, needed.iter().map(|(other, _)| other).collect::<Vec<_>>())
        });
        let (mut edges, mut circles): (SortedMap<_, _>, _) = (edges.collect(), BTreeSet::new());
        while let Some(way) = circle(&edges) {
            let Some((object, needed)) = needs.get_key_value(&way[0]) else { break };
            for (_, component) in needed.iter().filter(|(other, _)| *other == way[1]) {
                let sentence = format!("{}: each waits for the next", way.join(" -> "));
                let at = (component.origin, "depends-on");
                let help = "leave out one of these dependencies";
                self.find("robot::cycle", sentence, at, help, "here");
            }
            edges.entry(object).or_default().retain(|other| **other != way[1]);
            circles.extend(way.windows(2).map(<[String]>::to_vec));
        }
        for (object, needed) in &needs {
            for (other, component) in needed {
                let at = (component.origin, "depends-on");
                let (node, own) = other.split_once(':').unwrap_or_default();
                let Some(place) = order.get(other) else {
                    let same = order.keys().filter_map(|name| name.split_once(':'));
                    let same = same.filter(|(of, _)| *of == node).map(|(_, name)| name);
                    let same: Vec<&str> = same.collect();
                    let sentence = format!("node {node} has no `{own}`");
                    self.find("robot::dependency", sentence, at, hint(own, same), "unknown");
                    continue;
                };
                // One that a rung runs starts when all else has.
                let Some(here) = order.get(object).copied() else { continue };
                let own_node = self.robot.nodes[here.0].name.as_str();
                self.reach(groups, own_node, node, at);
                if place.0 == here.0 && place.1 < here.1 {
                    continue;
                }
                let edge = [object.clone(), other.clone()];
                if place.0 == here.0 && !circles.contains(&edge[..]) {
                    let sentence =
                        format!("`{}` depends on `{own}`, which starts after it", component.name);
                    let help = format!("move `{own}` before `{}`", component.name);
                    self.find("robot::order", sentence, at, help, "starts later");
                }
            }
        }
    }

    fn connections(&mut self, groups: &BTreeMap<&str, usize>) {
        let (robot, types, mut known) = (self.robot, self.types, BTreeMap::new());
        for ConnectionDescription { ports, origin } in &robot.connections {
            let (origin, mut is_known, mut leads) = (*origin, true, false);
            let resolved = resolve(ports, |address, is_out| {
                let found = types.port(robot, address, is_out);
                let port = found.unwrap_or_else(|ValueError { sentence, help, label }| {
                    let at = (origin, if is_out { "from" } else { "to" });
                    is_known = false;
                    self.find("robot::connection", sentence, at, help, &label);
                    None
                });
                leads |= port.is_some_and(|port| is_out && port.role.connects());
                Ok(port.map(Cow::Borrowed))
            });
            if let Err(error) = resolved {
                let text = error.to_string();
                let (first, rest) = text.split_once('\n').unwrap_or((&text, ""));
                let sentence =
                    format!("`{}` cannot be connected to `{}`: {first}", ports.from, ports.to);
                let help = match rest.trim() {
                    "" => "connect ports of one contract",
                    rest => rest,
                };
                self.find("robot::connection", sentence, (origin, "to"), help, "does not fit");
            }
            // A port that commands or asks leads to one port.
            let key = (&ports.from, (!leads).then_some(&ports.to));
            if let Some(first) = known.insert(key, origin) {
                let (sentence, part) = match leads {
                    true => (
                        format!("`{}`, which leads to one port, is connected twice", ports.from),
                        "from",
                    ),
                    false => (format!("{ports} is connected twice"), "to"),
                };
                self.twice(sentence, part, [first, origin], "delete one");
            }
            if let (true, Some(from), Some(to)) = (is_known, &ports.from.node, &ports.to.node) {
                let (from, to) = (from.as_str(), to.as_str());
                self.reach(groups, from, to, (origin, "to"));
                self.commanded(ports, from, to, origin);
            }
        }
    }
}

/// Numbers everything below a supervisor in the order in which it is at work.
fn number(children: &[ChildDescription], started: &mut usize, entry: &mut impl FnMut(&str, usize)) {
    for child in children {
        if let ChildDescription::Supervisor(supervisor) = child {
            number(&supervisor.children, started, entry);
        }
        *started += 1;
        entry(child.identity().0, *started);
    }
}
