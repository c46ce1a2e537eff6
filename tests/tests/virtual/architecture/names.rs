//! Rules about the names of types.

use crate::architecture::tree::{Breach, Definition, Tree};
use std::collections::BTreeMap;

/// The packages of a robot in operation. Test doubles are named after what they stand for.
const PRODUCT: [&str; 10] = [
    "core/src/",
    "core/trees/src/",
    "core/lite/src/",
    "core/contract/src/",
    "core/macros/src/",
    "transports/src/",
    "actors/src/",
    "actors/robot/src/",
    "actors/cli/src/",
    "actors/demo/src/",
];

/// Names that several types may have, and why.
const SHARED: [(&str, &str); 3] = [
    ("Link", "the facade's description of a link, and the core's machine that it configures"),
    ("Port", "the port of a device, on a chip, and of a node of a tree: no program has both"),
    ("Known", "both types belong to the replicated services, which are to be replaced as a whole"),
];

/// A type that other files can name shares its name with no other type.
pub(crate) fn of_types(tree: &Tree) -> Vec<Breach> {
    let mut named: BTreeMap<&str, Vec<(&str, &Definition)>> = BTreeMap::new();
    for source in tree.sources.iter().filter(|source| !source.test) {
        if PRODUCT.iter().any(|folder| source.path.starts_with(folder)) {
            for definition in &source.types {
                named.entry(&definition.name).or_default().push((&source.path, definition));
            }
        }
    }
    named.retain(|name, all| {
        let visible = all.iter().any(|(_, definition)| !definition.private);
        all.len() > 1 && visible && !SHARED.iter().any(|(shared, _)| shared == name)
    });
    let breach =
        |&(path, at): &(&str, &Definition)| Breach::new(path, at.line, format!("`{}`", at.name));
    named.values().flatten().map(breach).collect()
}
