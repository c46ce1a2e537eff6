//! The model of recovery actions that a plan chooses.

use crate::robots::ledger::{Cause, What};
use crate::robots::plan::Clock;
use crate::robots::run::Evidence;
use blastema::detection::{FaultTransition, MonitorRow};
use blastema::recovery::RecoveryAction;

/// An isolated component takes nothing until it is restarted.
pub(crate) fn isolation(evidence: &Evidence, out: &mut Vec<String>) {
    // On real threads it may have begun with its last message when it is isolated.
    if evidence.robot.clock != Clock::Virtual {
        return;
    }
    for event in &evidence.events {
        let isolated =
            matches!(&event.turn, FaultTransition::GaveUp { reason } if is_isolation(reason));
        let location = event.fault.location.to_string();
        let part =
            evidence.robot.parts.iter().position(|part| location == format!("robot:{}", part.name));
        let (true, Some(part)) = (isolated, part) else { continue };
        // What it has taken before is noted when it is no longer held up.
        if evidence.was(part, Cause::Slow) {
            continue;
        }
        let restarts =
            |what: &What| matches!(what, What::Began | What::Struck(Cause::RestartChild));
        // What came first at one instant of virtual time is not known.
        let at_once = evidence.of_part(part).filter(|entry| entry.at == event.at);
        if at_once.into_iter().any(|entry| restarts(&entry.what)) {
            continue;
        }
        let since = evidence.of_part(part).skip_while(|entry| entry.at <= event.at);
        let until = since.take_while(|entry| !restarts(&entry.what));
        let took =
            |what: &What| matches!(what, What::Serving(_) | What::Read { .. } | What::Load(_));
        if let Some(entry) = until.into_iter().find(|entry| took(&entry.what)) {
            let (name, at) = (evidence.name(part), evidence.ms(event.at));
            out.push(format!("isolation: {name} is isolated at {at} ms, and takes {entry:?}"));
        }
    }
}

fn is_isolation(reason: &str) -> bool {
    reason.contains(&format!("contained by {}", RecoveryAction::Isolate))
}

/// Whether the plan has had this component isolated.
pub(crate) fn was_isolated(evidence: &Evidence, part: usize) -> bool {
    let location = format!("robot:{}", evidence.name(part));
    evidence.events.iter().any(|event| {
        let gave_up =
            matches!(&event.turn, FaultTransition::GaveUp { reason } if is_isolation(reason));
        gave_up && event.fault.location.to_string() == location
    })
}

/// Whether the plan has this component isolated, and it is.
pub(crate) fn is_isolated(evidence: &Evidence, row: &MonitorRow) -> bool {
    let of_row = |location: &_| *location == row.location;
    let mut entries = evidence.record.entries.iter().filter(|entry| of_row(&entry.fault.location));
    let gave_up =
        |why: &Option<(_, String)>| why.as_ref().is_some_and(|(_, why)| is_isolation(why));
    row.isolated && entries.any(|entry| gave_up(&entry.given_up))
}
