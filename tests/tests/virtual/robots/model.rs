//! The small model: what must hold of every robot, whatever struck it.
//!
//! It knows what really happened, from the ledger, and compares it with what the node shows. It
//! does not predict what the middleware does; it says which answers cannot be right.

use crate::robots::answers::{is_isolated, isolation};
use crate::robots::commands::{activity, commands};
use crate::robots::ledger::{Answer, Cause, Entry, What};
use crate::robots::plan::{Branch, Clock, Group};
use crate::robots::requests::requests;
use crate::robots::run::{Evidence, is_open, leaves};
use crate::robots::story::{line, story};
use blastema::core::recovery::{ChildState, GiveUpReason};
use blastema::detection::{FaultEntry, FaultTransition};
use blastema::recovery::{Restart, Strategy};
use blastema::{FaultKind, Lifecycle, NodeState, Opinion};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// Everything that does not hold, each line with its kind in front of a colon.
pub(crate) fn breaches(evidence: &Evidence) -> Vec<String> {
    let mut breaches = Vec::new();
    let out = &mut breaches;
    requests(evidence, out);
    incarnations(evidence, out);
    events(evidence, out);
    deaths(evidence, out);
    notices(evidence, out);
    roots(evidence, out);
    ends(evidence, out);
    pictures(evidence, out);
    rounds(evidence, out);
    bystanders(evidence, out);
    isolation(evidence, out);
    commands(evidence, out);
    if !evidence.ended {
        out.push("shutdown: it does not end".into());
    }
    activity(&evidence.late_entries, evidence.robot.clock, out);
    if !breaches.is_empty() {
        breaches.push(story(evidence));
    }
    breaches
}

impl Evidence {
    pub(crate) fn was(&self, part: usize, wanted: Cause) -> bool {
        self.causes(part).any(|(_, cause)| cause == wanted)
    }

    /// It was removed, or not added yet.
    fn is_away(&self, part: usize) -> bool {
        let not_yet = self.robot.parts[part].late && !self.was(part, Cause::Added);
        not_yet || self.was(part, Cause::Removed)
    }

    pub(crate) fn name(&self, part: usize) -> &str {
        &self.robot.parts[part].name
    }

    pub(crate) fn of_part(&self, part: usize) -> impl Iterator<Item = &Entry> {
        self.entries.iter().filter(move |entry| entry.part == part)
    }

    pub(crate) fn causes(&self, part: usize) -> impl Iterator<Item = (&Entry, Cause)> {
        self.of_part(part).filter_map(|entry| match entry.what {
            What::Struck(cause) => Some((entry, cause)),
            _ => None,
        })
    }

    /// The faults of this object.
    fn faults<'a>(&'a self, object: &str) -> impl Iterator<Item = &'a FaultEntry> {
        let location = format!("robot:{object}");
        self.record.entries.iter().filter(move |entry| entry.fault.location.to_string() == location)
    }

    /// Milliseconds since the first line of the ledger; before it, less than none.
    pub(crate) fn ms(&self, at: blastema::Instant) -> i64 {
        let ms = |at: blastema::Instant| i64::try_from(at.as_nanos() / 1_000_000).unwrap_or(0);
        ms(at) - self.entries.first().map_or(0, |entry| ms(entry.at))
    }

    pub(crate) fn at_rest(&self) -> bool {
        matches!(self.state, NodeState::InSafeState { .. })
    }

    /// Where this component stands with its supervisor.
    pub(crate) fn child_status(&self, part: usize) -> Option<(ChildState, u64)> {
        let leaves = leaves(self.tree.as_ref()?);
        let own = leaves.into_iter().find(|(name, ..)| name == self.name(part))?;
        Some((own.1, own.2))
    }

    pub(crate) fn is_running(&self, part: usize) -> bool {
        !self.at_rest()
            && self.child_status(part).is_some_and(|(state, _)| state == ChildState::Running)
    }
}

/// No two incarnations have one number, and none acts when a later one has begun.
fn incarnations(evidence: &Evidence, out: &mut Vec<String>) {
    let mut latest: BTreeMap<usize, u64> = BTreeMap::new();
    for entry in &evidence.entries {
        let latest = latest.entry(entry.part).or_default();
        let name = evidence.name(entry.part);
        match entry.what {
            What::Began if entry.incarnation <= *latest => {
                out.push(format!("incarnations: {name}#{} began twice", entry.incarnation));
            }
            What::Began => *latest = entry.incarnation,
            // What an abandoned thread does at last is fenced; a notice is written by the watcher.
            What::Returned | What::Dropped | What::Down { .. } => {}
            What::Struck(Cause::DropPanic | Cause::Condition(_)) => {}
            _ if entry.incarnation < *latest => {
                out.push(format!("incarnations: {name} acts after its end: {entry:?}"));
            }
            _ => {}
        }
    }
}

/// Events are read once, in order, by who wants them; what is missing is counted.
fn events(evidence: &Evidence, out: &mut Vec<String>) {
    let robot = &evidence.robot;
    for (listener, plan) in robot.parts.iter().enumerate() {
        let mut read: BTreeMap<(usize, usize), u64> = BTreeMap::new();
        let mut all = BTreeSet::new();
        for entry in evidence.of_part(listener) {
            let What::Read { topic, from, n, .. } = entry.what else { continue };
            all.insert((from, n));
            let last = read.entry((topic, from)).or_default();
            if n <= *last {
                let name = &plan.name;
                out.push(format!("events: {name} read {n} after {last}: {entry:?}"));
            }
            *last = n;
            if !plan.listens.iter().any(|(other, each)| *other == topic && n % each == 0) {
                out.push(format!("events: {} does not want {entry:?}", plan.name));
            }
        }
        missing(evidence, listener, &all, out);
    }
}

/// What was published while the listener was there, and not read, is among the dead letters.
fn missing(
    evidence: &Evidence,
    listener: usize,
    read: &BTreeSet<(usize, u64)>,
    out: &mut Vec<String>,
) {
    let plan = &evidence.robot.parts[listener];
    let mut groups = Vec::new();
    below(&evidence.robot.root, &mut groups);
    groups.retain(|(_, parts)| parts.contains(&listener));
    // A group that escalates stops its members until a supervisor above it starts it again.
    let escalated = groups.iter().any(|(name, _)| {
        evidence.faults(name).any(|entry| entry.fault.kind == FaultKind::UnexpectedExit)
    });
    // One that was stopped or isolated, for good or until it was restarted, misses what it does not
    // have to read.
    let stayed = evidence.is_running(listener)
        && !escalated
        && evidence
            .events
            .iter()
            .all(|event| !matches!(event.turn, FaultTransition::GaveUp { .. }))
        && !evidence.was(listener, Cause::Stop)
        && plan.restart == Restart::Permanent;
    let active = |entry: &Entry| entry.what == What::Hook("on_activated");
    let Some(from) = evidence.of_part(listener).find(|entry| active(entry)) else { return };
    if !stayed {
        return;
    }
    let dead = |object: &str| -> u64 {
        let of = evidence
            .dead
            .iter()
            .filter(|dead| dead.object.as_str() == object && dead.contract == "robots/reading");
        of.map(|dead| dead.count).sum()
    };
    // What was published at the very end may still be under way on real threads.
    let until = match evidence.robot.clock {
        Clock::Virtual => evidence.seen_at,
        Clock::Real { .. } => evidence.quiet_at,
    };
    for (topic, each) in &plan.listens {
        let missed: Vec<&Entry> = evidence
            .entries
            .iter()
            .filter(|entry| match entry.what {
                What::Published { topic: other, n } if other == *topic && n % each == 0 => {
                    entry.at > from.at && entry.at < until && !read.contains(&(entry.part, n))
                }
                _ => false,
            })
            .collect();
        let lost = dead(&plan.name) + dead(&format!("t{topic}"));
        if lost < missed.len() as u64 {
            let first = missed[0];
            let name = &plan.name;
            out.push(format!(
                "events: {name} missed {} of t{topic}, {lost} are counted as lost; the first was \
                 {:?} of {}#{} at {} ms",
                missed.len(),
                first.what,
                evidence.name(first.part),
                first.incarnation,
                evidence.ms(first.at),
            ));
        }
    }
}

/// Each panic is told, once for the incarnation that it ended.
fn deaths(evidence: &Evidence, out: &mut Vec<String>) {
    for part in 0..evidence.robot.parts.len() {
        let name = evidence.name(part);
        let mut died: BTreeSet<u64> = BTreeSet::new();
        let (mut conditions, mut kills, mut others) = (0, 0, 0);
        for (entry, cause) in evidence.causes(part) {
            match cause {
                Cause::Panic(_) => {
                    died.insert(entry.incarnation);
                }
                Cause::Condition(_) => conditions += 1,
                Cause::Kill => kills += 1,
                Cause::Declare => others += 1,
                _ => {}
            }
        }
        // A panic in `Drop` after an orderly end is a fault; after a panic it is only logged.
        let in_order = |entry: &Entry| {
            entry.what == What::Struck(Cause::DropPanic)
                && entry.at <= evidence.seen_at
                && evidence.of_part(part).any(|other| match &other.what {
                    What::Down { incarnation, ending, .. } => {
                        *incarnation == entry.incarnation
                            && matches!(&ending[..], "Stopped" | "Returned")
                    }
                    _ => false,
                })
        };
        let drops = evidence.of_part(part).filter(|entry| in_order(entry)).count() as u64;
        let count = |kind: FaultKind| -> u64 {
            let of_kind = evidence.faults(name).filter(|entry| entry.fault.kind == kind);
            of_kind.map(|entry| u64::from(entry.fault.count)).sum()
        };
        // The condition of a component that is between two incarnations ends none of them.
        let (panics, checks) = (count(FaultKind::Panic), count(FaultKind::CheckFailed));
        let told = panics + checks.saturating_sub(others + drops);
        let died = died.len() as u64;
        let in_conditions = u64::from(conditions > 0 && died == 0);
        if checks < drops && !evidence.is_away(part) {
            out.push(format!(
                "deaths: {drops} drops of {name} panicked, told were {checks} checks"
            ));
        }
        if told < died + in_conditions || panics > died + conditions + kills {
            out.push(format!(
                "deaths: {name} panicked in {died} incarnations and {conditions} times in \
                 conditions, and was killed {kills} times; told were {panics}, and {checks} checks"
            ));
        }
    }
}

/// The watcher is told of each end once, and of the last in any case.
fn notices(evidence: &Evidence, out: &mut Vec<String>) {
    if evidence.at_rest() {
        return;
    }
    let watcher = evidence.tree.as_ref().and_then(|tree| {
        tree.children.iter().find(|child| child.name.as_str() == crate::robots::part::WATCHER)
    });
    if watcher.is_none_or(|child| child.incarnation.0 != 1) {
        return;
    }
    for part in 0..evidence.robot.parts.len() {
        let name = evidence.name(part);
        let from = evidence.watched_from.iter().find(|(watched, ..)| watched == name);
        let Some((_, _, from)) = from else { continue };
        let (mut last, mut known) = (0, 0);
        for entry in evidence.of_part(part).filter(|entry| entry.at <= evidence.seen_at) {
            let What::Down { incarnation, ending, .. } = &entry.what else { continue };
            known = known.max(*incarnation);
            // It ended before it was watched, or was removed.
            if ending == "NotAlive" || ending == "Unknown" {
                continue;
            }
            if *incarnation <= last {
                out.push(format!("notices: the end of {name}#{incarnation} is told after #{last}"));
            }
            last = *incarnation;
        }
        let Some((state, now)) = evidence.child_status(part) else { continue };
        let over = if state == ChildState::Running { now.saturating_sub(1) } else { now };
        if known < over && over >= *from {
            out.push(format!(
                "notices: the end of {name}#{over} is not told; #{known} was the last"
            ));
        }
    }
}

/// Each fault has a cause in its place, or is a symptom of one that has.
fn roots(evidence: &Evidence, out: &mut Vec<String>) {
    let mut groups = Vec::new();
    below(&evidence.robot.root, &mut groups);
    let late = (0..evidence.robot.parts.len()).filter(|part| evidence.robot.parts[*part].late);
    groups.push((evidence.robot.root.name.clone(), late.collect()));
    for entry in &evidence.record.entries {
        let fault = &entry.fault;
        if fault.symptom_of.is_some() {
            continue;
        }
        let location = fault.location.to_string();
        let object = location.strip_prefix("robot:").unwrap_or(&location);
        let at = |part: usize| {
            evidence
                .causes(part)
                .filter(|(entry, _)| entry.at <= fault.found_at)
                .map(|(_, cause)| cause)
        };
        // What the plan lets components do may be more than their threads can.
        if fault.kind == FaultKind::Overload && evidence.robot.clock != Clock::Virtual {
            continue;
        }
        let part = (0..evidence.robot.parts.len()).find(|part| evidence.name(*part) == object);
        let explained = match part {
            Some(part) => at(part).any(|cause| explains(cause, &fault.kind)),
            None => {
                let of_group = groups.iter().filter(|(name, _)| name == object);
                let mut parts = of_group.flat_map(|(_, parts)| parts);
                location == "robot" || parts.any(|part| at(*part).next().is_some())
            }
        };
        if !explained {
            out.push(format!("roots: without a cause: {}", line(evidence, entry)));
        }
    }
}

fn explains(cause: Cause, kind: &FaultKind) -> bool {
    let waits = matches!(cause, Cause::Wait(_) | Cause::Hang | Cause::Slow);
    // A component may wait for another one's answer as long as it may wait at all.
    let stands = waits || matches!(cause, Cause::Block(_) | Cause::Consult);
    let fails = matches!(cause, Cause::Fail(_) | Cause::Fatal(_) | Cause::Unavailable);
    match kind {
        FaultKind::Panic => {
            matches!(cause, Cause::Panic(_) | Cause::Condition(_) | Cause::Kill)
        }
        FaultKind::UnexpectedExit => cause == Cause::Stop,
        FaultKind::Hang => stands,
        FaultKind::Silence => stands || matches!(cause, Cause::Silence | Cause::Flood),
        FaultKind::Overload => stands || cause == Cause::Flood,
        // Also of the last hooks, which fail for good or are cut off.
        FaultKind::ErrorState => waits || fails,
        FaultKind::InitializationFailed => {
            let hook = "on_initialize";
            waits || [Cause::Fail(hook), Cause::Fatal(hook), Cause::FailInit].contains(&cause)
        }
        FaultKind::Fatal => waits || fails || cause == Cause::FailInit,
        FaultKind::Unavailable => cause == Cause::Unavailable,
        FaultKind::CheckFailed => {
            // Two that consult each other wait in a circle, which is told.
            let causes = [Cause::Declare, Cause::DropPanic, Cause::Consult];
            causes.contains(&cause) || matches!(cause, Cause::Condition(_))
        }
        _ => false,
    }
}

/// The supervisors, each with all components below it.
fn below(group: &Group, groups: &mut Vec<(String, Vec<usize>)>) -> Vec<usize> {
    let mut parts = Vec::new();
    for child in &group.children {
        match child {
            Branch::Part(index) => parts.push(*index),
            Branch::Group(below) => parts.extend(self::below(below, groups)),
        }
    }
    groups.push((group.name.clone(), parts.clone()));
    parts
}

/// Nothing is being recovered from when it has been quiet for long.
fn ends(evidence: &Evidence, out: &mut Vec<String>) {
    if evidence.at_rest() {
        return;
    }
    for entry in evidence.record.entries.iter().filter(|entry| is_open(entry)) {
        out.push(format!("ends: a fault does not: {}", line(evidence, entry)));
    }
}

/// Tree, table and the components themselves agree.
fn pictures(evidence: &Evidence, out: &mut Vec<String>) {
    for (part, answer) in evidence.answers.iter().enumerate() {
        let name = evidence.name(part);
        let row =
            evidence.table.iter().find(|row| row.location.to_string() == format!("robot:{name}"));
        if evidence.is_away(part) {
            let child_status = evidence.child_status(part);
            let is_seen = row.is_some() || child_status.is_some();
            if is_seen || !matches!(answer, Answer::NotTaken(_)) {
                out.push(format!(
                    "pictures: {name} is away: {child_status:?}, {answer:?}, {row:?}"
                ));
            }
            continue;
        }
        let Some(row) = row else {
            out.push(format!("pictures: {name} is not in the table"));
            continue;
        };
        let child_status = evidence.child_status(part);
        let began = |entry: &Entry| entry.what == What::Began && entry.at <= evidence.seen_at;
        let began = evidence.of_part(part).filter(|entry| began(entry)).last();
        let began = began.map_or(0, |entry| entry.incarnation);
        let told =
            format!("{name}: in the tree {child_status:?}, began #{began}, {answer:?}, {row:?}");
        if is_isolated(evidence, row) {
            if !matches!(answer, Answer::NotTaken(_)) {
                out.push(format!("pictures: isolated: {told}"));
            }
        } else if evidence.is_running(part) {
            let agreed = row.state == Some(Lifecycle::Active)
                && (row.opinion == Opinion::Trusted
                    || evidence.robot.clock != Clock::Virtual && row.opinion == Opinion::Suspect)
                && child_status == Some((ChildState::Running, row.incarnation.0))
                && began == row.incarnation.0
                && *answer == Answer::Reply(row.incarnation.0);
            if !agreed {
                out.push(format!("pictures: {told}"));
            }
        } else {
            // That an end is final is a reason for those alone whose rules say so.
            let is_final = GiveUpReason::Finished.to_string();
            let gave_up = |entry: &FaultEntry| {
                entry.given_up.as_ref().is_some_and(|(_, why)| *why != is_final)
            };
            let given_up = || evidence.record.entries.iter().any(gave_up);
            let stopped = evidence.was(part, Cause::Stop);
            let why = evidence.at_rest()
                || given_up()
                || stopped
                || evidence.robot.parts[part].restart == Restart::Temporary;
            let at_rest = matches!(
                child_status,
                None | Some((ChildState::Resting | ChildState::Finished | ChildState::Waiting, _))
            );
            if !why || (!at_rest && !evidence.at_rest()) || !matches!(answer, Answer::NotTaken(_)) {
                out.push(format!("pictures: not running: {told}"));
            }
        }
    }
}

/// Each component that works has its rounds: none starves in silence.
fn rounds(evidence: &Evidence, out: &mut Vec<String>) {
    for (part, plan) in evidence.robot.parts.iter().enumerate() {
        let Some(hz) = plan.rate_hz.filter(|_| evidence.is_running(part)) else { continue };
        // One that hangs may be left alone in its isolation.
        let location = format!("robot:{}", plan.name);
        let row = evidence.table.iter().find(|row| row.location.to_string() == location);
        if evidence.robot.clock != Clock::Virtual
            || row.is_some_and(|row| is_isolated(evidence, row))
        {
            continue;
        }
        // The last twenty seconds of the quiet.
        let span = Duration::from_secs(20);
        let counted = evidence.of_part(part).filter(|entry| {
            entry.what == What::Round
                && entry.at + span >= evidence.seen_at
                && entry.at < evidence.seen_at
        });
        let (counted, due) = (counted.count(), 20 * hz as usize);
        if counted + 1 < due || counted > due + 1 {
            out.push(format!("rounds: {} had {counted} of {due} rounds", plan.name));
        }
    }
}

/// One to which nothing happens, and that depends on no sibling, is not restarted.
fn bystanders(evidence: &Evidence, out: &mut Vec<String>) {
    let storm = |entry: &FaultEntry| entry.fault.kind == FaultKind::RestartStorm;
    // On real threads it may stand behind a hang, and be moved.
    if evidence.robot.clock != Clock::Virtual
        || evidence.at_rest()
        || evidence.record.entries.iter().any(storm)
    {
        return;
    }
    let mut alone = Vec::new();
    independent(&evidence.robot.root, &mut alone);
    for part in alone {
        let name = evidence.name(part);
        let began = evidence.of_part(part).filter(|entry| entry.what == What::Began).count();
        let untouched = evidence.causes(part).next().is_none();
        if untouched && (began > 1 || evidence.faults(name).any(|f| f.fault.symptom_of.is_none())) {
            out.push(format!("bystanders: {name} began {began} times, though nothing struck it"));
        }
    }
}

/// The components that no supervisor above them restarts because of a sibling.
fn independent(group: &Group, alone: &mut Vec<usize>) {
    if group.strategy != Strategy::OneForOne {
        return;
    }
    for child in &group.children {
        match child {
            Branch::Part(index) => alone.push(*index),
            Branch::Group(below) => independent(below, alone),
        }
    }
}
