//! The model of starts and of a person's commands.

use crate::robots::ledger::{Cause, Entry, What};
use crate::robots::plan::Clock;
use crate::robots::run::{Evidence, Refusal};
use blastema::StartError;

/// A node that does not start says who is to blame, and leaves nothing behind.
pub(crate) fn breaches_of_start(refusal: &Refusal) -> Vec<String> {
    let Refusal { robot, entries, error, late_entries } = refusal;
    let mut breaches = Vec::new();
    activity(late_entries, robot.clock, &mut breaches);
    let broken = robot.parts.iter().find(|part| part.broken_ports && !part.late);
    let right = match (broken, error) {
        (Some(_), StartError::Spec(_)) => entries.is_empty(),
        (None, StartError::GaveUp { .. }) => {
            entries.iter().any(|entry| matches!(entry.what, What::Struck(_)))
        }
        _ => false,
    };
    let text = error.to_string();
    let named = robot.parts.iter().any(|part| text.contains(&part.name));
    if !right || !named {
        let lines: Vec<String> = entries.iter().map(|entry| format!("{entry:?}")).collect();
        breaches.push(format!("start: refused without a cause: {text}"));
        breaches.push(lines.join("\n"));
    }
    breaches
}

/// Components do nothing when their node has ended. What an abandoned thread does at last is to
/// return.
pub(crate) fn activity(late: &[Entry], clock: Clock, out: &mut Vec<String>) {
    let returns = |entry: &&Entry| matches!(entry.what, What::Returned | What::Dropped);
    if let Some(entry) = late.iter().find(|entry| clock == Clock::Virtual || !returns(entry)) {
        out.push(format!("shutdown: components do something after it: {entry:?}"));
    }
}

/// What a person wants of the node is done, or refused with a reason.
pub(crate) fn commands(evidence: &Evidence, out: &mut Vec<String>) {
    for step in &evidence.unanswered {
        out.push(format!("commands: without an outcome: {step:?}"));
    }
    for (part, why) in &evidence.refused {
        let plan = &evidence.robot.parts[*part];
        let right = match plan.broken_ports {
            true => why.contains(&plan.name),
            false => plan.depends_on.is_some() || evidence.at_rest(),
        };
        if !right {
            out.push(format!("commands: {} was not added: {why}", plan.name));
        }
    }
    for (part, plan) in evidence.robot.parts.iter().enumerate() {
        if plan.broken_ports && (!plan.late || evidence.was(part, Cause::Added)) {
            out.push(format!("start: {} is there, though its ports panic", plan.name));
        }
    }
}
