//! Rules about packages: who may depend on whom, and what every manifest says.

use crate::architecture::tree::{Breach, Manifest, Tree, key};

/// What a package may depend on within the workspace, and what beside it in tests.
struct Place {
    package: &'static str,
    below: &'static [&'static str],
    below_in_tests: &'static [&'static str],
}

/// The map of ARCHITECTURE.md as data, from the bottom to the top.
const PLACES: [Place; 18] = [
    Place { package: "blastema-macros", below: &[], below_in_tests: &[] },
    // It runs on a chip, where nothing else of the workspace does.
    Place { package: "blastema-lite", below: &[], below_in_tests: &[] },
    // The derives are written for the core's traits, so the core's tests try them.
    Place { package: "blastema-core", below: &[], below_in_tests: &["blastema-macros"] },
    // Usable without the rest.
    Place { package: "blastema-trees", below: &[], below_in_tests: &[] },
    Place { package: "blastema-contract", below: &["blastema-core"], below_in_tests: &[] },
    // Its actors are tried with probes in their neighbours' places.
    Place {
        package: "blastema-transports",
        below: &["blastema-core", "blastema-contract"],
        below_in_tests: &["blastema-doubles", "blastema-ptys"],
    },
    // Its adapters speak the core's SLCAN.
    Place { package: "blastema-ptys", below: &["blastema-core"], below_in_tests: &[] },
    Place {
        package: "blastema-doubles",
        below: &["blastema-core", "blastema-contract"],
        below_in_tests: &[],
    },
    Place {
        package: "blastema",
        below: &[
            "blastema-core",
            "blastema-lite",
            "blastema-macros",
            "blastema-contract",
            "blastema-transports",
            "blastema-trees",
        ],
        below_in_tests: &["blastema-doubles"],
    },
    Place {
        package: "blastema-testkit",
        below: &[
            "blastema-core",
            "blastema-macros",
            "blastema-contract",
            "blastema-doubles",
            "blastema",
        ],
        below_in_tests: &[],
    },
    // The program uses what every user uses, and nothing else. Its tests take turns.
    Place {
        package: "blastema-cli",
        below: &["blastema", "blastema-robot"],
        below_in_tests: &["blastema-doubles"],
    },
    Place {
        package: "blastema-robot",
        below: &["blastema"],
        below_in_tests: &["blastema-doubles"],
    },
    Place {
        package: "blastema-demo",
        below: &["blastema", "blastema-robot"],
        below_in_tests: &["blastema-doubles"],
    },
    Place { package: "blastema-tests", below: EVERYTHING, below_in_tests: EVERYTHING },
    Place { package: "blastema-bench", below: EVERYTHING, below_in_tests: EVERYTHING },
    // Their nodes and contracts are those of a user.
    Place { package: "blastema-beds", below: &["blastema"], below_in_tests: &[] },
    Place { package: "blastema-derives", below: &["blastema"], below_in_tests: &[] },
    Place {
        package: "blastema-examples",
        below: &["blastema"],
        below_in_tests: &[
            "blastema",
            "blastema-doubles",
            "blastema-ptys",
            "blastema-robot",
            "blastema-testkit",
        ],
    },
];

/// What whole systems under test may use: all that is no program, test or example itself.
const EVERYTHING: &[&str] = &[
    "blastema-macros",
    "blastema-lite",
    "blastema-core",
    "blastema-trees",
    "blastema-contract",
    "blastema-transports",
    "blastema-doubles",
    "blastema-ptys",
    "blastema",
    "blastema-robot",
    "blastema-testkit",
];

/// The crates from outside that the core may use. It stays nearly bare, so that what it decides can
/// be simulated, and one day run on a microcontroller.
const CORE_TAKES: [&str; 8] =
    ["bincode", "bytes", "ring", "serde", "snow", "thiserror", "x25519-dalek", "zeroize"];
/// The same for behaviour trees.
const TREES_TAKE: [&str; 3] = ["roxmltree", "strsim", "thiserror"];

/// Crates of which only these packages may know.
const KNOWN_BY: [(&str, &[&str]); 6] = [
    // Behind the feature `journal`: not every user has a C compiler.
    ("rusqlite", &["blastema"]),
    ("bincode", &["blastema-core"]),
    ("snow", &["blastema-core"]),
    ("x25519-dalek", &["blastema-core"]),
    (
        "actix",
        &[
            "blastema-contract",
            "blastema-transports",
            "blastema-doubles",
            "blastema",
            "blastema-testkit",
            "blastema-tests",
            "blastema-bench",
            "blastema-examples",
        ],
    ),
    ("socket2", &["blastema-transports", "blastema", "blastema-tests", "blastema-bench"]),
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
        let Some(place) = PLACES.iter().find(|place| place.package == package) else {
            breaches.push(Breach::new(
                &manifest.path,
                1,
                format!("the package {package} has no place in the map"),
            ));
            continue;
        };
        let normal = ["dependencies", "build-dependencies"].map(|name| (name, false));
        for (section, in_tests) in normal.into_iter().chain([("dev-dependencies", true)]) {
            for (line, entry) in manifest.section(section) {
                let needed = key(entry);
                let allowed = place.below.contains(&needed)
                    || in_tests && place.below_in_tests.contains(&needed);
                if is_ours(needed) && !allowed {
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
            let barred = KNOWN_BY
                .iter()
                .any(|(krate, packages)| *krate == needed && !packages.contains(&package));
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
