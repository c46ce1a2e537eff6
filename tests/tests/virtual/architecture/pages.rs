//! Rules about the pages that people read first.

use crate::architecture::tree::{Breach, Tree};

/// The pages with the words and with the packages.
const GLOSSARY: &str = "actors/src/manual/glossary.md";
const MAP: &str = "ARCHITECTURE.md";
/// The page that says what each error means, and the errors.
const ERRORS: &str = "actors/src/manual/sending.md";
const DELIVERY: &str = "core/src/delivery/mod.rs";

/// One word per concept: in types, files, manual and command line.
const VOCABULARY: &str = "node, object, component, contract, sender, port, transport, link, \
    session, route, incarnation, fault, error, failure, heartbeat, ping, trusted, suspect, failed, \
    strategy, child spec, intensity, escalate, proxy, safe state, degraded";

/// The manual explains every word of the vocabulary in the first column of its glossary.
pub(crate) fn glossary(tree: &Tree) -> Vec<Breach> {
    let rows = section(tree, GLOSSARY, "# Glossary");
    let terms: String = rows
        .filter_map(|row| row.strip_prefix('|')?.split('|').next())
        .collect::<Vec<_>>()
        .join(" ")
        .to_lowercase();
    VOCABULARY
        .split(", ")
        .filter(|term| !terms.contains(term))
        .map(|term| Breach::new(GLOSSARY, 1, format!("the glossary lacks \"{term}\"")))
        .collect()
}

/// The manual's table of errors has every variant of `DeliveryError`.
pub(crate) fn errors(tree: &Tree) -> Vec<Breach> {
    let table: String = section(tree, ERRORS, "## What every error means").collect();
    let source = tree.files.get(DELIVERY).map_or("", String::as_str);
    let body = source.lines().skip_while(|line| *line != "pub enum DeliveryError {").skip(1);
    let variants = body.take_while(|line| *line != "}").filter_map(|line| {
        let name = line.strip_prefix("    ").filter(|rest| rest.starts_with(char::is_uppercase))?;
        Some(name.trim_end_matches([',', ' ', '{']))
    });
    variants
        .filter(|name| !table.contains(&format!("`{name}`")))
        .map(|name| Breach::new(ERRORS, 1, format!("the table of errors lacks {name}")))
        .collect()
}

/// The map names every package and its folder in one row.
pub(crate) fn map(tree: &Tree) -> Vec<Breach> {
    let rows: Vec<&str> = section(tree, MAP, "## The map").collect();
    tree.manifests
        .iter()
        .filter_map(|manifest| {
            let package = manifest.package.as_deref()?;
            let folder = manifest.folder().trim_end_matches('/');
            let named = rows.iter().any(|row| {
                row.contains(&format!("`{folder}/`")) && row.contains(&format!("`{package}`"))
            });
            let what = format!("the map has no row for `{folder}/` with `{package}`");
            (!named).then(|| Breach::new(MAP, 1, what))
        })
        .collect()
}

/// A page is read in a terminal beside the code. A row of a table cannot be broken.
const WIDTH: usize = 120;

/// No line of a page is wider than that, but for tables.
pub(crate) fn width(tree: &Tree) -> Vec<Breach> {
    let pages = tree.files.iter().filter(|(path, _)| path.ends_with(".md"));
    let lines = pages.flat_map(|(path, text)| text.lines().zip(1..).map(move |line| (path, line)));
    lines
        .filter(|(_, (line, _))| {
            !line.trim_start().starts_with('|') && line.chars().count() > WIDTH
        })
        .map(|(path, (_, number))| Breach::new(path, number, "wider than 120 columns".to_owned()))
        .collect()
}

/// The lines below a heading, up to the next one of its rank.
fn section<'a>(tree: &'a Tree, page: &str, heading: &'a str) -> impl Iterator<Item = &'a str> {
    let text = tree.files.get(page).map_or("", String::as_str);
    text.lines()
        .skip_while(move |line| *line != heading)
        .skip(1)
        .take_while(|line| !line.starts_with("## "))
}

/// Words that leave open which part of the system acts.
const VAGUE: [&str; 6] = ["whoever", "nobody", "somebody", "anybody", "everybody", "anew"];

/// A sentence names the part of the system that acts: the peer, the sender, the other node. These
/// rules and their tests are the only files that contain the words.
pub(crate) fn subjects(tree: &Tree) -> Vec<Breach> {
    let is_prose = |path: &str| path.ends_with(".rs") || path.ends_with(".md");
    let is_rule = |path: &str| path.starts_with("tests/tests/virtual/architecture/");
    let files = tree.files.iter().filter(|(path, _)| is_prose(path) && !is_rule(path));
    let lines = files.flat_map(|(path, text)| text.lines().zip(1..).map(move |line| (path, line)));
    let found = lines.filter_map(|(path, (line, number))| {
        let mut words = line.split(|c: char| !c.is_alphanumeric() && c != '_');
        let vague =
            words.find(|word| VAGUE.iter().any(|vague| word.eq_ignore_ascii_case(vague)))?;
        Some(Breach::new(path, number, format!("`{vague}` leaves open which part acts")))
    });
    found.collect()
}
