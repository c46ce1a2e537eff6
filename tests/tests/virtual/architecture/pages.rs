//! Rules about the pages that people read first.

use crate::architecture::tree::{Breach, Tree};

/// One word per concept: in types, files, manual and command line.
const VOCABULARY: &str = "node, object, component, contract, sender, port, transport, link, \
    session, route, incarnation, fault, error, failure, heartbeat, ping, trusted, suspect, failed, \
    strategy, child spec, intensity, escalate, proxy, safe state, degraded";

/// The glossary explains each word of the vocabulary, the manual each variant of `DeliveryError`,
/// and the map each package, where its table says so.
pub(crate) fn tables(tree: &Tree) -> Vec<Breach> {
    let words = VOCABULARY.split(", ").map(|word| vec![word.to_owned()]).collect();
    let errors = tree.files.get("core/src/delivery/mod.rs").map_or("", String::as_str);
    let errors = errors.lines().skip_while(|line| *line != "pub enum DeliveryError {").skip(1);
    let errors = errors.take_while(|line| *line != "}").filter_map(|line| {
        let name = line.strip_prefix("    ").filter(|rest| rest.starts_with(char::is_uppercase))?;
        Some(vec![format!("`{}`", name.trim_end_matches([',', ' ', '{']))])
    });
    let packages = tree.manifests.iter().filter_map(|manifest| {
        let folder = manifest.path.trim_end_matches("Cargo.toml");
        Some(vec![format!("`{folder}`"), format!("`{}`", manifest.package()?)])
    });
    // A page, its heading, in how many columns the names stand, and the names of each row.
    let tables: [(&str, &str, usize, Vec<Vec<String>>); 3] = [
        ("actors/src/manual/glossary.md", "# Glossary", 1, words),
        ("actors/src/manual/sending.md", "## What every error means", 1, errors.collect()),
        ("ARCHITECTURE.md", "## The map", 2, packages.collect()),
    ];
    let mut breaches = Vec::new();
    for (page, heading, columns, wanted) in tables {
        // The lines below the heading, up to the next one of its rank.
        let lines = tree.files.get(page).map_or("", String::as_str).lines();
        let lines = lines.skip_while(|line| *line != heading).skip(1);
        let rows = lines
            .take_while(|line| !line.starts_with("## "))
            .map(|line| line.to_lowercase().split('|').skip(1).take(columns).collect::<String>());
        let rows: Vec<String> = rows.collect();
        for entry in wanted {
            let explains =
                |row: &String| entry.iter().all(|name| row.contains(&*name.to_lowercase()));
            if !rows.iter().any(explains) {
                breaches.push(Breach::new(page, 1, format!("no row of {heading} has {entry:?}")));
            }
        }
    }
    breaches
}
