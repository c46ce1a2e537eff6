//! The contents of a tree's files: trees, and models of nodes.

use super::NodeType;
use super::source::{Attribute, Element, MAX_DEPTH, Named, Place, Sources};
use crate::factory::Factory;
use crate::model::may_be_name;
use std::collections::BTreeSet;

/// The trees by their names, and the models of subtrees.
#[derive(Default)]
pub(super) struct Definitions {
    /// Their outermost nodes.
    pub(super) trees: Named<Option<Element>>,
    /// The ports of subtrees, with their defaults, from `TreeNodesModel`.
    pub(super) models: Named<Named<Option<String>>>,
}

impl Definitions {
    /// The outermost node of the tree that is named at this place.
    pub(super) fn tree(&self, sources: &mut Sources, name: &str, place: Place) -> Option<&Element> {
        if !self.trees.contains_key(name) {
            let known = self.trees.keys().map(String::as_str);
            sources.misspelt(place, format!("no tree is called `{name}`"), name, known);
        }
        self.trees.get(name)?.as_ref()
    }

    /// Sorts the contents of the files.
    pub(super) fn of(factory: &Factory, sources: &mut Sources) -> Definitions {
        let mut definitions = Definitions::default();
        let elements = std::mem::take(&mut sources.elements);
        let count = elements.len();
        for element in elements {
            match element.name.as_str() {
                "BehaviorTree" => definitions.define(factory, sources, element, count),
                "TreeNodesModel" => definitions.model(factory, sources, &element),
                _ => sources.meaningless(&element, &["BehaviorTree", "TreeNodesModel", "include"]),
            }
        }
        let mut done = BTreeSet::new();
        for name in definitions.trees.keys() {
            definitions.circles(sources, name, &mut Vec::new(), &mut done);
        }
        definitions
    }

    /// Takes a tree; it needs a name where the file has anything else.
    fn define(
        &mut self,
        factory: &Factory,
        sources: &mut Sources,
        mut element: Element,
        count: usize,
    ) {
        let place = element.place;
        let named = count > 1 || element.attribute("ID").is_some();
        let id = if named { sources.needed(&element, "ID") } else { None };
        let name = id.map_or("BehaviorTree_0", |id| &id.value).to_owned();
        if let Some(id) = id {
            if !may_be_name(&name) {
                sources.error(id.value_place, format!("`{name}` cannot be the name of a tree"));
            } else if NodeType::of_name(factory, &name).is_some() || self.trees.contains_key(&name)
            {
                sources.error(id.value_place, format!("the name `{name}` is taken"));
            }
        }
        let found = element.children.len();
        if found != 1 {
            sources.error(place, format!("`BehaviorTree` has {found} children instead of 1"));
        }
        let root = if found == 1 { element.children.pop() } else { None };
        self.trees.insert(name, root);
    }

    /// Takes the ports of subtrees, and compares those of other nodes with the program's. A node
    /// that the program does not have is an editor's matter until a tree uses it.
    fn model(&mut self, factory: &Factory, sources: &mut Sources, models: &Element) {
        for model in &models.children {
            let Some(id) = sources.needed(model, "ID") else { continue };
            let known = NodeType::of_name(factory, &id.value);
            let mut ports = Named::new();
            for port in model.children.iter().filter(|child| child.name.ends_with("_port")) {
                let Some(name) = sources.needed(port, "name") else { continue };
                ports.insert(name.value.clone(), port.value("default").map(str::to_owned));
                if let Some(known) = &known
                    && known.ports.iter().all(|known| known.name != name.value)
                {
                    sources.unknown_port(known, name.value_place, &name.value);
                }
            }
            if model.name == "SubTree" {
                self.models.insert(id.value.clone(), ports);
            }
        }
    }

    /// Reports each tree that contains itself, once for each circle: follows the subtrees of each
    /// tree once.
    fn circles<'a>(
        &'a self,
        sources: &mut Sources,
        name: &'a str,
        path: &mut Vec<&'a str>,
        done: &mut BTreeSet<&'a str>,
    ) {
        // Deeper trees are refused when they are built.
        if path.len() >= MAX_DEPTH || !done.insert(name) {
            return;
        }
        path.push(name);
        let mut found = Vec::new();
        let root = self.trees.get(name).into_iter().flatten();
        root.for_each(|root| collect_subtrees(root, &mut found));
        for id in found {
            match path.iter().position(|known| *known == id.value) {
                Some(first) => {
                    let circle = [&path[first..], &[&id.value]].concat().join(" -> ");
                    sources.error(id.value_place, format!("a circle: {circle}"));
                }
                None => self.circles(sources, &id.value, path, done),
            }
        }
        path.pop();
    }
}

/// The names of the subtrees at or below an element.
fn collect_subtrees<'a>(element: &'a Element, found: &mut Vec<&'a Attribute>) {
    if element.name == "SubTree" {
        found.extend(element.attribute("ID"));
    }
    element.children.iter().for_each(|child| collect_subtrees(child, found));
}
