//! Rules about which folder imports from which, within a package.

use crate::architecture::tree::{Breach, PRODUCT, Source, Token, Tree};
use std::collections::BTreeMap;
use std::iter::Peekable;

/// The layers of `actors`, bottom up, and what each may import.
const LAYERS: &str = "
    platform -
    arbiter platform
    messaging platform arbiter
    runtime platform arbiter messaging
    liveness platform arbiter messaging
    registry platform arbiter messaging
    journal platform runtime
    plain arbiter messaging
    fault_chain platform runtime arbiter messaging registry
    component platform runtime arbiter messaging liveness registry
    host platform runtime arbiter messaging liveness registry component
    topic platform runtime arbiter messaging liveness registry component host
    net platform runtime arbiter messaging registry topic
    variable platform runtime arbiter messaging liveness registry component host topic net
    actuator platform runtime arbiter messaging liveness registry component host topic net
    port messaging registry component topic actuator
    directory platform runtime arbiter messaging liveness registry component host topic net
    condition platform runtime arbiter messaging registry component topic net actuator directory
    trees platform registry component host topic variable actuator condition
    service platform runtime arbiter messaging liveness registry component host topic net directory
    bridge platform runtime arbiter messaging liveness registry component host topic net
    device platform messaging component host topic variable actuator
    process platform runtime arbiter messaging liveness registry component host
    parameters arbiter component variable
    features platform component topic variable actuator condition service port";
/// The top layer imports all others.
const TOP: &str = "node";
/// What every layer may name: the atomics, the table of settings, and the pages of the manual.
const EVERYWHERE: &[&str] = &["sync", "settings", "manual"];

/// The folders whose files may import each other in a circle.
const CIRCLES: [&str; 3] = [
    // `Component` names its `Context`, which names the cell, which names envelopes.
    "actors/src/component",
    // A leaf's task names the context of its tree's component, which names the leaves.
    "actors/src/trees",
    // The next edition of services replaces it.
    "core/src/service",
];

type Path = Vec<String>;

/// One path of a `use`, or of the code itself, and the name that it gets.
pub(crate) struct Import {
    pub(crate) path: Path,
    pub(crate) name: String,
    pub(crate) line: usize,
    /// Whether a `pub` stands before its `use`.
    exported: bool,
}

/// The paths that the code imports or begins with `crate` or `super`.
pub(crate) fn imports_of(code: &[Token]) -> Vec<Import> {
    let (mut imports, mut tokens) = (Vec::new(), code.iter().peekable());
    let mut before = "";
    while let Some(token) = tokens.peek() {
        let exported = matches!(before, "pub" | ")");
        before = &token.text;
        match before {
            "use" => drop(tokens.next()),
            "crate" | "super" => {}
            _ => {
                tokens.next();
                continue;
            }
        }
        let found = imports.len();
        read_path(&mut tokens, Vec::new(), &mut imports);
        imports[found..].iter_mut().for_each(|import| import.exported = exported);
    }
    imports
}

/// Reads one path, or those of one group.
fn read_path<'a>(
    tokens: &mut Peekable<impl Iterator<Item = &'a Token>>,
    mut path: Path,
    imports: &mut Vec<Import>,
) {
    let mut line = 0;
    while let Some(token) = tokens.next_if(|token| is_name(&token.text) || token.text == "{") {
        line = token.line;
        if token.text == "{" {
            while tokens.next_if(|token| token.text == "}").is_none() {
                read_path(tokens, path.clone(), imports);
                tokens.next_if(|token| token.text == ",");
            }
            return;
        }
        if token.text != "self" || path.is_empty() {
            path.push(token.text.clone());
        }
        if tokens.next_if(|token| token.text == "::").is_none() {
            break;
        }
    }
    let mut name = path.last().cloned().unwrap_or_default();
    if tokens.next_if(|token| token.text == "as").is_some() {
        name = tokens.next().map(|token| token.text.clone()).unwrap_or_default();
    }
    imports.push(Import { path, name, line, exported: false });
}

fn is_name(text: &str) -> bool {
    text == "*" || text.starts_with(|c: char| c.is_alphabetic() || c == '_')
}

/// The modules of one package, and what each of them imports from it.
struct Modules<'a> {
    sources: BTreeMap<Path, &'a Source>,
    /// The names that a module gives to items of others.
    exports: BTreeMap<Path, Path>,
    imports: Vec<(Path, Path, usize)>,
}

impl<'a> Modules<'a> {
    fn below(tree: &'a Tree, root: &str) -> Self {
        let below = |source: &'a Source| {
            let file = source.path.strip_prefix(root)?.strip_prefix('/')?;
            (!source.code.is_empty()).then(|| (module_of(file), source))
        };
        let sources: BTreeMap<Path, &Source> = tree.sources.iter().filter_map(below).collect();
        let mut modules = Modules { sources, exports: BTreeMap::new(), imports: Vec::new() };
        for (module, source) in modules.sources.clone() {
            for Import { path, name, line, exported } in imports_of(&source.code) {
                let Some(path) = modules.absolute(&module, &path) else { continue };
                if exported {
                    let name = module.iter().cloned().chain([name]).collect();
                    modules.exports.insert(name, path.clone());
                }
                modules.imports.push((module.clone(), path, line));
            }
        }
        modules
    }

    /// The path from the root of the package, if it lies there.
    fn absolute(&self, module: &Path, path: &[String]) -> Option<Path> {
        let supers = path.iter().take_while(|segment| *segment == "super").count();
        let base = match path.first()?.as_str() {
            "crate" => &[],
            "self" => &module[..],
            "super" => &module[..module.len().checked_sub(supers)?],
            child => {
                let child = [&module[..], &[child.to_owned()]].concat();
                self.sources.get(&child)?;
                return Some([&module[..], path].concat());
            }
        };
        Some([base, &path[supers.max(1)..]].concat())
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

/// Each folder of `actors` imports only the layers below it.
pub(crate) fn layers(tree: &Tree) -> Vec<Breach> {
    let modules = Modules::below(tree, "actors/src");
    let is_open = |folder: &str| folder == TOP || EVERYWHERE.contains(&folder);
    let mut breaches = Vec::new();
    for (module, path, line) in &modules.imports {
        let Some(folder) = module.first().filter(|folder| !is_open(folder)) else { continue };
        let below = LAYERS
            .lines()
            .find_map(|line| line.trim_start().strip_prefix(folder.as_str())?.strip_prefix(' '));
        let what = match (below, modules.defining(path).first()) {
            (None, _) => format!("{folder} is no layer"),
            (Some(below), Some(from))
                if from != folder
                    && !below.split(' ').any(|layer| layer == from)
                    && !EVERYWHERE.contains(&from.as_str()) =>
            {
                format!("{folder} imports {}", path.join("::"))
            }
            _ => continue,
        };
        breaches.push(Breach::new(&modules.sources[module].path, *line, what));
    }
    breaches
}

/// The files of one folder do not import each other in a circle. `x.rs` and `x/` count as one.
pub(crate) fn circles(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for root in PRODUCT {
        let modules = Modules::below(tree, root);
        let mut folders: BTreeMap<&[String], Vec<(&str, String, Breach)>> = BTreeMap::new();
        for (module, path, line) in &modules.imports {
            let defining = modules.defining(path);
            let shared = module.iter().zip(&defining).take_while(|(a, b)| a == b).count();
            if let (Some(from), Some(to)) = (module.get(shared), defining.get(shared)) {
                let what = format!("{root}: {from} imports {to}, and that leads back to it");
                let breach = Breach::new(&modules.sources[module].path, *line, what);
                let edges = folders.entry(&module[..shared]).or_default();
                edges.push((from, to.clone(), breach));
            }
        }
        for (folder, mut edges) in folders {
            if CIRCLES.contains(&&*[&[root.to_owned()], folder].concat().join("/")) {
                continue;
            }
            // What leads nowhere, or comes from nowhere, is in no circle.
            let mut before = usize::MAX;
            while edges.len() < before {
                before = edges.len();
                let all = edges.clone();
                edges.retain(|(from, to, _)| {
                    all.iter().any(|edge| edge.0 == to) && all.iter().any(|edge| edge.1 == *from)
                });
            }
            breaches.extend(edges.into_iter().map(|(.., breach)| breach));
        }
    }
    breaches
}
