//! Checks every tree of the files, whether it is used or not.

use super::problem::Problem;
use super::source::{Attribute, Element, Named, Place, Sources, nearest};
use super::{AFTER, BEFORE, Definitions, NodeType, is_port, key_of};
use crate::blackboard::Blackboard;
use crate::factory::Factory;
use crate::model::{BUILTINS, Category, Kind, Port, PortDirection};
use crate::script;
use crate::status::Status;
use crate::value::{PortValue, Value};
use std::collections::BTreeMap;

/// Checks the files, and sorts what they hold.
pub(super) fn check(factory: &Factory, sources: &mut Sources) -> Definitions {
    let elements = std::mem::take(&mut sources.elements);
    let mut checker = Checker { factory, sources, definitions: Definitions::default() };
    let count = elements.len();
    for element in elements {
        match element.name.as_str() {
            "BehaviorTree" => checker.define(element, count),
            "TreeNodesModel" => checker.models(&element),
            name => {
                let known = ["BehaviorTree", "TreeNodesModel", "include"];
                let problem = Problem::Element(name.to_owned());
                checker.sources.misspelt(element.place, problem, name, known);
            }
        }
    }
    let trees = std::mem::take(&mut checker.definitions.trees);
    let names: Vec<&str> = trees.keys().map(String::as_str).collect();
    for root in trees.values().flatten() {
        checker.node(root, &names);
    }
    checker.circles(&trees);
    checker.definitions.trees = trees;
    checker.definitions
}

struct Checker<'a> {
    factory: &'a Factory,
    sources: &'a mut Sources,
    definitions: Definitions,
}

impl Checker<'_> {
    /// Takes a tree; it needs a name where the file has anything else.
    fn define(&mut self, mut element: Element, count: usize) {
        let place = element.place;
        let name = match element.attribute("ID") {
            Some(id) => {
                let (name, place) = (id.value.clone(), id.value_place);
                if !may_be_name(&name) {
                    self.sources.error(place, Problem::Name(name.clone()));
                } else if NodeType::of_name(self.factory, &name).is_some()
                    || self.definitions.trees.contains_key(&name)
                {
                    self.sources.error(place, Problem::Taken(name.clone()));
                }
                name
            }
            None => {
                if count > 1 {
                    let element = element.name.clone();
                    let problem = Problem::Attribute { element, attribute: "ID" };
                    self.sources.error(place, problem);
                }
                format!("BehaviorTree_{}", self.definitions.trees.len())
            }
        };
        let found = element.children.len();
        if found != 1 {
            let (node, expected) = ("BehaviorTree".into(), "1".into());
            self.sources.error(place, Problem::Children { node, found, expected });
        }
        let root = if found == 1 { element.children.pop() } else { None };
        self.definitions.trees.insert(name, root);
    }

    /// Takes the ports of subtrees, and compares the other nodes with those of the program.
    fn models(&mut self, models: &Element) {
        for model in &models.children {
            let Some(id) = model.attribute("ID") else {
                let element = model.name.clone();
                let problem = Problem::Attribute { element, attribute: "ID" };
                self.sources.error(model.place, problem);
                continue;
            };
            if model.name != "SubTree" {
                self.compare_model(model, id);
                continue;
            }
            let ports = self.definitions.models.entry(id.value.clone()).or_default();
            for port in model.children.iter().filter(|child| direction(&child.name).is_some()) {
                match port.value("name") {
                    Some(name) => {
                        ports.insert(name.to_owned(), port.value("default").map(str::to_owned));
                    }
                    None => {
                        let element = port.name.clone();
                        let problem = Problem::Attribute { element, attribute: "name" };
                        self.sources.error(port.place, problem);
                    }
                }
            }
        }
    }

    /// A node that the program does not have is an editor's matter until a tree uses it.
    fn compare_model(&mut self, model: &Element, id: &Attribute) {
        let categories = ["Action", "Condition", "Control", "Decorator", "SubTree"];
        let Some(category) = Category::from_name(&model.name) else {
            let problem = Problem::Element(model.name.clone());
            return self.sources.misspelt(model.place, problem, &model.name, categories);
        };
        let Some(known) = NodeType::of_name(self.factory, &id.value) else { return };
        if known.kind().category() != category {
            let known = format!("of the category {}", known.kind().category().name());
            let problem = Problem::Model { node: id.value.clone(), known };
            self.sources.error(id.value_place, problem);
        }
        for port in &model.children {
            let (Some(way), Some(name)) = (direction(&port.name), port.attribute("name")) else {
                continue;
            };
            match known.ports().iter().find(|known| known.name == name.value) {
                None => self.unknown_port(&known, name.value_place, &name.value),
                Some(known) if known.direction != way => {
                    let known = Problem::direction(known.direction);
                    let problem = Problem::Model { node: name.value.clone(), known };
                    self.sources.error(port.place, problem);
                }
                Some(_) => {}
            }
        }
    }

    fn unknown_port(&mut self, node: &NodeType<'_>, place: Place, port: &str) {
        let problem = Problem::UnknownPort { node: node.name().into(), port: port.into() };
        let known: Vec<&str> = node.ports().iter().map(|port| port.name).collect();
        self.sources.misspelt(place, problem, port, known);
    }

    /// Checks a node and those below it.
    fn node(&mut self, element: &Element, trees: &[&str]) {
        for child in &element.children {
            self.node(child, trees);
        }
        let explicit = Category::from_name(&element.name).is_some();
        if (explicit || element.name == "SubTree") && element.attribute("ID").is_none() {
            let problem = Problem::Attribute { element: element.name.clone(), attribute: "ID" };
            return self.sources.error(element.place, problem);
        }
        for attribute in &element.attributes {
            self.condition(attribute);
        }
        let Some(node) = NodeType::of_element(self.factory, element) else {
            return self.unknown_node(element, explicit, trees);
        };
        let kind = node.kind();
        // In a file a subtree is a leaf.
        let expected = if kind == Kind::SubTree { 0..=0 } else { kind.children() };
        let found = element.children.len();
        if !expected.contains(&found) {
            let expected = match (*expected.start(), *expected.end()) {
                (least, usize::MAX) => format!("at least {least}"),
                (least, most) if least == most => least.to_string(),
                (least, most) => format!("{least} to {most}"),
            };
            let problem = Problem::Children { node: node.name().into(), found, expected };
            self.sources.error(element.place, problem);
        }
        if kind == Kind::SubTree {
            return self.subtree(element, trees);
        }
        if !explicit && let Some(id) = element.attribute("ID") {
            self.sources.error(id.place, Problem::CompactId(element.name.clone()));
        }
        let is_async = |child: &&Element| child.name == "AsyncSequence";
        if kind == Kind::ReactiveSequence && element.children.iter().filter(is_async).count() > 1 {
            self.sources.error(element.place, Problem::AsyncChildren);
        }
        self.ports(element, &node);
    }

    fn unknown_node(&mut self, element: &Element, explicit: bool, trees: &[&str]) {
        let (name, place) = match element.attribute("ID") {
            Some(id) if explicit => (id.value.as_str(), id.value_place),
            _ => (element.name.as_str(), element.place),
        };
        let builtins = BUILTINS.iter().map(|known| known.name);
        let leaves = self.factory.leaves.keys().map(String::as_str);
        let known: Vec<&str> = builtins.chain(leaves).collect();
        let problem = Problem::UnknownNode(name.to_owned());
        // A tree is not used by its name alone.
        if trees.contains(&name) {
            let right = format!("<SubTree ID=\"{name}\"/>");
            return self.sources.misspelt(place, problem, &right, [right.as_str()]);
        }
        self.sources.misspelt(place, problem, name, known);
    }

    fn subtree(&mut self, element: &Element, trees: &[&str]) {
        let Some(id) = element.attribute("ID") else { return };
        if !trees.contains(&id.value.as_str()) {
            let problem = Problem::UnknownTree(id.value.clone());
            let known = trees.iter().copied();
            self.sources.misspelt(id.value_place, problem, &id.value, known);
        }
        let autoremap = element.attribute("_autoremap");
        let all = autoremap.map(|value| bool::from_value(&Value::text(value.value.as_str())));
        if let (Some(autoremap), Some(None)) = (autoremap, all) {
            let (value, kind) = (autoremap.value.clone(), bool::TYPE.name());
            self.sources.error(autoremap.value_place, Problem::Value { value, kind });
        }
        for port in element.attributes.iter().filter(|attribute| is_port(attribute)) {
            if let Some(key) = key_of(&port.name, &port.value) {
                self.key(port, key);
            }
        }
        let Some(model) = self.definitions.models.get(&id.value) else { return };
        let missing = model.iter().find(|(port, default)| {
            default.is_none() && element.attribute(port).is_none() && all != Some(Some(true))
        });
        if let Some((port, _)) = missing {
            let problem = Problem::MissingPort { node: id.value.clone(), port: port.clone() };
            self.sources.error(element.place, problem);
        }
    }

    fn ports(&mut self, element: &Element, node: &NodeType<'_>) {
        for attribute in element.attributes.iter().filter(|attribute| is_port(attribute)) {
            match node.ports().iter().find(|port| port.name == attribute.name) {
                None => self.unknown_port(node, attribute.place, &attribute.name),
                Some(port) => self.port(element, node, port, attribute),
            }
        }
        for port in node.ports() {
            let needed = port.reads() && port.default.is_none() && !port.optional;
            if needed && element.attribute(port.name).is_none() {
                let (node, port) = (node.name().into(), port.name.into());
                self.sources.error(element.place, Problem::MissingPort { node, port });
            }
        }
    }

    fn port(&mut self, element: &Element, node: &NodeType<'_>, port: &Port, attribute: &Attribute) {
        let (place, text) = (attribute.value_place, &attribute.value);
        if node.is_script(port) {
            if key_of("", text).is_some() {
                self.sources.error(place, Problem::ScriptInEntry);
            } else if !(text.is_empty() && node.kind() == Kind::Script) {
                self.script(attribute);
            }
            return;
        }
        if let Some(key) = key_of(&attribute.name, text) {
            return self.key(attribute, key);
        }
        if node.is_name(port) {
            return self.key(attribute, text);
        }
        if port.direction == PortDirection::Output {
            return self.sources.error(place, Problem::NotAKey(port.name.into()));
        }
        let value = Value::text(text.as_str());
        let idle = port.kind == Status::TYPE && *text == "IDLE";
        let Some(value) = port.kind.admit(&value).filter(|_| !idle) else {
            let (value, kind) = (text.clone(), port.kind.name());
            return self.sources.error(place, Problem::Value { value, kind });
        };
        if let (Kind::Parallel | Kind::ParallelAll, Value::Int(threshold)) = (node.kind(), value) {
            let children = element.children.len();
            if threshold > 0 && threshold as usize > children {
                self.sources.error(place, Problem::Threshold { threshold, children });
            }
        }
    }

    /// Checks the name of an entry.
    fn key(&mut self, attribute: &Attribute, key: &str) {
        let name = key.strip_prefix('@').unwrap_or(key);
        if name.is_empty() || name.contains(['@', '{', '}']) {
            self.sources.error(attribute.value_place, Problem::Key(key.to_owned()));
        }
    }

    /// Checks an attribute whose name begins with `_`: a script, or something for an editor.
    fn condition(&mut self, attribute: &Attribute) {
        let known = || BEFORE.into_iter().chain(AFTER);
        if known().any(|known| known == attribute.name) {
            self.script(attribute);
        } else if attribute.name.starts_with('_')
            && attribute.name != "_autoremap"
            && nearest(&attribute.name, known()).is_some()
        {
            let problem = Problem::UnknownCondition(attribute.name.clone());
            self.sources.misspelt(attribute.place, problem, &attribute.name, known());
        }
    }

    fn script(&mut self, attribute: &Attribute) {
        // Only the grammar is looked at: which entries the keys are is the builder's matter.
        let mut board = Blackboard::default();
        let root = board.add(None, BTreeMap::new(), false);
        let parsed =
            script::parse(&attribute.value, &self.factory.enums, &mut |key| board.key(root, key));
        if let Err(error) = parsed {
            let place = self.sources.within(attribute, error.at);
            self.sources.error(place, Problem::Script(error.what.into_owned()));
        }
    }

    /// Reports each tree that contains itself, once for each circle.
    fn circles(&mut self, trees: &Named<Option<Element>>) {
        let mut done = Vec::new();
        for (name, tree) in trees {
            if let Some(root) = tree {
                self.follow(trees, root, &mut vec![name], &mut done);
            }
            done.push(name);
        }
    }

    fn follow<'a>(
        &mut self,
        trees: &'a Named<Option<Element>>,
        element: &'a Element,
        path: &mut Vec<&'a str>,
        done: &mut Vec<&'a String>,
    ) {
        for child in &element.children {
            self.follow(trees, child, path, done);
        }
        let (true, Some(id)) = (element.name == "SubTree", element.attribute("ID")) else {
            return;
        };
        if let Some(first) = path.iter().position(|name| *name == id.value) {
            let mut circle: Vec<String> = path[first..].iter().map(|&name| name.into()).collect();
            circle.push(id.value.clone());
            return self.sources.error(id.value_place, Problem::Circle(circle));
        }
        let Some((name, tree)) = trees.get_key_value(&id.value) else { return };
        if done.contains(&name) || path.len() > super::source::MAX_DEPTH {
            return;
        }
        if let Some(root) = tree {
            path.push(name);
            self.follow(trees, root, path, done);
            path.pop();
        }
        done.push(name);
    }
}

/// Which way the port of a model goes, by the name of its element.
fn direction(element: &str) -> Option<PortDirection> {
    match element {
        "input_port" => Some(PortDirection::Input),
        "output_port" => Some(PortDirection::Output),
        "inout_port" => Some(PortDirection::InOut),
        _ => None,
    }
}

/// Whether nodes and trees may have this name.
pub(crate) fn may_be_name(name: &str) -> bool {
    let forbidden = |c: char| c.is_control() || " <>&\"'/\\:*?|.".contains(c);
    !name.is_empty() && !name.eq_ignore_ascii_case("root") && !name.contains(forbidden)
}
