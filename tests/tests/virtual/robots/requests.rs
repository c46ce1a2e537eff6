//! The model of requests.

use crate::robots::answers::was_isolated;
use crate::robots::ledger::{Answer, Cause, Entry, What};
use crate::robots::plan::Clock;
use crate::robots::run::Evidence;
use blastema::Instant;
use std::collections::BTreeMap;
use std::time::Duration;

/// A beat, by which the end of a deadline may be late, and the millisecond of a timer.
const BEAT: Duration = Duration::from_millis(12);

/// Each request has one outcome, in time, and it is true.
pub(crate) fn requests(evidence: &Evidence, out: &mut Vec<String>) {
    let mut served: BTreeMap<u64, Vec<&Entry>> = BTreeMap::new();
    for entry in &evidence.entries {
        if let What::Serving(number) = entry.what {
            served.entry(number).or_default().push(entry);
        }
    }
    for (number, serving) in &served {
        if serving.len() > 1 {
            out.push(format!("requests: number {number} was served twice: {serving:?}"));
        }
    }
    for asked in &evidence.asked {
        let serving = served.get(&asked.number).and_then(|serving| serving.first());
        let told = format!("{asked:?}, served: {serving:?}");
        let Some((at, answer)) = &asked.answer else {
            let ended = |(part, incarnation)| is_over(evidence, part, incarnation);
            if !asked.by.is_some_and(ended) {
                out.push(format!("requests: without an outcome: {told}"));
            }
            continue;
        };
        let took = *at - asked.asked_at;
        let deadline = Duration::from_millis(asked.deadline_ms);
        if evidence.robot.clock == Clock::Virtual && took > deadline + BEAT {
            out.push(format!("requests: late, after {took:?}: {told}"));
        }
        let right = match answer {
            Answer::Reply(incarnation) => {
                serving.is_some_and(|entry| entry.incarnation == *incarnation)
            }
            Answer::NotTaken(_) => serving.is_none(),
            Answer::PeerDied(incarnation) => {
                serving.is_none_or(|entry| entry.incarnation == *incarnation)
                    && is_over(evidence, asked.part, *incarnation)
            }
            Answer::DeadlinePassed => {
                let killed_at = serving.and_then(|serving| killed_by(evidence, serving));
                let before = |at: Instant| at < asked.asked_at + deadline;
                took >= deadline
                    && (evidence.robot.clock != Clock::Virtual || !killed_at.is_some_and(before))
            }
            // It was served, and its reply was not let out.
            Answer::Other(_) => serving.is_some() && was_isolated(evidence, asked.part),
        };
        if !right {
            out.push(format!("requests: an outcome that is not true: {told}"));
        }
    }
}

/// When the incarnation that began to serve this request died of it at once.
fn killed_by(evidence: &Evidence, serving: &Entry) -> Option<Instant> {
    let mut later = evidence.of_part(serving.part).skip_while(|entry| *entry != serving);
    let next = later.find(|entry| *entry != serving && entry.incarnation == serving.incarnation)?;
    matches!(next.what, What::Struck(Cause::Panic(_))).then_some(next.at)
}

/// Whether this incarnation has ended, as far as the pictures at the end tell.
fn is_over(evidence: &Evidence, part: usize, incarnation: u64) -> bool {
    let now = evidence.child_status(part);
    !evidence.is_running(part) || now.is_some_and(|(_, now)| now > incarnation)
}
