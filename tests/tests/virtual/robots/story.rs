//! What happened, for a person.

use crate::robots::ledger::{Entry, What};
use crate::robots::run::Evidence;
use blastema::detection::FaultEntry;

/// One fault, with what became of it.
pub(crate) fn line(evidence: &Evidence, entry: &FaultEntry) -> String {
    let fault = &entry.fault;
    let after = evidence.ms(fault.found_at);
    let decided = entry.decided.as_ref().map(|(_, action)| action.as_str());
    let given_up = entry.given_up.as_ref().map(|(_, why)| why.as_str());
    let symptom = fault.symptom_of.map(|root| format!(" symptom of {}", root.0));
    format!(
        "{after} ms #{} {} of {}{} ×{}: {}; {decided:?} {given_up:?} {}{}",
        fault.id.0,
        fault.kind,
        fault.location,
        fault.incarnation,
        fault.count,
        fault.detail,
        entry.status(),
        symptom.unwrap_or_default(),
    )
}

/// The ledger without its rounds and events, and the faults.
pub(crate) fn story(evidence: &Evidence) -> String {
    let told = |entry: &&Entry| {
        !matches!(
            entry.what,
            What::Round | What::Read { .. } | What::Published { .. } | What::Load(_)
        )
    };
    let mut lines: Vec<(i64, String)> = evidence
        .entries
        .iter()
        .filter(told)
        .map(|entry| {
            let Entry { at, part, incarnation, what } = entry;
            let after = evidence.ms(*at);
            (after, format!("{after:>8} ms {}#{incarnation} {what:?}", evidence.name(*part)))
        })
        .collect();
    for event in &evidence.events {
        let after = evidence.ms(event.at);
        let fault = &event.fault;
        let (kind, location, incarnation) = (&fault.kind, &fault.location, fault.incarnation);
        let text = format!(
            "{after:>8} ms   fault {} {kind} of {location}{incarnation}: {:?}: {}",
            fault.id.0, event.turn, fault.detail
        );
        lines.push((after, text));
    }
    lines.sort_by_key(|(after, _)| *after);
    let lines: Vec<String> = lines.into_iter().map(|(_, line)| line).collect();
    let (dead, state) = (&evidence.dead, &evidence.state);
    let quiet = evidence.ms(evidence.quiet_at);
    let missed = evidence.missed_events;
    format!(
        "the story, quiet from {quiet} ms on, {state:?}, {missed} steps of faults missed:\n{}\n{dead:?}",
        lines.join("\n")
    )
}
