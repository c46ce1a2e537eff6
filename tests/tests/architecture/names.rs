//! Rules about the names of types.

use crate::tree::{Breach, Tree, attributes, only_in_tests};
use std::collections::BTreeMap;

/// The packages of a robot in operation. Test doubles are named after what they stand for.
const PRODUCT: [&str; 6] = [
    "core/src/",
    "core/contract/src/",
    "core/macros/src/",
    "transports/src/",
    "actors/src/",
    "actors/cli/src/",
];

/// Names that several types may have, and why.
const SHARED: [(&str, &str); 2] = [
    ("Link", "the facade's description of a link, and the core's machine that it configures"),
    ("Known", "both types belong to the replicated services, which are to be replaced as a whole"),
];

/// The definition of a type.
struct Definition<'a> {
    path: &'a str,
    line: usize,
    private: bool,
}

/// A type that other files can name shares its name with no other type.
pub(crate) fn of_types(tree: &Tree) -> Vec<Breach> {
    let mut named: BTreeMap<String, Vec<Definition<'_>>> = BTreeMap::new();
    for source in &tree.sources {
        if source.test || !PRODUCT.iter().any(|folder| source.path.starts_with(folder)) {
            continue;
        }
        let file = syn::parse_file(&source.text).expect("the tree holds only what parses");
        types(&file.items, &mut |ident, visibility| {
            let private = matches!(visibility, syn::Visibility::Inherited);
            let line = ident.span().start().line;
            let definition = Definition { path: &source.path, line, private };
            named.entry(ident.to_string()).or_default().push(definition);
        });
    }
    named.retain(|name, all| {
        let visible = all.iter().any(|definition| !definition.private);
        all.len() > 1 && visible && !SHARED.iter().any(|(shared, _)| shared == name)
    });
    let breach =
        |name: &String, at: &Definition<'_>| Breach::new(at.path, at.line, format!("`{name}`"));
    named.iter().flat_map(|(name, all)| all.iter().map(move |at| breach(name, at))).collect()
}

/// Calls `found` with each type that is defined outside of tests.
fn types(items: &[syn::Item], found: &mut impl FnMut(&syn::Ident, &syn::Visibility)) {
    for item in items.iter().filter(|item| !only_in_tests(attributes(item))) {
        match item {
            syn::Item::Enum(item) => found(&item.ident, &item.vis),
            syn::Item::Struct(item) => found(&item.ident, &item.vis),
            syn::Item::Trait(item) => found(&item.ident, &item.vis),
            syn::Item::Type(item) => found(&item.ident, &item.vis),
            syn::Item::Union(item) => found(&item.ident, &item.vis),
            syn::Item::Mod(syn::ItemMod { content: Some((_, inner)), .. }) => types(inner, found),
            _ => {}
        }
    }
}
