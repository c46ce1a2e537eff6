//! Rules about packages: who may depend on whom, and what every manifest says.

use crate::architecture::tree::{Breach, Manifest, Tree};

/// The map of ARCHITECTURE.md as data, from the bottom to the top: each package, what it may depend
/// on within the workspace, and what beside it in tests. Which package may know a crate from
/// outside is for `deny.toml`.
const PLACES: [(&str, &str, &str); 18] = [
    ("blastema-macros", "", ""),
    // It runs on a chip, where nothing else of the workspace does.
    ("blastema-lite", "", ""),
    // The derives are written for the core's traits, so the core's tests try them.
    ("blastema-core", "", "blastema-macros"),
    // Usable without the rest.
    ("blastema-trees", "", ""),
    ("blastema-contract", "blastema-core", ""),
    // Its actors are tried with probes in their neighbours' places.
    ("blastema-transports", "blastema-core blastema-contract", "blastema-doubles blastema-ptys"),
    // Its adapters speak the core's SLCAN.
    ("blastema-ptys", "blastema-core", ""),
    ("blastema-doubles", "blastema-core blastema-contract", ""),
    (
        "blastema",
        "blastema-core blastema-lite blastema-macros blastema-contract blastema-transports \
         blastema-trees",
        "blastema-doubles",
    ),
    (
        "blastema-testkit",
        "blastema-core blastema-macros blastema-contract blastema-doubles blastema",
        "",
    ),
    // The program uses what every user uses, and nothing else. Its tests take turns.
    ("blastema-cli", "blastema blastema-robot", "blastema-doubles"),
    ("blastema-robot", "blastema", "blastema-doubles"),
    ("blastema-demo", "blastema blastema-robot", "blastema-doubles"),
    ("blastema-tests", EVERYTHING, ""),
    ("blastema-bench", EVERYTHING, ""),
    // Their nodes and contracts are those of a user.
    ("blastema-beds", "blastema", ""),
    ("blastema-derives", "blastema", ""),
    (
        "blastema-examples",
        "blastema",
        "blastema-doubles blastema-ptys blastema-robot blastema-testkit",
    ),
];

/// What whole systems under test may use: all that is no program, test or example itself.
const EVERYTHING: &str = "blastema-macros blastema-lite blastema-core blastema-trees \
     blastema-contract blastema-transports blastema-doubles blastema-ptys blastema blastema-robot \
     blastema-testkit";

/// All crates from outside that these packages may use. The core stays nearly bare, so that what it
/// decides can be simulated; a chip has neither a heap nor an operating system.
const BARE: [(&str, &str); 4] = [
    ("blastema-core", "bincode bytes ring serde snow thiserror x25519-dalek zeroize"),
    ("blastema-contract", "actix bytes"),
    ("blastema-trees", "roxmltree strsim thiserror"),
    ("blastema-lite", ""),
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
        let Some((_, below, in_tests)) = PLACES.iter().find(|(name, ..)| *name == package) else {
            breach(format!("the package {package} has no place in the map"));
            continue;
        };
        let bare = BARE.iter().find(|(name, _)| *name == package).map(|(_, outside)| outside);
        for section in ["dependencies", "build-dependencies", "dev-dependencies"] {
            let of_tests = section == "dev-dependencies";
            for (needed, _) in manifest.dependencies(section) {
                let ours = needed == "blastema" || needed.starts_with("blastema-");
                let known = match ours {
                    true => has(below, needed) || of_tests && has(in_tests, needed),
                    false => of_tests || bare.is_none_or(|outside| has(outside, needed)),
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
