//! One fault, from its injection to the instant at which all is as before.
//!
//! ```text
//! Striking ─► Watching ─────────────────► Settling ─► Tidying ─► Over
//! the fault   found? repaired, if it      all that    what was
//! is there    must be; service back?      was sent    cut is
//!                                         has come    up again
//! ```
//!
//! A phase that exceeds its deadline adds a problem to the row. The next phase begins nevertheless,
//! so that one broken promise does not hide the next.

use super::flow_accounting::FlowLosses;
use super::injection::{FaultInjection, FaultMatch, ServiceRestored};
use super::machine_instant::MachineInstant;
use super::protocol::{DirectorCommand, FaultNote, ModuleEvent, OrderId};
use super::report::{FaultRow, ReportedFault, counted, paper_figure};
use super::robot::{DemoCable, Flow, Module};
use super::robot_state::RobotState;
use super::tone::LineTone;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// An interruption that no session may end in. A session waits for two seconds from the last sign
/// of its peer, which on a busy machine comes before the cut by as much as a handler may keep its
/// thread.
const SESSIONS_LAST: Duration = Duration::from_millis(1_500);

/// How long each phase may take before the promise counts as broken. The limits are generous: they
/// end a run in which something is missing, and say nothing about speed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrialTimeouts {
    /// Until an injection is carried out.
    pub(crate) strike: Duration,
    /// From the fault to the return of service; a process must be started within it.
    pub(crate) recovery: Duration,
    /// Until all sent messages have arrived.
    pub(crate) settling: Duration,
    /// The shortest time between a cut and its repair, which also waits for the detection.
    pub(crate) before_repair: Duration,
    /// The shortest step, so that a person can follow it.
    pub(crate) least: Duration,
}

impl Default for TrialTimeouts {
    fn default() -> Self {
        TrialTimeouts {
            strike: Duration::from_secs(10),
            recovery: Duration::from_secs(30),
            settling: Duration::from_secs(30),
            before_repair: Duration::from_millis(300),
            least: Duration::from_millis(1_200),
        }
    }
}

/// An output of a trial.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum TrialOutput {
    /// Send a command to a module.
    Send(Module, DirectorCommand),
    /// Kill a module's process with signal 9.
    Kill(Module),
}

/// The trial of one fault.
#[derive(Debug)]
pub(crate) struct FaultTrial {
    injection: FaultInjection,
    number: u32,
    timeouts: TrialTimeouts,
    phase: Phase,
    begun_at: MachineInstant,
    due: Option<MachineInstant>,
    outputs: VecDeque<TrialOutput>,
    waiting: Vec<Module>,
    struck: Option<Struck>,
    repair: Repair,
    named: BTreeMap<(Module, u64), FaultNote>,
    /// Faults without a relation to the injection, unless they are reported as symptoms later.
    foreign: BTreeMap<(Module, u64), FaultNote>,
    /// Faults that were reported as consequences, in any module.
    symptoms: BTreeSet<(Module, u64)>,
    reported: bool,
    served_at: Option<MachineInstant>,
    passed: BTreeMap<&'static str, MachineInstant>,
    before: FlowLosses,
    problems: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Striking,
    Watching,
    Settling,
    Tidying,
    Over,
}

/// When the fault began: at the first end of a cable, and at the last.
#[derive(Clone, Copy, Debug)]
struct Struck {
    first: MachineInstant,
    last: MachineInstant,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Repair {
    NotNeeded,
    Needed,
    Ordered,
    Done { at: MachineInstant },
}

impl FaultTrial {
    /// Starts with the injection.
    pub(crate) fn new(
        injection: FaultInjection,
        number: u32,
        timeouts: TrialTimeouts,
        robot: &RobotState,
        now: MachineInstant,
    ) -> FaultTrial {
        let repairs = injection.repair(OrderId(0)).is_empty();
        let mut trial = FaultTrial {
            number,
            timeouts,
            phase: Phase::Striking,
            begun_at: now,
            due: Some(now + timeouts.strike),
            outputs: VecDeque::new(),
            waiting: Vec::new(),
            struck: None,
            repair: if repairs { Repair::NotNeeded } else { Repair::Needed },
            named: BTreeMap::new(),
            foreign: BTreeMap::new(),
            symptoms: BTreeSet::new(),
            reported: false,
            served_at: None,
            passed: BTreeMap::new(),
            before: robot.accounting.losses(),
            problems: Vec::new(),
            injection,
        };
        if let FaultInjection::Kill { module } = trial.injection {
            trial.outputs.push_back(TrialOutput::Kill(module));
        }
        trial.order(trial.injection.strike(trial.strike_order()));
        trial
    }

    /// Returns the injected fault.
    pub(crate) fn injection(&self) -> &FaultInjection {
        &self.injection
    }

    /// Handles an event of a module, which `robot` has handled before. Returns the line that it
    /// adds to the progress: the first report of the fault, a decision about it, or a failure.
    pub(crate) fn handle_event(
        &mut self,
        from: Module,
        event: &ModuleEvent,
        robot: &mut RobotState,
        now: MachineInstant,
    ) -> Option<(LineTone, String)> {
        let line = self.line(from, event);
        match event {
            ModuleEvent::CarriedOut { order, at } => {
                self.handle_carried_out(from, *order, *at, now)
            }
            ModuleEvent::Refused { order, reason } if self.is_mine(*order) => {
                self.problems.push(format!("{from} refused: {reason}"));
                self.waiting.retain(|module| *module != from);
                self.enter(Phase::Settling, robot, now);
            }
            ModuleEvent::Found(note) => self.handle_found(from, note),
            ModuleEvent::Explained { id, .. } if self.foreign.remove(&(from, *id)).is_some() => {
                self.symptoms.insert((from, *id));
            }
            // An overload ends when the queue is empty again, without a recovery action.
            ModuleEvent::Recovered { id, .. } | ModuleEvent::Cleared { id }
                if self.named.contains_key(&(from, *id)) =>
            {
                self.reported = true;
            }
            ModuleEvent::GaveUp { id, reason } => {
                self.problems.push(format!("{from} gave fault {id} up: {reason}"));
            }
            ModuleEvent::Served { order, at, .. } if *order == self.strike_order() => {
                self.served_at.get_or_insert(*at);
            }
            ModuleEvent::Passed { flow, since, at } if Some(*since) == self.watched_since() => {
                if let Some(flow) = Flow::from_name(flow) {
                    self.passed.entry(flow.name).or_insert(*at);
                }
            }
            // A new process has not received the requests that its predecessor received.
            ModuleEvent::Ready => self.watch_in(&[from]),
            _ => {}
        }
        self.advance(robot, now);
        line
    }

    /// The line for a person. The symptoms are folded into the last line of the fault.
    fn line(&self, from: Module, event: &ModuleEvent) -> Option<(LineTone, String)> {
        match event {
            ModuleEvent::Found(note)
                if self.named.is_empty() && self.injection.judge(note) == FaultMatch::Named =>
            {
                let FaultNote { kind, location, .. } = note;
                let text = format!("{from} found {} {kind} in {location}", kind.code());
                Some((LineTone::Finding, text))
            }
            ModuleEvent::Decided { id, action } if self.root() == Some((from, *id)) => {
                Some((LineTone::Remark, format!("{from} decided: {action}")))
            }
            ModuleEvent::GaveUp { reason, .. } => {
                Some((LineTone::Alarm, format!("{from} gave up: {reason}")))
            }
            _ => None,
        }
    }

    /// Returns whether the two ends were parted for so long that a session may have ended.
    fn may_end_sessions(&self, robot: &RobotState) -> bool {
        let parted = matches!(self.injection, FaultInjection::Blackout { .. });
        let since = self.struck.map(|struck| struck.first);
        let span = since.zip(self.back_at(robot)).map(|(since, back)| back - since);
        parted && span.is_some_and(|span| span >= SESSIONS_LAST)
    }

    /// The first report of the fault.
    fn root(&self) -> Option<(Module, u64)> {
        let first = self.named.iter().min_by_key(|(_, note)| note.found_at);
        first.map(|(key, _)| *key)
    }

    /// Counts the other reports of the fault and the reports of its consequences.
    fn symptoms(&self) -> u64 {
        (self.named.len().saturating_sub(1) + self.symptoms.len()) as u64
    }

    /// Handles the kill of a process by the scenario.
    pub(crate) fn handle_killed(&mut self, at: MachineInstant, now: MachineInstant) {
        if self.phase == Phase::Striking {
            self.struck = Some(Struck { first: at, last: at });
            self.phase = Phase::Watching;
            self.due = Some(now + self.timeouts.recovery);
            self.watch_in(&Module::ALL);
        }
    }

    /// Handles the end of a process that was not ordered.
    pub(crate) fn handle_exit(&mut self, module: Module, how: &str) {
        self.problems.push(format!("{module} ended by itself: {how}"));
    }

    /// Returns the next output.
    pub(crate) fn poll_output(&mut self) -> Option<TrialOutput> {
        self.outputs.pop_front()
    }

    /// Returns when the timer expires.
    pub(crate) fn poll_timeout(&self) -> Option<MachineInstant> {
        let repair = match (self.phase, self.repair, self.struck) {
            (Phase::Watching, Repair::Needed, Some(struck)) if !self.named.is_empty() => {
                Some(struck.last + self.timeouts.before_repair)
            }
            _ => None,
        };
        self.due.into_iter().chain(repair).min()
    }

    /// Handles the expiry of the timer.
    pub(crate) fn handle_timeout(&mut self, robot: &mut RobotState, now: MachineInstant) {
        self.advance(robot, now);
        if self.due.is_none_or(|due| due > now) {
            return;
        }
        match self.phase {
            Phase::Striking => {
                self.problems.push("the fault could not be injected in time".into());
                self.enter(Phase::Settling, robot, now);
            }
            Phase::Watching => {
                self.problems.extend(self.what_is_missing(robot));
                self.enter(Phase::Settling, robot, now);
            }
            Phase::Settling => {
                let names: Vec<_> = robot.accounting.unsettled().map(|flow| flow.name).collect();
                if !names.is_empty() {
                    self.problems.push(format!("messages did not arrive on {}", names.join(", ")));
                }
                self.enter(Phase::Tidying, robot, now);
            }
            Phase::Tidying => {
                if !self.is_tidy(robot) {
                    let missing = robot.missing(|cable| self.expects(cable));
                    self.problems.push(format!("not as before: {missing}"));
                }
                self.phase = Phase::Over;
                self.due = None;
            }
            Phase::Over => {}
        }
        self.advance(robot, now);
    }

    /// Returns whether a promise is broken.
    pub(crate) fn is_broken(&self) -> bool {
        !self.problems.is_empty()
    }

    /// Ends the trial in its present phase; what is missing is a problem.
    pub(crate) fn cut_short(&mut self, robot: &RobotState) {
        match self.phase {
            Phase::Striking => self.problems.push("the fault was not injected".into()),
            Phase::Watching => self.problems.extend(self.what_is_missing(robot)),
            Phase::Settling | Phase::Tidying | Phase::Over => {}
        }
        self.problems.push("cut short: time is up".into());
        self.phase = Phase::Over;
        self.due = None;
    }

    /// Returns whether the trial has ended; then [`row`](Self::row) is final.
    pub(crate) fn is_over(&self) -> bool {
        self.phase == Phase::Over
    }

    /// Returns the row up to now.
    pub(crate) fn row(&self, robot: &RobotState) -> FaultRow {
        let losses = robot.accounting.losses() - self.before;
        let FlowLosses { lost, doubled, perished, returned } = losses;
        let mut problems = self.problems.clone();
        for ((finder, _), FaultNote { kind, location, detail, .. }) in &self.foreign {
            problems.push(format!("{finder} named {kind} in {location}: {detail}"));
        }
        if lost > 0 {
            problems.push(format!("{} lost", counted(lost, "reliable message")));
        }
        if doubled > 0 {
            problems.push(format!("{} doubled", counted(doubled, "reliable message")));
        }
        if returned > 0 && !self.may_end_sessions(robot) {
            let returned = counted(returned, "reliable message");
            problems
                .push(format!("{returned} became dead letters, though a path was there in time"));
        }
        let first_named = self.named.values().min_by_key(|note| note.found_at);
        let struck = self.struck.map(|struck| struck.first);
        let since =
            |start: Option<MachineInstant>, end: Option<MachineInstant>| Some(end? - start?);
        FaultRow {
            number: self.number,
            fault: self.injection.title(),
            location: self.injection.location(),
            named: first_named.map(ReportedFault::from),
            detected_after: since(struck, first_named.map(|note| note.found_at)),
            recovered_after: since(self.recovery_starts(), self.back_at(robot)),
            from_repair: self.repair != Repair::NotNeeded,
            lost,
            doubled,
            perished,
            returned,
            symptoms: self.symptoms(),
            paper: paper_figure(self.injection.title()),
            problems,
        }
    }

    fn strike_order(&self) -> OrderId {
        OrderId(u64::from(self.number) * 4)
    }

    fn repair_order(&self) -> OrderId {
        OrderId(u64::from(self.number) * 4 + 1)
    }

    fn tidy_order(&self) -> OrderId {
        OrderId(u64::from(self.number) * 4 + 2)
    }

    fn is_mine(&self, order: OrderId) -> bool {
        [self.strike_order(), self.repair_order(), self.tidy_order()].contains(&order)
    }

    fn order(&mut self, commands: Vec<(Module, DirectorCommand)>) {
        self.waiting = commands.iter().map(|(module, _)| *module).collect();
        self.outputs.extend(
            commands.into_iter().map(|(module, command)| TrialOutput::Send(module, command)),
        );
    }

    fn handle_carried_out(
        &mut self,
        from: Module,
        order: OrderId,
        at: MachineInstant,
        now: MachineInstant,
    ) {
        if !self.is_mine(order) || !self.waiting.contains(&from) {
            return;
        }
        self.waiting.retain(|module| *module != from);
        if order == self.strike_order() {
            let struck = self.struck.get_or_insert(Struck { first: at, last: at });
            struck.first = struck.first.min(at);
            struck.last = struck.last.max(at);
            if self.waiting.is_empty() {
                self.phase = Phase::Watching;
                self.due = Some(now + self.timeouts.recovery);
                self.watch_in(&Module::ALL);
            }
        } else if order == self.repair_order() && self.waiting.is_empty() {
            self.repair = Repair::Done { at };
            self.due = Some(now + self.timeouts.recovery);
            self.watch_in(&Module::ALL);
        }
    }

    fn handle_found(&mut self, from: Module, note: &FaultNote) {
        match self.injection.judge(note) {
            FaultMatch::Named => {
                self.named.entry((from, note.id)).or_insert_with(|| note.clone());
            }
            FaultMatch::Companion if note.is_warning() => {}
            FaultMatch::Companion => drop(self.symptoms.insert((from, note.id))),
            FaultMatch::Foreign => {
                self.foreign.entry((from, note.id)).or_insert_with(|| note.clone());
            }
        }
    }

    fn advance(&mut self, robot: &mut RobotState, now: MachineInstant) {
        if self.phase == Phase::Watching {
            self.repair_when_due(now);
            if self.what_is_missing(robot).is_empty() {
                self.enter(Phase::Settling, robot, now);
            }
        }
        if self.phase == Phase::Settling && robot.accounting.is_settled() {
            self.enter(Phase::Tidying, robot, now);
        }
        let seen = now - self.begun_at >= self.timeouts.least;
        if self.phase == Phase::Tidying && seen && self.is_tidy(robot) {
            self.phase = Phase::Over;
            self.due = None;
        }
    }

    fn repair_when_due(&mut self, now: MachineInstant) {
        let Some(struck) = self.struck else { return };
        // A cut that was repaired before its detection would never be found.
        let is_found = !self.named.is_empty();
        let is_due = now >= struck.last + self.timeouts.before_repair;
        if self.repair == Repair::Needed && is_found && is_due {
            self.repair = Repair::Ordered;
            self.order(self.injection.repair(self.repair_order()));
        }
    }

    fn enter(&mut self, phase: Phase, robot: &mut RobotState, now: MachineInstant) {
        self.phase = phase;
        self.due = Some(now + self.timeouts.settling.max(self.timeouts.least));
        match phase {
            Phase::Settling => {
                robot.accounting.settle(now);
                let status =
                    Module::ALL.map(|module| TrialOutput::Send(module, DirectorCommand::Status));
                self.outputs.extend(status);
            }
            Phase::Tidying => self.order(self.injection.clean_up(self.tidy_order())),
            Phase::Striking | Phase::Watching | Phase::Over => {}
        }
    }

    /// Makes modules watch for the first message sent since the recovery could begin.
    fn watch_in(&mut self, modules: &[Module]) {
        if let Some(since) = self.watched_since() {
            let watch =
                |module: &Module| TrialOutput::Send(*module, DirectorCommand::Watch { since });
            self.outputs.extend(modules.iter().map(watch));
        }
    }

    fn watched_since(&self) -> Option<MachineInstant> {
        match (self.phase, self.repair) {
            (Phase::Watching, Repair::NotNeeded) => Some(self.struck?.last),
            (Phase::Watching, Repair::Done { at }) => Some(at),
            _ => None,
        }
    }

    fn recovery_starts(&self) -> Option<MachineInstant> {
        match self.repair {
            Repair::NotNeeded => self.struck.map(|struck| struck.first),
            Repair::Done { at } => Some(at),
            Repair::Needed | Repair::Ordered => None,
        }
    }

    fn back_at(&self, robot: &RobotState) -> Option<MachineInstant> {
        let traffic = || {
            let arrivals = self.injection.flows().into_iter();
            let arrivals = arrivals.map(|flow| self.passed.get(flow.name).copied());
            arrivals.collect::<Option<Vec<_>>>()?.into_iter().max()
        };
        match self.injection.comes_back_by() {
            ServiceRestored::Service => self.served_at,
            ServiceRestored::Traffic => traffic(),
            ServiceRestored::Rejoining => traffic().filter(|_| robot.are_ready()),
        }
    }

    fn what_is_missing(&self, robot: &RobotState) -> Vec<String> {
        let mut missing = Vec::new();
        if self.named.is_empty() {
            missing.push("the fault was not found".to_owned());
        } else if self.injection.wants_report() && !self.reported {
            missing.push("its recovery was not reported".to_owned());
        }
        if self.back_at(robot).is_none() {
            missing.push("service is not back".to_owned());
        }
        missing
    }

    /// Returns whether a cable is to be up at the end of the step.
    fn expects(&self, cable: &DemoCable) -> bool {
        match &self.injection {
            FaultInjection::Cut { cable: cut, returns } => *returns || cut != cable,
            _ => true,
        }
    }

    fn is_tidy(&self, robot: &RobotState) -> bool {
        self.waiting.is_empty() && robot.is_together(|cable| self.expects(cable))
    }
}
