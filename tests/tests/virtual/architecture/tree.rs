//! The project's files as the rules see them: manifests as tables, sources as tokens with lines.
//!
//! Comments and texts are no tokens, so that a rule about code never trips over a sentence that
//! speaks of it. The tree is plain data: a rule can be shown a small false one.

use proc_macro2::{Delimiter, TokenStream, TokenTree};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// The packages of a robot in operation. Test doubles are named after what they stand for.
pub(crate) const PRODUCT: [&str; 10] = [
    "core/src",
    "core/trees/src",
    "core/lite/src",
    "core/contract/src",
    "core/macros/src",
    "transports/src",
    "actors/src",
    "actors/robot/src",
    "actors/cli/src",
    "actors/demo/src",
];

/// Where a rule is broken, and how.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Breach {
    /// The file, from the project's root.
    pub(crate) path: String,
    /// The line, from 1.
    pub(crate) line: usize,
    /// What stands there.
    pub(crate) what: String,
}

impl Breach {
    pub(crate) fn new(path: &str, line: usize, what: impl Into<String>) -> Breach {
        Breach { path: path.into(), line, what: what.into() }
    }
}

/// One word or sign of a source; brackets are tokens themselves, and so is `::`.
#[derive(Clone, Debug)]
pub(crate) struct Token {
    pub(crate) text: String,
    pub(crate) line: usize,
    /// How many brackets are open around it.
    pub(crate) depth: usize,
}

/// Whether these tokens, parted by blanks, begin the others: `Instant :: now`.
pub(crate) fn begins(tokens: &[Token], code: &str) -> bool {
    let mut tokens = tokens.iter();
    code.split(' ').all(|wanted| tokens.next().is_some_and(|token| token.text == wanted))
}

/// One Rust source.
#[derive(Debug)]
pub(crate) struct Source {
    pub(crate) path: String,
    pub(crate) tokens: Vec<Token>,
    /// The tokens that are not only for tests.
    pub(crate) code: Vec<Token>,
}

impl Source {
    fn new(path: &str, text: &str) -> Source {
        let stream: TokenStream =
            text.parse().unwrap_or_else(|error| panic!("{path}: {error}: rustfmt shows where"));
        let mut tokens = Vec::new();
        flatten(stream, 0, &mut tokens);
        let is_test = |part: &str| matches!(part, "tests" | "tests.rs" | "benches");
        let code = if path.split('/').any(is_test) { Vec::new() } else { without_tests(&tokens) };
        Source { path: path.into(), tokens, code }
    }
}

fn flatten(stream: TokenStream, depth: usize, out: &mut Vec<Token>) {
    let mut colon = false;
    for tree in stream {
        let line = tree.span().start().line;
        let mut push = |text: &str, line| out.push(Token { text: text.into(), line, depth });
        let joined = std::mem::take(&mut colon);
        match tree {
            TokenTree::Group(group) => {
                let (open, close) = match group.delimiter() {
                    Delimiter::Parenthesis => ("(", ")"),
                    Delimiter::Brace => ("{", "}"),
                    Delimiter::Bracket => ("[", "]"),
                    Delimiter::None => ("", ""),
                };
                push(open, line);
                flatten(group.stream(), depth + 1, out);
                let line = group.span_close().start().line;
                out.push(Token { text: close.into(), line, depth });
            }
            TokenTree::Punct(sign) if sign.as_char() == ':' && joined => {
                out.last_mut().expect("the first colon").text = "::".into();
            }
            other => {
                let text = other.to_string();
                colon = text == ":";
                push(&text, line);
            }
        }
    }
}

/// The tokens without each item, statement or field behind `#[cfg(test)]`, or `#[cfg(all(test, ..`.
fn without_tests(tokens: &[Token]) -> Vec<Token> {
    let (mut code, mut at) = (Vec::new(), 0);
    while let Some(token) = tokens.get(at) {
        let rest = &tokens[at..];
        let tests = ["# [ cfg ( test", "# [ cfg ( all ( test"];
        if !tests.iter().any(|test| begins(rest, test)) {
            code.push(token.clone());
            at += 1;
            continue;
        }
        let ends = |end: &Token| {
            end.depth < token.depth
                || end.depth == token.depth && matches!(end.text.as_str(), ";" | "," | "}")
        };
        at += rest.iter().position(ends).map_or(rest.len(), |end| end + 1);
    }
    code
}

/// The manifest of a package of this workspace, or of the workspace.
#[derive(Debug)]
pub(crate) struct Manifest {
    pub(crate) path: String,
    pub(crate) table: toml::Table,
}

impl Manifest {
    /// The package's name; none in the root manifest.
    pub(crate) fn package(&self) -> Option<&str> {
        self.table.get("package")?.get("name")?.as_str()
    }

    /// The entries of a section of dependencies, those for some targets included.
    pub(crate) fn dependencies(&self, section: &str) -> Vec<(&str, &toml::Value)> {
        let targets = self.table.get("target").and_then(toml::Value::as_table);
        let targets = targets.into_iter().flatten().map(|(_, target)| target.get(section));
        let sections = targets.chain([self.table.get(section)]).flatten();
        let entries = sections.filter_map(toml::Value::as_table).flatten();
        entries.map(|(name, entry)| (name.as_str(), entry)).collect()
    }
}

/// All files that rules look at.
#[derive(Debug, Default)]
pub(crate) struct Tree {
    /// Sources, manifests and pages by their path from the root.
    pub(crate) files: BTreeMap<String, String>,
    pub(crate) sources: Vec<Source>,
    pub(crate) manifests: Vec<Manifest>,
}

impl Tree {
    /// The project that this test belongs to.
    pub(crate) fn of_project() -> Tree {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let root = root.parent().expect("the tests' package lies in the project's root");
        let mut files = BTreeMap::new();
        collect(root, root, &mut files);
        Tree::of(files)
    }

    pub(crate) fn of(files: BTreeMap<String, String>) -> Tree {
        let named = |ending| files.iter().filter(move |(path, _)| path.ends_with(ending));
        let sources = named(".rs").map(|(path, text)| Source::new(path, text)).collect();
        let manifest = |(path, text): (&String, &String)| Manifest {
            path: path.clone(),
            table: text.parse().unwrap_or_else(|error| panic!("{path}: {error}")),
        };
        let manifests = named("Cargo.toml").map(manifest).collect();
        Tree { sources, manifests, files }
    }
}

/// Puts every text file below `folder` into `files`; what is built or kept by tools, and what is not to
/// compile, is left out.
fn collect(root: &Path, folder: &Path, files: &mut BTreeMap<String, String>) {
    let entries = fs::read_dir(folder).expect("the project's folders can be read");
    for entry in entries {
        let path = entry.expect("the project's folders can be read").path();
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        if path.is_dir() {
            if !matches!(name, "target" | ".git" | "corpus" | "artifacts" | "compile_fail") {
                collect(root, &path, files);
            }
        } else if [".rs", ".md", "Cargo.toml"].iter().any(|ending| name.ends_with(ending)) {
            let short = path.strip_prefix(root).expect("a path below the root");
            let text = fs::read_to_string(&path).expect("sources and pages are UTF-8");
            files.insert(short.to_string_lossy().replace('\\', "/"), text);
        }
    }
}
