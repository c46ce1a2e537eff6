//! One fault, from its injection to the instant at which all is as before.
//!
//! ```text
//! Watching ─────────────────► Settling ──────────────► Over
//! found? repaired, if it      all that was sent has
//! must be; service back?      come, all is up that is
//!                             to be
//! ```
//!
//! A phase that exceeds its deadline adds a problem to the row. The next phase begins nevertheless,
//! so that one broken promise does not hide the next.

use crate::faults::{Blow, DemoFault, FAULTS, FaultMatch};
use crate::flow_account::FlowLosses;
use crate::report::{FaultRow, ReportedFault, counted};
use crate::robot::{DemoCable, Module};
use crate::robot_state::{FoundFault, FoundKey, RobotState};
use blastema::Instant;
use std::time::Duration;

/// From the fault, or its repair, to the return of service; a process must be started within it.
/// The limits are generous: they end a run in which something is missing, and say nothing of speed.
const RECOVERY: Duration = Duration::from_secs(30);
/// Until all sent messages have arrived, and until all is as before.
const SETTLING: Duration = Duration::from_secs(30);
/// The shortest time between a cut and its repair, which also waits for the detection.
const BEFORE_REPAIR: Duration = Duration::from_millis(300);
/// The shortest step, so that a person can follow it.
const LEAST: Duration = Duration::from_millis(1_200);
/// An interruption that no session may end in. A session waits for two seconds from the last sign
/// of its peer, which on a busy machine comes before the cut by as much as a handler may keep its
/// thread.
const SESSIONS_LAST: Duration = Duration::from_millis(1_500);

/// The trial of one fault.
#[derive(Debug)]
pub(crate) struct FaultTrial {
    /// The injected fault.
    pub(crate) fault: &'static DemoFault,
    number: u32,
    phase: Phase,
    begun_at: Instant,
    due: Instant,
    /// When the fault began: at the first end of a cable, and at the last.
    struck: Option<[Instant; 2]>,
    repair: CableRepair,
    is_told: bool,
    has_ended: bool,
    before: FlowLosses,
    /// The broken promises so far.
    pub(crate) problems: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Striking,
    Watching,
    Settling,
    Over,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum CableRepair {
    NotNeeded,
    Needed,
    Ordered,
    Done { at: Instant },
}

impl FaultTrial {
    /// The fault of this number, from 1, is being injected.
    pub(crate) fn new(number: u32, robot: &RobotState, now: Instant) -> FaultTrial {
        let fault = &FAULTS[number as usize - 1];
        let needs_repair = fault.blow == Blow::Blackout;
        FaultTrial {
            fault,
            number,
            phase: Phase::Striking,
            begun_at: now,
            due: now,
            struck: None,
            repair: if needs_repair { CableRepair::Needed } else { CableRepair::NotNeeded },
            is_told: false,
            has_ended: false,
            before: robot.losses(),
            problems: Vec::new(),
        }
    }

    /// The fault is present since these instants, or the cables are plugged in; or it could not be
    /// done.
    pub(crate) fn handle_struck(
        &mut self,
        struck: Result<[Instant; 2], String>,
        robot: &mut RobotState,
        now: Instant,
    ) {
        match struck {
            Ok([_, at]) if self.phase == Phase::Watching => {
                self.repair = CableRepair::Done { at };
                self.due = now + RECOVERY;
            }
            Ok(struck) => {
                self.struck = Some(struck);
                self.enter(Phase::Watching, robot, now);
            }
            Err(reason) => {
                self.problems.push(format!("an order was not carried out: {reason}"));
                self.enter(Phase::Settling, robot, now);
            }
        }
    }

    /// Goes on as far as possible. Returns whether the cables are to be plugged in now.
    pub(crate) fn advance(&mut self, robot: &mut RobotState, now: Instant) -> bool {
        let is_late = now >= self.due;
        match self.phase {
            Phase::Watching => {
                // A cut that was repaired before its detection would never be found.
                let is_found = self.named(robot).next().is_some();
                let repair_due = self.struck.is_some_and(|[_, last]| now >= last + BEFORE_REPAIR);
                if self.repair == CableRepair::Needed && is_found && repair_due {
                    self.repair = CableRepair::Ordered;
                    return true;
                }
                let missing = self.what_is_missing(robot);
                if missing.is_empty() || is_late {
                    self.problems.extend(missing);
                    self.enter(Phase::Settling, robot, now);
                }
            }
            Phase::Settling => {
                let unsettled = robot.unsettled().join(", ");
                let missing = robot.missing(|cable| self.expects(cable));
                if !unsettled.is_empty() && is_late {
                    self.problems.push(format!("messages did not arrive on {unsettled}"));
                }
                if !missing.is_empty() && is_late {
                    self.problems.push(format!("not as before: {missing}"));
                }
                let is_as_before = unsettled.is_empty() && missing.is_empty();
                if now >= self.begun_at + LEAST && (is_as_before || is_late) {
                    self.phase = Phase::Over;
                }
            }
            Phase::Striking | Phase::Over => {}
        }
        false
    }

    /// Returns the first report of the fault, once.
    pub(crate) fn news(&mut self, robot: &RobotState) -> Option<String> {
        let (key, FoundFault { report, .. }) = self.root(robot).filter(|_| !self.is_told)?;
        self.is_told = true;
        let (module, kind, place) = (key.0, &report.kind, &report.location);
        Some(format!("{module} found {} {kind} in {place}", kind.code()))
    }

    /// Returns whether the trial has ended; then [`row`](Self::row) is final.
    pub(crate) fn is_over(&self) -> bool {
        self.phase == Phase::Over
    }

    /// Handles the end of a module's process. Returns whether it is the one that was killed.
    pub(crate) fn handle_end(&mut self, module: Module) -> bool {
        let is_killed = self.fault.blow == Blow::Kill && self.fault.module == module;
        is_killed && !std::mem::replace(&mut self.has_ended, true)
    }

    /// Returns since when messages must have been sent to show that they pass again.
    pub(crate) fn watched_since(&self) -> Option<Instant> {
        match self.repair {
            CableRepair::NotNeeded => self.struck.map(|[_, last]| last),
            CableRepair::Done { at } => Some(at),
            CableRepair::Needed | CableRepair::Ordered => None,
        }
    }

    /// The first report of the fault; one that stood before only if there is no other.
    fn root<'a>(&self, robot: &'a RobotState) -> Option<(&'a FoundKey, &'a FoundFault)> {
        self.named(robot).min_by_key(|(_, found)| (!self.is_new(found), found.report.found_at))
    }

    /// Returns the row up to now.
    pub(crate) fn row(&self, robot: &RobotState) -> FaultRow {
        let losses = robot.losses() - self.before;
        let mut problems = self.problems.clone();
        let previous = self.number.checked_sub(2).map(|before| &FAULTS[before as usize]);
        let mut symptoms = self.named(robot).count().saturating_sub(1) as u64;
        for (key, found) in self.found(robot) {
            let report = &found.report;
            problems.extend(found.given_up(key));
            let belated = previous.map_or(FaultMatch::Foreign, |before| before.judge(report));
            match (self.fault.judge(report), belated) {
                (FaultMatch::Foreign, FaultMatch::Foreign) => {
                    let (kind, place) = (&report.kind, &report.location);
                    problems.push(format!("{} named {kind} in {place}: {}", key.0, report.detail));
                }
                (FaultMatch::Companion, _) if !report.is_warning() => symptoms += 1,
                _ => {}
            }
        }
        for (count, what) in [(losses.lost, "lost"), (losses.doubled, "doubled")] {
            if count > 0 {
                problems.push(format!("{} {what}", counted(count, "reliable message")));
            }
        }
        if losses.returned > 0 && !self.may_end_sessions(robot) {
            let returned = counted(losses.returned, "reliable message");
            problems
                .push(format!("{returned} became dead letters, though a path was there in time"));
        }
        let root = self.root(robot).map(|(_, found)| found);
        let named = root.map(|found| &found.report);
        // One that stood before was not found by the injection.
        let found_at = root.filter(|found| self.is_new(found));
        let found_at = found_at.map(|found| Instant::from_nanos(found.report.found_at));
        let struck = self.struck.map(|[first, _]| first);
        let since = |start: Option<Instant>, end: Option<Instant>| Some(end? - start?);
        FaultRow {
            number: self.number,
            fault: self.fault,
            location: self.fault.place(),
            named: named.map(ReportedFault::from),
            detected_after: since(struck, found_at),
            recovered_after: since(self.recovery_starts(), self.back_at(robot)),
            from_repair: self.repair != CableRepair::NotNeeded,
            losses,
            symptoms,
            problems,
        }
    }

    /// All faults that were found while this one was tried.
    fn found<'a>(
        &self,
        robot: &'a RobotState,
    ) -> impl Iterator<Item = (&'a FoundKey, &'a FoundFault)> {
        robot.found.iter().filter(|(_, found)| self.is_new(found))
    }

    fn is_new(&self, found: &FoundFault) -> bool {
        found.during == (self.number, true)
    }

    /// Whether a fault was found before, and still stands after the injection.
    fn stands_already(&self, found: &FoundFault) -> bool {
        let stands = self.struck.is_some_and(|[first, _]| found.stood_at >= first);
        !self.is_new(found) && stands && self.fault.may_stand_before(&found.report)
    }

    /// All reports of the fault.
    fn named<'a>(
        &self,
        robot: &'a RobotState,
    ) -> impl Iterator<Item = (&'a FoundKey, &'a FoundFault)> {
        let is_named = |found: &FoundFault| {
            self.is_new(found) && self.fault.judge(&found.report) == FaultMatch::Named
        };
        let all = robot.found.iter();
        all.filter(move |(_, found)| is_named(found) || self.stands_already(found))
    }

    /// Returns whether the two ends were parted for so long that a session may have ended.
    fn may_end_sessions(&self, robot: &RobotState) -> bool {
        let since = self.struck.map(|[first, _]| first);
        let span = since.zip(self.back_at(robot)).map(|(since, back)| back - since);
        self.fault.blow == Blow::Blackout && span.is_some_and(|span| span >= SESSIONS_LAST)
    }

    fn enter(&mut self, phase: Phase, robot: &mut RobotState, now: Instant) {
        self.phase = phase;
        self.due = now + if phase == Phase::Watching { RECOVERY } else { SETTLING };
        if phase == Phase::Settling {
            robot.settle(now);
        }
    }

    fn recovery_starts(&self) -> Option<Instant> {
        match self.repair {
            CableRepair::NotNeeded => self.struck.map(|[first, _]| first),
            _ => self.watched_since(),
        }
    }

    /// Returns when service was back: the object answers, or messages pass that were sent later; of
    /// a killed process, which runs again.
    fn back_at(&self, robot: &RobotState) -> Option<Instant> {
        if !self.fault.object.is_empty() {
            return robot.served(self.fault.module, self.number - 1);
        }
        let since = self.watched_since()?;
        let arrivals = self.fault.flows().map(|flow| robot.passed(flow.name, since));
        let last = arrivals.collect::<Option<Vec<_>>>()?.into_iter().max();
        let is_killed = self.fault.blow == Blow::Kill;
        last.filter(|_| !is_killed || robot.is_new(self.fault.module, since))
    }

    fn what_is_missing(&self, robot: &RobotState) -> Vec<String> {
        let mut missing = Vec::new();
        if self.named(robot).next().is_none() {
            missing.push("the fault was not found".to_owned());
        } else if !self.named(robot).any(|(_, found)| self.fault.is_settled_by(&found.report)) {
            missing.push("its recovery was not reported".to_owned());
        }
        if self.back_at(robot).is_none() {
            missing.push("service is not back".to_owned());
        }
        missing
    }

    /// Returns whether a cable is to be up at the end of the step.
    fn expects(&self, cable: &DemoCable) -> bool {
        self.fault.blow != Blow::Cut(cable.name)
    }
}
