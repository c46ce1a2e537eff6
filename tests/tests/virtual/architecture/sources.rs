//! Rules about what stands in which file. What code calls, and which types it takes from libraries,
//! is for the lints of the `clippy.toml` files.

use crate::architecture::imports::imports_of;
use crate::architecture::tree::{Breaches, Token, Tree};
use std::collections::BTreeSet;

/// Words that leave open which part of the system acts.
const VAGUE: &str = "whoever nobody somebody anybody everybody anew";
/// What sources do not contain: parts of their paths, parted by blanks, and the marks after a bar.
const REFUSED: [&str; 3] = [
    // Silences a warning, or skips a test or an example.
    ".rs|#[ignore|allow(dead_code|allow(unused|allow(clippy::all|```ignore|text,ignore|rust,ignore",
    // What clippy refuses in programs of tests, unit tests may otherwise do.
    "actors/src/ core/ examples/tests/|thread::sleep",
    // Modules whose every use is an effect. Clippy's lists name single functions.
    "core/src/ core/lite/src/ core/trees/src/|std::net|std::os|std::fs|std::env|std::process|\
     std::thread",
];
/// A file stays below this, so that it can be read in one sitting.
const LONGEST: usize = 1_000;

/// Pages and sources say which part acts; sources silence nothing, and begin with what they are.
/// Tests that were moved out of a file have their story there.
pub(crate) fn lines(tree: &Tree) -> Breaches {
    let mut breaches = Breaches::new();
    // These files contain what they look for.
    let is_rule = |path: &str| path.starts_with("tests/tests/virtual/architecture/");
    for (path, text) in tree.files.iter().filter(|(path, _)| !is_rule(path)) {
        let mut breach = |line, what: &str| breaches.insert((path.clone(), line, what.to_owned()));
        let is_source = path.ends_with(".rs");
        for (line, number) in text.lines().zip(1..) {
            let mut words = line.split(|c: char| !c.is_alphanumeric() && c != '_');
            let is_vague = |word: &&str| VAGUE.split(' ').any(|v| word.eq_ignore_ascii_case(v));
            let mark = REFUSED.iter().find_map(|refused| {
                let (paths, marks) = refused.split_once('|')?;
                let held = is_source && paths.split(' ').any(|part| path.contains(part));
                let mark = marks.split('|').find(|mark| held && line.contains(mark))?;
                // The platform's own wait.
                (mark != "thread::sleep" || !path.ends_with("/platform.rs")).then_some(mark)
            });
            if let Some(found) = mark.or_else(|| words.find(is_vague)) {
                breach(number, found);
            }
        }
        if is_source && !text.starts_with("//!") && !path.ends_with("tests.rs") {
            breach(1, "the file does not begin with //!");
        }
        if is_source && text.lines().count() > LONGEST {
            breach(LONGEST, "the file is too long to be read in one sitting");
        }
    }
    breaches
}

/// Tests on real threads stand in a test program or a module `real`, and each takes its turn first,
/// or is run by `doubles::real`, which no other test is. A test that plays a role in a process of
/// another test has none to wait for.
pub(crate) fn turns(tree: &Tree) -> Breaches {
    let mut breaches = Breaches::new();
    for (path, text) in tree.files.iter().filter(|(path, _)| path.ends_with(".rs")) {
        let mut real = path.contains("/real/");
        let mut lines = text.lines().map(str::trim_start).zip(1..);
        while let Some((line, number)) = lines.next() {
            real |= line == "mod real {";
            let is_run = line.starts_with("#[") && line.contains("test(crate =");
            let mut wrong = is_run && line.contains("::real\"") != real;
            if real && line == "#[test]" {
                let (name, _) = lines.find(|(line, _)| line.starts_with("fn ")).unwrap_or_default();
                let (first, _) =
                    lines.find(|(line, _)| !line.starts_with("//")).unwrap_or_default();
                let takes = first.starts_with("let _turn") || first.starts_with("let Some(_turn");
                wrong = !takes && !name.starts_with("fn a_process_");
            }
            if wrong {
                breaches.insert((path.clone(), number, line.to_owned()));
            }
        }
    }
    breaches
}

/// actix stays out of what a user of the facade can name, but for the module that is for it. That
/// what is marked `pub` can be reached from outside is for the compiler's lint `unreachable_pub`.
pub(crate) fn facade(tree: &Tree) -> Breaches {
    let mut breaches = Breaches::new();
    let is_facade =
        |path: &str| path.starts_with("actors/src/") && !path.starts_with("actors/src/plain");
    for (path, code) in tree.code.iter().filter(|(path, _)| is_facade(path)) {
        let is_actix = |name: &String| name == "actix" || name == "actix_rt";
        let imports = imports_of(code).into_iter();
        let imports = imports.filter(|import| import.path.first().is_some_and(is_actix));
        let names: BTreeSet<String> = imports.map(|import| import.name).collect();
        let is_foreign = |token: &&Token| is_actix(&token.text) || names.contains(&token.text);
        for at in (1..code.len()).filter(|&at| code[at - 1].text == "pub" && code[at].text != "(") {
            for token in interface(&code[at..]).filter(is_foreign) {
                breaches.insert((path.clone(), token.line, token.text.clone()));
            }
        }
    }
    breaches
}

/// What a user sees of the public item or field that begins here: all but the body of a function,
/// and the fields of a struct, each of which has a visibility of its own.
fn interface(item: &[Token]) -> impl Iterator<Item = &Token> {
    let (kind, depth, mut angles) = (item[0].text.as_str(), item[0].depth, 0);
    item.iter().take_while(move |token| {
        let ends = match token.text.as_str() {
            "{" => !matches!(kind, "use" | "enum" | "trait"),
            "(" => kind == "struct",
            // The end of a field; a generic argument is followed by one as well.
            "," => angles <= 0 && !matches!(kind, "fn" | "async" | "const"),
            sign => matches!(sign, ";" | "}"),
        };
        angles += i32::from(token.text == "<") - i32::from(token.text == ">");
        token.depth > depth || token.depth == depth && !ends
    })
}
