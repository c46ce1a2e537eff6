//! Rules about which folder imports from which, within a package.

use crate::architecture::tree::{Breaches, PRODUCT, Token, Tree};
use std::collections::{BTreeMap, BTreeSet};
use std::iter::Peekable;

/// The layers of `actors`, bottom up. Each imports only from lines before its own.
const LAYERS: &str = "
    platform
    arbiter
    messaging
    runtime liveness registry plain
    journal fault_chain component
    host
    topic process
    net
    variable actuator directory bridge
    condition service port device parameters
    trees features
    node";
/// What every layer may name: the atomics, the table of settings, and the pages of the manual.
const EVERYWHERE: &str = "sync settings manual";

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
    line: usize,
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
        let begins = matches!(before, "crate" | "super");
        if !begins {
            tokens.next();
        }
        if begins || before == "use" {
            read_path(&mut tokens, Vec::new(), exported, &mut imports);
        }
    }
    imports
}

/// Reads one path, or those of one group.
fn read_path<'a>(
    tokens: &mut Peekable<impl Iterator<Item = &'a Token>>,
    mut path: Path,
    exported: bool,
    imports: &mut Vec<Import>,
) {
    let is_name =
        |text: &str| text == "*" || text.starts_with(|c: char| c.is_alphabetic() || c == '_');
    let mut line = 0;
    while let Some(token) = tokens.next_if(|token| is_name(&token.text) || token.text == "{") {
        line = token.line;
        if token.text == "{" {
            while tokens.next_if(|token| token.text == "}").is_none() {
                read_path(tokens, path.clone(), exported, imports);
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
    let renamed = tokens.next_if(|token| token.text == "as").and_then(|_| tokens.next());
    let name = renamed.map(|token| &token.text).or(path.last()).cloned().unwrap_or_default();
    imports.push(Import { path, name, line, exported });
}

/// The modules of one package, and what each of them imports from it.
struct Modules<'a> {
    /// The file of each module: `a/b.rs` and `a/b/mod.rs` are `a::b`, the root file is empty.
    files: BTreeMap<Path, &'a str>,
    /// The names that a module gives to items of others.
    exports: BTreeMap<Path, Path>,
    imports: Vec<(Path, Path, usize)>,
}

impl<'a> Modules<'a> {
    fn below(tree: &'a Tree, root: &str) -> Self {
        let module_of = |path: &'a str| {
            let file = path.strip_prefix(root)?.strip_prefix('/')?.trim_end_matches(".rs");
            let mut module: Path = file.split('/').map(str::to_owned).collect();
            module.pop_if(|last| matches!(last.as_str(), "mod" | "lib" | "main"));
            Some((module, path))
        };
        let files = tree.code.keys().filter_map(|path| module_of(path)).collect();
        let mut modules = Modules { files, exports: BTreeMap::new(), imports: Vec::new() };
        for (module, file) in modules.files.clone() {
            for Import { path, name, line, exported } in imports_of(&tree.code[file]) {
                let Some(path) = modules.absolute(&module, &path) else { continue };
                if exported {
                    modules.exports.insert([&module[..], &[name]].concat(), path.clone());
                }
                modules.imports.push((module.clone(), path, line));
            }
        }
        modules
    }

    /// The path from the root of the package, if it lies there.
    fn absolute(&self, module: &[String], path: &[String]) -> Option<Path> {
        let supers = path.iter().take_while(|segment| *segment == "super").count();
        let (kept, gone) = match path.first()?.as_str() {
            "crate" => (0, 1),
            "self" => (module.len(), 1),
            "super" => (module.len().checked_sub(supers)?, supers),
            _ => self.files.get(&[module, &path[..1]].concat()).map(|_| (module.len(), 0))?,
        };
        Some([&module[..kept], &path[gone..]].concat())
    }

    /// The module that defines what this path names.
    fn defining(&self, path: &Path) -> Path {
        let mut path = path.clone();
        // A chain of exports is short, and one in a circle does not compile.
        for _ in 0..8 {
            let known = (0..=path.len()).rev().find(|&n| self.files.contains_key(&path[..n]));
            let known = known.unwrap_or_default();
            match path.get(..=known).and_then(|name| self.exports.get(name)) {
                Some(behind) => path = [&behind[..], &path[known + 1..]].concat(),
                None => path.truncate(known),
            }
        }
        path
    }
}

/// Each folder of `actors` imports only the layers below it.
pub(crate) fn layers(tree: &Tree) -> Breaches {
    let modules = Modules::below(tree, "actors/src");
    let has = |line: &str, folder: &str| line.split(' ').any(|name| name == folder);
    let layer = |folder: &str| LAYERS.lines().position(|line| has(line, folder));
    let is_allowed = |from: &str, folder: &str| {
        from == folder
            || has(EVERYWHERE, from)
            || layer(from).is_some_and(|from| Some(from) < layer(folder))
    };
    let mut breaches = Breaches::new();
    for (module, path, line) in &modules.imports {
        let defining = modules.defining(path);
        if let (Some(folder), Some(from)) = (module.first(), defining.first())
            && !is_allowed(from, folder)
        {
            let what = format!("{folder} imports {}", path.join("::"));
            breaches.insert((modules.files[module].into(), *line, what));
        }
    }
    breaches
}

/// The files of one folder do not import each other in a circle. `x.rs` and `x/` count as one.
pub(crate) fn circles(tree: &Tree) -> Breaches {
    let mut breaches = Breaches::new();
    for root in PRODUCT.split(' ') {
        let modules = Modules::below(tree, root);
        let mut edges = Vec::new();
        for (module, path, line) in &modules.imports {
            let defining = modules.defining(path);
            let shared = module.iter().zip(&defining).take_while(|(a, b)| a == b).count();
            let folder = [&[root.to_owned()], &module[..shared]].concat().join("/");
            if let (Some(from), Some(to)) = (module.get(..=shared), defining.get(..=shared))
                && !CIRCLES.contains(&&*folder)
            {
                edges.push((from.to_vec(), to.to_vec(), modules.files[module], *line));
            }
        }
        // What leads nowhere, or comes from nowhere, is in no circle.
        let mut before = usize::MAX;
        while edges.len() < before {
            before = edges.len();
            let ends = edges.iter().map(|(from, to, ..)| (from.clone(), to.clone()));
            let (starts, ends): (BTreeSet<_>, BTreeSet<_>) = ends.unzip();
            edges.retain(|(from, to, ..)| starts.contains(to) && ends.contains(from));
        }
        breaches.extend(edges.into_iter().map(|(from, to, file, line)| {
            let (from, to) = (from.join("::"), to.join("::"));
            (file.into(), line, format!("{root}: {from} imports {to}, and that leads back to it"))
        }));
    }
    breaches
}
