//! One fault, from its injection to the instant at which all is as before.
//!
//! ```text
//! Striking ─► Watching ─────────────────► Settling ─► Tidying ─► Over
//! the fault   found? repaired, if it      all that    what was
//! is there    must be; service back?      was sent    cut is
//!                                         has come    up again
//! ```
//!
//! A phase that does not end within its deadline is a problem, which breaks the row, and the next
//! phase begins: one broken promise does not hide the next.

use super::flow_accounting::FlowLosses;
use super::injection::{FaultMatch, Injection, ServiceRestored};
use super::machine_instant::MachineInstant;
use super::protocol::{DirectorCommand, FaultNote, ModuleEvent, OrderId};
use super::report::{FaultRow, ReportedFault, counted, paper_figure};
use super::robot::{DemoCable, Flow, Module};
use super::robot_state::RobotState;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// How long each phase may take before it counts as broken. Ten times what a healthy robot takes, on a
/// machine that is busy with something else.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrialTimeouts {
    /// Until an order is carried out.
    pub(crate) strike: Duration,
    /// From the fault to the return of service; a process must be started within it.
    pub(crate) recovery: Duration,
    /// Until what was sent has arrived.
    pub(crate) settling: Duration,
    /// How long a cut that must be repaired is left alone.
    pub(crate) before_repair: Duration,
    /// How long a step takes at least, so that a person sees it.
    pub(crate) least: Duration,
}

impl Default for TrialTimeouts {
    fn default() -> Self {
        TrialTimeouts {
            strike: Duration::from_secs(2),
            recovery: Duration::from_secs(6),
            settling: Duration::from_secs(3),
            before_repair: Duration::from_millis(800),
            least: Duration::from_millis(1_200),
        }
    }
}

/// What a trial wants done.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum TrialOutput {
    /// Say this to a module.
    Send(Module, DirectorCommand),
    /// Kill a module's process with signal 9.
    Kill(Module),
}

/// The trial of one fault.
#[derive(Debug)]
pub(crate) struct FaultTrial {
    injection: Injection,
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
    /// Faults that have nothing to do with what was done, unless they turn out to be symptoms.
    foreign: BTreeMap<(Module, u64), FaultNote>,
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

/// When the fault began: at the first end of a cable, and when it was whole.
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
    /// Begins with the injection at once.
    pub(crate) fn new(
        injection: Injection,
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
            reported: false,
            served_at: None,
            passed: BTreeMap::new(),
            before: robot.accounting.losses(),
            problems: Vec::new(),
            injection,
        };
        if let Injection::Kill { module } = trial.injection {
            trial.outputs.push_back(TrialOutput::Kill(module));
        }
        trial.order(trial.injection.strike(trial.strike_order()));
        trial
    }

    /// What is tried.
    pub(crate) fn injection(&self) -> &Injection {
        &self.injection
    }

    /// Something came from a module; `known` has it already.
    pub(crate) fn handle_event(
        &mut self,
        from: Module,
        event: &ModuleEvent,
        robot: &mut RobotState,
        now: MachineInstant,
    ) {
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
            ModuleEvent::Explained { id, .. } => {
                self.foreign.remove(&(from, *id));
            }
            // An overload is over when the queue has been worked off: nothing is done about it.
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
            // A new process knows nothing of what the old one was asked.
            ModuleEvent::Ready => self.watch_in(&[from]),
            _ => {}
        }
        self.advance(robot, now);
    }

    /// The process was killed, as ordered.
    pub(crate) fn handle_killed(&mut self, at: MachineInstant, now: MachineInstant) {
        if self.phase == Phase::Striking {
            self.struck = Some(Struck { first: at, last: at });
            self.phase = Phase::Watching;
            self.due = Some(now + self.timeouts.recovery);
            self.watch_in(&Module::ALL);
        }
    }

    /// A process ended that nobody had killed.
    pub(crate) fn handle_exit(&mut self, module: Module, how: &str) {
        self.problems.push(format!("{module} ended by itself: {how}"));
    }

    /// What is to be done next.
    pub(crate) fn poll_output(&mut self) -> Option<TrialOutput> {
        self.outputs.pop_front()
    }

    /// When time alone changes something.
    pub(crate) fn poll_timeout(&self) -> Option<MachineInstant> {
        let repair = match (self.phase, self.repair, self.struck) {
            (Phase::Watching, Repair::Needed, Some(struck)) => {
                Some(struck.last + self.timeouts.before_repair)
            }
            _ => None,
        };
        self.due.into_iter().chain(repair).min()
    }

    /// Acts on what is due.
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

    /// Something broke already.
    pub(crate) fn is_broken(&self) -> bool {
        !self.problems.is_empty()
    }

    /// Ends it where it stands; what is still missing is a problem.
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

    /// It is over; [`row`](Self::row) is final.
    pub(crate) fn is_over(&self) -> bool {
        self.phase == Phase::Over
    }

    /// What came of it so far.
    pub(crate) fn row(&self, robot: &RobotState) -> FaultRow {
        let FlowLosses { lost, doubled, perished } = robot.accounting.losses() - self.before;
        let mut problems = self.problems.clone();
        for ((finder, _), FaultNote { kind, place, detail, .. }) in &self.foreign {
            problems.push(format!("{finder} named {kind} in {place}: {detail}"));
        }
        if lost > 0 {
            problems.push(format!("{} lost", counted(lost, "reliable message")));
        }
        if doubled > 0 {
            problems.push(format!("{} doubled", counted(doubled, "reliable message")));
        }
        let first_named = self.named.values().min_by_key(|note| note.found_at);
        let struck = self.struck.map(|struck| struck.first);
        let since =
            |start: Option<MachineInstant>, end: Option<MachineInstant>| Some(end? - start?);
        FaultRow {
            number: self.number,
            fault: self.injection.title(),
            place: self.injection.place(),
            named: first_named.map(ReportedFault::from),
            detected_after: since(struck, first_named.map(|note| note.found_at)),
            recovered_after: since(self.recovery_starts(), self.back_at(robot)),
            from_repair: self.repair != Repair::NotNeeded,
            lost,
            doubled,
            perished,
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
            FaultMatch::Companion => {}
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
        if self.repair == Repair::Needed && now >= struck.last + self.timeouts.before_repair {
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

    /// Tells modules to look out for the first message sent since the recovery could begin.
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

    /// Whether a cable should be up when the step is over.
    fn expects(&self, cable: &DemoCable) -> bool {
        match &self.injection {
            Injection::Cut { cable: cut, returns } => *returns || cut != cable,
            _ => true,
        }
    }

    fn is_tidy(&self, robot: &RobotState) -> bool {
        self.waiting.is_empty() && robot.is_together(|cable| self.expects(cable))
    }
}
