//! Rules about packages: who may depend on whom, and what every manifest says.

use crate::architecture::tree::{Breach, Manifest, Tree, key};

/// The map of ARCHITECTURE.md as data, from the bottom to the top: each package, what it may depend
/// on within the workspace, and what beside it in tests.
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
    (
        "blastema-transports",
        "blastema-core blastema-contract",
        "blastema-doubles blastema-macros blastema-ptys",
    ),
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

/// The crates from outside that the core may use. It stays nearly bare, so that what it decides can
/// be simulated, and one day run on a microcontroller.
const CORE_TAKES: [&str; 8] =
    ["bincode", "bytes", "ring", "serde", "snow", "thiserror", "x25519-dalek", "zeroize"];
/// The same for behaviour trees.
const TREES_TAKE: [&str; 3] = ["roxmltree", "strsim", "thiserror"];

/// Crates of which only these packages may know.
const KNOWN_BY: [(&str, &str); 6] = [
    // Behind the feature `journal`: not every user has a C compiler.
    ("rusqlite", "blastema"),
    ("bincode", "blastema-core"),
    ("snow", "blastema-core"),
    ("x25519-dalek", "blastema-core"),
    (
        "actix",
        "blastema-contract blastema-transports blastema-doubles blastema blastema-testkit \
         blastema-tests blastema-bench blastema-examples",
    ),
    ("socket2", "blastema-transports blastema blastema-tests blastema-bench"),
];

/// Workspaces of their own: one needs a nightly compiler, and the crates of the other compile for
/// minutes.
const APART: [&str; 2] = ["tests/fuzz/Cargo.toml", "transports/zenoh/Cargo.toml"];

/// The manifests of the workspace's packages.
fn members(tree: &Tree) -> impl Iterator<Item = (&Manifest, &str)> {
    tree.manifests
        .iter()
        .filter(|manifest| !APART.contains(&manifest.path.as_str()))
        .filter_map(|manifest| Some((manifest, manifest.package.as_deref()?)))
}

fn is_ours(package: &str) -> bool {
    package == "blastema" || package.starts_with("blastema-")
}

/// Every dependency between two of our packages leads to one further down.
pub(crate) fn arrows(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for (manifest, package) in members(tree) {
        let Some((_, below, in_tests)) = PLACES.iter().find(|(name, ..)| *name == package) else {
            breaches.push(Breach::new(
                &manifest.path,
                1,
                format!("the package {package} has no place in the map"),
            ));
            continue;
        };
        let sections =
            [("dependencies", ""), ("build-dependencies", ""), ("dev-dependencies", *in_tests)];
        for (section, beside) in sections {
            for (line, entry) in manifest.section(section) {
                let needed = key(entry);
                let mut allowed = below.split(' ').chain(beside.split(' '));
                if is_ours(needed) && !allowed.any(|name| name == needed) {
                    let what = format!("{package} -> {needed} ({section})");
                    breaches.push(Breach::new(&manifest.path, line, what));
                }
            }
        }
    }
    breaches
}

/// Crates from outside are known only where they belong.
pub(crate) fn outsiders(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for (manifest, package) in members(tree) {
        for (line, entry) in manifest.section("dependencies") {
            let needed = key(entry);
            if is_ours(needed) {
                continue;
            }
            let barred = KNOWN_BY.iter().any(|(krate, packages)| {
                *krate == needed && !packages.split(' ').any(|name| name == package)
            });
            let bare = match package {
                "blastema-core" => CORE_TAKES.contains(&needed),
                "blastema-trees" => TREES_TAKE.contains(&needed),
                // A chip has neither a heap nor an operating system.
                "blastema-lite" => false,
                _ => true,
            };
            if barred || !bare {
                breaches.push(Breach::new(&manifest.path, line, format!("{package} -> {needed}")));
            }
        }
    }
    breaches
}

/// Versions of dependencies, and the package's own facts, stand in the root manifest only.
pub(crate) fn inheritance(tree: &Tree) -> Vec<Breach> {
    let mut breaches = Vec::new();
    for (manifest, package) in members(tree) {
        for section in ["dependencies", "dev-dependencies", "build-dependencies"] {
            for (line, entry) in manifest.section(section) {
                let entry_text = entry.replace(' ', "");
                if !entry_text.contains("workspace=true") {
                    breaches.push(Breach::new(&manifest.path, line, entry));
                }
            }
        }
        for fact in ["version", "edition", "rust-version", "license"] {
            let inherited = manifest
                .section("package")
                .any(|(_, entry)| entry.starts_with(&format!("{fact}.workspace")));
            if !inherited {
                let what = format!("{package} does not say {fact}.workspace = true");
                breaches.push(Breach::new(&manifest.path, 1, what));
            }
        }
    }
    breaches
}

/// Every package takes the workspace's lints, and these forbid unsafe code.
pub(crate) fn lints(tree: &Tree) -> Vec<Breach> {
    let mut breaches: Vec<Breach> = members(tree)
        .filter(|(manifest, _)| {
            !manifest.section("lints").any(|(_, entry)| entry.replace(' ', "") == "workspace=true")
        })
        .map(|(manifest, package)| {
            Breach::new(&manifest.path, 1, format!("{package} has no [lints] workspace = true"))
        })
        .collect();
    let root = tree.manifests.iter().find(|manifest| manifest.path == "Cargo.toml");
    let forbids = root.is_some_and(|root| {
        root.entries.iter().any(|(section, _, entry)| {
            section == "workspace.lints.rust" && entry.replace(' ', "") == "unsafe_code=\"forbid\""
        })
    });
    if !forbids {
        breaches.push(Breach::new("Cargo.toml", 1, "unsafe_code is not forbidden"));
    }
    breaches
}
