//! Builds a tree from its checked definition.

use super::problem::Problem;
use super::source::{Attribute, Element, MAX_DEPTH, Named, Sources};
use super::{AFTER, BEFORE, Definitions, NodeType, is_port, key_of};
use crate::blackboard::BoardId;
use crate::factory::Factory;
use crate::model::Kind;
use crate::script;
use crate::status::Status;
use crate::tree::{
    Binding, Code, Hooks, Label, LeafState, LoopQueue, NodeMemory, Tree, TreeNode, TreeNodeId,
};
use crate::value::{PortValue, Value};
use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

/// Trees can contain each other so that each level doubles the nodes. The library, which numbers
/// nodes in 16 bits, has no larger trees.
const MAX_NODES: usize = 65_535;

/// Builds the main tree.
pub(super) fn build(
    factory: &Factory,
    sources: &mut Sources,
    definitions: &Definitions,
    main: &str,
) -> Tree {
    let mut tree = Tree::default();
    tree.enums = factory.enums.clone();
    let mut builder = Builder { factory, sources, definitions, tree, paths: BTreeSet::new() };
    let board = builder.tree.board.add(None, Named::new(), false);
    if let Some(Some(root)) = builder.definitions.trees.get(main) {
        builder.node(root, board, "", 0);
    }
    builder.tree.reserve();
    builder.tree
}

struct Builder<'a> {
    factory: &'a Factory,
    sources: &'a mut Sources,
    definitions: &'a Definitions,
    tree: Tree,
    paths: BTreeSet<String>,
}

impl<'a> Builder<'a> {
    /// Adds a node and those below it. The path of a node begins with `prefix`.
    fn node(
        &mut self,
        element: &'a Element,
        board: BoardId,
        prefix: &str,
        depth: u32,
    ) -> Option<TreeNodeId> {
        let node = NodeType::of_element(self.factory, element)?;
        if self.tree.nodes.len() >= MAX_NODES {
            self.limit(element, "65,535 nodes");
            return None;
        }
        if depth as usize >= MAX_DEPTH {
            self.limit(element, "256 nodes that are nested");
            return None;
        }
        if self.tree.board.is_full() {
            self.limit(element, "65,536 keys");
            return None;
        }
        let id = TreeNodeId(self.tree.nodes.len() as u32);
        let kind = node.kind();
        let type_name = match kind {
            Kind::SubTree => element.value("ID").unwrap_or_default(),
            _ => node.name(),
        };
        let path = self.path(element, prefix, type_name, id);
        let part = self.part(element, &node, board, id);
        let first_binding = self.tree.bindings.len() as u32;
        self.bindings(element, &node, board);
        let hooks = self.hooks(element, board);
        self.tree.nodes.push(TreeNode {
            kind,
            status: Status::Idle,
            answer: Status::Idle,
            done: false,
            first_child: 0,
            child_count: 0,
            first_binding,
            board,
            hooks,
            part,
            memory: NodeMemory::default(),
        });
        let label = Label { path: path.clone(), type_name: type_name.to_owned(), depth };
        self.tree.labels.push(label);
        let mut children = Vec::new();
        if kind == Kind::SubTree {
            let inner = self.inner_board(element, board);
            let root = self.definitions.trees.get(type_name).and_then(Option::as_ref);
            let prefix = format!("{path}/");
            children.extend(root.and_then(|root| self.node(root, inner, &prefix, depth + 1)));
        } else {
            for child in &element.children {
                children.extend(self.node(child, board, prefix, depth + 1));
            }
        }
        let added = &mut self.tree.nodes[id.0 as usize];
        added.first_child = self.tree.children.len() as u32;
        added.child_count = children.len() as u32;
        self.tree.children.extend(children);
        Some(id)
    }

    fn limit(&mut self, element: &Element, limit: &'static str) {
        // Once is enough: the nodes that follow are beyond it too.
        if self.sources.errors.is_empty() {
            self.sources.error(element.place, Problem::Limit(limit));
        }
    }

    /// `prefix/name`, or `prefix/Type::number` where the node has no name of its own.
    fn path(&mut self, element: &Element, prefix: &str, type_name: &str, id: TreeNodeId) -> String {
        // The library counts from 1.
        let number = id.0 + 1;
        let name = element.value("name").unwrap_or(type_name);
        let mut path = format!("{prefix}{name}");
        let is_tree = element.name == "SubTree";
        if name == type_name && !(is_tree && element.attribute("name").is_some()) {
            path = format!("{path}::{number}");
        }
        if !self.paths.insert(path.clone()) {
            if is_tree {
                self.sources.error(element.place, Problem::Path(path.clone()));
            }
            path = format!("{path}::{number}");
            self.paths.insert(path.clone());
        }
        path
    }

    /// What of a node lies in a list of its own.
    fn part(
        &mut self,
        element: &Element,
        node: &NodeType<'_>,
        board: BoardId,
        id: TreeNodeId,
    ) -> u32 {
        let index = match (node, node.kind()) {
            (NodeType::Leaf(model), _) => {
                self.tree.leaves.push(LeafState {
                    node: id,
                    model: (*model).clone(),
                    body: None,
                    answer: None,
                    starts: 0,
                    since: Duration::ZERO,
                    deferred: false,
                });
                self.tree.leaves.len()
            }
            (_, Kind::Loop) => {
                let element = node.ports()[2].kind;
                self.tree.loops.push(LoopQueue { element, queue: VecDeque::new(), loaded: false });
                self.tree.loops.len()
            }
            (_, Kind::Script | Kind::ScriptCondition | Kind::Precondition) => {
                let code = element.attribute(node.ports()[0].name);
                let code = code.map(|code| self.code(code, board));
                self.tree.codes.extend(code);
                self.tree.codes.len()
            }
            _ => return 0,
        };
        index as u32 - 1
    }

    fn code(&mut self, attribute: &Attribute, board: BoardId) -> Code {
        let Tree { board: keys, enums, .. } = &mut self.tree;
        let script = script::parse(&attribute.value, enums, &mut |key| keys.key(board, key)).ok();
        Code { text: attribute.value.clone(), script }
    }

    fn hooks(&mut self, element: &Element, board: BoardId) -> Option<u32> {
        let mut code = |name| element.attribute(name).map(|code| self.code(code, board));
        let hooks = Hooks { before: BEFORE.map(&mut code), after: AFTER.map(&mut code) };
        if hooks.before.iter().chain(&hooks.after).all(Option::is_none) {
            return None;
        }
        self.tree.hooks.push(hooks);
        Some(self.tree.hooks.len() as u32 - 1)
    }

    /// Connects the ports of a node, and declares the entries that they use.
    fn bindings(&mut self, element: &Element, node: &NodeType<'_>, board: BoardId) {
        for port in node.ports() {
            let attribute = element.attribute(port.name);
            let text = attribute.map(|attribute| attribute.value.as_str()).or(port.default);
            let key = text.and_then(|text| key_of(port.name, text));
            let binding = match (text, key) {
                _ if node.is_script(port) => Binding::Missing,
                (None, _) => Binding::Missing,
                (Some(_), Some(key)) => {
                    let id = self.tree.board.key(board, key);
                    if let (Err(known), Some(attribute)) =
                        (self.tree.board.declare(id, port.kind), attribute)
                    {
                        let (key, known) = (key.to_owned(), known.name());
                        let kind = port.kind.name();
                        let problem = Problem::EntryType { key, known, kind };
                        self.sources.error(attribute.value_place, problem);
                    }
                    Binding::Key(id)
                }
                (Some(text), None) if node.is_name(port) => {
                    let key = self.tree.board.key(board, text);
                    match node.kind() {
                        Kind::SetBlackboard | Kind::UnsetBlackboard => Binding::Entry(key),
                        _ => Binding::Key(key),
                    }
                }
                (Some(text), None) => {
                    let value = port.kind.admit(&Value::text(text));
                    value.map_or(Binding::Missing, Binding::Literal)
                }
            };
            self.tree.bindings.push(binding);
        }
    }

    /// The board of a subtree: which keys are the parent's, and what is written into it at once.
    fn inner_board(&mut self, element: &Element, outer: BoardId) -> BoardId {
        let given = element.attributes.iter().filter(|attribute| is_port(attribute));
        let mut ports: Named<&str> =
            given.map(|attribute| (attribute.name.clone(), attribute.value.as_str())).collect();
        let autoremap = element.value("_autoremap");
        let autoremap = autoremap.and_then(|text| bool::from_value(&Value::text(text)));
        let autoremap = autoremap.unwrap_or(false);
        let model = element.value("ID").and_then(|id| self.definitions.models.get(id));
        for (port, default) in model.into_iter().flatten() {
            if let (Some(default), false) = (default, autoremap) {
                ports.entry(port.clone()).or_insert(default);
            }
        }
        let mut literals = Vec::new();
        let mut remaps = Named::new();
        for (port, text) in ports {
            match key_of(&port, text).map(str::to_owned) {
                Some(key) if text != "=" => {
                    remaps.insert(port, key);
                }
                _ => literals.push((port, literal(text))),
            }
        }
        let board = self.tree.board.add(Some(outer), remaps, autoremap);
        for (port, value) in literals {
            let key = self.tree.board.own_key(board, &port);
            // The entry is new, and has no type that could refuse the value.
            let _ = self.tree.board.assign(key, value);
        }
        board
    }
}

/// A literal that a subtree is given: a number where the whole text is one.
fn literal(text: &str) -> Value {
    let value = Value::text(text);
    let int = value.as_int().map(Value::Int);
    let real = || value.as_real().map(Value::Real);
    int.or_else(real).unwrap_or(value.clone())
}
