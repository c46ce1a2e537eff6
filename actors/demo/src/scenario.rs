//! The scenario of the demonstration: the order of the faults, and whether each promise was kept.
//!
//! A pure state machine: its inputs are the time and the reports of the modules, its outputs are
//! orders and progress lines. A test runs it in virtual time.

use crate::faults::{FAULTS, FaultMatch};
use crate::messages::{FaultReport, ModuleReport, Strike};
use crate::report::{FaultRow, Report, counted, latencies};
use crate::robot::Module;
use crate::robot_state::{FoundFault, FoundKey, RobotState};
use crate::trial::FaultTrial;
use blastema::{FaultKind, FaultLocation, Instant};
use std::collections::VecDeque;
use std::time::Duration;

/// How long the three processes may take to connect, on a busy machine.
const ASSEMBLY: Duration = Duration::from_secs(30);
/// A scenario in which something broke ends then, with whatever has not been tried: what it would
/// still tell is not worth minutes of a person's time.
const BROKEN_AT_MOST: Duration = Duration::from_secs(25);
/// The pause between two faults.
const PAUSE: Duration = Duration::from_millis(400);
/// Faults found during the assembly that are named, to explain why it failed.
const HINDRANCE_LIMIT: usize = 5;

/// The state machine of a run.
#[derive(Debug)]
pub(crate) struct Scenario {
    /// The robot as its modules report it.
    pub(crate) robot: RobotState,
    /// The start of the run.
    pub(crate) began_at: Instant,
    now: Instant,
    scene: Scene,
    /// The number of the present fault, or of the last one.
    number: u32,
    rows: Vec<FaultRow>,
    problems: Vec<String>,
    lines: VecDeque<String>,
}

#[derive(Debug)]
enum Scene {
    Assembling,
    Pausing { until: Instant },
    Trying(Box<FaultTrial>),
    Finished,
}

/// What the director is to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum ScenarioOrder {
    /// Inject a fault, or repair what it has broken.
    Strike(Strike),
    /// The run has ended.
    End,
    /// The robot was not assembled: what is missing, and which faults were found.
    NotAssembled(String),
}

impl Scenario {
    /// Starts with the assembly of the robot.
    pub(crate) fn new(now: Instant) -> Scenario {
        Scenario {
            robot: RobotState::default(),
            began_at: now,
            now,
            scene: Scene::Assembling,
            number: 0,
            rows: Vec::new(),
            problems: Vec::new(),
            lines: VecDeque::new(),
        }
    }

    /// Handles the report of a module.
    pub(crate) fn handle_report(&mut self, module: Module, report: ModuleReport, now: Instant) {
        self.now = now;
        let during = (self.number, matches!(self.scene, Scene::Trying(_)));
        if self.robot.handle_report(module, report, during) {
            self.say(' ', &format!("{module} is ready"));
        }
    }

    /// Handles the end of a module's process, or that it is to be ended.
    pub(crate) fn handle_end(&mut self, module: Module, how: &str, now: Instant) {
        self.now = now;
        self.robot.handle_end(module);
        let is_ordered = match &mut self.scene {
            Scene::Trying(trial) => trial.handle_end(module),
            _ => false,
        };
        if !is_ordered {
            self.complain(format!("{module} ended by itself: {how}"));
        }
    }

    /// What was ordered is done since these instants, at the first and at the last of its places, or
    /// could not be.
    pub(crate) fn handle_struck(&mut self, struck: Result<[Instant; 2], String>, now: Instant) {
        self.now = now;
        if let Scene::Trying(trial) = &mut self.scene {
            trial.handle_struck(struck, &mut self.robot, now);
        }
    }

    /// Goes on as far as possible, and returns what is to be done now. It is called at least ten
    /// times a second.
    pub(crate) fn advance(&mut self, now: Instant) -> Option<ScenarioOrder> {
        self.now = now;
        let is_up = self.is_broken() && now >= self.began_at + BROKEN_AT_MOST;
        match &mut self.scene {
            Scene::Assembling => {
                let missing = self.robot.missing(|_| true);
                if missing.is_empty() {
                    let text = "the robot is assembled: three processes, four cables";
                    self.say(' ', text);
                    self.scene = Scene::Pausing { until: now + PAUSE };
                } else if now >= self.began_at + ASSEMBLY {
                    return Some(ScenarioOrder::NotAssembled(self.explained(missing)));
                }
                None
            }
            Scene::Pausing { until } if now < *until => None,
            Scene::Pausing { .. } => {
                let left = FAULTS.len() - self.number as usize;
                if left > 0 && is_up {
                    let left = counted(left as u64, "fault");
                    self.complain(format!("{left} not tried: a promise is broken, and time is up"));
                }
                if left == 0 || is_up {
                    self.scene = Scene::Finished;
                    return Some(ScenarioOrder::End);
                }
                self.number += 1;
                let trial = FaultTrial::new(self.number, &self.robot, now);
                let (fault, steps) = (trial.fault, FAULTS.len());
                self.scene = Scene::Trying(Box::new(trial));
                self.say('>', &format!("{} of {steps}: {fault}", self.number));
                self.say(' ', &format!("broken: {}", fault.broken));
                self.say(' ', &format!("robot:  {}", fault.robot_does));
                self.say(' ', &format!("user:   {}", fault.user_sees));
                Some(ScenarioOrder::Strike(Strike { fault: self.number - 1, repair: false }))
            }
            Scene::Trying(trial) => {
                let must_repair = trial.advance(&mut self.robot, now);
                let news = trial.news(&self.robot);
                let row = trial.is_over().then(|| trial.row(&self.robot));
                news.into_iter().for_each(|text| self.say('!', &text));
                row.into_iter().for_each(|row| self.end_trial(row));
                let repair = Strike { fault: self.number - 1, repair: true };
                must_repair.then_some(ScenarioOrder::Strike(repair))
            }
            Scene::Finished => Some(ScenarioOrder::End),
        }
    }

    fn end_trial(&mut self, row: FaultRow) {
        for problem in &row.problems {
            self.say('X', problem);
        }
        if let (true, Some(span)) = (row.problems.is_empty(), row.recovered_after) {
            let symptoms = counted(row.symptoms, "symptom");
            self.say('+', &format!("recovered after {span:.1?}, with {symptoms}"));
        }
        self.rows.push(row);
        self.scene = Scene::Pausing { until: self.now + PAUSE };
    }

    /// Returns since when messages must have been sent to show that they pass again.
    pub(crate) fn watched_since(&self) -> Instant {
        match &self.scene {
            Scene::Trying(trial) => trial.watched_since().unwrap_or_default(),
            _ => Instant::default(),
        }
    }

    /// Returns the next progress line.
    pub(crate) fn poll_line(&mut self) -> Option<String> {
        self.lines.pop_front()
    }

    /// Returns the report up to now.
    pub(crate) fn report(&self) -> Report {
        let messages = self.robot.losses();
        let is_finished = matches!(self.scene, Scene::Finished);
        let mut problems = self.problems.clone();
        problems.extend(self.robot.found.iter().filter_map(|(key, found)| self.stray(key, found)));
        let given_up = self.robot.found.iter().filter_map(|(key, found)| found.given_up(key));
        let is_in_row = |text: &String| self.rows.iter().any(|row| row.problems.contains(text));
        problems.extend(given_up.filter(|text| !is_in_row(text)));
        // During a trial, messages may still be in flight.
        if !matches!(self.scene, Scene::Trying(_)) {
            let between = messages - self.rows.iter().map(|row| row.losses).sum();
            for (count, what) in [(between.lost, "lost"), (between.doubled, "doubled")] {
                if count > 0 {
                    let messages = counted(count, "reliable message");
                    problems.push(format!("{messages} {what} between two faults"));
                }
            }
        }
        let are_well = self.rows.iter().all(|row| row.problems.is_empty());
        let overloads = self.robot.found.values().filter(|found| self.is_overload(found));
        let report = Report {
            promises_kept: is_finished && are_well && problems.is_empty(),
            finished: is_finished,
            took: self.now - self.began_at,
            rows: self.rows.clone(),
            problems,
            messages,
            received: self.robot.received(),
            overloads: overloads.count() as u64,
            latencies: latencies(&self.robot.measured),
            notes: Vec::new(),
        };
        report.with_notes()
    }

    /// Returns whether a fault is an overload that was not injected.
    fn is_overload(&self, found: &FoundFault) -> bool {
        let FoundFault { report, during: (number, _), .. } = found;
        let is_of_object = matches!(report.location, FaultLocation::Object(_));
        let near = [number.checked_sub(1), number.checked_sub(2)].into_iter().flatten();
        let mut near = near.map(|at| FAULTS[at as usize].judge(report));
        report.kind == FaultKind::Overload
            && report.symptom_of.is_none()
            && !(is_of_object && near.any(|near| near == FaultMatch::Named))
    }

    fn is_broken(&self) -> bool {
        let rows = self.rows.iter().any(|row| !row.problems.is_empty());
        let trial = matches!(&self.scene, Scene::Trying(trial) if !trial.problems.is_empty());
        rows || trial || !self.problems.is_empty()
    }

    /// Describes a fault that was found between two trials and was not injected.
    fn stray(&self, key: &FoundKey, found: &FoundFault) -> Option<String> {
        let FoundFault { report, during: (number, is_tried), .. } = found;
        let FaultReport { kind, location, detail, .. } = report;
        // During the assembly missing cables and nodes are expected; missing objects are not.
        let is_foreign = match number.checked_sub(1) {
            Some(last) => FAULTS[last as usize].judge(report) == FaultMatch::Foreign,
            None => {
                matches!(location, FaultLocation::Object(_))
                    && !report.is_warning()
                    && report.symptom_of.is_none()
                    // They explain why the assembly has failed.
                    && !matches!(self.scene, Scene::Assembling)
            }
        };
        (is_foreign && !is_tried).then(|| {
            format!("{} named {kind} in {location}, where no fault was injected: {detail}", key.0)
        })
    }

    /// Describes why the robot was not assembled.
    fn explained(&self, missing: String) -> String {
        let found = self.robot.found.iter().take(HINDRANCE_LIMIT).map(|(key, found)| {
            let FaultReport { kind, location, detail, .. } = &found.report;
            format!("{} found {kind} in {location}: {detail}", key.0)
        });
        std::iter::once(missing).chain(found).collect::<Vec<_>>().join("; ")
    }

    fn complain(&mut self, problem: String) {
        self.say('X', &problem);
        match &mut self.scene {
            Scene::Trying(trial) => trial.problems.push(problem),
            _ => self.problems.push(problem),
        }
    }

    /// Adds a line with its mark: `>` a fault is injected, `!` it was found, `+` it is recovered, `X`
    /// a promise is broken.
    fn say(&mut self, mark: char, text: &str) {
        let after = (self.now - self.began_at).as_secs_f64();
        // Text of a module cannot move the cursor.
        let text: String = text.chars().filter(|c| !c.is_control()).collect();
        self.lines.push_back(format!("{after:8.3} {mark} {text}"));
    }
}

#[cfg(test)]
mod tests;
