//! The scenario of the demonstration: the order of the faults, and whether each promise was kept.
//!
//! A pure state machine: its inputs are the time and the events of the modules, its outputs are
//! commands and progress lines. A test runs it in virtual time.

use super::chaos::{FLOOD_MESSAGES, HANG_MILLIS, RandomFaults, SeededRandom};
use super::injection::{FaultInjection, FaultMatch};
use super::machine_instant::MachineInstant;
use super::protocol::{FaultNote, ModuleEvent, ObjectFault};
use super::report::{FaultRow, NOTES, Report, counted};
use super::robot::{CABLES, Module};
use super::robot_state::RobotState;
use super::tone::LineTone;
use super::trial::{FaultTrial, TrialOutput, TrialTimeouts};
use blastema::core::{FaultKind, FaultLocation};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// How long the three processes may take to connect, on a busy machine.
const ASSEMBLY: Duration = Duration::from_secs(30);
/// A scenario in which something broke ends then, with whatever has not been tried: what it would
/// still tell is not worth minutes of a person's time.
const BROKEN_AT_MOST: Duration = Duration::from_secs(25);
/// Faults found during the assembly that are kept, to explain a failed assembly.
const HINDRANCE_LIMIT: usize = 5;
/// The shortest pause between two faults.
const PAUSE: Duration = Duration::from_millis(300);
/// The random part of the pause, so that faults meet timers in every phase.
const PAUSE_SPREAD: Duration = Duration::from_millis(200);
/// Rows that are kept. Of more, the oldest rows without a problem are left out.
const ROW_LIMIT: usize = 1_000;
/// Problems outside of rows that are kept, beginning with the first.
const PROBLEM_LIMIT: usize = 100;

/// The state machine of a run.
#[derive(Debug)]
pub(crate) struct Scenario {
    plan: ScenarioPlan,
    script: InjectionSource,
    random: SeededRandom,
    /// The state of the robot as reported by its modules.
    pub(crate) robot: RobotState,
    scene: Scene,
    began_at: MachineInstant,
    now: MachineInstant,
    last: Option<FaultInjection>,
    number: u32,
    rows: Vec<FaultRow>,
    rows_left_out: u64,
    broken: bool,
    finished: bool,
    problems: Vec<String>,
    /// Faults that were found and not injected, unless they are reported as symptoms later.
    stray: BTreeMap<(Module, u64), String>,
    overloads: u64,
    /// Faults found during the assembly.
    hindrances: BTreeMap<FaultLocation, String>,
    outputs: VecDeque<ScenarioOutput>,
}

/// The settings of a run.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ScenarioPlan {
    /// Random faults instead of the script.
    pub(crate) chaos: bool,
    /// The seed of everything random.
    pub(crate) seed: u64,
    /// No step begins later than this after the start; `None` runs the scenario once.
    pub(crate) length: Option<Duration>,
    /// The deadlines.
    pub(crate) timeouts: TrialTimeouts,
}

/// An output of the scenario.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum ScenarioOutput {
    /// An action on the robot.
    Do(TrialOutput),
    /// A line for the display.
    Tell(ProgressLine),
    /// The run has ended.
    Finished,
    /// The robot was not assembled: what is missing, and which faults were found.
    Stillborn(String),
}

/// A line of the progress.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ProgressLine {
    /// Since the start.
    pub(crate) after: Duration,
    /// Its meaning.
    pub(crate) tone: LineTone,
    /// The text.
    pub(crate) text: String,
}

#[derive(Debug)]
enum Scene {
    Assembling { due: MachineInstant },
    Pausing { until: MachineInstant },
    Trying(Box<FaultTrial>),
    Over,
}

#[derive(Debug)]
enum InjectionSource {
    Script(VecDeque<FaultInjection>),
    Random(RandomFaults),
}

impl Scenario {
    /// Starts with the assembly of the robot.
    pub(crate) fn new(plan: ScenarioPlan, now: MachineInstant) -> Scenario {
        let script = if plan.chaos {
            InjectionSource::Random(RandomFaults::new(plan.seed))
        } else {
            InjectionSource::Script(script().into())
        };
        Scenario {
            script,
            random: SeededRandom::new(plan.seed),
            robot: RobotState::default(),
            scene: Scene::Assembling { due: now + ASSEMBLY },
            began_at: now,
            now,
            last: None,
            number: 0,
            rows: Vec::new(),
            rows_left_out: 0,
            broken: false,
            finished: false,
            problems: Vec::new(),
            stray: BTreeMap::new(),
            overloads: 0,
            hindrances: BTreeMap::new(),
            outputs: VecDeque::new(),
            plan,
        }
    }

    /// Handles an event of a module.
    pub(crate) fn handle_event(&mut self, from: Module, event: &ModuleEvent, now: MachineInstant) {
        self.now = now;
        self.robot.handle_event(from, event);
        match event {
            ModuleEvent::Explained { id, .. } => drop(self.stray.remove(&(from, *id))),
            ModuleEvent::Ready => self.say(LineTone::Remark, format!("{from} is ready")),
            ModuleEvent::Found(note) => self.warn(from, note),
            _ => {}
        }
        match (&mut self.scene, event) {
            (Scene::Trying(trial), ModuleEvent::Found(note)) => {
                let late = self.last.as_ref().map(|last| last.judge(note));
                let belated = matches!(late, Some(FaultMatch::Named | FaultMatch::Companion));
                if !belated || trial.injection().judge(note) != FaultMatch::Foreign {
                    let line = trial.handle_event(from, event, &mut self.robot, now);
                    self.say_all(line);
                }
            }
            (Scene::Trying(trial), event) => {
                let line = trial.handle_event(from, event, &mut self.robot, now);
                self.say_all(line);
            }
            (Scene::Pausing { .. }, ModuleEvent::Found(note)) => self.judge_between(from, note),
            // During the assembly missing cables and nodes are expected; missing objects are not.
            (Scene::Assembling { .. }, ModuleEvent::Found(note))
                if matches!(note.location, FaultLocation::Object(_)) =>
            {
                self.judge_between(from, note);
                self.hinder(from, note);
            }
            (Scene::Assembling { .. }, ModuleEvent::Found(note)) => self.hinder(from, note),
            _ => {}
        }
        self.advance();
    }

    /// Handles the kill of a process by the scenario.
    pub(crate) fn handle_killed(&mut self, at: MachineInstant, now: MachineInstant) {
        self.now = now;
        if let Scene::Trying(trial) = &mut self.scene {
            trial.handle_killed(at, now);
        }
        self.advance();
    }

    /// Handles the end of a process; `unasked` describes an end that was not ordered.
    pub(crate) fn handle_exit(
        &mut self,
        module: Module,
        unasked: Option<&str>,
        now: MachineInstant,
    ) {
        self.now = now;
        self.robot.handle_exit(module);
        if let Some(how) = unasked {
            match &mut self.scene {
                Scene::Trying(trial) => {
                    trial.handle_exit(module, how);
                    self.say(LineTone::Alarm, format!("{module} ended by itself: {how}"));
                }
                _ => self.complain(format!("{module} ended by itself: {how}")),
            }
        }
        self.advance();
    }

    /// Handles the expiry of the timer.
    pub(crate) fn handle_timeout(&mut self, now: MachineInstant) {
        self.now = now;
        if let Scene::Trying(trial) = &mut self.scene {
            trial.handle_timeout(&mut self.robot, now);
        }
        self.advance();
    }

    /// Returns the next output.
    pub(crate) fn poll_output(&mut self) -> Option<ScenarioOutput> {
        if let Scene::Trying(trial) = &mut self.scene
            && let Some(output) = trial.poll_output()
        {
            return Some(ScenarioOutput::Do(output));
        }
        self.outputs.pop_front()
    }

    /// Returns when the timer expires.
    pub(crate) fn poll_timeout(&self) -> Option<MachineInstant> {
        match &self.scene {
            Scene::Assembling { due } => Some(*due),
            Scene::Pausing { until } => Some(*until),
            Scene::Trying(trial) => {
                let end = self.must_end_at(trial).filter(|end| *end > self.now);
                trial.poll_timeout().into_iter().chain(end).min()
            }
            Scene::Over => None,
        }
    }

    /// Returns the present step, for the live view.
    pub(crate) fn caption(&self) -> String {
        match &self.scene {
            Scene::Assembling { .. } => "the robot is being assembled".into(),
            Scene::Pausing { .. } => "no fault".into(),
            Scene::Trying(trial) => format!("{}: {}", self.number, trial.injection()),
            Scene::Over => "the end".into(),
        }
    }

    /// How many faults there will be, if that is robot.
    pub(crate) fn steps(&self) -> Option<usize> {
        match (&self.script, self.plan.length) {
            (InjectionSource::Script(rest), None) => {
                Some(rest.len() + usize::try_from(self.number).unwrap_or_default())
            }
            _ => None,
        }
    }

    /// Returns the start of the run.
    pub(crate) fn began_at(&self) -> MachineInstant {
        self.began_at
    }

    /// Returns the report up to now.
    pub(crate) fn report(&self) -> Report {
        let messages = self.robot.accounting.losses();
        let in_rows = |count: fn(&FaultRow) -> u64| self.rows.iter().map(count).sum::<u64>();
        let mut problems: Vec<String> =
            self.problems.iter().chain(self.stray.values()).cloned().collect();
        // During a trial, messages may still be in flight.
        if !matches!(self.scene, Scene::Trying(_)) {
            let between = [
                (messages.lost.saturating_sub(in_rows(|row| row.lost)), "lost"),
                (messages.doubled.saturating_sub(in_rows(|row| row.doubled)), "doubled"),
            ];
            for (count, what) in between.into_iter().filter(|(count, _)| *count > 0) {
                let messages = counted(count, "reliable message");
                problems.push(format!("{messages} {what} between two faults"));
            }
        }
        let mut report = Report {
            promises_kept: !self.broken && self.finished && problems.is_empty() && self.number > 0,
            finished: self.finished,
            seed: self.plan.seed,
            chaos: self.plan.chaos,
            took: self.now - self.began_at,
            rows: self.rows.clone(),
            rows_left_out: self.rows_left_out,
            problems,
            late: in_rows(|row| row.lost).saturating_sub(messages.lost),
            messages,
            received: self.robot.accounting.received(),
            overloads: self.overloads,
            responses: Vec::new(),
            events: Vec::new(),
            notes: NOTES.into(),
        };
        report.take_measured(&self.robot.measured());
        report
    }

    fn advance(&mut self) {
        match &self.scene {
            Scene::Assembling { due } => {
                if self.robot.is_together(|_| true) {
                    let text = "the robot is assembled: three processes, four cables";
                    self.say(LineTone::Remark, text.into());
                    self.pause();
                } else if self.now >= *due {
                    let missing = std::iter::once(self.robot.missing(|_| true));
                    let found = self.hindrances.values().cloned();
                    let text = missing.chain(found).collect::<Vec<_>>().join("; ");
                    // They explain the failure, and no fault was injected.
                    self.stray.clear();
                    self.scene = Scene::Over;
                    self.outputs.push_back(ScenarioOutput::Stillborn(text));
                }
            }
            Scene::Pausing { until } if self.now >= *until => self.begin_next(),
            Scene::Trying(trial) if trial.is_over() => self.end_trial(),
            Scene::Trying(trial) if self.must_end_at(trial).is_some_and(|end| self.now >= end) => {
                self.end_trial();
            }
            Scene::Pausing { .. } | Scene::Trying(_) | Scene::Over => {}
        }
    }

    fn pause(&mut self) {
        let until = self.now + PAUSE + self.random.pause(PAUSE_SPREAD);
        self.scene = Scene::Pausing { until };
    }

    /// Returns when a run with a broken promise ends; a run with a fixed length has its own end.
    fn must_end_at(&self, trial: &FaultTrial) -> Option<MachineInstant> {
        let is_broken = self.broken || trial.is_broken();
        (self.plan.length.is_none() && is_broken).then_some(self.began_at + BROKEN_AT_MOST)
    }

    fn hinder(&mut self, from: Module, note: &FaultNote) {
        if self.hindrances.len() < HINDRANCE_LIMIT {
            let FaultNote { kind, location, detail, .. } = note;
            let text = format!("{from} found {kind} in {location}: {detail}");
            self.hindrances.insert(location.clone(), text);
        }
    }

    fn begin_next(&mut self) {
        let is_late = self.now - self.began_at >= BROKEN_AT_MOST;
        if self.broken
            && is_late
            && self.plan.length.is_none()
            && let InjectionSource::Script(rest) = &mut self.script
            && !rest.is_empty()
        {
            let left = counted(rest.len() as u64, "fault");
            rest.clear();
            self.complain(format!("{left} not tried: a promise is broken, and time is up"));
        }
        let Some(injection) = self.next_injection() else {
            self.finish();
            return;
        };
        self.number += 1;
        let steps = self.steps().map(|steps| format!(" of {steps}")).unwrap_or_default();
        self.say(LineTone::Injection, format!("{}{steps}: {injection}", self.number));
        let timeouts = self.plan.timeouts;
        let trial = FaultTrial::new(injection, self.number, timeouts, &self.robot, self.now);
        self.scene = Scene::Trying(Box::new(trial));
    }

    fn next_injection(&mut self) -> Option<FaultInjection> {
        let is_time_up = self.plan.length.is_some_and(|length| self.now - self.began_at >= length);
        match &mut self.script {
            // A cut that a later step repairs must be repaired.
            InjectionSource::Script(rest)
                if is_time_up && !matches!(self.last, Some(FaultInjection::Cut { .. })) =>
            {
                rest.clear();
                None
            }
            InjectionSource::Script(rest) => {
                if rest.is_empty() && self.plan.length.is_some() {
                    *rest = script().into();
                }
                rest.pop_front()
            }
            InjectionSource::Random(_) if is_time_up => None,
            InjectionSource::Random(chaos) => Some(chaos.next()),
        }
    }

    fn end_trial(&mut self) {
        let scene = std::mem::replace(&mut self.scene, Scene::Over);
        let Scene::Trying(mut trial) = scene else { return };
        if !trial.is_over() {
            trial.cut_short(&self.robot);
        }
        let row = trial.row(&self.robot);
        for problem in &row.problems {
            self.broken = true;
            self.say(LineTone::Alarm, problem.clone());
        }
        if row.problems.is_empty() {
            let span = row.recovered_after.map(|span| format!(" after {span:.1?}"));
            let symptoms = match row.symptoms {
                0 => String::new(),
                count => format!(", and {}", counted(count, "symptom")),
            };
            self.say(LineTone::Relief, format!("recovered{}{symptoms}", span.unwrap_or_default()));
        }
        if self.rows.len() == ROW_LIMIT {
            let good = self.rows.iter().position(|row| row.problems.is_empty());
            self.rows.remove(good.unwrap_or_default());
            self.rows_left_out += 1;
        }
        self.rows.push(row);
        self.last = Some(trial.injection().clone());
        self.pause();
    }

    fn finish(&mut self) {
        self.scene = Scene::Over;
        self.finished = true;
        self.outputs.push_back(ScenarioOutput::Finished);
    }

    fn judge_between(&mut self, from: Module, note: &FaultNote) {
        let belongs = |last: &FaultInjection| last.judge(note) != FaultMatch::Foreign;
        let excused = note.is_warning() || note.symptom_of.is_some();
        if !excused && !self.last.as_ref().is_some_and(belongs) {
            let FaultNote { kind, location, detail, .. } = note;
            let text =
                format!("{from} named {kind} in {location}, where no fault was injected: {detail}");
            if self.stray.len() < PROBLEM_LIMIT {
                self.stray.insert((from, note.id), text);
            }
        }
    }

    /// Tells of an overload that was not injected.
    fn warn(&mut self, from: Module, note: &FaultNote) {
        let trial = match &self.scene {
            Scene::Trying(trial) => Some(trial.injection()),
            _ => None,
        };
        let is_injected = trial
            .into_iter()
            .chain(&self.last)
            .any(|injection| injection.judge(note) == FaultMatch::Named);
        if note.kind == FaultKind::Overload && note.symptom_of.is_none() && !is_injected {
            self.overloads += 1;
            let FaultNote { kind, location, detail, .. } = note;
            self.say(LineTone::Remark, format!("{from} warns of {kind} in {location}: {detail}"));
        }
    }

    fn complain(&mut self, problem: String) {
        self.broken = true;
        if self.problems.len() < PROBLEM_LIMIT {
            self.say(LineTone::Alarm, problem.clone());
            self.problems.push(problem);
        }
    }

    fn say_all(&mut self, line: Option<(LineTone, String)>) {
        if let Some((tone, text)) = line {
            self.say(tone, text);
        }
    }

    fn say(&mut self, tone: LineTone, text: String) {
        let after = self.now - self.began_at;
        self.outputs.push_back(ScenarioOutput::Tell(ProgressLine { after, tone, text }));
    }
}

/// Returns the ten faults in their order.
fn script() -> Vec<FaultInjection> {
    let object = |module, object: &str, fault| FaultInjection::Object {
        module,
        object: object.into(),
        fault,
    };
    vec![
        object(Module::Module1, "skin/17", ObjectFault::Panic),
        object(Module::Module2, "laser", ObjectFault::Hang { millis: HANG_MILLIS }),
        object(Module::Module3, "motors", ObjectFault::ErrorState),
        object(Module::Module1, "planner", ObjectFault::FailInitialization),
        object(Module::Module3, "odometry", ObjectFault::Silence),
        FaultInjection::Cut { cable: CABLES[0], returns: false },
        FaultInjection::Blackout { far: CABLES[0].far },
        FaultInjection::Router { module: Module::Module1 },
        FaultInjection::Kill { module: Module::Module3 },
        object(Module::Module2, "operator", ObjectFault::Flood { messages: FLOOD_MESSAGES }),
    ]
}

#[cfg(test)]
mod tests;
