//! Rules about packages: who may depend on whom.

use crate::architecture::tree::{Breaches, Tree};

/// The map of ARCHITECTURE.md as data, from the bottom to the top: each package, what it may depend
/// on within the workspace; after the bar what in tests alone; and after a second bar all crates
/// from outside that it may use. What else may be known from outside is for `deny.toml`.
///
/// The core stays nearly bare, so that what it decides can be simulated. A chip, which has neither a
/// heap nor an operating system, runs `blastema-lite`; behaviour trees are usable without the rest.
/// The derives are written for the core's traits, so the core's tests try them; transports and
/// objects are tried with doubles in their neighbours' places. A program of ours, and the nodes of
/// the beds, use what every user uses; whole systems under test use all that is no program, test or
/// example itself.
const PLACES: &str = "
    macros |
    lite | |
    core | macros | bincode bytes ring serde snow strsim thiserror x25519-dalek zeroize
    trees | | roxmltree strsim thiserror
    contract core | | actix bytes
    transports core contract | doubles ptys macros
    ptys core |
    doubles core contract |
    blastema core lite macros contract transports trees | doubles
    testkit core macros contract doubles blastema |
    robot blastema | doubles
    cli blastema robot | doubles
    demo blastema robot | doubles
    tests macros lite core trees contract transports doubles ptys blastema robot testkit |
    bench macros lite core trees contract transports doubles ptys blastema robot testkit |
    beds blastema |
    derives blastema |
    examples blastema | doubles ptys robot testkit";

/// Workspaces of their own: one needs a nightly compiler, and the crates of the other compile for
/// minutes.
const APART: [&str; 2] = ["tests/fuzz/Cargo.toml", "transports/zenoh/Cargo.toml"];

/// Every dependency between two of our packages leads to one further down, the lowest use few
/// others, and each takes the lints of the workspace, which forbid unsafe code.
pub(crate) fn arrows(tree: &Tree) -> Breaches {
    let has = |names: &str, name: &str| names.split(' ').any(|known| known == name);
    let (mut breaches, map) = (Breaches::new(), tree.files.get("ARCHITECTURE.md"));
    for (path, text) in tree.files.iter().filter(|(path, _)| path.ends_with("Cargo.toml")) {
        let manifest: toml::Table = text.parse().unwrap_or_else(|error| panic!("{path}: {error}"));
        let Some(package) = manifest.get("package").filter(|_| !APART.contains(&&**path)) else {
            continue;
        };
        let mut breach = |what: &str| breaches.insert((path.clone(), 1, what.to_owned()));
        if manifest.get("lints").is_none_or(|lints| lints.get("workspace") != Some(&true.into())) {
            breach("the manifest does not say lints.workspace = true");
        }
        let name = package["name"].as_str().expect("a name");
        if map.is_some_and(|map| !map.contains(&format!("`{name}`"))) {
            breach("the map of ARCHITECTURE.md does not show the package");
        }
        let package = name.trim_start_matches("blastema-");
        let mut places = PLACES.lines().map(|line| line.trim_start().split('|'));
        let place = places.find_map(|mut place| {
            let (below, tests) = (place.next()?, place.next()?);
            (below.split(' ').next() == Some(package)).then(|| (below, tests, place.next()))
        });
        let Some((below, tests, outside)) = place else {
            breach("the package has no place in PLACES");
            continue;
        };
        let targets = manifest.get("target").and_then(toml::Value::as_table);
        let targets = targets.into_iter().flatten().filter_map(|(_, target)| target.as_table());
        for (section, entries) in targets.chain([&manifest]).flatten() {
            let of_tests = section == "dev-dependencies";
            let entries = entries.as_table().filter(|_| section.ends_with("dependencies"));
            for needed in entries.into_iter().flat_map(toml::Table::keys) {
                let known = match needed.strip_prefix("blastema") {
                    Some(rest) => {
                        let ours = rest.strip_prefix('-').unwrap_or(needed);
                        has(below, ours) || of_tests && has(tests, ours)
                    }
                    None => of_tests || outside.is_none_or(|outside| has(outside, needed)),
                };
                if !known {
                    breach(&format!("{package} -> {needed} ({section})"));
                }
            }
        }
    }
    breaches
}
