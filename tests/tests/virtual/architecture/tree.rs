//! The project's files as the rules see them: manifests as lines, sources as tokens with lines.
//!
//! Comments and texts are no tokens, so that a rule about code never trips over a sentence that
//! speaks of it. The tree is plain data: a rule can be shown a small false one.

use proc_macro2::{Delimiter, Spacing, TokenStream, TokenTree};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use syn::spanned::Spanned;

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

/// One word or sign of a source.
#[derive(Clone, Debug)]
pub(crate) struct Token {
    pub(crate) text: String,
    pub(crate) line: usize,
}

/// The definition of a type.
#[derive(Debug)]
pub(crate) struct Definition {
    pub(crate) name: String,
    pub(crate) line: usize,
    /// Only its own file can name it.
    pub(crate) private: bool,
}

/// One Rust file.
#[derive(Debug)]
pub(crate) struct Source {
    pub(crate) path: String,
    pub(crate) text: String,
    pub(crate) tokens: Vec<Token>,
    /// The files in which its declared modules may lie, and whether they exist only in tests.
    modules: Vec<(Vec<String>, bool)>,
    /// The types that it defines outside of tests.
    pub(crate) types: Vec<Definition>,
    /// Reached only as a test: a file under `tests/`, or behind `#[cfg(test)]`.
    pub(crate) test: bool,
    /// First and last lines of the items that exist only in tests.
    test_lines: Vec<(usize, usize)>,
}

impl Source {
    /// Whether the line exists only in tests.
    pub(crate) fn is_test(&self, line: usize) -> bool {
        self.test || self.test_lines.iter().any(|&(first, last)| (first..=last).contains(&line))
    }

    /// The lines where these tokens, parted by blanks, follow one another: `Instant :: now`.
    pub(crate) fn lines_with(&self, code: &str) -> Vec<usize> {
        let wanted: Vec<&str> = code.split(' ').collect();
        self.tokens
            .windows(wanted.len())
            .filter(|here| here.iter().zip(&wanted).all(|(token, wanted)| token.text == *wanted))
            .map(|here| here[0].line)
            .collect()
    }

    /// How many lines the file has, those that exist only in tests not counted.
    pub(crate) fn length(&self) -> usize {
        (1..=self.text.lines().count()).filter(|&line| !self.is_test(line)).count()
    }
}

#[derive(Debug)]
pub(crate) struct Manifest {
    pub(crate) path: String,
    /// The package's name; none in the root manifest.
    pub(crate) package: Option<String>,
    /// Every entry: its section, its line and its text.
    pub(crate) entries: Vec<(String, usize, String)>,
}

impl Manifest {
    /// The entries of the sections that end so, as `dependencies` or `dev-dependencies`.
    pub(crate) fn section<'a>(
        &'a self,
        ending: &'a str,
    ) -> impl Iterator<Item = (usize, &'a str)> + 'a {
        let of_target = format!(".{ending}");
        self.entries
            .iter()
            .filter(move |(section, ..)| section == ending || section.ends_with(&of_target))
            .map(|(_, line, text)| (*line, text.as_str()))
    }

    /// The folder of the package, with a slash at its end unless it is the root.
    pub(crate) fn folder(&self) -> &str {
        self.path.trim_end_matches("Cargo.toml")
    }
}

/// The name at the beginning of a manifest's entry.
pub(crate) fn key(entry: &str) -> &str {
    entry.split(['=', '.']).next().unwrap_or(entry).trim().trim_matches('"')
}

/// All files that rules look at.
#[derive(Debug, Default)]
pub(crate) struct Tree {
    /// Sources, manifests and pages by their path from the root.
    pub(crate) files: BTreeMap<String, String>,
    /// The Rust sources that some target reaches.
    pub(crate) sources: Vec<Source>,
    /// The Rust sources that no target reaches.
    pub(crate) unreached: BTreeSet<String>,
    /// The workspace's manifests.
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

    /// A tree of these files.
    pub(crate) fn of_texts(texts: &[(&str, &str)]) -> Tree {
        Tree::of(texts.iter().map(|&(path, text)| (path.into(), text.into())).collect())
    }

    fn of(files: BTreeMap<String, String>) -> Tree {
        let manifests: Vec<Manifest> = files
            .iter()
            .filter(|(path, _)| path.as_str() == "Cargo.toml" || path.ends_with("/Cargo.toml"))
            .map(|(path, text)| manifest(path, text))
            .collect();
        let mut tree = Tree { files, manifests, ..Tree::default() };
        let mut reached = BTreeMap::new();
        for path in tree.files.keys().filter(|path| path.ends_with(".rs")) {
            if let Some(test) = target(path) {
                tree.reach(path, test, &mut reached);
            }
        }
        tree.unreached = tree
            .files
            .keys()
            .filter(|path| path.ends_with(".rs") && !reached.contains_key(*path))
            .cloned()
            .collect();
        tree.sources = reached.into_values().collect();
        tree
    }

    /// Reads a file and the files of the modules that it declares.
    fn reach(&self, path: &str, test: bool, reached: &mut BTreeMap<String, Source>) {
        // A file that both a test and the product reach is the product's.
        if reached.get(path).is_some_and(|known| test || !known.test) {
            return;
        }
        let text = &self.files[path];
        let source = source(path, text, test);
        let declared = source.modules.clone();
        reached.insert(path.into(), source);
        for (candidates, test) in declared {
            if let Some(found) = candidates.iter().find(|path| self.files.contains_key(*path)) {
                self.reach(found, test, reached);
            }
        }
    }

    /// The manifest of the package that the file belongs to.
    pub(crate) fn package_of(&self, path: &str) -> Option<&Manifest> {
        self.manifests
            .iter()
            .filter(|manifest| path.starts_with(manifest.folder()))
            .max_by_key(|manifest| manifest.folder().len())
    }
}

/// Puts every text file below `folder` into `files`; what is built or kept by tools is left out.
fn collect(root: &Path, folder: &Path, files: &mut BTreeMap<String, String>) {
    let entries = fs::read_dir(folder).expect("the project's folders can be read");
    for entry in entries {
        let path = entry.expect("the project's folders can be read").path();
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        if path.is_dir() {
            if !matches!(name, "target" | ".git" | "corpus" | "artifacts") {
                collect(root, &path, files);
            }
        } else if name.ends_with(".rs") || name.ends_with(".toml") || name.ends_with(".md") {
            let short = path.strip_prefix(root).expect("a path below the root");
            let text = fs::read_to_string(&path).expect("sources and pages are UTF-8");
            files.insert(short.to_string_lossy().replace('\\', "/"), text);
        }
    }
}

/// Whether Cargo takes the file for the root of a target by its place, and then whether of a test.
fn target(path: &str) -> Option<bool> {
    let folders: Vec<&str> = path.split('/').collect();
    let below = |name: &str| {
        let at = folders.iter().rposition(|folder| *folder == name)?;
        let rest = &folders[at + 1..];
        (rest.len() == 1 || rest.len() == 2 && rest[1] == "main.rs").then_some(())
    };
    if path.starts_with("tests/fuzz/") {
        return below("fuzz_targets").map(|()| true);
    }
    if path == "build.rs" || path.ends_with("/build.rs") {
        return Some(false);
    }
    if folders.iter().rev().nth(1) == Some(&"src")
        && matches!(folders.last(), Some(&"lib.rs" | &"main.rs"))
        || below("bin").is_some() && folders.contains(&"src")
    {
        return Some(path.starts_with("tests/"));
    }
    // The package `tests` has its own folder `tests`; `tests/bench` is a package and no target.
    let own = folders.iter().filter(|folder| **folder == "tests").count();
    let test = below("tests").is_some() && (folders[0] != "tests" || own == 2);
    let example = below("examples").is_some() && (folders[0] != "examples" || folders.len() > 2);
    (test || below("benches").is_some() || example).then_some(!example)
}

/// Where the files of a file's modules lie.
fn module_folder(path: &str) -> String {
    let (folder, file) = path.rsplit_once('/').unwrap_or(("", path));
    let stem = file.trim_end_matches(".rs");
    let is_root = target(path).is_some() || stem == "mod";
    if is_root { folder.into() } else { format!("{folder}/{stem}") }
}

/// The files in which a module that is declared may lie, and whether it exists only in tests.
fn declared_modules(items: &[syn::Item], folder: &str, test: bool) -> Vec<(Vec<String>, bool)> {
    let mut found = Vec::new();
    for item in items {
        let syn::Item::Mod(module) = item else { continue };
        let test = test || only_in_tests(&module.attrs);
        let name = module.ident.to_string();
        match &module.content {
            Some((_, inner)) => {
                found.extend(declared_modules(inner, &format!("{folder}/{name}"), test));
            }
            None => {
                let named = module.attrs.iter().find(|attribute| attribute.path().is_ident("path"));
                let candidates = match named.map(|attribute| &attribute.meta) {
                    Some(syn::Meta::NameValue(meta)) => {
                        let value = &meta.value;
                        let text = quote::quote!(#value).to_string();
                        vec![format!("{folder}/{}", text.trim_matches('"'))]
                    }
                    _ => vec![format!("{folder}/{name}.rs"), format!("{folder}/{name}/mod.rs")],
                };
                found.push((candidates, test));
            }
        }
    }
    found
}

fn source(path: &str, text: &str, test: bool) -> Source {
    let file = syn::parse_file(text).unwrap_or_else(|error| {
        panic!("{path}:{}: {error}: let rustfmt show what is wrong", error.span().start().line)
    });
    let stream = text.parse().expect("what parses as a file is made of tokens");
    let (mut test_lines, mut types) = (Vec::new(), Vec::new());
    collect_test_lines(&file.items, &mut test_lines);
    collect_types(&file.items, &mut types);
    Source {
        path: path.into(),
        text: text.into(),
        tokens: tokens_of(stream),
        modules: declared_modules(&file.items, &module_folder(path), test),
        types,
        test,
        test_lines,
    }
}

fn collect_test_lines(items: &[syn::Item], lines: &mut Vec<(usize, usize)>) {
    for item in items {
        if only_in_tests(attributes(item)) {
            lines.push((item.span().start().line, item.span().end().line));
        } else if let syn::Item::Mod(syn::ItemMod { content: Some((_, inner)), .. }) = item {
            collect_test_lines(inner, lines);
        }
    }
}

fn collect_types(items: &[syn::Item], types: &mut Vec<Definition>) {
    for item in items.iter().filter(|item| !only_in_tests(attributes(item))) {
        let (name, visibility) = match item {
            syn::Item::Enum(item) => (&item.ident, &item.vis),
            syn::Item::Struct(item) => (&item.ident, &item.vis),
            syn::Item::Trait(item) => (&item.ident, &item.vis),
            syn::Item::Type(item) => (&item.ident, &item.vis),
            syn::Item::Union(item) => (&item.ident, &item.vis),
            syn::Item::Mod(syn::ItemMod { content: Some((_, inner)), .. }) => {
                collect_types(inner, types);
                continue;
            }
            _ => continue,
        };
        let private = matches!(visibility, syn::Visibility::Inherited);
        types.push(Definition { name: name.to_string(), line: name.span().start().line, private });
    }
}

fn attributes(item: &syn::Item) -> &[syn::Attribute] {
    match item {
        syn::Item::Const(item) => &item.attrs,
        syn::Item::Enum(item) => &item.attrs,
        syn::Item::Fn(item) => &item.attrs,
        syn::Item::Impl(item) => &item.attrs,
        syn::Item::Macro(item) => &item.attrs,
        syn::Item::Mod(item) => &item.attrs,
        syn::Item::Static(item) => &item.attrs,
        syn::Item::Struct(item) => &item.attrs,
        syn::Item::Trait(item) => &item.attrs,
        syn::Item::Type(item) => &item.attrs,
        syn::Item::Union(item) => &item.attrs,
        syn::Item::Use(item) => &item.attrs,
        _ => &[],
    }
}

/// Whether the attributes hold `#[cfg(test)]`, or `test` as one condition of `all`.
fn only_in_tests(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().filter(|attribute| attribute.path().is_ident("cfg")).any(|attribute| {
        let syn::Meta::List(list) = &attribute.meta else { return false };
        let tokens = tokens_of(list.tokens.clone());
        let first = tokens.first().map(|token| token.text.as_str());
        first == Some("test")
            || first == Some("all") && tokens.iter().any(|token| token.text == "test")
    })
}

/// A stream of tokens without its nesting; brackets are tokens themselves, and so is `::`.
pub(crate) fn tokens_of(stream: TokenStream) -> Vec<Token> {
    fn flatten(stream: TokenStream, out: &mut Vec<Token>) {
        let mut joined = false;
        for tree in stream {
            let line = tree.span().start().line;
            match tree {
                TokenTree::Group(group) => {
                    let (open, close) = match group.delimiter() {
                        Delimiter::Parenthesis => ("(", ")"),
                        Delimiter::Brace => ("{", "}"),
                        Delimiter::Bracket => ("[", "]"),
                        Delimiter::None => ("", ""),
                    };
                    out.push(Token { text: open.into(), line });
                    flatten(group.stream(), out);
                    out.push(Token { text: close.into(), line: group.span_close().start().line });
                }
                other => {
                    let text = other.to_string();
                    match out.last_mut() {
                        Some(last) if joined && text == ":" => last.text = "::".into(),
                        _ => out.push(Token { text: text.clone(), line }),
                    }
                    joined = matches!(&other, TokenTree::Punct(sign)
                        if text == ":" && sign.spacing() == Spacing::Joint);
                }
            }
        }
    }
    let mut out = Vec::new();
    flatten(stream, &mut out);
    out
}

/// Reads the little of TOML that Cargo's manifests in this project use: sections, and entries on
/// one line or on several lines of one list.
fn manifest(path: &str, text: &str) -> Manifest {
    let mut section = String::new();
    let mut package = None;
    let mut entries = Vec::new();
    for (at, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            section = name.trim_matches(['[', ']']).into();
            // `[dependencies.serde]` is an entry of its parent as well.
            if let Some((parent, name)) = section.rsplit_once("dependencies.") {
                entries.push((format!("{parent}dependencies"), at + 1, format!("{name} = table")));
            }
            continue;
        }
        if section == "package" && key(line) == "name" {
            package = line.split('"').nth(1).map(String::from);
        }
        entries.push((section.clone(), at + 1, line.into()));
    }
    Manifest { path: path.into(), package, entries }
}
