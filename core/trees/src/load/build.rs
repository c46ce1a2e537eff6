//! Builds a tree from its definition, and checks the definition on the way.

use super::definitions::Definitions;
use super::source::{Attribute, Element, MAX_DEPTH, Named, Place, Sources, nearest};
use super::{CONDITIONS, EXPLICIT, NodeType};
use crate::blackboard::{BoardId, KeyId};
use crate::factory::Factory;
use crate::model::{BUILTINS, Kind, Port, PortDirection, PortRole, is_port, key_of};
use crate::script;
use crate::status::Status;
use crate::tree::{
    BoundPort, Code, LeafState, LoopQueue, NodeLabel, PortBinding, Tree, TreeNode, TreeNodeId,
};
use crate::value::{PortValue, Value};
use std::collections::{BTreeSet, VecDeque};

/// Trees can contain each other so that each level doubles the nodes. The library, which numbers
/// nodes in 16 bits, has no larger trees.
const MAX_NODES: usize = 65_535;
/// All paths and attributes of the largest tree, 256 bytes for each node.
const MAX_BYTES: usize = 16 << 20;

/// Builds the tree of this outermost node, with its subtrees or, to check it, without.
pub(super) fn build(
    factory: &Factory,
    sources: &mut Sources,
    definitions: &Definitions,
    root: &Element,
    with_subtrees: bool,
) -> Tree {
    let (tree, paths, bytes) = (Tree::default(), BTreeSet::new(), 0);
    let mut builder = Builder { factory, sources, definitions, with_subtrees, tree, paths, bytes };
    let board = builder.tree.board.add(None, Named::new(), false);
    builder.node(root, Scope { board, prefix: "", depth: 0 });
    builder.tree.reserve();
    builder.tree
}

struct Builder<'a> {
    factory: &'a Factory,
    sources: &'a mut Sources,
    definitions: &'a Definitions,
    with_subtrees: bool,
    tree: Tree,
    paths: BTreeSet<String>,
    /// The length of all paths and attributes.
    bytes: usize,
}

/// The surroundings of a node.
#[derive(Clone, Copy)]
struct Scope<'a> {
    board: BoardId,
    /// The beginning of its path.
    prefix: &'a str,
    depth: u32,
}

impl<'a> Builder<'a> {
    /// Adds a node and those below it.
    fn node(&mut self, element: &'a Element, at: Scope<'_>) -> Option<TreeNodeId> {
        let limits = [
            ("65,535 nodes", self.tree.nodes.len() >= MAX_NODES),
            ("256 nodes that are nested", at.depth as usize >= MAX_DEPTH),
            ("65,536 keys", self.tree.board.is_full()),
            ("16 MiB in paths and attributes", self.bytes > MAX_BYTES),
        ];
        if let Some((limit, _)) = limits.into_iter().find(|(_, reached)| *reached) {
            // Once is enough: the nodes that follow are beyond it too.
            if self.sources.errors.is_empty() {
                self.sources.error(element.place, format!("more than {limit}"));
            }
            return None;
        }
        let Scope { board, prefix, depth } = at;
        let below = Scope { depth: depth + 1, ..at };
        let Some(node) = self.node_type(element) else {
            for child in &element.children {
                self.node(child, below);
            }
            return None;
        };
        self.check_children(element, &node);
        let id = TreeNodeId(self.tree.nodes.len() as u32);
        let kind = node.kind;
        let is_subtree = kind == Kind::SubTree;
        let type_name = if is_subtree { element.value("ID")? } else { node.name };
        let path = self.path(element, prefix, type_name, id);
        let texts = element.attributes.iter().map(|given| given.name.len() + given.value.len());
        self.bytes += path.len() + texts.sum::<usize>();
        let part = self.part(element, &node, board, id);
        let first_binding = self.tree.bindings.len() as u32;
        if !is_subtree {
            self.bindings(element, &node, board);
        }
        let hooks = self.hooks(element, board);
        self.tree.nodes.push(TreeNode {
            kind,
            first_binding,
            board,
            hooks,
            part,
            label: NodeLabel { path: path.clone(), type_name: type_name.to_owned(), depth },
            ..TreeNode::default()
        });
        let mut children = Vec::new();
        if let Some(id) = element.attribute("ID").filter(|_| is_subtree) {
            let inner = self.inner_board(element, id, board);
            let root = self.definitions.tree(self.sources, &id.value, id.value_place);
            if let (Some(root), true) = (root, self.with_subtrees) {
                let prefix = &format!("{path}/");
                children.extend(self.node(root, Scope { board: inner, prefix, ..below }));
            }
        }
        for child in &element.children {
            children.extend(self.node(child, below));
        }
        let added = &mut self.tree.nodes[id.0 as usize];
        added.first_child = self.tree.children.len() as u32;
        added.child_count = children.len() as u32;
        self.tree.children.extend(children);
        Some(id)
    }

    /// The type of a node, unless there is none.
    fn node_type(&mut self, element: &Element) -> Option<NodeType<'a>> {
        let explicit = EXPLICIT.contains(&element.name.as_str());
        let mut named = (element.name.as_str(), element.place);
        if explicit || element.name == "SubTree" {
            let id = self.sources.needed(element, "ID")?;
            if explicit {
                named = (&id.value, id.value_place);
            }
        }
        let node = NodeType::of_name(self.factory, named.0);
        match (&node, element.attribute("ID")) {
            (Some(node), Some(id)) if !explicit && node.kind != Kind::SubTree => {
                self.sources.unknown_port(node, id.place, "ID");
            }
            (Some(_), _) => {}
            (None, _) => self.unknown_node(named.0, named.1),
        }
        node
    }

    fn unknown_node(&mut self, name: &str, place: Place) {
        // A tree is not used by its name alone.
        let subtree = format!("<SubTree ID=\"{name}\"/>");
        let is_tree = self.definitions.trees.contains_key(name);
        let wrong = if is_tree { &subtree } else { name };
        let leaves = self.factory.leaves.keys().map(String::as_str);
        let known = BUILTINS.iter().map(|known| known.0).chain(leaves);
        let known = known.chain(is_tree.then_some(subtree.as_str()));
        let problem = format!("no type of node is called `{name}`");
        self.sources.misspelt(place, problem, wrong, known);
    }

    fn check_children(&mut self, element: &Element, node: &NodeType<'_>) {
        // In a file a subtree is a leaf.
        let expected = if node.kind == Kind::SubTree { 0..=0 } else { node.kind.children() };
        let found = element.children.len();
        if !expected.contains(&found) {
            let expected = match (*expected.start(), *expected.end()) {
                (least, usize::MAX) => format!("at least {least}"),
                (least, most) if least == most => least.to_string(),
                (least, most) => format!("{least} to {most}"),
            };
            let problem = format!("`{}` has {found} children instead of {expected}", node.name);
            self.sources.error(element.place, problem);
        }
        let is_async = |child: &&Element| child.name == "AsyncSequence";
        if node.kind == (Kind::Reactive { go: Status::Success })
            && element.children.iter().filter(is_async).count() > 1
        {
            let problem = "a ReactiveSequence has at most one AsyncSequence as its child";
            self.sources.error(element.place, problem);
        }
    }

    /// `prefix/name`, or `prefix/Type::number` where the node has no name of its own.
    fn path(&mut self, element: &Element, prefix: &str, type_name: &str, id: TreeNodeId) -> String {
        // The library counts from 1.
        let number = id.0 + 1;
        let name = element.value("name");
        let is_tree = element.name == "SubTree";
        let mut path = format!("{prefix}{}", name.unwrap_or(type_name));
        if name.is_none() || !is_tree && name == Some(type_name) {
            path = format!("{path}::{number}");
        }
        if !self.paths.insert(path.clone()) {
            if is_tree {
                self.sources.error(element.place, format!("the name `{path}` is taken"));
            }
            path = format!("{path}::{number}");
            self.paths.insert(path.clone());
        }
        path
    }

    /// Adds the part of a node that lies in a list of its own; its index there.
    fn part(
        &mut self,
        element: &Element,
        node: &NodeType<'_>,
        board: BoardId,
        id: TreeNodeId,
    ) -> u32 {
        let index = match (node.leaf, node.kind) {
            (Some(model), _) => {
                self.tree.leaves.push(LeafState::new(id, model.clone()));
                self.tree.leaves.len()
            }
            (_, Kind::Loop) => {
                let element = node.ports[2].kind;
                self.tree.loops.push(LoopQueue { element, queue: VecDeque::new(), loaded: false });
                self.tree.loops.len()
            }
            (_, Kind::Script | Kind::ScriptCondition | Kind::Precondition) => {
                let code = element.attribute(node.ports[0].name);
                let may_be_empty = node.kind == Kind::Script;
                return code.map_or(0, |code| self.code(code, board, may_be_empty));
            }
            _ => return 0,
        };
        index as u32 - 1
    }

    /// Adds the script of this attribute.
    fn code(&mut self, attribute: &Attribute, board: BoardId, may_be_empty: bool) -> u32 {
        let text = &attribute.value;
        let Tree { board: keys, codes, .. } = &mut self.tree;
        let script = script::parse(text, &mut |key| keys.key(board, key));
        let script = script.unwrap_or_else(|error| {
            let in_entry = key_of("", text).is_some();
            if in_entry || !(text.is_empty() && may_be_empty) {
                let place = self.sources.within(attribute, error.at);
                let what =
                    if in_entry { "a script is not taken from an entry" } else { &error.what };
                self.sources.error(place, what);
            }
            script::Script::default()
        });
        codes.push(Code { text: text.clone(), script });
        codes.len() as u32 - 1
    }

    /// The conditions of a node.
    fn hooks(&mut self, element: &Element, board: BoardId) -> Option<Box<[Option<u32>; 8]>> {
        let mut hooks = [None; CONDITIONS.len()];
        for attribute in &element.attributes {
            let name = attribute.name.as_str();
            if let Some(index) = CONDITIONS.iter().position(|known| *known == name) {
                hooks[index] = Some(self.code(attribute, board, false));
            } else if name.starts_with('_') && nearest(name, CONDITIONS).is_some() {
                let problem = format!("`{name}` is no condition of a node");
                self.sources.misspelt(attribute.place, problem, name, CONDITIONS);
            }
        }
        hooks.iter().any(Option::is_some).then(|| Box::new(hooks))
    }

    /// Connects the ports of a node, and declares the entries that they use.
    fn bindings(&mut self, element: &Element, node: &NodeType<'_>, board: BoardId) {
        for attribute in element.attributes.iter().filter(|given| is_port(&given.name)) {
            if node.ports.iter().all(|port| port.name != attribute.name) {
                self.sources.unknown_port(node, attribute.place, &attribute.name);
            }
        }
        for port in node.ports {
            let binding = match (element.attribute(port.name), port.default) {
                (Some(given), _) => self.binding(port, board, &given.value, given.value_place),
                (None, Some(text)) => self.binding(port, board, text, element.place),
                (None, None) => {
                    if port.direction != PortDirection::Output && !port.optional {
                        self.sources.needs_port(element.place, node.name, port.name);
                    }
                    PortBinding::Missing
                }
            };
            let children = element.children.len();
            if let (Kind::Parallel | Kind::ParallelAll, PortBinding::Literal(Value::Int(threshold))) =
                (node.kind, &binding)
                && i64::try_from(children).is_ok_and(|children| *threshold > children)
            {
                let problem = format!("a threshold of {threshold} with {children} children");
                self.sources.error(element.place, problem);
            }
            self.tree.bindings.push(BoundPort { name: port.name, binding });
        }
    }

    fn binding(&mut self, port: &Port, board: BoardId, text: &str, place: Place) -> PortBinding {
        match (key_of(port.name, text), port.role) {
            (_, PortRole::Script) => return PortBinding::Missing,
            (None, PortRole::Name) => return PortBinding::Entry(self.key(board, text, place)),
            (None, PortRole::Entry) => return PortBinding::Key(self.key(board, text, place)),
            (Some(key), _) => {
                let id = self.key(board, key, place);
                if let Err(known) = self.tree.board.declare(id, port.kind) {
                    let (known, kind) = (known.name(), port.kind.name());
                    let problem =
                        format!("the entry `{key}` is of type {known} already, and not {kind}");
                    self.sources.error(place, problem);
                }
                return PortBinding::Key(id);
            }
            (None, PortRole::Value) => {}
        }
        if port.direction == PortDirection::Output {
            self.sources.no_value(place, text, "key in braces, to which the node could write");
        }
        let idle = port.kind == Status::TYPE && text == Status::Idle.name();
        let Some(value) = port.kind.admit(&Value::text(text)).filter(|_| !idle) else {
            self.sources.no_value(place, text, port.kind.name());
            return PortBinding::Missing;
        };
        if let Some(kind) = port.refuses(&value) {
            self.sources.no_value(place, text, kind);
        }
        PortBinding::Literal(value)
    }

    /// The entry that a key means.
    fn key(&mut self, board: BoardId, key: &str, place: Place) -> KeyId {
        let name = key.strip_prefix('@').unwrap_or(key);
        if name.is_empty() || name.contains(['@', '{', '}']) {
            self.sources.no_value(place, key, "name of an entry");
        }
        self.tree.board.key(board, key)
    }

    /// The board of a subtree, with the keys that are the parent's and the literals in it.
    fn inner_board(&mut self, element: &'a Element, id: &Attribute, outer: BoardId) -> BoardId {
        let given = element.attributes.iter().filter(|given| is_port(&given.name));
        let mut ports: Named<(&str, Place)> =
            given.map(|port| (port.name.clone(), (&*port.value, port.value_place))).collect();
        let mut autoremap = false;
        if let Some(given) = element.attribute("_autoremap") {
            match bool::from_value(&Value::text(&*given.value)) {
                Some(value) => autoremap = value,
                None => self.sources.no_value(given.value_place, &given.value, bool::TYPE.name()),
            }
        }
        for (port, default) in self.definitions.models.get(&id.value).into_iter().flatten() {
            if autoremap || ports.contains_key(port) {
                continue;
            }
            match default {
                Some(default) => {
                    // One model gives it to each of its subtrees.
                    self.bytes += port.len() + default.len();
                    ports.insert(port.clone(), (default, element.place));
                }
                None => self.sources.needs_port(element.place, &id.value, port),
            }
        }
        let mut literals = Vec::new();
        let mut remaps = Named::new();
        for (port, (text, place)) in ports {
            match key_of(&port, text).filter(|_| text != "=") {
                Some(key) => {
                    self.key(outer, key, place);
                    remaps.insert(port.clone(), key.to_owned());
                }
                None => literals.push((port.clone(), literal(text))),
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
