//! Rules about which folder imports from which, within a package.

use crate::architecture::tree::{Breach, Source, Tree};
use std::collections::{BTreeMap, BTreeSet};

/// The layers of `actors`, bottom up, and what each may import.
const LAYERS: &[(&str, &str)] = &[
    ("platform", ""),
    ("arbiter", "platform"),
    ("messaging", "platform arbiter"),
    ("runtime", "platform arbiter messaging"),
    ("liveness", "platform arbiter messaging"),
    ("registry", "platform arbiter messaging"),
    ("journal", "platform runtime"),
    ("plain", "arbiter messaging"),
    ("fault_chain", "platform runtime arbiter messaging registry"),
    ("component", "platform runtime arbiter messaging liveness registry"),
    ("host", "platform runtime arbiter messaging liveness registry component"),
    ("topic", TO_HOST),
    ("net", "platform runtime arbiter messaging registry topic"),
    ("variable", TO_NET),
    ("actuator", TO_NET),
    ("port", "messaging registry component topic actuator"),
    ("directory", TO_NET),
    (
        "condition",
        "platform runtime arbiter messaging registry component topic net actuator directory",
    ),
    ("trees", "platform registry component host topic variable actuator condition"),
    (
        "service",
        "platform runtime arbiter messaging liveness registry component host topic net directory",
    ),
    ("bridge", TO_NET),
    ("device", "platform messaging component host topic variable actuator"),
    ("process", TO_HOST),
    ("parameters", "arbiter component variable"),
    ("features", "platform component topic variable actuator condition service port"),
];
const TO_HOST: &str = "platform runtime arbiter messaging liveness registry component host";
const TO_NET: &str =
    "platform runtime arbiter messaging liveness registry component host topic net";
/// The top layer imports all others.
const TOP: &str = "node";
/// What every layer may name: the atomics, the table of settings, and the pages of the manual.
const EVERYWHERE: &[&str] = &["sync", "settings", "manual"];

/// The folders whose files may import each other in a circle, and why.
const CIRCLES: &[(&str, &str)] = &[
    (
        "actors/src/component",
        "`Component` names its `Context`, which names the cell, which names envelopes",
    ),
    (
        "actors/src/trees",
        "a leaf's task names the context of its tree's component, which names the leaves",
    ),
    ("core/src/service", "the next edition of services replaces it"),
];

/// The sources of the packages whose folders are layered.
const ROOTS: &[&str] = &[
    "core/src",
    "core/trees/src",
    "core/lite/src",
    "core/contract/src",
    "transports/src",
    "actors/src",
    "actors/cli/src",
    "actors/demo/src",
];

type Path = Vec<String>;

/// The modules of one package, and what each of them imports from it.
struct Modules<'a> {
    sources: BTreeMap<Path, &'a Source>,
    /// The names that a module gives to items of others.
    exports: BTreeMap<Path, Path>,
    imports: Vec<(Path, Path, usize)>,
}

impl<'a> Modules<'a> {
    fn below(tree: &'a Tree, root: &str) -> Self {
        let below = |source: &&Source| source.path.starts_with(&format!("{root}/"));
        let sources: BTreeMap<Path, &Source> = tree
            .sources
            .iter()
            .filter(|source| !source.test)
            .filter(below)
            .map(|source| (module_of(&source.path[root.len() + 1..]), source))
            .collect();
        let mut modules = Modules { sources, exports: BTreeMap::new(), imports: Vec::new() };
        for (module, source) in modules.sources.clone() {
            let file = syn::parse_file(&source.text).expect("it was parsed before");
            modules.read_uses(&module, source, &file.items);
            modules.read_paths(&module, source);
        }
        modules
    }

    /// The path from the root of the package, if it lies there.
    fn absolute(&self, module: &Path, path: &[String]) -> Option<Path> {
        let first = path.first()?.as_str();
        let supers = path.iter().take_while(|segment| *segment == "super").count();
        let mut base = module.clone();
        match first {
            "crate" => return Some(path[1..].to_vec()),
            "self" => base.extend_from_slice(&path[1..]),
            "super" => {
                base.truncate(module.len().checked_sub(supers)?);
                base.extend_from_slice(&path[supers..]);
            }
            child => {
                base.push(child.to_owned());
                self.sources.get(&base)?;
                base.extend_from_slice(&path[1..]);
            }
        }
        Some(base)
    }

    fn read_uses(&mut self, module: &Path, source: &Source, items: &[syn::Item]) {
        for item in items {
            let syn::Item::Use(item) = item else { continue };
            let line = syn::spanned::Spanned::span(item).start().line;
            let mut leaves = Vec::new();
            leaves_of(&item.tree, &mut Vec::new(), &mut leaves);
            for (path, name) in leaves {
                let Some(path) = self.absolute(module, &path) else { continue };
                if !matches!(item.vis, syn::Visibility::Inherited) {
                    let exported = module.iter().cloned().chain([name]).collect();
                    self.exports.insert(exported, path.clone());
                }
                if !source.is_test(line) {
                    self.imports.push((module.clone(), path, line));
                }
            }
        }
    }

    /// Paths that stand in the code itself.
    fn read_paths(&mut self, module: &Path, source: &Source) {
        let tokens = &source.tokens;
        for (at, token) in tokens.iter().enumerate() {
            let begins = matches!(token.text.as_str(), "crate" | "super");
            let goes_on = at > 0 && tokens[at - 1].text == "::";
            if !begins || goes_on || source.is_test(token.line) {
                continue;
            }
            let rest = tokens[at + 1..].chunks(2);
            let rest = rest.take_while(|pair| pair.len() == 2 && pair[0].text == "::");
            let rest = rest.map(|pair| pair[1].text.clone());
            let path: Path = [token.text.clone()].into_iter().chain(rest).collect();
            let is_word = |text: &String| text.starts_with(|c: char| c.is_alphabetic());
            let path: Path = path.into_iter().take_while(is_word).collect();
            if path.len() > 1
                && let Some(path) = self.absolute(module, &path)
            {
                self.imports.push((module.clone(), path, token.line));
            }
        }
    }

    /// The module that defines what this path names.
    fn defining(&self, path: &Path) -> Path {
        let mut path = path.clone();
        // A chain of exports is short, and one in a circle does not compile.
        for _ in 0..8 {
            let known = (0..=path.len()).rev().find(|&n| self.sources.contains_key(&path[..n]));
            let known = known.unwrap_or_default();
            let exported = path.get(..known + 1).and_then(|name| self.exports.get(name));
            let Some(behind) = exported else {
                path.truncate(known);
                return path;
            };
            path = behind.iter().chain(&path[known + 1..]).cloned().collect();
        }
        path
    }
}

/// `a/b.rs` and `a/b/mod.rs` are the module `a::b`; the root file is the empty path.
fn module_of(file: &str) -> Path {
    let file = file.trim_end_matches(".rs");
    let mut module: Path = file.split('/').map(str::to_owned).collect();
    if matches!(module.last().map(String::as_str), Some("mod" | "lib" | "main")) {
        module.pop();
    }
    module
}

/// The paths of one `use`, and the names that they get.
fn leaves_of(tree: &syn::UseTree, path: &mut Path, leaves: &mut Vec<(Path, String)>) {
    let mut leaf = |path: &Path, last: &syn::Ident, name: &syn::Ident| {
        let mut path = path.clone();
        if last != "self" {
            path.push(last.to_string());
        }
        let name = if name == "self" { path.last().cloned() } else { Some(name.to_string()) };
        leaves.push((path, name.unwrap_or_default()));
    };
    match tree {
        syn::UseTree::Path(part) => {
            path.push(part.ident.to_string());
            leaves_of(&part.tree, path, leaves);
            path.pop();
        }
        syn::UseTree::Name(name) => leaf(path, &name.ident, &name.ident),
        syn::UseTree::Rename(name) => leaf(path, &name.ident, &name.rename),
        syn::UseTree::Glob(_) => leaves.push((path.clone(), "*".into())),
        syn::UseTree::Group(group) => {
            group.items.iter().for_each(|tree| leaves_of(tree, path, leaves));
        }
    }
}

/// Each folder of `actors` imports only the layers below it.
pub(crate) fn layers(tree: &Tree) -> Vec<Breach> {
    let modules = Modules::below(tree, "actors/src");
    let mut breaches = Vec::new();
    for (module, path, line) in &modules.imports {
        let Some(folder) = module.first().filter(|folder| *folder != TOP) else { continue };
        let defining = modules.defining(path);
        let mut breach = |what: String| {
            breaches.push(Breach::new(&modules.sources[module].path, *line, what));
        };
        let Some((_, below)) = LAYERS.iter().find(|(layer, _)| layer == folder) else {
            if !EVERYWHERE.contains(&folder.as_str()) {
                breach(format!("{folder} is no layer"));
            }
            continue;
        };
        if let Some(from) = defining.first()
            && from != folder
            && !below.split(' ').any(|layer| layer == from)
            && !EVERYWHERE.contains(&from.as_str())
        {
            breach(format!("{folder} imports {}", path.join("::")));
        }
    }
    breaches
}

/// The files of one folder do not import each other in a circle. `x.rs` and `x/` count as one.
pub(crate) fn circles(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for root in ROOTS {
        let modules = Modules::below(tree, root);
        let mut folders: BTreeMap<Path, Vec<(String, String, &Path, usize)>> = BTreeMap::new();
        for (module, path, line) in &modules.imports {
            let defining = modules.defining(path);
            let shared = module.iter().zip(&defining).take_while(|(a, b)| a == b).count();
            if let (Some(from), Some(to)) = (module.get(shared), defining.get(shared)) {
                let edge = (from.clone(), to.clone(), module, *line);
                folders.entry(module[..shared].to_vec()).or_default().push(edge);
            }
        }
        for (folder, edges) in folders {
            let place = [&[(*root).to_owned()], &folder[..]].concat().join("/");
            if CIRCLES.iter().any(|(known, _)| place.starts_with(known)) {
                continue;
            }
            for (from, to, module, line) in &edges {
                if reaches(&edges, to, from) {
                    let source = modules.sources[*module];
                    let what = format!("{place}: {from} and {to} import each other");
                    breaches.push(Breach::new(&source.path, *line, what));
                }
            }
        }
    }
    breaches
}

fn reaches(edges: &[(String, String, &Path, usize)], from: &String, to: &String) -> bool {
    let mut seen = BTreeSet::from([from]);
    let mut ahead = vec![from];
    while let Some(here) = ahead.pop() {
        if here == to {
            return true;
        }
        let next = edges.iter().filter(|(from, ..)| from == here).map(|(_, to, ..)| to);
        ahead.extend(next.filter(|to| seen.insert(to)));
    }
    false
}

/// Production code names what it takes from its parent.
pub(crate) fn globs_of_parents(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for source in tree.sources.iter().filter(|source| !source.test) {
        if CIRCLES.iter().any(|(known, _)| source.path.starts_with(known)) {
            continue;
        }
        let lines = source.lines_with("use super :: *").into_iter();
        let lines = lines.filter(|line| !source.is_test(*line));
        breaches.extend(lines.map(|line| Breach::new(&source.path, line, "use super::*")));
    }
    breaches
}
