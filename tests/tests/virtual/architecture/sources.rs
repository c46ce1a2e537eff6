//! Rules about what stands in which file.

use crate::architecture::tree::{Breach, Source, Tree, tokens_of};
use quote::ToTokens;
use std::collections::BTreeSet;

/// The lines of the product's files in which one of these pieces of code stands.
fn found<'a>(
    tree: &'a Tree,
    codes: &'a [&'a str],
    concerns: impl Fn(&Source, usize) -> bool + 'a,
) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for source in &tree.sources {
        for code in codes {
            let lines = source.lines_with(code);
            let lines = lines.into_iter().filter(|&line| concerns(source, line));
            breaches.extend(lines.map(|line| Breach::new(&source.path, line, *code)));
        }
    }
    breaches
}

/// What ships to a user's robot: neither tests and benchmarks nor the doubles for them.
fn ships(source: &Source, line: usize) -> bool {
    let for_tests = ["tests/", "examples/", "core/doubles/", "actors/testkit/"];
    !source.is_test(line) && !for_tests.iter().any(|folder| source.path.starts_with(folder))
}

/// The core's machines know no actor, no runtime and no operating system, not even in their tests.
pub(crate) fn purity(tree: &Tree) -> Vec<Breach> {
    let foreign = "tokio, actix, actix_rt, std :: net, std :: thread, std :: fs, std :: process, \
        std :: env, Instant :: now, SystemTime, HashMap, HashSet";
    let foreign: Vec<_> = foreign.split(", ").collect();
    found(tree, &foreign, |source, _| {
        let machines = ["core/src/", "core/lite/src/", "core/trees/src/"];
        machines.iter().any(|folder| source.path.starts_with(folder))
    })
}

/// The contract names what objects say to each other; it opens and starts nothing.
pub(crate) fn contract_purity(tree: &Tree) -> Vec<Breach> {
    let deeds = ["tokio", "UdpSocket", "TcpStream", "TcpListener", "std :: thread", "std :: fs"];
    found(tree, &deeds, |source, line| {
        source.path.starts_with("core/contract/src/") && !source.is_test(line)
    })
}

/// One file reads the clock. The programs stand outside: they measure and wait for nodes.
pub(crate) fn clock(tree: &Tree) -> Vec<Breach> {
    let readings = ["Instant :: now", "SystemTime", "UNIX_EPOCH", ". elapsed ( )", "clock_gettime"];
    found(tree, &readings, |source, line| {
        ships(source, line)
            && source.path != "actors/src/platform.rs"
            && !["actors/cli/", "actors/demo/"].iter().any(|own| source.path.starts_with(own))
    })
}

/// One file knows the codec's library.
pub(crate) fn codec(tree: &Tree) -> Vec<Breach> {
    found(tree, &["bincode"], |source, _| source.path != "core/src/contract/codec.rs")
}

/// One file, and its tests, know the libraries of the handshake.
pub(crate) fn handshake_libraries(tree: &Tree) -> Vec<Breach> {
    found(tree, &["snow ::", "x25519_dalek ::"], |source, _| {
        !source.path.starts_with("core/src/net/seal/noise")
    })
}

/// Nothing is silenced or skipped. That nothing is unsafe or unfinished is for the lints.
pub(crate) fn silenced(tree: &Tree) -> Vec<Breach> {
    let marks = ["# [ ignore", "allow ( dead_code", "allow ( unused", "allow ( clippy :: all"];
    let mut breaches = found(tree, &marks, |_, _| true);
    for source in &tree.sources {
        // The derives' examples need the facade, which stands above them; it shows them again.
        if source.path.starts_with("core/macros/") {
            continue;
        }
        let skipped = ["```ignore", "```text,ignore", "```rust,ignore"];
        for (at, line) in source.text.lines().enumerate() {
            let doc = line.trim_start();
            if doc.starts_with("//") && skipped.iter().any(|mark| doc.contains(mark)) {
                breaches.push(Breach::new(&source.path, at + 1, doc));
            }
        }
    }
    breaches
}

/// A failure that can happen is an error; one that cannot is an `expect` with the reason.
pub(crate) fn unwrapping(tree: &Tree) -> Vec<Breach> {
    found(tree, &[". unwrap ( )", ". unwrap_err ( )"], ships)
}

/// Queues without a bound fill the memory of a robot that has fallen behind.
pub(crate) fn unbounded_queues(tree: &Tree) -> Vec<Breach> {
    let unbounded = ["unbounded_channel", "UnboundedSender", "unbounded", "mpsc :: channel ( )"];
    found(tree, &unbounded, ships)
}

/// What stops an actor's mailbox and timers stops its control lane.
pub(crate) fn mailbox_stops(tree: &Tree) -> Vec<Breach> {
    let stops = ["AtomicResponse", "context . wait (", "ctx . wait (", "cx . wait ("];
    found(tree, &stops, ships)
}

/// Tests use virtual time, or wait for the event itself. The program's own tests start real
/// processes, whose coming and going nothing announces; the beds pull real cables for a while.
pub(crate) fn sleeping_tests(tree: &Tree) -> Vec<Breach> {
    found(tree, &["thread :: sleep"], |source, line| {
        let real_time = ["tests/bench/", "tests/beds/", "actors/cli/tests/", "actors/demo/tests/"];
        source.is_test(line) && !real_time.iter().any(|folder| source.path.starts_with(folder))
    })
}

/// Tests on real threads stand in a test program or a module `real`, and each takes its turn first. A test that
/// plays a role in a process of another test has none to wait for.
pub(crate) fn turns(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for source in &tree.sources {
        let real = if source.path.contains("/real/") {
            Some(0)
        } else {
            source.lines_with("mod real {").first().copied()
        };
        let Some(real) = real else { continue };
        for (at, here) in source.tokens.windows(4).enumerate() {
            let texts = here.iter().map(|token| token.text.as_str());
            if here[0].line < real || !texts.eq(["#", "[", "test", "]"]) {
                continue;
            }
            let mut after = source.tokens[at + 4..].iter().map(|token| token.text.as_str());
            let name = after.by_ref().skip_while(|text| *text != "fn").nth(1).unwrap_or_default();
            let mut body = after.skip_while(|text| *text != "{").skip(1);
            let takes_turn = body.next() == Some("let")
                && matches!(
                    (body.next(), body.next(), body.next()),
                    (Some("_turn"), ..) | (Some("Some"), _, Some("_turn"))
                );
            if !takes_turn && !name.starts_with("a_process_") {
                breaches.push(Breach::new(&source.path, here[0].line, name));
            }
        }
    }
    breaches
}

/// Every file is declared by a module, is a target, or is named by a test that compiles it.
pub(crate) fn dead_files(tree: &Tree) -> Vec<Breach> {
    let named_by_a_test = |path: &str| {
        let Some(package) = tree.package_of(path) else { return false };
        let within = &path[package.folder().len()..];
        let (folder, file) = within.rsplit_once('/').unwrap_or(("", within));
        tree.sources.iter().filter(|source| source.path.starts_with(package.folder())).any(
            |source| {
                let text = &source.text;
                text.contains(&format!("{folder}/*.rs\""))
                    || text.contains(&format!("{folder}/{file}\""))
            },
        )
    };
    tree.unreached
        .iter()
        .filter(|path| !named_by_a_test(path))
        .map(|path| Breach::new(path, 1, "no module declares this file"))
        .collect()
}

/// A file without tests stays below this, so that it can be read in one sitting.
const LONGEST: usize = 1_000;

/// Files hold one concept each.
pub(crate) fn long_files(tree: &Tree) -> Vec<Breach> {
    tree.sources
        .iter()
        .filter(|source| !source.test && source.length() > LONGEST)
        .map(|source| {
            let what = format!("{} lines without tests; {LONGEST} is the limit", source.length());
            Breach::new(&source.path, LONGEST, what)
        })
        .collect()
}

/// Every file begins with what it is about; a folder's `mod.rs` with the folder's story. Tests that
/// were moved out of a file have their story there.
pub(crate) fn stories(tree: &Tree) -> Vec<Breach> {
    tree.sources
        .iter()
        .filter(|source| !source.text.starts_with("//!") && !source.path.ends_with("tests.rs"))
        .map(|source| Breach::new(&source.path, 1, "the file does not begin with //!"))
        .collect()
}

/// Names that say nothing about what they name.
const EMPTY_NAMES: [&str; 9] =
    ["util", "utils", "common", "helper", "helpers", "manager", "managers", "misc", "stuff"];

/// Files, folders, packages, modules and types are named by what they are.
pub(crate) fn empty_names(tree: &Tree) -> Vec<Breach> {
    let empty = |name: &str| EMPTY_NAMES.contains(&name.to_lowercase().as_str());
    let mut breaches = Vec::new();
    for path in tree.files.keys() {
        let parts = path.trim_end_matches(".rs").split(['/', '_', '-', '.']);
        if parts.into_iter().any(empty) {
            breaches.push(Breach::new(path, 1, "the path"));
        }
    }
    for source in &tree.sources {
        for pair in source.tokens.windows(2) {
            let named = ["struct", "enum", "trait", "mod", "type"].contains(&pair[0].text.as_str());
            if named && words(&pair[1].text).iter().any(|word| empty(word)) {
                breaches.push(Breach::new(&source.path, pair[1].line, &pair[1].text));
            }
        }
    }
    breaches
}

/// The words of a name in either case style.
fn words(name: &str) -> Vec<String> {
    let mut words = vec![String::new()];
    for sign in name.chars() {
        if sign == '_' || sign.is_uppercase() {
            words.push(String::new());
        }
        if sign != '_' {
            words.last_mut().expect("there is always a last word").push(sign);
        }
    }
    words
}

/// actix stays out of what a user of the facade can name, but for the module that is for it.
pub(crate) fn facade(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for source in &tree.sources {
        let plain = source.path.starts_with("actors/src/plain");
        if !source.path.starts_with("actors/src/") || plain || source.test {
            continue;
        }
        let mut foreign: BTreeSet<String> = ["actix", "actix_rt"].map(String::from).into();
        let file = syn::parse_file(&source.text).expect("the tree holds only what parses");
        imports(&file.items, &mut foreign);
        exposed(&file.items, &foreign, &source.path, &mut breaches);
    }
    breaches
}

/// Adds the names that `use actix::..` brings into the file.
fn imports(items: &[syn::Item], names: &mut BTreeSet<String>) {
    fn leaves(tree: &syn::UseTree, names: &mut BTreeSet<String>) {
        match tree {
            syn::UseTree::Path(path) => leaves(&path.tree, names),
            syn::UseTree::Name(name) => drop(names.insert(name.ident.to_string())),
            syn::UseTree::Rename(name) => drop(names.insert(name.rename.to_string())),
            syn::UseTree::Group(group) => group.items.iter().for_each(|tree| leaves(tree, names)),
            syn::UseTree::Glob(_) => {}
        }
    }
    for item in items {
        if let syn::Item::Use(item) = item
            && let syn::UseTree::Path(path) = &item.tree
            && (path.ident == "actix" || path.ident == "actix_rt")
        {
            leaves(&path.tree, names);
        }
    }
    names.remove("self");
}

/// Whether an item is public without reserve. That what is so marked can also be reached from
/// outside is the business of the compiler's lint `unreachable_pub`.
fn is_public(visibility: &syn::Visibility) -> bool {
    matches!(visibility, syn::Visibility::Public(_))
}

/// Notes the public items in whose outside one of the foreign names stands.
fn exposed(items: &[syn::Item], foreign: &BTreeSet<String>, path: &str, out: &mut Vec<Breach>) {
    let mut check = |tokens: proc_macro2::TokenStream| {
        for token in tokens_of(tokens) {
            if foreign.contains(&token.text) {
                out.push(Breach::new(path, token.line, token.text));
            }
        }
    };
    for item in items {
        match item {
            syn::Item::Use(item) if is_public(&item.vis) => check(item.tree.to_token_stream()),
            syn::Item::Fn(item) if is_public(&item.vis) => check(item.sig.to_token_stream()),
            syn::Item::Type(item) if is_public(&item.vis) => check(item.ty.to_token_stream()),
            syn::Item::Const(item) if is_public(&item.vis) => check(item.ty.to_token_stream()),
            syn::Item::Enum(item) if is_public(&item.vis) => {
                check(item.generics.to_token_stream());
                check(item.variants.to_token_stream());
            }
            syn::Item::Struct(item) if is_public(&item.vis) => {
                check(item.generics.to_token_stream());
                for field in item.fields.iter().filter(|field| is_public(&field.vis)) {
                    check(field.ty.to_token_stream());
                }
            }
            syn::Item::Trait(item) if is_public(&item.vis) => {
                check(item.generics.to_token_stream());
                check(item.supertraits.to_token_stream());
                for item in &item.items {
                    match item {
                        syn::TraitItem::Fn(item) => check(item.sig.to_token_stream()),
                        other => check(other.to_token_stream()),
                    }
                }
            }
            syn::Item::Impl(item) if item.trait_.is_none() => {
                for item in &item.items {
                    if let syn::ImplItem::Fn(item) = item
                        && is_public(&item.vis)
                    {
                        check(item.sig.to_token_stream());
                    }
                }
            }
            _ => {}
        }
    }
    for item in items {
        if let syn::Item::Mod(item) = item
            && let Some((_, inner)) = &item.content
        {
            exposed(inner, foreign, path, out);
        }
    }
}

/// Objects of the middleware hold recipients of messages, not addresses of each other's types. An
/// actor's own file may hold its address: there stands the handle by which others know it.
pub(crate) fn acquaintance(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for source in &tree.sources {
        let objects = ["actors/src/fault_chain/", "actors/src/net/", "transports/src/"];
        // The one file that starts the network's actors, and connects them, knows them all.
        let connects = source.path == "actors/src/net/mod.rs";
        if connects || !objects.iter().any(|folder| source.path.starts_with(folder)) {
            continue;
        }
        for here in source.tokens.windows(3) {
            let address = here[0].text == "Addr" && here[1].text == "<";
            let whose = &here[2].text;
            let own = whose == "Self"
                || !source.lines_with(&format!("impl Actor for {whose}")).is_empty();
            if address && !own && !source.is_test(here[0].line) {
                let what = format!("Addr<{whose}>");
                breaches.push(Breach::new(&source.path, here[0].line, what));
            }
        }
    }
    breaches
}
