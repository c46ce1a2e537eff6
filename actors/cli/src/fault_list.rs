//! `blastema fault list`.

use crate::args::FaultListOptions;
use crate::monitor::client::look;
use crate::monitor::tables::{WIDEST, table};
use crate::print;
use blastema::journal::{self, JournalEntry};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::io::{self, IsTerminal};
use std::path::Path;
use std::time::Duration;

/// The columns after those that say when the fault was found.
const COLUMNS: &str = "node, fault=id, code, kind, location, times=count, status, symptom of, action, \
     service restored after=recovered_after_ms, part repaired after=repaired_after_ms, detail";

/// Prints the list that is asked for.
///
/// # Errors
/// A source of it cannot be read.
pub(crate) fn run(options: &FaultListOptions) -> Result<(), String> {
    let (found, rows) = match &options.journal {
        Some(path) => ("found=found_at", of_journal(path, options)?),
        None => ("found before=age_ms", of_nodes(options)?),
    };
    let text = match (options.json, rows.is_empty()) {
        (true, _) => format!("{}\n", Value::from(rows)),
        (false, true) if options.all => "no faults\n".to_owned(),
        (false, true) => "no fault stands\n".to_owned(),
        (false, false) => {
            // Programs read files and pipes, and want the texts in full.
            let widest = if io::stdout().is_terminal() { WIDEST } else { usize::MAX };
            table(&format!("{found}, {COLUMNS}"), &rows, widest)
        }
    };
    print(&text)
}

fn of_journal(path: &Path, options: &FaultListOptions) -> Result<Vec<Value>, String> {
    let entries = journal::read(path).map_err(|error| error.to_string())?;
    check_node(options, entries.iter().map(|entry| entry.node.as_str()))?;
    let wanted = |entry: &JournalEntry| {
        (options.all || entry.status.stands())
            && options.node.as_ref().is_none_or(|node| *node == entry.node)
    };
    Ok(entries.iter().filter(|entry| wanted(entry)).map(row).collect())
}

/// The node that is asked for is one of these, where there are any.
fn check_node<'a>(
    options: &FaultListOptions,
    known: impl Iterator<Item = &'a str>,
) -> Result<(), String> {
    let Some(wanted) = &options.node else { return Ok(()) };
    let known: BTreeSet<&str> = known.collect();
    if known.is_empty() || known.contains(wanted.as_str()) {
        return Ok(());
    }
    // A misspelt node would look like one without faults.
    let known = known.into_iter().collect::<Vec<_>>().join(", ");
    Err(format!("nothing is known of a node `{wanted}` here, but of {known}"))
}

/// The keys are those of a node's snapshot, where that has the same.
fn row(entry: &JournalEntry) -> Value {
    let fault = |id: u64| format!("fault {id}");
    let millis = |span: Duration| (span.as_secs_f64() * 1e6).round() / 1e3;
    json!({
        "sequence": entry.sequence,
        "node": entry.node,
        "node_incarnation": entry.node_incarnation,
        "id": fault(entry.id),
        "code": entry.code,
        "kind": entry.kind,
        "severity": entry.severity,
        "location": entry.location,
        "incarnation": entry.incarnation,
        "detail": entry.detail,
        "count": entry.count,
        "symptom_of": entry.symptom_of.map(fault),
        "action": entry.action,
        "given_up": entry.given_up,
        "status": entry.status.to_string(),
        "found_at": entry.found_at.to_string(),
        "recovered_at": entry.recovered.map(|(at, _)| at.to_string()),
        "recovered_after_ms": entry.recovered.map(|(_, span)| millis(span)),
        "repaired_at": entry.repaired.map(|(at, _)| at.to_string()),
        "repaired_after_ms": entry.repaired.map(|(_, span)| millis(span)),
    })
}

fn of_nodes(options: &FaultListOptions) -> Result<Vec<Value>, String> {
    let (mut rows, mut nodes) = (Vec::new(), Vec::new());
    for path in &options.sockets {
        let seen = blastema::run(look(path, options.within))?;
        let node = &seen.snapshot["node"];
        nodes.extend(node.as_str().map(str::to_owned));
        if options.node.as_ref().is_some_and(|wanted| node.as_str() != Some(wanted)) {
            continue;
        }
        let Some(faults) = seen.snapshot["faults"].as_array() else {
            return Err(format!(
                "the node at {} shows itself, but its list of faults did not answer: try again, or \
                 read its journal",
                path.display()
            ));
        };
        for fault in faults.iter().filter(|fault| options.all || fault["status"] != "closed") {
            let mut row = fault.clone();
            row["node"] = node.clone();
            rows.push(row);
        }
    }
    check_node(options, nodes.iter().map(String::as_str))?;
    Ok(rows)
}
