//! Rules about packages: who may depend on whom, and what every manifest says.

use crate::architecture::tree::{Breach, Manifest, Tree};

/// The map of ARCHITECTURE.md as data, from the bottom to the top: each package, what it may depend
/// on within the workspace, and after the bar what in tests alone. Which package may know a crate
/// from outside is for `deny.toml`.
///
/// A chip runs `blastema-lite`, and behaviour trees are usable without the rest. The derives are
/// written for the core's traits, so the core's tests try them; transports and objects are tried
/// with doubles in their neighbours' places. A program of ours, and the nodes of the beds, use what
/// every user uses; whole systems under test use all that is no program, test or example itself.
const PLACES: &str = "
    macros |
    lite |
    core | macros
    trees |
    contract core |
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

/// All crates from outside that these packages may use. The core stays nearly bare, so that what it
/// decides can be simulated; a chip has neither a heap nor an operating system.
const BARE: [(&str, &str); 4] = [
    ("core", "bincode bytes ring serde snow thiserror x25519-dalek zeroize"),
    ("contract", "actix bytes"),
    ("trees", "roxmltree strsim thiserror"),
    ("lite", ""),
];

/// Workspaces of their own: one needs a nightly compiler, and the crates of the other compile for
/// minutes.
const APART: [&str; 2] = ["tests/fuzz/Cargo.toml", "transports/zenoh/Cargo.toml"];

/// The manifests of the workspace's packages.
fn members(tree: &Tree) -> impl Iterator<Item = (&Manifest, &str)> {
    tree.manifests
        .iter()
        .filter(|manifest| !APART.contains(&manifest.path.as_str()))
        .filter_map(|manifest| Some((manifest, manifest.package()?)))
}

fn has(names: &str, name: &str) -> bool {
    names.split(' ').any(|known| known == name)
}

/// Every dependency between two of our packages leads to one further down, and the lowest use few
/// others.
pub(crate) fn arrows(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for (manifest, package) in members(tree) {
        let mut breach = |what| breaches.push(Breach::new(&manifest.path, 1, what));
        let package = package.trim_start_matches("blastema-");
        let mut places =
            PLACES.lines().map(|line| line.trim_start().split_once('|').unwrap_or_default());
        let place = places.find(|(place, _)| place.split(' ').next() == Some(package));
        let Some((below, in_tests)) = place else {
            breach(format!("the package {package} has no place in the map"));
            continue;
        };
        let bare = BARE.iter().find(|(name, _)| *name == package).map(|(_, outside)| outside);
        for section in ["dependencies", "build-dependencies", "dev-dependencies"] {
            let of_tests = section == "dev-dependencies";
            for (needed, _) in manifest.dependencies(section) {
                let known = match needed.strip_prefix("blastema") {
                    Some(rest) => {
                        let ours = rest.strip_prefix('-').unwrap_or(needed);
                        has(below, ours) || of_tests && has(in_tests, ours)
                    }
                    None => of_tests || bare.is_none_or(|outside| has(outside, needed)),
                };
                if !known {
                    breach(format!("{package} -> {needed} ({section})"));
                }
            }
        }
    }
    breaches
}

/// Versions of dependencies, the package's own facts and the lints stand in the root manifest only,
/// and the lints forbid unsafe code.
pub(crate) fn inheritance(tree: &Tree) -> Vec<Breach> {
    let inherits = |entry: Option<&toml::Value>| {
        entry.is_some_and(|entry| entry.get("workspace") == Some(&true.into()))
    };
    let mut breaches = Vec::new();
    for (manifest, package) in members(tree) {
        let mut check = |entry, name: &str| {
            if !inherits(entry) {
                let what = format!("{package} does not say {name}.workspace = true");
                breaches.push(Breach::new(&manifest.path, 1, what));
            }
        };
        for section in ["dependencies", "dev-dependencies", "build-dependencies"] {
            manifest
                .dependencies(section)
                .iter()
                .for_each(|(name, entry)| check(Some(entry), name));
        }
        for fact in ["version", "edition", "rust-version", "license"] {
            check(manifest.table["package"].get(fact), fact);
        }
        check(manifest.table.get("lints"), "lints");
    }
    let root = tree.manifests.iter().find(|manifest| manifest.path == "Cargo.toml");
    let unsafe_code = root.and_then(|root| {
        root.table.get("workspace")?.get("lints")?.get("rust")?.get("unsafe_code")?.as_str()
    });
    if unsafe_code != Some("forbid") {
        breaches.push(Breach::new("Cargo.toml", 1, "unsafe_code is not forbidden"));
    }
    breaches
}
