//! The invariants of ARCHITECTURE.md, held as tests.
//!
//! Each rule is a function from the tree of files to its breaches. One test applies the rules to
//! this project; another one shows each of them small trees that break it, since a rule that cannot
//! fail proves nothing.

mod imports;
mod names;
mod packages;
mod pages;
mod sources;
mod tree;

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
    let (mut files, mut marks) = (Vec::<(&str, String)>::new(), Vec::new());
    for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
        let lines = line.strip_prefix("¶ ").unwrap_or_else(|| {
            let (path, lines) = line.split_once(':').expect("a path and a text");
            files.push((path, String::new()));
            lines.strip_prefix(' ').unwrap_or_default()
        });
        let (path, file) = files.last_mut().expect("a path comes first");
        for line in lines.split(" ¶ ") {
            let kept = line.strip_suffix("<-").map(str::trim_end);
            *file += &format!("{}\n", kept.unwrap_or(line));
            marks.extend(kept.map(|_| ((*path).to_owned(), file.lines().count())));
        }
    }
    marks.sort();
    let files: Vec<_> = files.iter().map(|(path, file)| (*path, file.as_str())).collect();
    (Tree::of_texts(&files), marks)
}

fn with_rules(mut each: impl FnMut(Rule<'_>)) {
    let (lines, wide) = ("fn a() {} ¶ ".repeat(1_000), "ä".repeat(120));
    let long = format!(
        "core/src/lib.rs: #[cfg(test)] ¶ mod tests {{ ¶ {lines}}}
        actors/src/lib.rs: {}<- ¶ fn a() {{}}",
        lines.trim_end_matches("¶ ")
    );
    let wide = format!("docs/page.md: | {wide} | ¶ {wide} ¶ {wide}ä <-");
    let rules: [Rule<'_>; 30] = [
        (
            packages::arrows,
            "move what is needed further down, or turn the call into a message of core/contract; \
             a new package gets its place in the map of ARCHITECTURE.md and in PLACES of \
             packages.rs",
            &[
                r#"
            core/Cargo.toml: [package] ¶ name = "blastema-core" ¶ [dependencies]
                ¶ serde.workspace = true ¶ blastema.workspace = true <-
            core/doubles/Cargo.toml: [package] ¶ name = "blastema-doubles"
                ¶ [dev-dependencies] ¶ blastema-transports = { workspace = true } <-
            extras/Cargo.toml: [package] <- ¶ name = "blastema-extras""#,
                r#"
            core/Cargo.toml: [package] ¶ name = "blastema-core"
                ¶ [dependencies.blastema-contract] <- ¶ workspace = true
                ¶ [target.'cfg(unix)'.dependencies] ¶ blastema-contract.workspace = true <-"#,
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
            imports::globs_of_parents,
            "write out the names",
            &[r"
            core/src/lib.rs: mod a;
            core/src/a.rs: use super::*; <- ¶ #[cfg(test)] ¶ mod tests { use super::*; }"],
        ),
        (
            packages::outsiders,
            "reach the crate through the package that knows it; the core takes only what it is \
             given",
            &[r#"
            core/Cargo.toml: [package] ¶ name = "blastema-core" ¶ [dependencies]
                ¶ tokio.workspace = true <-
            core/lite/Cargo.toml: [package] ¶ name = "blastema-lite" ¶ [dependencies]
                ¶ bytes.workspace = true <-"#],
        ),
        (
            packages::inheritance,
            "write the version into [workspace.dependencies] and `name.workspace = true` here",
            &[r#"
            actors/Cargo.toml: [package] ¶ name = "blastema" ¶ version.workspace = true
                ¶ edition.workspace = true ¶ rust-version.workspace = true
                ¶ license.workspace = true ¶ [dependencies] ¶ serde = "1" <-
                ¶ bytes = { workspace = true, features = ["std"] }"#],
        ),
        (
            packages::lints,
            "add `[lints]` and `workspace = true` to the manifest",
            &[
                r#"
            Cargo.toml: [workspace.lints.rust] ¶ unsafe_code = "forbid"
            core/Cargo.toml: [package] <- ¶ name = "blastema-core""#,
                r#"
            Cargo.toml: [workspace] <-
            core/Cargo.toml: [package] ¶ name = "blastema-core" ¶ [lints] ¶ workspace = true"#,
            ],
        ),
        (
            sources::purity,
            "let the machine say what it wants done and be given the time; use BTreeMap and \
             BTreeSet, which iterate in a fixed order",
            &[r#"
            core/src/lib.rs: //! A machine.
                ¶ // Instant::now in a comment, "tokio" in a text: harmless.
                ¶ fn f() -> &'static str { "tokio" } ¶ fn g() { std::time::Instant::now(); } <-
                ¶ #[cfg(test)] ¶ mod tests { ¶     use std::collections::HashMap; <- ¶ }"#],
        ),
        (
            sources::contract_purity,
            "move the deed into the object that carries it out",
            &[r"
            core/contract/src/lib.rs: use std::net::{SocketAddr, UdpSocket}; <-"],
        ),
        (
            sources::clock,
            "take an Instant as an argument, or ask actors/src/platform.rs, whose clock tests \
             can pause",
            &[r"
            actors/src/lib.rs: mod node; ¶ mod platform;
            actors/src/node.rs: fn f() { tokio::time::Instant::now(); } <-
                ¶ fn g(start: T) { start.elapsed(); } <- ¶ #[cfg(test)]
                ¶ mod tests { fn f() { Instant::now(); } }
            actors/src/platform.rs: fn now() { Instant::now(); }"],
        ),
        (
            sources::codec,
            "encode and decode through core/src/contract/codec.rs",
            &[r"
            core/src/lib.rs: mod codec; ¶ use bincode::config; <-
            core/src/contract/codec.rs: use bincode::config;"],
        ),
        (
            sources::handshake_libraries,
            "ask core/src/net/seal/noise.rs, or any SealCrypto, for what they do",
            &[r"
            core/src/lib.rs: mod net; ¶ fn a() { snow::b() } <-
                ¶ use x25519_dalek::PublicKey; <-
            core/src/net/mod.rs: mod seal;
            core/src/net/seal/mod.rs: mod noise;
            core/src/net/seal/noise.rs: use snow::Builder; ¶ use x25519_dalek::PublicKey;"],
        ),
        (
            sources::silenced,
            "finish it, delete it, or make the test pass",
            &[r#"
            actors/src/lib.rs: #[ignore = "slow"] <- ¶ fn c() {} ¶ #[allow(dead_code)] <-
                ¶ fn d() {} ¶ /// ```ignore <- ¶ fn e() {}"#],
        ),
        (
            sources::unwrapping,
            "return an error, or `expect` the fact that makes the failure impossible",
            &[r"
            actors/src/lib.rs: mod tests_of_it;
                ¶ fn a() { b().unwrap(); c().unwrap_or(1); } <- ¶ #[cfg(test)]
                ¶ mod tests { fn a() { b().unwrap(); } } ¶ #[cfg(test)] ¶ mod more;
            actors/src/more.rs: fn a() { b().unwrap(); }
            actors/src/tests_of_it.rs: fn a() { b().unwrap(); } <-
            actors/tests/behaviour.rs: fn a() { b().unwrap(); }"],
        ),
        (
            sources::unbounded_queues,
            "give the queue a capacity, a reason for it, and say what full means",
            &[r"
            actors/src/lib.rs: fn a() { tokio::sync::mpsc::unbounded_channel(); } <-
                ¶ fn b() { std::sync::mpsc::channel(); } <- ¶ fn c() { mpsc::channel(8); }"],
        ),
        (
            sources::mailbox_stops,
            "keep the state of the wait in the actor, or spawn a future",
            &[r"
            actors/src/lib.rs: fn a() { ctx.wait(b); } <- ¶ fn c() { child.wait(); }"],
        ),
        (
            sources::sleeping_tests,
            "advance the paused clock, or wait for the event itself",
            &[r"
            tests/tests/demo.rs: fn a() { std::thread::sleep(b); } <-
            actors/cli/src/main.rs: fn a() { std::thread::sleep(b); }"],
        ),
        (
            sources::dead_files,
            "declare it with `mod`, or delete it",
            &[r#"
            tests/Cargo.toml: [package] ¶ name = "blastema-tests"
            tests/tests/derive.rs: fn a() { t.compile_fail("tests/wrong/*.rs"); }
            tests/tests/wrong/usize.rs: this is not Rust
            core/src/lib.rs: mod link; ¶ mod net;
            core/src/link.rs:
            core/src/net/mod.rs: mod frame;
            core/src/net/frame.rs:
            core/src/net/left_over.rs: <-"#],
        ),
        (sources::long_files, "split the file by concept, each part named by its noun", &[&long]),
        (
            sources::stories,
            "begin with `//!`: what it is, and what it deliberately does not do",
            &[r"
            core/src/lib.rs: //! The core. ¶ mod net;
            core/src/net/mod.rs: <-"],
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
            names::of_types,
            "name one of them by the field's term for what it is; the machine or the message of \
             the glossary keeps the name",
            &[r"
            core/src/lib.rs: mod b; ¶ pub(crate) struct State; <- ¶ enum Phase {}
                ¶ struct Link; ¶ mod c { trait Mode {} }
            core/src/b.rs: type State = u8; <- ¶ struct Phase; ¶ pub struct Link;
                ¶ #[cfg(test)] ¶ pub struct Mode;"],
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
                ¶     pub fn l(&self) -> u8 { actix::m() } ¶ }
            actors/src/plain.rs: pub fn a() -> actix::Recipient<B> { c() }"],
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
            sources::acquaintance,
            "hold a Recipient of the message instead of the other's address",
            &[r"
            transports/src/lib.rs: struct A { b: Addr<Self>, c: Recipient<D> }
                ¶ struct E { f: Addr<A> } <- ¶ impl Actor for G {} ¶ struct H { i: Addr<G> }"],
        ),
        (
            pages::glossary,
            "add the term to actors/src/manual/glossary.md",
            &[r"
            actors/src/manual/glossary.md: # Glossary <- ¶ | node | a process |"],
        ),
        (
            pages::errors,
            "say in actors/src/manual/sending.md what it means and what to do",
            &[r"
            core/src/delivery/mod.rs: pub enum DeliveryError { ¶     Full,
                ¶     Left { node: String }, ¶ }
            actors/src/manual/sending.md: ## What every error means <- ¶ | `Full` |
                ¶ ## Next ¶ | `Left` |"],
        ),
        (
            pages::map,
            "add the row `folder/` | `package` | what it holds to the map of ARCHITECTURE.md",
            &[r#"
            ARCHITECTURE.md: ## The map <- ¶ | `lite/` | `blastema-lite` |
            core/Cargo.toml: [package] ¶ name = "blastema-core"
            lite/Cargo.toml: [package] ¶ name = "blastema-lite""#],
        ),
        (pages::width, "wrap the paragraph at 120 columns", &[&wide]),
        (
            pages::subjects,
            "name the part of the system that acts: the peer, the sender, the session",
            &[r"
            README.md: The caller waits. ¶ Nobody asks. <-
            core/src/lib.rs: fn nobody_asks() {} ¶ // Whoever asks, waits. <-
            core/data.txt: nobody"],
        ),
    ];
    rules.into_iter().for_each(&mut each);
}
