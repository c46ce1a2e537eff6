//! The rules of a robot: names, references, order, types, and what a node's start would refuse.
//!
//! Rules about one object are those of [`NodeBuilder::check`](blastema::NodeBuilder::check), which
//! a start applies too; this file adds the place. What is wrong is left out of the next trial, so
//! that all mistakes are found.

use crate::description::{
    AnswerDescription, ChildDescription, ComponentDescription, ElementOrigin, EndpointDescription,
    NodeDescription, RobotDescription,
};
use crate::finding::{ElementPart, ElementPlaces, FINDINGS_MAX, RobotFinding, RobotSources};
use crate::types::{Types, network_of};
use blastema::core::port::{ConnectionRole, PortAddress, PortDescription, check_connection};
use blastema::core::suggestion::nearest;
use blastema::prelude::*;
use blastema::recovery::PlanError;
use blastema::{ParameterError, SpecError};
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Finds what is wrong with a robot, with the types that a program has registered.
pub(crate) fn check(
    robot: &RobotDescription,
    sources: &RobotSources,
    types: &Types,
) -> Vec<RobotFinding> {
    let places = ElementPlaces::of(sources);
    let mut checker = RobotChecker { robot, types, places, findings: Vec::new() };
    let start = ("robot", robot.origin);
    checker.names("node", start, robot.nodes.iter().map(|node| (&*node.name, node.origin)));
    checker.names(
        "network",
        start,
        robot.networks.iter().map(|known| (&*known.name, known.origin)),
    );
    checker.answers(&robot.plan);
    if robot.nodes.is_empty() {
        let help = "add `<node name=…>`".to_owned();
        checker.find("robot::missing", "the robot has no node", robot.origin, help, "here");
    }
    for node in &robot.nodes {
        checker.node(node);
    }
    checker.networks();
    checker.dependencies();
    checker.connections();
    checker.findings
}

struct RobotChecker<'a> {
    robot: &'a RobotDescription,
    types: &'a Types,
    places: ElementPlaces<'a>,
    findings: Vec<RobotFinding>,
}

/// The nearest word, or all.
fn hint<'w>(wrong: &str, known: impl IntoIterator<Item = &'w str> + Clone) -> String {
    match nearest(wrong, known.clone()) {
        Some(near) => format!("write `{near}`"),
        None => match known.into_iter().take(10).collect::<Vec<_>>().join(", ") {
            all if all.is_empty() => "there is none".to_owned(),
            all => format!("there are {all}"),
        },
    }
}

impl<'a> RobotChecker<'a> {
    /// Adds a finding about the name of an element.
    fn find(
        &mut self,
        code: &'static str,
        sentence: impl Into<String>,
        origin: ElementOrigin,
        help: String,
        label: &str,
    ) {
        self.find_at(code, sentence, (origin, ElementPart::Value("name")), help, label);
    }

    fn find_at(
        &mut self,
        code: &'static str,
        sentence: impl Into<String>,
        (origin, part): (ElementOrigin, ElementPart),
        help: String,
        label: &str,
    ) {
        let place = self.places.find(origin, &part).map(|place| (place, label.to_owned()));
        let labels = place.into_iter().collect();
        let finding = RobotFinding { code, sentence: sentence.into(), help: Some(help), labels };
        if !self.findings.contains(&finding) {
            self.findings.push(finding);
        }
    }

    /// Finds names that two have.
    fn names<'n>(
        &mut self,
        what: &str,
        (of, origin): (&str, ElementOrigin),
        names: impl Iterator<Item = (&'n str, ElementOrigin)>,
    ) {
        let mut known = BTreeMap::new();
        for (name, again) in names.filter(|(name, _)| !name.is_empty()) {
            let Some(first) = known.insert(name.to_owned(), again) else { continue };
            let part = ElementPart::Value("name");
            let labels = [(first, "first"), (again, "again")]
                .into_iter()
                .filter_map(|(at, label)| Some((self.places.find(at, &part)?, label.to_owned())));
            let labels: Vec<_> = labels.collect();
            let sentence = format!("`{name}` is the name of two {what}s of {of}");
            let help = Some("rename one".to_owned());
            let labels = if labels.is_empty() {
                self.places.find(origin, &part).map(|at| (at, "here".into())).into_iter().collect()
            } else {
                labels
            };
            self.findings.push(RobotFinding { code: "robot::twice", sentence, help, labels });
        }
    }

    fn answers(&mut self, answers: &[AnswerDescription]) {
        for answer in answers {
            let [_, strategies, _] = self.types.names();
            let plan = Plan::default().on(answer.fault.clone(), answer.ladder.clone());
            let Err(error) = plan.check([], [], strategies.iter().copied()) else { continue };
            let part = match &error {
                PlanError::NoSuchStrategy { strategy, .. } => ElementPart::Child {
                    element: "step",
                    key: ("strategy", strategy.clone()),
                    attribute: "strategy",
                },
                _ => ElementPart::Value("fault"),
            };
            let help = match &error {
                PlanError::NoSuchStrategy { strategy, .. } => hint(strategy, strategies),
                _ => "change the step, or the fault".to_owned(),
            };
            self.find_at("robot::plan", error.to_string(), (answer.origin, part), help, "here");
        }
    }

    fn node(&mut self, node: &'a NodeDescription) {
        let [types, _, safe_outputs] = self.types.names();
        let mut objects = Vec::new();
        node.root.visit(&mut |child| objects.push(child.identity()));
        let of = format!("node {}", node.name);
        self.names("object", (&of, node.origin), objects.iter().copied());
        self.answers(&node.plan);
        let mut trial = node.clone();
        if let Some(name) = node.safe_outputs.as_deref().filter(|name| !safe_outputs.contains(name))
        {
            let sentence = format!("no safe outputs `{name}` are registered");
            let at = (node.origin, ElementPart::Value("safe-outputs"));
            self.find_at("robot::type", sentence, at, hint(name, safe_outputs), "unknown");
            trial.safe_outputs = None;
        }
        for component in node.components() {
            let name = component.type_name.as_str();
            if !name.is_empty() && !types.contains(&name) {
                let sentence = format!("no type `{name}` is registered");
                let at = (component.origin, ElementPart::Value("type"));
                self.find_at("robot::type", sentence, at, hint(name, types.clone()), "unknown");
            }
            self.answers(&component.plan);
        }
        // Dependencies and plans have rules of their own here, and names that two have were found.
        trial.plan.clear();
        let mut names = BTreeSet::from([String::new()]);
        trial.root.retain(&mut |child| {
            let is_new = names.insert(child.identity().0.to_owned());
            let ChildDescription::Component(component) = child else { return is_new };
            component.depends_on.clear();
            component.plan.clear();
            is_new && types.contains(&component.type_name.as_str())
        });
        self.trials(node, trial);
    }

    /// Checks a node again and again, each time without what was found before.
    fn trials(&mut self, node: &'a NodeDescription, mut trial: NodeDescription) {
        let robot = RobotDescription::default();
        while self.findings.len() < FINDINGS_MAX {
            let builder = match self.types.composed(&robot, &trial) {
                Ok(builder) => builder,
                Err(error) => {
                    return self.find("robot::node", error, node.origin, String::new(), "");
                }
            };
            let refused = builder.check();
            if refused.is_empty() {
                return;
            }
            for error in refused {
                if !self.refused(node, &mut trial, error) {
                    return;
                }
            }
        }
    }

    /// Shows what a start would refuse, and takes it out of the trial. False: nothing was taken
    /// out.
    fn refused(
        &mut self,
        node: &'a NodeDescription,
        trial: &mut NodeDescription,
        error: StartError,
    ) -> bool {
        let text = error.to_string();
        let mut sentence = text.lines().next().unwrap_or_default().to_owned();
        let (object, part, help) = match error {
            StartError::Spec(SpecError::Setting { name, setting, value, cure }) => {
                let part = part_of_setting(setting);
                sentence = format!("`{}` of {name} is {value}", part.attribute());
                (name, part, cure.to_owned())
            }
            StartError::Spec(SpecError::Parameters { name, error }) => {
                let key = ("name", key_of(&error).to_owned());
                let attribute = match &error {
                    ParameterError::Unknown { key, .. } => {
                        sentence = format!("{name} has no parameter `{key}`");
                        "name"
                    }
                    error => {
                        sentence = format!("of {name}, {error}");
                        "value"
                    }
                };
                let part = ElementPart::Child { element: "param", key, attribute };
                (name.to_string(), part, self.parameter_help(node, name.as_str(), &error))
            }
            StartError::Spec(SpecError::ActuatorSettings { name, contract, why }) => {
                sentence = format!("of {name}, {why}");
                self.actuator(node, name.as_str(), &contract, &mut sentence)
            }
            StartError::Spec(SpecError::Ports { name, .. }) => {
                (name.to_string(), ElementPart::Value("type"), "mend its `ports`".to_owned())
            }
            StartError::Setting { setting, value, cure } => {
                let part = part_of_setting(setting);
                sentence = format!("`{}` of node {} is {value}", part.attribute(), node.name);
                self.find_at("robot::setting", sentence, (node.origin, part), cure.into(), "here");
                (trial.work_threads, trial.grace) = (None, None);
                return setting == "work_threads" || setting == "grace";
            }
            _ => {
                let help = "change the description of the node".to_owned();
                self.find("robot::node", sentence, node.origin, help, "this node");
                return false;
            }
        };
        let code = match &part {
            ElementPart::Child { element: "param", .. } => "robot::parameter",
            ElementPart::Child { element: "actuator" | "field", .. } => "robot::actuator",
            _ => "robot::setting",
        };
        let mut found = None;
        node.root.visit(&mut |child| {
            if child.identity().0 == object {
                found.get_or_insert(child.identity().1);
            }
        });
        self.find_at(code, sentence, (found.unwrap_or(node.origin), part.clone()), help, "here");
        let mut changed = false;
        trial.root.retain(&mut |child| {
            if child.identity().0 != object {
                return true;
            }
            changed = true;
            match child {
                ChildDescription::Component(component) => without(component, &part),
                ChildDescription::Supervisor(supervisor) => {
                    (supervisor.intensity, supervisor.period) = (None, None);
                    true
                }
            }
        });
        if !changed {
            // The root has no name of its own.
            changed =
                object == "root" && trial.root.intensity.is_some() | trial.root.period.is_some();
            (trial.root.intensity, trial.root.period) = (None, None);
        }
        changed
    }

    fn parameter_help(&self, node: &NodeDescription, name: &str, error: &ParameterError) -> String {
        let components = node.components();
        let component = components.iter().find(|component| component.name == name);
        let of = component.and_then(|component| self.types.description(&component.type_name));
        let parameters = of.map(|of| &*of.parameters).unwrap_or_default();
        let key = match error {
            ParameterError::Unknown { nearest: Some(nearest), .. } => nearest,
            error => key_of(error),
        };
        match parameters.iter().find(|parameter| parameter.name == key) {
            Some(parameter) => {
                let unit = parameter.unit.as_ref().map(|unit| format!(" in {unit}"));
                let range = parameter.range.as_ref().map(|range| format!(", {range}"));
                let (unit, range) = (unit.unwrap_or_default(), range.unwrap_or_default());
                format!(
                    "write `{key}` ({}{unit}{range}, default {})",
                    parameter.takes, parameter.default
                )
            }
            None => hint(key, parameters.iter().map(|parameter| parameter.name.as_str())),
        }
    }

    /// What is wrong with the settings of an actuator, which are of this contract: the component,
    /// the port or the field, and what to write.
    fn actuator(
        &self,
        node: &NodeDescription,
        name: &str,
        contract: &str,
        sentence: &mut String,
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
        let mut fields = written.into_iter().flat_map(|(_, settings)| &settings.safe);
        let field = fields.find(|(field, _)| sentence.contains(&format!("`{field}`")));
        let (part, help) = match field {
            _ if !known.contains(&port) => {
                *sentence = format!("{name} is commanded at no port `{port}`");
                let key = ("port", port.to_owned());
                let part = ElementPart::Child { element: "actuator", key, attribute: "port" };
                (part, hint(port, known))
            }
            Some((field, _)) => {
                let key = ("name", field.clone());
                let part = ElementPart::Child { element: "field", key, attribute: "value" };
                (part, "correct the field".to_owned())
            }
            None => {
                let key = ("port", port.to_owned());
                let part = ElementPart::Child { element: "actuator", key, attribute: "port" };
                (part, "correct the settings".to_owned())
            }
        };
        (name.to_owned(), part, help)
    }

    fn networks(&mut self) {
        let names = self.robot.networks.iter().map(|network| network.name.as_str());
        let mut ends: BTreeMap<&str, Vec<(&NodeDescription, &EndpointDescription)>> =
            names.clone().map(|name| (name, Vec::new())).collect();
        for node in &self.robot.nodes {
            for end in &node.endpoints {
                match ends.get_mut(end.network.as_str()) {
                    Some(known) => known.push((node, end)),
                    None if end.network.is_empty() => {}
                    None => {
                        let at = (end.origin, ElementPart::Value("network"));
                        let sentence = format!("there is no network `{}`", end.network);
                        let help = hint(&end.network, names.clone());
                        self.find_at("robot::network", sentence, at, help, "unknown");
                    }
                }
            }
        }
        for (name, ends) in ends {
            if let [(node, end)] = ends[..] {
                let at = (end.origin, ElementPart::Value("network"));
                let sentence = format!("only node `{}` has an endpoint of `{name}`", node.name);
                let help = "add an endpoint to another node, or delete this one".to_owned();
                self.find_at("robot::network", sentence, at, help, "without a partner");
            }
            for (at, &(node, end)) in ends.iter().enumerate() {
                let mut others = ends[..at].iter();
                if let Some((other, _)) =
                    others.find(|(_, other)| other.at == end.at && other.origin.at != end.origin.at)
                {
                    let sentence = format!("`{}` is the endpoint of `{}` too", end.at, other.name);
                    let at = (end.origin, ElementPart::Value("at"));
                    let help = "give each node an address of its own".to_owned();
                    self.find_at("robot::network", sentence, at, help, "again");
                }
                if at == 2 && end.at.starts_with("serial:") {
                    let sentence =
                        format!("`{name}` has three endpoints, and a serial line joins two");
                    let at = (end.origin, ElementPart::Value("network"));
                    let help = "make it a network of its own".to_owned();
                    self.find_at("robot::network", sentence, at, help, "the third");
                }
                self.endpoint(node, end);
            }
        }
    }

    fn endpoint(&mut self, node: &NodeDescription, end: &EndpointDescription) {
        let place = end.at.split_once("://").map_or("", |(_, place)| place);
        let unspecified = place.starts_with("0.0.0.0:") || place.starts_with("[::]:");
        if unspecified && end.reached_at.is_none() {
            let port = place.rsplit([':']).next().unwrap_or_default();
            let port = port.split('?').next().unwrap_or_default();
            let host = place.rsplit_once(':').map_or(place, |(host, _)| host);
            let sentence = format!("other nodes cannot reach {} at {host}", node.name);
            let at = (end.origin, ElementPart::Value("at"));
            let help = format!(
                "add `reached-at=\"192.168.0.1:{port}\"`, with the address of {}",
                node.name
            );
            return self.find_at(
                "robot::network",
                sentence,
                at,
                help,
                "every address of its computer",
            );
        }
        let network = match network_of(self.robot, node, end) {
            Ok(network) => network,
            Err(error) => return self.find("robot::network", error, end.origin, String::new(), ""),
        };
        // Keys need not be on the computer that checks.
        let has_keys = self.robot.keys_of(node).is_some();
        let network = if has_keys { network.insecure() } else { network };
        for error in Node::builder(&node.name).network(network).check() {
            let text = error.to_string();
            let sentence = text.lines().next().unwrap_or_default().to_owned();
            match error {
                StartError::Insecure { network, .. } => {
                    let described = self.robot.networks.iter().find(|known| known.name == network);
                    let origin = described.map_or(end.origin, |network| network.origin);
                    let sentence = format!("`{network}` leaves the computer without keys");
                    let help = "add `keys=\"…\"` to `robot`, or `insecure=\"true\"` here if every \
                                station on it may command this robot";
                    self.find("robot::network", sentence, origin, help.to_owned(), "here");
                }
                _ => {
                    let at = (end.origin, ElementPart::Value("at"));
                    let help = "see the manual's page on media".to_owned();
                    self.find_at("robot::network", sentence, at, help, "here");
                }
            }
        }
        let insecure = self.robot.networks.iter().find(|known| known.name == end.network);
        if let Some(network) = insecure.filter(|network| network.insecure && has_keys) {
            let sentence =
                format!("`{}` is insecure, and node `{}` has keys", network.name, node.name);
            let at = (network.origin, ElementPart::Value("insecure"));
            let help = "delete `insecure`".to_owned();
            self.find_at("robot::network", sentence, at, help, "insecure");
        }
    }

    /// Everything that is needed is there and starts before, and nothing needs itself.
    fn dependencies(&mut self) {
        // The place of each object in the order of its node; a supervisor has that of its last
        // child.
        let mut order: BTreeMap<String, (usize, usize)> = BTreeMap::new();
        let mut needs: BTreeMap<String, Vec<(String, &ComponentDescription)>> = BTreeMap::new();
        for (at, node) in self.robot.nodes.iter().enumerate() {
            let full = |name: &str| match name.contains(':') {
                true => name.to_owned(),
                false => format!("{}:{name}", node.name),
            };
            let mut started = 0;
            number(&node.root.children, &mut started, &mut |name, place| {
                order.insert(full(name), (at, place));
            });
            for component in node.components() {
                let of = component.depends_on.iter().map(|name| (full(name), component));
                needs.entry(full(&component.name)).or_default().extend(of);
            }
        }
        let mut circles = BTreeSet::new();
        for (object, needed) in &needs {
            for (other, component) in needed {
                let at = (component.origin, ElementPart::Value("depends-on"));
                let (node, own) = other.split_once(':').unwrap_or_default();
                let Some(place) = order.get(other) else {
                    let same = order.keys().filter_map(|name| name.split_once(':'));
                    let same = same.filter(|(of, _)| *of == node).map(|(_, name)| name);
                    let same: Vec<&str> = same.collect();
                    let sentence = format!("node {node} has no `{own}`");
                    self.find_at("robot::dependency", sentence, at, hint(own, same), "unknown");
                    continue;
                };
                let here = order.get(object).copied().unwrap_or_default();
                if place.0 == here.0 && place.1 < here.1 {
                    continue;
                }
                if let Some(path) = path(&needs, other, object) {
                    let members: BTreeSet<&str> = path.iter().map(String::as_str).collect();
                    if circles.insert(members.into_iter().map(str::to_owned).collect::<Vec<_>>()) {
                        let shown = [std::slice::from_ref(object), &path].concat().join(" -> ");
                        let sentence = format!("{shown}: each waits for the next");
                        let help = "leave out one of these dependencies".to_owned();
                        self.find_at("robot::cycle", sentence, at, help, "here");
                    }
                } else if place.0 == here.0 {
                    let sentence =
                        format!("`{}` depends on `{own}`, which starts after it", component.name);
                    let help = format!("move `{own}` before `{}`", component.name);
                    self.find_at("robot::order", sentence, at, help, "starts later");
                }
            }
        }
    }

    fn connections(&mut self) {
        let robot = self.robot;
        for connection in &robot.connections {
            let ports = &connection.ports;
            let from = self.port(connection.origin, &ports.from, "from");
            let to = self.port(connection.origin, &ports.to, "to");
            let (Some(from), Some(to)) = (from, to) else { continue };
            if let Err(error) = check_connection(from, to) {
                let at = (connection.origin, ElementPart::Value("to"));
                let text = error.to_string();
                let (first, rest) = text.split_once('\n').unwrap_or((&text, ""));
                let sentence =
                    format!("`{}` cannot be connected to `{}`: {first}", ports.from, ports.to);
                let help = match rest.trim() {
                    "" => "connect ports of one contract".to_owned(),
                    rest => rest.to_owned(),
                };
                self.find_at("robot::connection", sentence, at, help, "does not fit");
            }
        }
        let mut known = BTreeSet::new();
        for connection in &robot.connections {
            if !known.insert(&connection.ports) {
                let at = (connection.origin, ElementPart::Value("to"));
                let sentence = format!("{} is connected twice", connection.ports);
                self.find_at("robot::twice", sentence, at, "delete one".into(), "again");
            }
        }
    }

    /// The port at one end of a connection.
    fn port(
        &mut self,
        origin: ElementOrigin,
        address: &PortAddress,
        end: &'static str,
    ) -> Option<&'a PortDescription> {
        let (robot, types) = (self.robot, self.types);
        let at = (origin, ElementPart::Value(end));
        let name = address.node.as_ref().map_or("", |node| node.as_str());
        let Some(node) = robot.node(name) else {
            let known: Vec<&str> = robot.nodes.iter().map(|node| node.name.as_str()).collect();
            let sentence = format!("the robot has no node `{name}`");
            self.find_at("robot::connection", sentence, at, hint(name, known), "unknown");
            return None;
        };
        let (components, object) = (node.components(), address.object.as_str());
        let Some(component) = components.iter().find(|known| known.name == object) else {
            let known: Vec<&str> = components.iter().map(|known| known.name.as_str()).collect();
            let sentence = format!("node {name} has no component `{object}`");
            self.find_at("robot::connection", sentence, at, hint(object, known), "unknown");
            return None;
        };
        let of = types.description(&component.type_name)?;
        match of.port(address, end == "from") {
            Ok(port) => Some(port),
            Err(error) => {
                let known = match end {
                    "from" => of.gives.as_deref().unwrap_or_default(),
                    _ => &of.takes,
                };
                let known: Vec<&str> = known.iter().map(|port| port.name.as_str()).collect();
                let help = hint(address.port.as_str(), known);
                self.find_at("robot::connection", error.to_string(), at, help, "no such port");
                None
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

/// The way from one object to another along what they need, with both of them.
fn path(
    needs: &BTreeMap<String, Vec<(String, &ComponentDescription)>>,
    from: &str,
    to: &str,
) -> Option<Vec<String>> {
    let mut before = BTreeMap::from([(from, "")]);
    let mut open = VecDeque::from([from]);
    while let Some(object) = open.pop_front() {
        if object == to {
            let mut path = vec![object.to_owned()];
            let mut at = object;
            while let Some(previous) = before.get(at).filter(|previous| !previous.is_empty()) {
                path.push((*previous).to_owned());
                at = previous;
            }
            path.reverse();
            return Some(path);
        }
        for (next, _) in needs.get(object).into_iter().flatten() {
            if !before.contains_key(next.as_str()) {
                before.insert(next, object);
                open.push_back(next);
            }
        }
    }
    None
}

/// The attribute of a setting.
fn part_of_setting(setting: &str) -> ElementPart {
    let of = |element, attribute| {
        let key = if element == "liveness" { "model" } else { "port" };
        ElementPart::Child { element, key: (key, String::new()), attribute }
    };
    match setting {
        "the queue" => ElementPart::Value("queue"),
        "rate_hz" => ElementPart::Value("rate"),
        "max_block" => ElementPart::Value("max-block"),
        "max_wait" => ElementPart::Value("max-wait"),
        "max_delay" => ElementPart::Value("max-delay"),
        "ready_within" => ElementPart::Value("ready-within"),
        "shutdown_within" => ElementPart::Value("shutdown-within"),
        "the watch's interval" => of("liveness", "interval"),
        "the watch's tolerance" => of("liveness", "tolerance"),
        "the watch's start_up" => of("liveness", "start-up"),
        "the watch's within" => of("liveness", "within"),
        "a lease" => of("actuator", "lease"),
        "the command timeout" => of("actuator", "command-timeout"),
        "the intensity" => ElementPart::Value("intensity"),
        "the intensity's period" => ElementPart::Value("period"),
        "work_threads" => ElementPart::Value("work-threads"),
        "grace" => ElementPart::Value("grace"),
        _ => ElementPart::Value("name"),
    }
}

/// Takes what is wrong out of a component. False: nothing in it is, so its type is wrong.
fn without(component: &mut ComponentDescription, part: &ElementPart) -> bool {
    let before = component.clone();
    match part {
        ElementPart::Value("queue") => component.queue = None,
        ElementPart::Value("rate") => component.rate_hz = None,
        ElementPart::Value("max-block") => component.max_block = None,
        ElementPart::Value("max-wait") => component.max_wait = None,
        ElementPart::Value("max-delay") => component.max_delay = None,
        ElementPart::Value("ready-within") => component.ready_within = None,
        ElementPart::Value("shutdown-within") => component.shutdown_within = None,
        ElementPart::Child { element: "liveness", .. } => component.liveness = None,
        ElementPart::Child { element: "param", key: (_, key), .. } => {
            component.parameters.retain(|(name, _)| name != key);
        }
        ElementPart::Child { element: "field", key: (_, field), .. } => {
            for (_, settings) in &mut component.actuators {
                settings.safe.retain(|(name, _)| name != field);
            }
        }
        ElementPart::Child { element: "actuator", key: (_, port), .. } => {
            component.actuators.retain(|(name, _)| name != port && !port.is_empty());
        }
        _ => {}
    }
    *component != before
}

fn key_of(error: &ParameterError) -> &str {
    match error {
        ParameterError::Unknown { key, .. } | ParameterError::Type { key, .. } => key,
        ParameterError::Unit { key, .. }
        | ParameterError::Range { key, .. }
        | ParameterError::Default { key, .. } => key,
        _ => "",
    }
}
