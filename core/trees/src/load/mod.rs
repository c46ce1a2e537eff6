//! Loads a tree: reads its files, checks every tree in them, and builds the main one.

mod build;
mod check;
mod problem;
mod source;

pub use problem::{Problem, TreeError, TreeErrors};

pub(crate) use check::may_be_name;

use crate::factory::Factory;
use crate::model::{BUILTINS, Builtin, Kind, Port};
use crate::tree::{LeafModel, Tree};
use source::{Attribute, Element, Named, Place, Sources};
use std::sync::Arc;

/// What the files of a tree hold.
#[derive(Default)]
struct Definitions {
    /// Their outermost nodes.
    trees: Named<Option<Element>>,
    /// The ports of subtrees, with their defaults, from `TreeNodesModel`.
    models: Named<Named<Option<String>>>,
}

/// Loads the main tree of a file.
pub(crate) fn load(
    factory: &Factory,
    file: &str,
    text: &str,
    main: Option<&str>,
    include: source::Include<'_>,
) -> Result<Tree, TreeErrors> {
    let mut sources = Sources::default();
    sources.read(file, text, include);
    let definitions = check::check(factory, &mut sources);
    let main = main_tree(&mut sources, &definitions, main);
    let tree = match main {
        Some(main) if sources.errors.is_empty() => {
            Some(build::build(factory, &mut sources, &definitions, main))
        }
        _ => None,
    };
    match tree {
        Some(tree) if sources.errors.is_empty() => Ok(tree),
        _ => Err(TreeErrors::new(sources.errors)),
    }
}

/// The tree that the caller names, else that of the first file, else the only one.
fn main_tree<'a>(
    sources: &mut Sources,
    definitions: &'a Definitions,
    main: Option<&str>,
) -> Option<&'a str> {
    let (wanted, place) = match (main, &sources.main) {
        (Some(main), _) => (main.to_owned(), Place { file: 0, at: 0 }),
        (None, Some(main)) => (main.value.clone(), main.value_place),
        (None, None) => {
            let mut names = definitions.trees.keys();
            if let (Some(name), None) = (names.next(), names.next()) {
                return Some(name);
            }
            sources.error(Place { file: 0, at: 0 }, Problem::NoMainTree);
            return None;
        }
    };
    if let Some((name, _)) = definitions.trees.get_key_value(&wanted) {
        return Some(name);
    }
    let known = definitions.trees.keys().map(String::as_str);
    sources.misspelt(place, Problem::UnknownTree(wanted.clone()), &wanted, known);
    None
}

/// What an element is.
#[derive(Clone)]
enum NodeType<'a> {
    Builtin(&'static Builtin),
    Leaf(&'a Arc<LeafModel>),
}

impl<'a> NodeType<'a> {
    fn of_name(factory: &'a Factory, name: &str) -> Option<NodeType<'a>> {
        let leaf = factory.leaves.get(name).map(NodeType::Leaf);
        leaf.or_else(|| BUILTINS.iter().find(|known| known.name == name).map(NodeType::Builtin))
    }

    /// The type that an element names: `<Wait/>`, or `<Action ID="Wait"/>`. A subtree's `ID` is
    /// the tree's.
    fn of_element(factory: &'a Factory, element: &Element) -> Option<NodeType<'a>> {
        let name = match element.name.as_str() {
            "Action" | "Condition" | "Control" | "Decorator" => element.value("ID")?,
            name => name,
        };
        NodeType::of_name(factory, name)
    }

    fn name(&self) -> &str {
        match self {
            NodeType::Builtin(builtin) => builtin.name,
            NodeType::Leaf(leaf) => &leaf.name,
        }
    }

    fn kind(&self) -> Kind {
        match self {
            NodeType::Builtin(builtin) => builtin.kind,
            NodeType::Leaf(leaf) => Kind::Leaf(leaf.kind),
        }
    }

    fn ports(&self) -> &[Port] {
        match self {
            NodeType::Builtin(builtin) => builtin.ports,
            NodeType::Leaf(leaf) => &leaf.ports,
        }
    }

    /// Whether the port is a script.
    fn is_script(&self, port: &Port) -> bool {
        match self.kind() {
            Kind::Script | Kind::ScriptCondition => true,
            Kind::Precondition => port.name == "if",
            _ => false,
        }
    }

    /// Whether the port is the name of an entry: without braces too.
    fn is_name(&self, port: &Port) -> bool {
        match self.kind() {
            Kind::SetBlackboard => port.name == "output_key",
            Kind::UnsetBlackboard | Kind::WasEntryUpdated | Kind::Updated(_) => true,
            _ => false,
        }
    }
}

/// The key that the text of a port names, if it names one: `{key}` with blanks around it, or `{=}`
/// and `=` for the port's own name.
pub(crate) fn key_of<'a>(port: &'a str, text: &'a str) -> Option<&'a str> {
    if text == "=" {
        return Some(port);
    }
    let key = text.trim_matches(' ').strip_prefix('{')?.strip_suffix('}')?;
    Some(if key == "=" { port } else { key.trim_matches(' ') })
}

/// The conditions of nodes: those before, and those after.
const BEFORE: [&str; 4] = ["_failureIf", "_successIf", "_skipIf", "_while"];
const AFTER: [&str; 4] = ["_onSuccess", "_onFailure", "_post", "_onHalted"];

/// Whether an attribute connects a port: all but `name`, `ID`, and what begins with no letter.
fn is_port(attribute: &Attribute) -> bool {
    let starts = attribute.name.starts_with(|c: char| c.is_ascii_alphabetic());
    starts && attribute.name != "name" && attribute.name != "ID"
}

/// Whether a type of node has this name.
pub(crate) fn is_taken(factory: &Factory, name: &str) -> bool {
    NodeType::of_name(factory, name).is_some()
}

/// Whether a port may have this name.
pub(crate) fn may_be_port(name: &str) -> bool {
    may_be_name(name)
        && name.starts_with(|c: char| c.is_ascii_alphabetic())
        && name != "name"
        && name != "ID"
}
