//! Rules about what stands in which file. What code calls, and which types it takes from libraries,
//! is for the lints of the `clippy.toml` files.

use crate::architecture::imports::imports_of;
use crate::architecture::tree::{Breach, PRODUCT, Source, Token, Tree, begins};
use std::collections::{BTreeMap, BTreeSet};

/// Words that leave open which part of the system acts.
const VAGUE: [&str; 6] = ["whoever", "nobody", "somebody", "anybody", "everybody", "anew"];
/// What silences a warning or skips a test or an example.
const SILENCED: [&str; 7] = [
    "#[ignore",
    "allow(dead_code",
    "allow(unused",
    "allow(clippy::all",
    "```ignore",
    "```text,ignore",
    "```rust,ignore",
];
/// A page is read in a terminal beside the code. A row of a table cannot be broken.
const WIDTH: usize = 120;
/// A file stays below this, so that it can be read in one sitting.
const LONGEST: usize = 1_000;

/// Modules whose every use is an effect. Clippy's lists name single functions.
const FOREIGN: [&str; 6] =
    ["std::net", "std::os", "std::fs", "std::env", "std::process", "std::thread"];

/// Lines of pages and sources are of readable width, say who acts, and silence nothing. That
/// nothing is unsafe or unfinished is for the lints.
pub(crate) fn lines(tree: &Tree) -> Vec<Breach> {
    // These files contain what they look for. The derives' examples need the facade, which stands
    // above them; it shows them again.
    let is_rule = |path: &str| path.starts_with("tests/tests/virtual/architecture/");
    let mut breaches = Vec::new();
    for (path, text) in tree.files.iter().filter(|(path, _)| !is_rule(path)) {
        let (page, derives) = (path.ends_with(".md"), path.starts_with("core/macros/"));
        for (line, number) in text.lines().zip(1..) {
            let mut words = line.split(|c: char| !c.is_alphanumeric() && c != '_');
            let vague = |word: &&str| VAGUE.iter().any(|vague| word.eq_ignore_ascii_case(vague));
            let silenced = SILENCED.iter().filter(|_| !page && !derives);
            let wide = page && !line.trim_start().starts_with('|') && line.chars().count() > WIDTH;
            // What clippy refuses in programs of tests, unit tests may otherwise do.
            let held = ["actors/src/", "core/", "examples/tests/"];
            let sleeps = held.iter().any(|folder| path.starts_with(folder))
                && path.ends_with(".rs")
                && !path.ends_with("/platform.rs")
                && line.contains("thread::sleep");
            let machines = ["core/src/", "core/lite/src/", "core/trees/src/"];
            let is_machine = machines.iter().any(|folder| path.starts_with(folder));
            let mut foreign = FOREIGN.iter().filter(|module| is_machine && line.contains(**module));
            let found = [
                words.find(vague).map(|word| format!("`{word}` leaves open which part acts")),
                silenced.filter(|mark| line.contains(**mark)).map(|mark| mark.to_string()).next(),
                sleeps.then(|| "thread::sleep".to_owned()),
                foreign.next().map(|module| format!("{module}: a machine of the core does no IO")),
                wide.then(|| format!("wider than {WIDTH} columns")),
            ];
            breaches
                .extend(found.into_iter().flatten().map(|what| Breach::new(path, number, what)));
        }
    }
    breaches
}

/// The files that the modules of all sources declare, wherever these may lie.
fn declared(tree: &Tree) -> BTreeSet<String> {
    let mut declared = BTreeSet::new();
    for Source { path, tokens, .. } in &tree.sources {
        let (folder, _) = path.rsplit_once('/').unwrap_or_default();
        for here in tokens.windows(3).filter(|here| here[0].text == "mod" && here[2].text == ";") {
            for folder in [folder, path.trim_end_matches(".rs")] {
                let file = format!("{folder}/{}", here[1].text);
                declared.extend([format!("{file}.rs"), format!("{file}/mod.rs")]);
            }
        }
    }
    declared
}

/// Whether Cargo takes the file for a target by its place.
fn is_target(tree: &Tree, path: &str) -> bool {
    let mut parts = path.rsplitn(3, '/');
    let (file, folder) = (parts.next().unwrap_or_default(), parts.next().unwrap_or_default());
    let package = parts.next().unwrap_or_default();
    match folder {
        "bin" => true,
        "tests" | "benches" | "examples" | "fuzz_targets" => {
            tree.files.contains_key(&format!("{package}/Cargo.toml"))
        }
        _ => matches!(file, "lib.rs" | "main.rs"),
    }
}

/// Every file is about one concept, says at its beginning which, and is declared by a module or
/// is a target. Tests that were moved out of a file have their story there.
pub(crate) fn files(tree: &Tree) -> Vec<Breach> {
    let (declared, mut breaches) = (declared(tree), Vec::new());
    for Source { path, .. } in &tree.sources {
        let text = &tree.files[path];
        if !text.starts_with("//!") && !path.ends_with("tests.rs") {
            breaches.push(Breach::new(path, 1, "the file does not begin with //!"));
        }
        if text.lines().count() > LONGEST {
            breaches.push(Breach::new(path, LONGEST, format!("more than {LONGEST} lines")));
        }
        if !declared.contains(path) && !is_target(tree, path) {
            breaches.push(Breach::new(path, 1, "no module declares this file"));
        }
    }
    breaches
}

/// Tests on real threads stand in a test program or a module `real`, and each takes its turn first.
/// A test that plays a role in a process of another test has none to wait for.
pub(crate) fn turns(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for Source { path, tokens, .. } in &tree.sources {
        let module = tokens.windows(3).position(|here| begins(here, "mod real {"));
        let whole = path.contains("/real/").then_some(0);
        let real = whole.or(module).unwrap_or(tokens.len());
        for at in (0..tokens.len()).filter(|&at| begins(&tokens[at..], "test ( crate =")) {
            let is_real = tokens[at..].iter().take(5).any(|token| token.text.contains("::real"));
            if is_real != (at > real) {
                let what = "a test on real threads runs by doubles::real, and no other does";
                breaches.push(Breach::new(path, tokens[at].line, what));
            }
        }
        for at in (real..tokens.len()).filter(|&at| begins(&tokens[at..], "# [ test ]")) {
            let mut after = tokens[at..].iter().map(|token| token.text.as_str());
            let name = after.by_ref().skip_while(|text| *text != "fn").nth(1).unwrap_or_default();
            let body = after.skip_while(|text| *text != "{").skip(1).take(4).collect::<Vec<_>>();
            let turn = body.starts_with(&["let", "_turn"])
                || matches!(body[..], ["let", "Some", _, "_turn"]);
            if !turn && !name.starts_with("a_process_") {
                breaches.push(Breach::new(path, tokens[at].line, name));
            }
        }
    }
    breaches
}

/// Names that several types may have.
const SHARED: [&str; 3] = [
    // The facade's description of a link, and the core's machine that it configures.
    "Link",
    // The port of a device, on a chip, and of a node of a tree: no program has both.
    "Port",
    // Both types belong to the replicated services, which are to be replaced as a whole.
    "Known",
];

/// A type that other files can name shares its name with no other type.
pub(crate) fn names_of_types(tree: &Tree) -> Vec<Breach> {
    let mut named: BTreeMap<&str, Vec<(bool, Breach)>> = BTreeMap::new();
    let kinds = ["struct", "enum", "trait", "type", "union"];
    for Source { path, code, .. } in &tree.sources {
        if !PRODUCT.iter().any(|folder| path.starts_with(folder)) {
            continue;
        }
        for (at, token) in code.iter().enumerate() {
            if token.depth == 0 && kinds.contains(&token.text.as_str()) {
                let visible = at > 0 && matches!(code[at - 1].text.as_str(), "pub" | ")");
                let name = &code[at + 1].text;
                let breach = Breach::new(path, code[at + 1].line, format!("`{name}`"));
                named.entry(name).or_default().push((visible, breach));
            }
        }
    }
    named.retain(|name, all| {
        let visible = all.iter().any(|(visible, _)| *visible);
        all.len() > 1 && visible && !SHARED.contains(name)
    });
    named.into_values().flatten().map(|(_, breach)| breach).collect()
}

/// Names that say nothing about what they name.
const EMPTY_NAMES: [&str; 9] =
    ["util", "utils", "common", "helper", "helpers", "manager", "managers", "misc", "stuff"];

/// Files, folders, packages, modules and types are named by what they are.
pub(crate) fn empty_names(tree: &Tree) -> Vec<Breach> {
    let paths = tree.files.keys().filter(|path| is_empty(path.trim_end_matches(".rs")));
    let mut breaches: Vec<_> = paths.map(|path| Breach::new(path, 1, "the path")).collect();
    for Source { path, tokens, .. } in &tree.sources {
        for pair in tokens.windows(2) {
            let named = ["struct", "enum", "trait", "mod", "type"].contains(&pair[0].text.as_str());
            if named && is_empty(&pair[1].text) {
                breaches.push(Breach::new(path, pair[1].line, &pair[1].text));
            }
        }
    }
    breaches
}

/// Whether one of the words of a name, in either case style, says nothing.
fn is_empty(name: &str) -> bool {
    let mut words = String::new();
    for sign in name.chars() {
        words.extend(sign.is_uppercase().then_some('_').into_iter().chain(sign.to_lowercase()));
    }
    words.split(|c: char| !c.is_alphanumeric()).any(|word| EMPTY_NAMES.contains(&word))
}

/// actix stays out of what a user of the facade can name, but for the module that is for it. That
/// what is marked `pub` can be reached from outside is for the compiler's lint `unreachable_pub`.
pub(crate) fn facade(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for Source { path, code, .. } in &tree.sources {
        if !path.starts_with("actors/src/") || path.starts_with("actors/src/plain") {
            continue;
        }
        let is_actix = |name: &str| name == "actix" || name == "actix_rt";
        let imports = imports_of(code).into_iter();
        let mut foreign: BTreeSet<String> = imports
            .filter(|import| import.path.first().is_some_and(|first| is_actix(first)))
            .map(|import| import.name)
            .collect();
        foreign.extend(["actix", "actix_rt"].map(String::from));
        for at in (0..code.len()).filter(|&at| code[at].text == "pub" && code[at + 1].text != "(") {
            for token in outside(&code[at + 1..]).filter(|token| foreign.contains(&token.text)) {
                breaches.push(Breach::new(path, token.line, &token.text));
            }
        }
    }
    breaches
}

/// What a user sees of the public item or field that begins here: all but the body of a function,
/// and the fields of a struct, each of which has a visibility of its own.
fn outside(item: &[Token]) -> impl Iterator<Item = &Token> {
    let depth = item.first().map_or(0, |token| token.depth);
    let mut words = item.iter().map(|token| token.text.as_str());
    let kind = words.find(|word| !matches!(*word, "async" | "const")).unwrap_or_default();
    let (mut angles, mut before) = (0, "");
    item.iter().take_while(move |token| {
        let text = token.text.as_str();
        match (text, before) {
            ("<", _) => angles += 1,
            (">", "-" | "=") => {}
            (">", _) => angles -= 1,
            _ => {}
        }
        before = text;
        let ends = match kind {
            "use" | "type" | "enum" | "trait" => matches!(text, ";" | "}"),
            "struct" => matches!(text, ";" | "{" | "("),
            "fn" | "mod" => matches!(text, ";" | "{"),
            _ => text == ";" || text == "," && angles == 0,
        };
        token.depth > depth || token.depth == depth && !ends
    })
}

/// Objects of the middleware hold recipients of messages, not addresses of each other's types. An
/// actor's own file may hold its address: there stands the handle by which others know it.
pub(crate) fn acquaintance(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for Source { path, code, .. } in &tree.sources {
        let objects = ["actors/src/fault_chain/", "actors/src/net/", "transports/src/"];
        // The one file that starts the network's actors, and connects them, knows them all.
        let connects = path == "actors/src/net/mod.rs";
        if connects || !objects.iter().any(|folder| path.starts_with(folder)) {
            continue;
        }
        for here in code.windows(3).filter(|here| begins(here, "Addr <")) {
            let whose = &here[2].text;
            let actor = format!("impl Actor for {whose}");
            if whose != "Self" && !code.windows(4).any(|here| begins(here, &actor)) {
                breaches.push(Breach::new(path, here[0].line, format!("Addr<{whose}>")));
            }
        }
    }
    breaches
}
