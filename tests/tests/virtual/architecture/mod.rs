//! The invariants of ARCHITECTURE.md, held as tests.
//!
//! Each rule is a function from the tree of files to its breaches. One test applies the rules to
//! this project; another one shows each of them small trees that break it, since a rule that cannot
//! fail proves nothing.

mod imports;
mod packages;
mod sources;
mod tree;

use std::collections::{BTreeMap, BTreeSet};
use tree::{Breaches, Tree};

/// What holds in a tree, what to do about a breach, and trees that break it, as [`marked`] reads
/// them.
type Rule = (fn(&Tree) -> Breaches, &'static str, &'static [&'static str]);

#[test]
fn the_project_keeps_every_rule() {
    let (project, mut told) = (Tree::of_project(), String::new());
    for (rule, cure, _) in RULES {
        for (path, line, what) in rule(&project) {
            told += &format!("{path}:{line}: {what}\n    What to do: {cure}\n");
        }
    }
    assert!(told.is_empty(), "\n{told}");
}

#[test]
fn every_rule_can_fail() {
    for (rule, cure, broken) in RULES {
        assert!(!broken.is_empty(), "{cure}");
        for text in *broken {
            let (tree, expected) = marked(text);
            let found = rule(&tree).into_iter().map(|(path, line, _)| (path, line));
            assert!(!expected.is_empty(), "{text}");
            assert_eq!(found.collect::<BTreeSet<_>>(), expected, "{cure}");
        }
    }
}

/// The tree of a text, and the paths and lines that break a rule. Each line of the text is a file:
/// its path, a colon, and its lines, which are parted by `¶`. A line that begins with that goes on
/// with the file. Where a line of a file ends with `<-`, which is no part of it, it breaks the rule,
/// and no other line does. `..` is 998 lines.
fn marked(text: &str) -> (Tree, BTreeSet<(String, usize)>) {
    let (mut files, mut marks, mut path) = (BTreeMap::<_, String>::new(), BTreeSet::new(), "");
    for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
        let lines = line.strip_prefix("¶ ").unwrap_or_else(|| {
            let (file, lines) = line.split_once(": ").expect("a path and a text");
            path = file;
            lines
        });
        let file = files.entry(path.to_owned()).or_default();
        for line in lines.replace("..", &["//"; 998].join(" ¶ ")).split(" ¶ ") {
            let kept = line.strip_suffix(" <-");
            *file += &format!("{}\n", kept.unwrap_or(line));
            marks.extend(kept.map(|_| (path.to_owned(), file.lines().count())));
        }
    }
    (Tree::of(files), marks)
}

const RULES: &[Rule] = &[
    (
        packages::arrows,
        "move what is needed further down, or turn the call into a message of core/contract",
        &[
            r#"core/Cargo.toml: package.name = "blastema-core" <- ¶ lints.workspace = true
            ¶ [dependencies] ¶ serde.workspace = true ¶ blastema.workspace = true
            core/doubles/Cargo.toml: package.name = "blastema-doubles" <-
            ¶ lints.workspace = true ¶ dev-dependencies.blastema-transports.workspace = true
            extras/Cargo.toml: package.name = "blastema-extras" <- ¶ lints.workspace = true
            core/macros/Cargo.toml: package.name = "blastema-macros" <-
            core/lite/Cargo.toml: package.name = "blastema-lite" <- ¶ lints.workspace = true
            ¶ dependencies.bytes.workspace = true"#,
            r#"core/Cargo.toml: package.name = "blastema-core" <- ¶ lints.workspace = true
            ¶ [target.'cfg(unix)'.dependencies] ¶ blastema-contract.workspace = true
            lite/Cargo.toml: package.name = "blastema-lite" <- ¶ lints.workspace = true
            ARCHITECTURE.md: | `core/` | `blastema-core` |"#,
        ],
    ),
    (
        imports::layers,
        "move what is needed to the lowest layer that needs it, or turn the import: a trait below, \
         an `impl` block above; a new folder gets its place in LAYERS",
        &[r"
            actors/src/lib.rs: mod arbiter; mod host; mod odd;
            actors/src/arbiter.rs: use crate::{host::A, sync::B}; <-
            ¶ fn a() { crate::odd::b() } <-
            actors/src/host.rs: mod spec; ¶ pub(crate) use spec::A; ¶ use crate::arbiter::C;
            actors/src/host/spec.rs: pub(crate) struct A;
            actors/src/odd.rs: use crate::arbiter::C; <- ¶ #[cfg(test)] ¶ use crate::host::A;"],
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
        "finish it, make the test pass, or leave the effect to an actor; name the part of the \
         system that acts; begin with what the file is and deliberately does not do; split it",
        &[
            r#"actors/src/lib.rs: //! A. ¶ #[ignore = "slow"] <- ¶ fn c() {} ¶ #[allow(dead_code)] <-
            ¶ fn d() {} ¶ /// ```ignore <- ¶ fn e() {} ¶ fn a() { std::thread::sleep(b) } <-
            README.md: The caller waits. ¶ Nobody asks. <- ¶ Call `thread::sleep`.
            core/src/lib.rs: fn nobody_asks() {} <- ¶ use std::fs; <- ¶ // Whoever asks, waits. <-"#,
            "core/src/lib.rs: //! Long. ¶ .. ¶ // <- ¶ //",
        ],
    ),
    (
        sources::turns,
        "begin it with `let _turn = blastema_doubles::turn();`",
        &[r#"
            core/tests/real/main.rs: #[test] <- ¶ #[a] ¶ fn b() { ¶ c(); ¶ } ¶ #[test]
            ¶ fn a_process_d() { ¶ } ¶ #[a::test(crate = "b")] <- ¶ #[a::test(crate = "c::real")]
            core/src/lib.rs: #[test] ¶ fn a() { ¶ } ¶ #[a::test(crate = "c::real")] <-
            ¶ mod real { ¶ #[test] ¶ fn b() { ¶ let _turn = c(); ¶ } ¶ #[test] <- ¶ fn d() { ¶ } ¶ }"#],
    ),
    (
        sources::facade,
        "hide it behind a type of our own, make it pub(crate), or move it to actors/src/plain",
        &[r"
            actors/src/lib.rs: mod plain; ¶ use actix::{Addr, Recipient as Door};
            ¶ pub use actix::Actor; <- ¶ pub fn a(b: Addr<C>) {} <- ¶ fn d(e: Addr<C>) {}
            ¶ pub struct F { pub g: M<H, Door<H>>, <- ¶ i: Door<H> } ¶ impl F {
            ¶     pub fn j(&self) -> actix::System { k() } <-
            ¶     pub fn l(&self) -> u8 { actix::m() } ¶ } ¶ pub type N = Map<O, Addr<P>>; <-
            actors/src/plain.rs: pub fn a() -> actix::Recipient<B> { c() }"],
    ),
];
