//! The project's files as the rules see them: texts, and the tokens of sources with their lines.
//!
//! Comments and texts are no tokens, so that a rule about code never trips over a sentence that
//! speaks of it. The tree is plain data: a rule can be shown a small false one.

use proc_macro2::{Delimiter, Span, TokenStream, TokenTree};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// The packages of a robot in operation. Test doubles are named after what they stand for.
pub(crate) const PRODUCT: &str = "core/src core/trees/src core/lite/src core/contract/src \
    core/macros/src transports/src actors/src actors/robot/src actors/cli/src actors/demo/src";

/// Where a rule is broken: the file from the project's root, the line from 1, and what stands there.
pub(crate) type Breaches = BTreeSet<(String, usize, String)>;

/// One word or sign of a source; brackets are tokens themselves, and so is `::`.
#[derive(Clone)]
pub(crate) struct Token {
    pub(crate) text: String,
    pub(crate) line: usize,
    /// How many brackets are open around it.
    pub(crate) depth: usize,
}

/// All files that rules look at, by their path from the root.
pub(crate) struct Tree {
    /// Sources, manifests and pages.
    pub(crate) files: BTreeMap<String, String>,
    /// The tokens of each source, without what is only for tests.
    pub(crate) code: BTreeMap<String, Vec<Token>>,
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
        let is_test = |part: &str| matches!(part, "tests" | "tests.rs" | "benches");
        let sources =
            files.iter().filter(|(path, _)| path.ends_with(".rs") && !path.split('/').any(is_test));
        let code = sources.map(|(path, text)| {
            let stream: TokenStream =
                text.parse().unwrap_or_else(|error| panic!("{path}: {error}: rustfmt shows where"));
            let mut tokens = Vec::new();
            flatten(stream, 0, &mut tokens);
            (path.clone(), without_tests(&tokens))
        });
        Tree { code: code.collect(), files }
    }
}

fn flatten(stream: TokenStream, depth: usize, tokens: &mut Vec<Token>) {
    let token =
        |text: &str, span: Span| Token { text: text.into(), line: span.start().line, depth };
    for tree in stream {
        match tree {
            TokenTree::Group(group) => {
                let (open, close) = match group.delimiter() {
                    Delimiter::Parenthesis => ("(", ")"),
                    Delimiter::Brace => ("{", "}"),
                    Delimiter::Bracket | Delimiter::None => ("[", "]"),
                };
                tokens.push(token(open, group.span_open()));
                flatten(group.stream(), depth + 1, tokens);
                tokens.push(token(close, group.span_close()));
            }
            other => match (other.to_string().as_str(), tokens.last_mut()) {
                (":", Some(colon)) if colon.text == ":" => colon.text.push(':'),
                (text, _) => tokens.push(token(text, other.span())),
            },
        }
    }
}

/// The tokens without each item, statement or field behind `#[cfg(test)]`, or `#[cfg(all(test, ..`.
fn without_tests(tokens: &[Token]) -> Vec<Token> {
    let (mut code, mut rest) = (Vec::new(), tokens);
    while let Some(token) = rest.first() {
        let ends = |end: &Token| {
            end.depth < token.depth
                || end.depth == token.depth && matches!(end.text.as_str(), ";" | "," | "}")
        };
        let is_test = token.text == "#" && {
            let attribute: String = rest.iter().take(7).map(|token| token.text.as_str()).collect();
            attribute.starts_with("#[cfg(test") || attribute.starts_with("#[cfg(all(test")
        };
        let mut end = 0;
        if is_test {
            end = rest.iter().position(ends).unwrap_or(rest.len() - 1);
        } else {
            code.push(token.clone());
        }
        rest = &rest[end + 1..];
    }
    code
}

/// Puts every text file below `folder` into `files`; what is built or kept by tools, and what is not to
/// compile, is left out.
fn collect(root: &Path, folder: &Path, files: &mut BTreeMap<String, String>) {
    for entry in fs::read_dir(folder).expect("the project's folders can be read") {
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
