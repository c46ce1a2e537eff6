//! Loads a tree: reads its files, checks every tree in them, and builds the main one.

mod build;
mod definitions;
mod problem;
mod source;

pub use problem::{Problem, TreeError, TreeErrors};

pub(crate) use definitions::may_be_name;

use crate::factory::Factory;
use crate::model::{BUILTINS, Kind, Port};
use crate::tree::{LeafModel, Tree};
use definitions::Definitions;
use source::{Element, Place, Sources};
use std::sync::Arc;

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
    let definitions = Definitions::of(factory, &mut sources);
    // Every tree is checked, whether it is used or not.
    for root in definitions.trees.values().flatten() {
        build::build(factory, &mut sources, &definitions, root, false);
    }
    let root = main_tree(&mut sources, &definitions, main);
    let root = root.filter(|_| sources.errors.is_empty());
    let tree = root.map(|root| build::build(factory, &mut sources, &definitions, root, true));
    let errors = sources.errors;
    tree.filter(|_| errors.is_empty()).ok_or(TreeErrors { errors })
}

/// The tree that the caller names, else that of the first file, else the only one.
fn main_tree<'a>(
    sources: &mut Sources,
    definitions: &'a Definitions,
    main: Option<&str>,
) -> Option<&'a Element> {
    let start = Place { file: 0, at: 0 };
    let given = sources.main.take();
    match (main, &given) {
        (Some(main), _) => definitions.tree(sources, main, start),
        (None, Some(main)) => definitions.tree(sources, &main.value, main.value_place),
        (None, None) if definitions.trees.len() == 1 => definitions.trees.values().next()?.as_ref(),
        (None, None) => {
            let (element, attribute) = ("root".into(), "main_tree_to_execute");
            sources.error(start, Problem::Attribute { element, attribute });
            None
        }
    }
}

/// Elements whose `ID` is the type of a node. Which of them it is makes no difference.
const EXPLICIT: [&str; 4] = ["Action", "Condition", "Control", "Decorator"];

/// What an element is.
struct NodeType<'a> {
    name: &'a str,
    kind: Kind,
    ports: &'a [Port],
    /// What the application has registered.
    leaf: Option<&'a Arc<LeafModel>>,
}

impl<'a> NodeType<'a> {
    fn of_name(factory: &'a Factory, name: &str) -> Option<NodeType<'a>> {
        if let Some(leaf) = factory.leaves.get(name) {
            let LeafModel { name, kind, ports, .. } = &**leaf;
            return Some(NodeType { name, kind: Kind::Leaf(*kind), ports, leaf: Some(leaf) });
        }
        let (name, kind, ports) = *BUILTINS.iter().find(|(known, ..)| *known == name)?;
        Some(NodeType { name, kind, ports, leaf: None })
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

/// The conditions of nodes: those that are looked at before a tick, and what is run after it.
const CONDITIONS: [&str; 8] = [
    "_failureIf",
    "_successIf",
    "_skipIf",
    "_while",
    "_onSuccess",
    "_onFailure",
    "_post",
    "_onHalted",
];

/// Whether an attribute of this name connects a port: not `name`, `ID` and what begins with `_`.
pub(crate) fn is_port(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_alphabetic()) && name != "name" && name != "ID"
}
