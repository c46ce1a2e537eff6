//! Loads a tree: reads its files, checks every tree in them, and builds the main one.

mod build;
mod definitions;
mod error;
mod source;

pub use error::{TreeError, TreeErrors};
pub use source::byte_at;

use crate::factory::Factory;
use crate::model::{BUILTINS, Kind, Port};
use crate::tree::{LeafModel, Tree};
use definitions::Definitions;
use source::{Element, Place, Sources};
use std::sync::Arc;

impl Factory {
    /// Loads the main tree of a file that includes no other.
    ///
    /// # Errors
    ///
    /// All that is wrong with the file.
    pub fn load(&self, file: &str, text: &str) -> Result<Tree, TreeErrors> {
        self.load_with(file, text, None, &mut |_| Err("no files are included here".into()))
    }

    /// Loads a tree: the one that `main` names, or else the file's main tree. `include` gives the
    /// text of an included file, whose path is relative to the same folder as `file`.
    ///
    /// # Errors
    ///
    /// All that is wrong with the files.
    pub fn load_with(
        &self,
        file: &str,
        text: &str,
        main: Option<&str>,
        include: &mut dyn FnMut(&str) -> Result<String, String>,
    ) -> Result<Tree, TreeErrors> {
        let mut sources = Sources::default();
        sources.read(file, text, include);
        let definitions = Definitions::of(self, &mut sources);
        // Every tree is checked, whether it is used or not.
        for root in definitions.trees.values().flatten() {
            build::build(self, &mut sources, &definitions, root, false);
        }
        let root = main_tree(&mut sources, &definitions, main);
        let root = root.filter(|_| sources.errors.is_empty());
        let tree = root.map(|root| build::build(self, &mut sources, &definitions, root, true));
        let errors = sources.errors;
        tree.filter(|_| errors.is_empty()).ok_or(TreeErrors { errors })
    }
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
            if definitions.trees.len() > 1 {
                sources.error(start, "<root> needs the attribute `main_tree_to_execute`");
            } else if sources.errors.is_empty() {
                sources.error(start, "`root` has 0 children instead of at least 1");
            }
            None
        }
    }
}

/// Elements whose `ID` is the type of a node. Which of them it is makes no difference.
const EXPLICIT: [&str; 4] = ["Action", "Condition", "Control", "Decorator"];

/// The type of a node.
struct NodeType<'a> {
    name: &'a str,
    kind: Kind,
    ports: &'a [Port],
    /// The application's own leaf.
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
