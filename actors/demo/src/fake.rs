//! A simulated robot in virtual time, which keeps every promise or breaks one: for tests.

use super::injection::cables_to;
use super::machine_instant::MachineInstant;
use super::protocol::{
    CableState, DirectorCommand, FaultNote, ModuleEvent, ObjectFault, OrderId, SinkState, Snapshot,
    SourceState,
};
use super::report::Report;
use super::robot::{CABLES, FLOWS, Flow, Module, address};
use super::robot_state::RobotState;
use super::scenario::{Scenario, ScenarioOutput};
use super::trial::TrialOutput;
use blastema::core::{FaultKind, FaultLocation, NodeName};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// The promise that the simulated robot breaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Flaw {
    None,
    NotFound,
    NotReported,
    NotBack,
    WrongCulprit,
    LosesOne,
    DoublesOne,
    DiesOfPanic,
    Refuses,
    FalseAlarm,
    NeverTogether,
    StopsForGood,
    ComesLate,
    /// Dead letters of an interruption that a session survives.
    ReturnsEarly,
    /// Dead letters of one that no session survives: no flaw.
    ReturnsLate,
    /// The computer is too busy: no flaw.
    MissesRounds,
}

/// The simulated robot with its virtual time.
pub(crate) struct FakeRobot {
    flaw: Flaw,
    now: MachineInstant,
    agenda: BTreeMap<(MachineInstant, u64), Happening>,
    written: u64,
    cut: BTreeSet<&'static str>,
    dead: BTreeSet<Module>,
    incarnations: BTreeMap<Module, u64>,
    began: BTreeMap<Module, MachineInstant>,
    watched: BTreeMap<Module, MachineInstant>,
    lost: u64,
    doubled: u64,
    returned: u64,
    next_fault: u64,
}

#[derive(Clone, Debug)]
enum Happening {
    Says(Module, ModuleEvent),
    Exits(Module, Option<&'static str>),
    Returns(Module),
    Reconnects(Vec<String>),
    Snapshots,
}

impl FakeRobot {
    pub(crate) fn new(flaw: Flaw) -> FakeRobot {
        FakeRobot {
            flaw,
            now: MachineInstant::default(),
            agenda: BTreeMap::new(),
            written: 0,
            cut: BTreeSet::new(),
            dead: BTreeSet::new(),
            incarnations: Module::ALL.map(|module| (module, 1)).into(),
            began: Module::ALL.map(|module| (module, MachineInstant::default())).into(),
            watched: BTreeMap::new(),
            lost: 0,
            doubled: 0,
            returned: 0,
            next_fault: 1,
        }
    }

    /// Runs the whole scenario.
    pub(crate) fn perform(mut self, mut scenario: Scenario) -> Report {
        for module in Module::ALL {
            if self.flaw != Flaw::NeverTogether || module != Module::Module3 {
                self.says(module, 50, ModuleEvent::Ready);
            }
        }
        self.plan(100, Happening::Snapshots);
        if self.flaw == Flaw::NeverTogether {
            let location = FaultLocation::Node(NodeName::new("module3").expect("a name"));
            let note = self.note(FaultKind::NodeLost, location, 60);
            self.says(Module::Module1, 60, ModuleEvent::Found(note));
        }
        if self.flaw == Flaw::FalseAlarm {
            let note = self.note(FaultKind::Silence, object(Module::Module1, "safety"), 350);
            self.says(Module::Module1, 350, ModuleEvent::Found(note));
            let symptom = self.note(FaultKind::Silence, object(Module::Module1, "planner"), 350);
            self.says(
                Module::Module1,
                355,
                ModuleEvent::Explained { id: symptom.id, symptom_of: 1 },
            );
            self.says(Module::Module1, 350, ModuleEvent::Found(symptom));
        }
        loop {
            while let Some(output) = scenario.poll_output() {
                match output {
                    ScenarioOutput::Do(output) => self.carry_out(output, &mut scenario),
                    ScenarioOutput::Tell(_) => {}
                    ScenarioOutput::Finished => return scenario.report(),
                    ScenarioOutput::Stillborn(reason) => {
                        let mut report = scenario.report();
                        report.problems.push(reason);
                        return report;
                    }
                }
            }
            self.step(&mut scenario);
        }
    }

    fn step(&mut self, scenario: &mut Scenario) {
        let first = self.agenda.keys().next().copied();
        let due = scenario.poll_timeout();
        match first {
            Some(key) if due.is_none_or(|due| key.0 <= due) => {
                self.now = key.0;
                let happening = self.agenda.remove(&key).expect("its key was just seen");
                self.happen(happening, scenario);
            }
            _ => {
                self.now =
                    due.expect("a scenario that is not over waits for something").max(self.now);
                scenario.handle_timeout(self.now);
            }
        }
    }

    fn happen(&mut self, happening: Happening, scenario: &mut Scenario) {
        match happening {
            Happening::Says(module, event) => scenario.handle_event(module, &event, self.now),
            Happening::Exits(module, how) => scenario.handle_exit(module, how, self.now),
            Happening::Returns(module) => {
                self.dead.remove(&module);
                *self.incarnations.entry(module).or_default() += 1;
                self.began.insert(module, self.now);
                scenario.handle_event(module, &ModuleEvent::Ready, self.now);
            }
            Happening::Reconnects(cables) => {
                self.cut.retain(|name| !cables.iter().any(|cable| cable == name));
            }
            Happening::Snapshots => {
                for module in Module::ALL {
                    if !self.dead.contains(&module) {
                        let snapshot = ModuleEvent::Snapshot(Box::new(self.snapshot(module)));
                        scenario.handle_event(module, &snapshot, self.now);
                    }
                }
                self.plan(100, Happening::Snapshots);
            }
        }
        self.answer_watches();
    }

    fn carry_out(&mut self, output: TrialOutput, scenario: &mut Scenario) {
        match output {
            TrialOutput::Kill(module) => {
                scenario.handle_killed(self.now, self.now);
                self.die(module, None);
                let location = FaultLocation::Node(NodeName::new(module.name()).expect("a name"));
                let note = self.note(FaultKind::NodeLost, location, 30);
                self.says(Module::Module1, 30, ModuleEvent::Found(note));
            }
            TrialOutput::Send(module, command) if !self.dead.contains(&module) => {
                self.obey(module, command);
            }
            TrialOutput::Send(..) => {}
        }
    }

    fn die(&mut self, module: Module, how: Option<&'static str>) {
        self.dead.insert(module);
        self.watched.remove(&module);
        self.plan(1, Happening::Exits(module, how));
        self.plan(200, Happening::Returns(module));
    }

    fn obey(&mut self, module: Module, command: DirectorCommand) {
        match command {
            DirectorCommand::Strike { order, object, fault } => {
                self.strike(module, order, object.as_str(), fault);
            }
            DirectorCommand::Cut { order, cables } => {
                for cable in CABLES.iter().filter(|cable| cables.iter().any(|n| n == cable.name)) {
                    self.cut.insert(cable.name);
                    let node = NodeName::new(module.name()).expect("a name");
                    let location =
                        FaultLocation::Link { node, link: cable.name.into(), neighbour: None };
                    let note = self.note(FaultKind::LinkDown, location, 20);
                    self.says(module, 20, ModuleEvent::Found(note));
                }
                let is_first = module == Module::Module1 && self.cut.len() == 1;
                self.lost += u64::from(self.flaw == Flaw::LosesOne && is_first);
                let returns = matches!(self.flaw, Flaw::ReturnsEarly | Flaw::ReturnsLate);
                if returns && module == Module::Module1 && self.cut.len() == 2 {
                    self.lost += 5;
                    self.returned += 5;
                }
                self.done(module, order);
            }
            DirectorCommand::Restore { order, cables } => {
                let after = if self.flaw == Flaw::ReturnsLate { 2_000 } else { 0 };
                self.plan(after, Happening::Reconnects(cables));
                self.done(module, order);
            }
            DirectorCommand::PanicRouter { order } => {
                let note = self.note(FaultKind::Panic, object(module, "net/router"), 1);
                self.says(module, 2, ModuleEvent::Recovered { id: note.id, at: self.after(2) });
                self.says(module, 1, ModuleEvent::Found(note));
                self.doubled += u64::from(self.flaw == Flaw::DoublesOne);
                self.done(module, order);
            }
            DirectorCommand::Watch { since } => {
                self.watched.insert(module, since);
            }
            DirectorCommand::Status => {
                let snapshot = ModuleEvent::Snapshot(Box::new(self.snapshot(module)));
                self.says(module, 0, snapshot);
            }
            DirectorCommand::Start { .. } | DirectorCommand::Shutdown => {}
        }
    }

    fn strike(&mut self, module: Module, order: OrderId, name: &str, fault: ObjectFault) {
        let kind = match fault {
            ObjectFault::Panic => FaultKind::Panic,
            ObjectFault::Hang { .. } => FaultKind::Hang,
            ObjectFault::ErrorState => FaultKind::ErrorState,
            ObjectFault::FailInitialization => FaultKind::InitializationFailed,
            ObjectFault::Silence => FaultKind::Silence,
            ObjectFault::Flood { .. } => FaultKind::Overload,
        };
        if self.flaw == Flaw::Refuses && kind == FaultKind::Overload {
            self.says(module, 0, ModuleEvent::Refused { order, reason: "no such object".into() });
            return;
        }
        if self.flaw == Flaw::StopsForGood && kind == FaultKind::Hang {
            // The process runs and sends no events.
            self.dead.insert(module);
            return;
        }
        self.done(module, order);
        if self.flaw == Flaw::MissesRounds {
            let note = self.note(FaultKind::Overload, object(Module::Module1, "safety"), 1);
            self.says(Module::Module1, 1, ModuleEvent::Found(note));
        }
        if self.flaw == Flaw::DiesOfPanic && kind == FaultKind::Panic {
            self.die(module, Some("signal 6"));
        }
        let culprit = match (self.flaw, &kind) {
            (Flaw::NotFound, FaultKind::Hang) => None,
            (Flaw::WrongCulprit, FaultKind::Hang) => Some("operator"),
            _ => Some(name),
        };
        if let Some(culprit) = culprit {
            let note = self.note(kind.clone(), object(module, culprit), 2);
            if self.flaw != Flaw::NotReported || kind != FaultKind::ErrorState {
                self.says(module, 4, ModuleEvent::Recovered { id: note.id, at: self.after(4) });
            }
            self.says(module, 2, ModuleEvent::Found(note));
        }
        if self.flaw != Flaw::NotBack || kind != FaultKind::Silence {
            self.says(module, 5, ModuleEvent::Served { order, at: self.after(5), incarnation: 2 });
        }
    }

    fn answer_watches(&mut self) {
        for (module, since) in self.watched.clone() {
            let flows: Vec<_> = FLOWS.iter().filter(|flow| flow.to == module).collect();
            if flows.iter().all(|flow| self.passes(flow)) {
                self.watched.remove(&module);
                for flow in flows {
                    let at = self.after(10);
                    self.says(
                        module,
                        10,
                        ModuleEvent::Passed { flow: flow.name.into(), since, at },
                    );
                }
            }
        }
    }

    fn passes(&self, flow: &Flow) -> bool {
        let reachable = |module: Module| {
            let cables = cables_to(module);
            let is_open = cables.iter().any(|cable| !self.cut.contains(cable.name));
            !self.dead.contains(&module) && (module == Module::Module1 || is_open)
        };
        reachable(flow.from) && reachable(flow.to) && reachable(Module::Module1)
    }

    fn snapshot(&self, module: Module) -> Snapshot {
        let is_up = |name| !self.cut.contains(name);
        let links = CABLES.iter().filter(|cable| cable.touches(module)).map(|cable| CableState {
            cable: cable.name.into(),
            up: is_up(cable.name) && cable.ends().iter().all(|end| !self.dead.contains(end)),
        });
        let sources = FLOWS.iter().filter(|flow| flow.from == module).map(|flow| SourceState {
            flow: flow.name.into(),
            epoch: self.incarnations[&module],
            sent: self.sent(flow),
            returned: if flow.name == FLOWS[0].name { self.returned } else { 0 },
        });
        let sinks = FLOWS.iter().filter(|flow| flow.to == module && self.passes(flow));
        Snapshot {
            at: self.now,
            links: links.collect(),
            sources: sources.collect(),
            sinks: sinks.map(|flow| self.sink(flow)).collect(),
            ..Snapshot::default()
        }
    }

    fn sink(&self, flow: &Flow) -> SinkState {
        let is_first = flow.name == FLOWS[0].name;
        let flawed = |count| if is_first && self.incarnations[&flow.to] == 1 { count } else { 0 };
        // What came while the process was not there went down with the one before it.
        let began = self.began[&flow.to].max(self.began[&flow.from]);
        let first = (began - self.began[&flow.from]).as_millis() as u64 / 10 + 1;
        SinkState {
            flow: flow.name.into(),
            process: self.incarnations[&flow.to],
            epoch: self.incarnations[&flow.from],
            first,
            highest: self.sent(flow),
            missing: flawed(self.lost) + self.held_back(flow),
            doubled: flawed(self.doubled),
            missing_before: 0,
        }
    }

    /// What comes only when its row has been closed.
    fn held_back(&self, flow: &Flow) -> u64 {
        let is_late = self.flaw == Flaw::ComesLate && flow.name == FLOWS[0].name;
        let span = MachineInstant::from_millis(2_800)..MachineInstant::from_millis(8_000);
        if is_late && span.contains(&self.now) { 7 } else { 0 }
    }

    /// A message every 10 ms since the source's process began.
    fn sent(&self, flow: &Flow) -> u64 {
        (self.now - self.began[&flow.from]).as_millis() as u64 / 10 + 1
    }

    fn note(&mut self, kind: FaultKind, location: FaultLocation, after: u64) -> FaultNote {
        let id = self.next_fault;
        self.next_fault += 1;
        let detail = "as ordered".into();
        FaultNote { id, kind, location, found_at: self.after(after), detail, symptom_of: None }
    }

    fn done(&mut self, module: Module, order: OrderId) {
        self.says(module, 0, ModuleEvent::CarriedOut { order, at: self.now });
    }

    fn after(&self, millis: u64) -> MachineInstant {
        self.now + Duration::from_millis(millis)
    }

    fn says(&mut self, module: Module, after: u64, event: ModuleEvent) {
        self.plan(after, Happening::Says(module, event));
    }

    fn plan(&mut self, after: u64, happening: Happening) {
        self.written += 1;
        self.agenda.insert((self.after(after), self.written), happening);
    }
}

fn object(module: Module, name: &str) -> FaultLocation {
    FaultLocation::Object(address(module, name))
}

/// Returns the state of an assembled robot.
pub(crate) fn robot_state() -> RobotState {
    let robot = FakeRobot::new(Flaw::None);
    let mut state = RobotState::default();
    for module in Module::ALL {
        state.handle_event(module, &ModuleEvent::Ready);
        state.handle_event(module, &ModuleEvent::Snapshot(Box::new(robot.snapshot(module))));
    }
    state
}
