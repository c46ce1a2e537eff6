//! The invariants of ARCHITECTURE.md, held as tests.
//!
//! Each rule is a function from the tree of files to its breaches. One test applies the rules to
//! this project; another one shows each of them small trees that break it, since a rule that cannot
//! fail proves nothing.

mod imports;
mod packages;
mod pages;
mod sources;
mod tree;

use std::collections::BTreeMap;
use tree::{Breach, Tree};

/// What holds in a tree, what to do about a breach, and trees that break it, as [`marked`] reads
/// them.
type Rule<'a> = (fn(&Tree) -> Vec<Breach>, &'static str, &'a [&'a str]);

/// The breaches of a rule, in order, each once.
fn found(rule: fn(&Tree) -> Vec<Breach>, tree: &Tree) -> Vec<Breach> {
    let mut breaches = rule(tree);
    breaches.sort();
    breaches.dedup();
    breaches
}

#[test]
fn the_project_keeps_every_rule() {
    let (project, mut told) = (Tree::of_project(), String::new());
    with_rules(|(rule, cure, _)| {
        for Breach { path, line, what } in found(rule, &project) {
            told += &format!("{path}:{line}: {what}\n    What to do: {cure}\n");
        }
    });
    assert!(told.is_empty(), "\n{told}");
}

#[test]
fn every_rule_can_fail() {
    with_rules(|(rule, cure, broken)| {
        assert!(!broken.is_empty(), "{cure}");
        for text in broken {
            let (tree, expected) = marked(text);
            assert!(!expected.is_empty(), "{text}");
            let found = found(rule, &tree).into_iter().map(|breach| (breach.path, breach.line));
            let mut found: Vec<_> = found.collect();
            found.dedup();
            assert_eq!(found, expected, "{cure}");
        }
    });
}

/// The tree of a text, and the paths and lines that break a rule. Each line of the text is a file:
/// its path, a colon, and its lines, which are parted by `¶`. A line that begins with that goes on
/// with the file. Where a line of a file ends with `<-`, which is no part of it, it breaks the rule,
/// and no other line does.
fn marked(text: &str) -> (Tree, Vec<(String, usize)>) {
    let (mut files, mut marks, mut path) = (BTreeMap::<_, String>::new(), Vec::new(), "");
    for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
        let lines = line.strip_prefix("¶ ").unwrap_or_else(|| {
            let (file, lines) = line.split_once(':').expect("a path and a text");
            path = file;
            lines.strip_prefix(' ').unwrap_or_default()
        });
        let file = files.entry(path.to_owned()).or_default();
        for line in lines.split(" ¶ ") {
            let kept = line.strip_suffix("<-").map(str::trim_end);
            *file += &format!("{}\n", kept.unwrap_or(line));
            marks.extend(kept.map(|_| (path.to_owned(), file.lines().count())));
        }
    }
    marks.sort();
    (Tree::of(files), marks)
}

fn with_rules(each: impl FnMut(Rule<'_>)) {
    let long = format!("core/src/lib.rs: //! Long. ¶ {}// <- ¶ //", "// ¶ ".repeat(998));
    let wide = "ä".repeat(120);
    let wide = format!("docs/page.md: | {wide} | ¶ {wide} ¶ {wide}ä <-");
    let rules: [Rule<'_>; 12] = [
        (
            packages::arrows,
            "move what is needed further down, or turn the call into a message of core/contract; \
             a new package gets its place in the map of ARCHITECTURE.md and in PLACES of \
             packages.rs",
            &[
                r#"core/Cargo.toml: [package] <- ¶ name = "blastema-core" ¶ [dependencies]
                ¶ serde.workspace = true ¶ blastema.workspace = true
                core/doubles/Cargo.toml: [package] <- ¶ name = "blastema-doubles"
                ¶ [dev-dependencies] ¶ blastema-transports = { workspace = true }
                extras/Cargo.toml: [package] <- ¶ name = "blastema-extras"
                core/lite/Cargo.toml: [package] <- ¶ name = "blastema-lite" ¶ [dependencies]
                ¶ bytes.workspace = true"#,
                r#"core/Cargo.toml: [package] <- ¶ name = "blastema-core"
                ¶ [target.'cfg(unix)'.dependencies] ¶ blastema-contract.workspace = true"#,
            ],
        ),
        (
            packages::inheritance,
            "write the version into [workspace.dependencies] and `name.workspace = true` here; \
             add `[lints]` and `workspace = true` to the manifest",
            &[
                r#"Cargo.toml: [workspace.lints.rust] ¶ unsafe_code = "forbid"
                core/Cargo.toml: [package] <- ¶ name = "blastema-core"
                ¶ version.workspace = true ¶ edition.workspace = true
                ¶ rust-version.workspace = true ¶ license.workspace = true
                ¶ [lints] ¶ workspace = true ¶ [dependencies] ¶ serde = "1""#,
                r#"Cargo.toml: [workspace.lints.rust] ¶ unsafe_code = "forbid"
                core/Cargo.toml: [package] <- ¶ name = "blastema-core"
                ¶ version.workspace = true ¶ edition.workspace = true
                ¶ rust-version.workspace = true ¶ license.workspace = true"#,
                "Cargo.toml: [workspace] <-",
            ],
        ),
        (
            imports::layers,
            "move what is needed to the lowest layer that needs it, or turn the import: a trait \
             below, an `impl` block above, an extension of the environment; a new folder gets \
             its place in LAYERS of imports.rs",
            &[r"
            actors/src/lib.rs: mod arbiter; mod host; mod odd;
            actors/src/arbiter.rs: use crate::{host::A, sync::B}; <-
                ¶ fn a() { crate::odd::b() } <-
            actors/src/host.rs: mod spec; ¶ pub(crate) use spec::A; ¶ use crate::arbiter::C;
            actors/src/host/spec.rs: pub(crate) struct A;
            actors/src/odd.rs: use crate::arbiter::C; <- ¶ #[cfg(test)]
                ¶ use crate::host::A;"],
        ),
        (
            imports::circles,
            "move what both need to a file of its own",
            &[r"
            core/src/lib.rs: mod a; mod b; mod c; ¶ pub use b::B;
            core/src/a.rs: use crate::B; <- ¶ use super::c::C;
            core/src/b.rs: use crate::a::A; <-
            core/src/c.rs: struct C;"],
        ),
        (
            sources::lines,
            "finish it, delete it, or make the test pass; name the part of the system that acts; \
             wrap the paragraph of a page",
            &[
                r#"actors/src/lib.rs: #[ignore = "slow"] <- ¶ fn c() {} ¶ #[allow(dead_code)] <-
                ¶ fn d() {} ¶ /// ```ignore <- ¶ fn e() {}"#,
                r"README.md: The caller waits. ¶ Nobody asks. <-
                core/src/lib.rs: fn nobody_asks() {} ¶ // Whoever asks, waits. <-
                actors/src/lib.rs: fn a() { std::thread::sleep(b) } <-",
                &wide,
            ],
        ),
        (
            sources::files,
            "begin with what the file is and deliberately does not do; split it by concept; \
             declare it with `mod`, or delete it",
            &[
                r#"core/src/lib.rs: //! The core. ¶ mod link; ¶ mod net;
                core/src/link.rs: //! A link.
                core/src/net/mod.rs: mod frame; <-
                core/src/net/frame.rs: //! A frame.
                core/src/net/left_over.rs: //! Left over. <-"#,
                &long,
            ],
        ),
        (
            sources::turns,
            "begin it with `let _turn = blastema_doubles::turn();`",
            &[r"
            core/tests/real/main.rs: #[test] <- ¶ #[a] ¶ fn b() { c(); } ¶ #[test]
                ¶ fn a_process_d() {}
            core/src/lib.rs: #[test] ¶ fn a() {} ¶ mod real { ¶ #[test]
                ¶ fn b() { let _turn = c(); } ¶ #[test] <- ¶ fn d() {} ¶ }"],
        ),
        (
            sources::names_of_types,
            "name one of them by the field's term for what it is; the machine or the message of \
             the glossary keeps the name",
            &[r"
            core/src/lib.rs: mod b; ¶ pub(crate) struct State; <- ¶ enum Phase {}
                ¶ struct Link; ¶ trait Mode {}
            core/src/b.rs: type State = u8; <- ¶ struct Phase; ¶ pub struct Link;
                ¶ #[cfg(test)] ¶ pub struct Mode;"],
        ),
        (
            sources::empty_names,
            "name it by the noun that it defines",
            &[r"
            core/src/lib.rs: mod time_utils; <- ¶ struct LinkManager; <-
                ¶ struct Misconduct;
            core/src/time_utils.rs: <-"],
        ),
        (
            sources::facade,
            "hide it behind a type of our own, make it pub(crate), or move it to \
             actors/src/plain",
            &[r"
            actors/src/lib.rs: mod plain; ¶ use actix::{Addr, Recipient as Door};
                ¶ pub use actix::Actor; <- ¶ pub fn a(b: Addr<C>) {} <- ¶ fn d(e: Addr<C>) {}
                ¶ pub struct F { pub g: Door<H>, i: Door<H> } <- ¶ impl F {
                ¶     pub fn j(&self) -> actix::System { k() } <-
                ¶     pub fn l(&self) -> u8 { actix::m() } ¶ } ¶ pub type N = Map<O, Addr<P>>; <-
            actors/src/plain.rs: pub fn a() -> actix::Recipient<B> { c() }"],
        ),
        (
            sources::acquaintance,
            "hold a Recipient of the message instead of the other's address",
            &[r"
            transports/src/lib.rs: struct A { b: Addr<Self>, c: Recipient<D> }
                ¶ struct E { f: Addr<A> } <- ¶ impl Actor for G {} ¶ struct H { i: Addr<G> }"],
        ),
        (
            pages::tables,
            "add the row to the table",
            &[r#"
            actors/src/manual/glossary.md: # Glossary <- ¶ | node | a process |
            core/src/delivery/mod.rs: pub enum DeliveryError { ¶     Full,
                ¶     Left { node: String }, ¶ }
            actors/src/manual/sending.md: ## What every error means <- ¶ | `Full` |
                ¶ ## Next ¶ | `Left` |
            ARCHITECTURE.md: ## The map <- ¶ | `lite/` | `blastema-lite` |
            core/Cargo.toml: [package] ¶ name = "blastema-core"
            lite/Cargo.toml: [package] ¶ name = "blastema-lite""#],
        ),
    ];
    rules.into_iter().for_each(each);
}
