//! A robot by chance: its tree, its components, and the timetable of what goes wrong.
//!
//! One seed gives one plan. A plan is data: it is printed where a run fails, and made smaller by
//! leaving out steps and components.

use blastema::core::random::Random;
use blastema::prelude::*;
use blastema::recovery::{Ladder, Plan, RecoveryAction};
use std::fmt;

/// Where a plan is carried out; it decides how long things take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Clock {
    /// On one thread, whose clock stands while a component has something to do.
    Virtual,
    /// On so many threads that share the components.
    Real { threads: u8 },
}

/// One robot and what strikes it.
#[derive(Clone, Debug)]
pub(crate) struct Robot {
    pub(crate) seed: u64,
    pub(crate) clock: Clock,
    /// The root supervisor.
    pub(crate) root: Group,
    /// In the order of their indices, which every other part of the plan uses.
    pub(crate) parts: Vec<PartPlan>,
    /// In the order of their times.
    pub(crate) steps: Vec<Step>,
    /// Which kinds of fault are answered by another action than usual.
    pub(crate) answers: Vec<(FaultKind, RecoveryAction)>,
}

#[derive(Clone, Debug)]
pub(crate) struct Group {
    pub(crate) name: String,
    pub(crate) strategy: Strategy,
    pub(crate) escalates: bool,
    /// Restarts in ten seconds.
    pub(crate) intensity: u32,
    pub(crate) children: Vec<Branch>,
}

#[derive(Clone, Debug)]
pub(crate) enum Branch {
    Part(usize),
    Group(Group),
}

/// How one component is made.
#[derive(Clone, Debug)]
pub(crate) struct PartPlan {
    pub(crate) name: String,
    pub(crate) restart: Restart,
    pub(crate) essential: bool,
    /// Rounds a second; in each, it publishes.
    pub(crate) rate_hz: Option<u32>,
    /// A sign of life each period of its rate, of which three may be missing.
    pub(crate) push: bool,
    pub(crate) pull: bool,
    pub(crate) queue: (usize, WhenFull),
    pub(crate) publishes: Option<usize>,
    /// Topics, and which events it takes of each: those whose number this divides.
    pub(crate) listens: Vec<(usize, u64)>,
    /// A component with a lower index, without which it cannot work.
    pub(crate) depends_on: Option<usize>,
    pub(crate) max_wait_ms: u64,
    pub(crate) own_thread: bool,
    /// How long each of its handlers keeps the thread, on real threads.
    pub(crate) work_ms: u64,
    /// It is not there before a step adds it.
    pub(crate) late: bool,
    /// Its ports panic where they are declared.
    pub(crate) broken_ports: bool,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Step {
    /// Before the node is started; such steps come first.
    pub(crate) early: bool,
    pub(crate) at_ms: u64,
    pub(crate) part: usize,
    pub(crate) action: Action,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Action {
    /// Tells it to do this.
    Tell(Deed),
    /// Asks it to do this, and gives it so many milliseconds.
    Ask(Deed, u64),
    /// The next call of this hook does this.
    Hook(&'static str, Pull),
    /// The next event that reaches its condition lets that do this.
    Condition(Blow),
    /// Its device is away until it is plugged in again.
    Unplug,
    PlugIn,
    /// A late component is added below the root.
    Add,
    /// A component that stands below the root is removed.
    Remove,
    Kill,
    Hang,
    Silence,
    FailInit(u32),
    Slow(u64),
    /// Takes out what was put in.
    Heal,
    /// So many messages at once.
    Flood(u64),
    /// A person restarts it.
    RestartChild,
}

/// What a condition does once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Blow {
    Panic,
    /// Keeps the thread for so many milliseconds.
    Block(u64),
}

/// What a component does while it serves a request, or afterwards.
#[derive(Clone, Debug, PartialEq, Structure)]
pub(crate) enum Deed {
    Nothing,
    Panic,
    /// In a task of its own, so many milliseconds later.
    PanicInTask(u64),
    PanicInTimer(u64),
    Fail,
    FailFatally,
    /// Ends its incarnation in order.
    Stop,
    /// Takes so many milliseconds, without keeping the thread.
    Await(u64),
    /// Keeps the thread for so many milliseconds.
    Block(u64),
    /// Declares a failed check.
    Declare,
    /// Publishes so many events at once.
    Publish(u64),
    /// Asks the component of this index, and gives it so many milliseconds.
    Consult(u64, u64),
}

/// What a hook does once.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Pull {
    Fail,
    Fatal,
    Panic,
    /// So many times in a row.
    Unavailable(u32),
    Wait(u64),
}

pub(crate) const TOPICS: usize = 3;
const HOOKS: [&str; 10] = [
    "on_initialize",
    "on_startup",
    "on_activated",
    "on_execute",
    "on_deactivated",
    "on_aborting",
    "on_error",
    "on_reset",
    "on_shutdown",
    "on_finalize",
];
/// What may go wrong while the node starts.
const FIRST_HOOKS: [&str; 3] = ["on_initialize", "on_startup", "on_activated"];

fn one_of<T: Clone>(random: &mut Random, things: &[T]) -> T {
    things[below(random, things.len())].clone()
}

fn below(random: &mut Random, limit: usize) -> usize {
    usize::try_from(random.below(limit as u64)).expect("an index")
}

impl Robot {
    pub(crate) fn of_seed(seed: u64, clock: Clock) -> Robot {
        let mut random = Random::new(seed);
        let random = &mut random;
        let count = 2 + below(random, 7);
        let patient = random.chance(0.5);
        let mut parts: Vec<PartPlan> = (0..count).map(|index| part(random, index, clock)).collect();
        let late = if random.chance(0.3) { 1 + below(random, 2) } else { 0 };
        for index in count..count + late {
            let restart = Restart::Permanent;
            parts.push(PartPlan { late: true, restart, ..part(random, index, clock) });
        }
        let mut free: Vec<usize> = (0..count).collect();
        let mut groups = 0;
        let mut root = group(random, "root", patient, &mut free, &mut groups, 0);
        root.children.extend(free.into_iter().map(Branch::Part));
        if random.chance(0.7) {
            root.strategy = Strategy::OneForOne;
        }
        let mut steps = steps(random, &parts, clock);
        if random.chance(0.3) {
            let early = 1 + below(random, 4);
            steps.splice(0..0, (0..early).map(|_| early_step(random, count, clock)));
        }
        let answers = if random.chance(0.3) { answers(random) } else { Vec::new() };
        Robot { seed, clock, root, parts, steps, answers }
    }

    /// The recovery plan of the node.
    pub(crate) fn recovery(&self) -> Plan {
        let ladder = |action: &RecoveryAction| {
            Ladder::first(action.clone()).then(RecoveryAction::Restart).times(2)
        };
        let answers = self.answers.iter();
        answers.fold(Plan::default(), |plan, (kind, action)| plan.on(kind.clone(), ladder(action)))
    }

    /// The plan without this component, or nothing where it is the last one.
    pub(crate) fn without_part(&self, index: usize) -> Option<Robot> {
        if self.parts.len() <= 1 {
            return None;
        }
        let lower = |other: usize| if other > index { other - 1 } else { other };
        let mut less = self.clone();
        less.parts.remove(index);
        for part in &mut less.parts {
            part.depends_on = part.depends_on.filter(|on| *on != index).map(lower);
        }
        less.root = without(&self.root, index);
        less.steps.retain(|step| step.part != index && consulted(step) != Some(index as u64));
        for step in &mut less.steps {
            step.part = lower(step.part);
            if let Action::Tell(Deed::Consult(other, _)) | Action::Ask(Deed::Consult(other, _), _) =
                &mut step.action
                && *other > index as u64
            {
                *other -= 1;
            }
        }
        Some(less)
    }
}

fn consulted(step: &Step) -> Option<u64> {
    match step.action {
        Action::Tell(Deed::Consult(other, _)) | Action::Ask(Deed::Consult(other, _), _) => {
            Some(other)
        }
        _ => None,
    }
}

/// The group without this component, and without supervisors that have no child left.
fn without(group: &Group, index: usize) -> Group {
    let child = |branch: &Branch| match branch {
        Branch::Part(part) if *part == index => None,
        Branch::Part(part) if *part > index => Some(Branch::Part(part - 1)),
        Branch::Part(part) => Some(Branch::Part(*part)),
        Branch::Group(group) => {
            let less = without(group, index);
            (!less.children.is_empty()).then_some(Branch::Group(less))
        }
    };
    Group { children: group.children.iter().filter_map(child).collect(), ..group.clone() }
}

fn group(
    random: &mut Random,
    name: &str,
    patient: bool,
    free: &mut Vec<usize>,
    groups: &mut usize,
    depth: usize,
) -> Group {
    let strategies = [Strategy::OneForOne, Strategy::OneForAll, Strategy::RestForOne];
    let mut group = Group {
        name: name.to_owned(),
        strategy: one_of(random, &strategies),
        escalates: random.chance(0.3),
        intensity: if patient { 1000 } else { one_of(random, &[0, 1, 3, 3, 3, 10]) },
        children: Vec::new(),
    };
    for _ in 0..1 + below(random, 4) {
        if free.is_empty() {
            break;
        }
        if depth < 2 && random.chance(0.35) {
            *groups += 1;
            let name = format!("group{groups}");
            let below = self::group(random, &name, patient, free, groups, depth + 1);
            group.children.push(Branch::Group(below));
        } else {
            group.children.push(Branch::Part(free.remove(0)));
        }
    }
    if group.children.is_empty() {
        // A supervisor without children proves nothing; there is at least one left for the first.
        group.children.extend(free.pop().map(Branch::Part));
    }
    group
}

fn part(random: &mut Random, index: usize, clock: Clock) -> PartPlan {
    let rate_hz = random.chance(0.7).then(|| one_of(random, &[1, 5, 10, 20]));
    let restarts = [Restart::Permanent, Restart::Permanent, Restart::Permanent, Restart::Transient];
    let policies = [WhenFull::Refuse, WhenFull::Wait, WhenFull::DropOldest, WhenFull::DropNewest];
    let real = clock != Clock::Virtual;
    PartPlan {
        name: format!("part{index}"),
        restart: if random.chance(0.1) { Restart::Temporary } else { one_of(random, &restarts) },
        essential: random.chance(0.05),
        push: rate_hz.is_some() && random.chance(0.3),
        pull: random.chance(0.1),
        rate_hz: if real { rate_hz.map(|hz| 2 * hz) } else { rate_hz },
        queue: (one_of(random, &[1, 2, 4, 16, 64, 64]), one_of(random, &policies)),
        publishes: random.chance(0.6).then(|| below(random, TOPICS)),
        listens: listens(random),
        depends_on: (index > 0 && random.chance(0.3)).then(|| below(random, index)),
        late: false,
        broken_ports: random.chance(0.005),
        max_wait_ms: if real { 400 } else { one_of(random, &[500, 2_000, 10_000]) },
        own_thread: random.chance(0.15),
        work_ms: if real { one_of(random, &[0, 0, 1, 3]) } else { 0 },
    }
}

/// Some topics, and which events of each.
fn listens(random: &mut Random) -> Vec<(usize, u64)> {
    let mut listens = Vec::new();
    for topic in 0..TOPICS {
        if random.chance(0.4) {
            listens.push((topic, one_of(random, &[1, 1, 2, 3])));
        }
    }
    listens
}

fn steps(random: &mut Random, parts: &[PartPlan], clock: Clock) -> Vec<Step> {
    let (count, pauses): (usize, &[u64]) = match clock {
        Clock::Virtual => (below(random, 40), &[0, 0, 0, 1, 10, 50, 300, 1_500]),
        Clock::Real { .. } => (below(random, 16), &[0, 0, 1, 5, 20, 60, 100]),
    };
    let mut at_ms = one_of(random, pauses);
    let mut steps = Vec::new();
    for _ in 0..1 + count {
        let part = below(random, parts.len());
        let action = match parts[part].late && random.chance(0.5) {
            true => Action::Add,
            false => action(random, parts, clock),
        };
        steps.push(Step { early: false, at_ms, part, action });
        at_ms += one_of(random, pauses);
    }
    steps
}

/// A component is isolated, or moved to a thread of its own, where it is restarted as a rule, or
/// nothing is done.
fn answers(random: &mut Random) -> Vec<(FaultKind, RecoveryAction)> {
    let kinds = [
        FaultKind::Panic,
        FaultKind::UnexpectedExit,
        FaultKind::Hang,
        FaultKind::Silence,
        FaultKind::ErrorState,
        FaultKind::InitializationFailed,
        FaultKind::CheckFailed,
        FaultKind::Overload,
    ];
    let actions = [RecoveryAction::Isolate, RecoveryAction::MoveToOwnThread];
    (0..1 + below(random, 3)).map(|_| (one_of(random, &kinds), one_of(random, &actions))).collect()
}

/// What goes wrong before the start is complete.
fn early_step(random: &mut Random, count: usize, clock: Clock) -> Step {
    let action = match random.below(8) {
        0 => Action::Condition(blow(random, clock)),
        1 | 2 => Action::Unplug,
        3 => Action::Hook("drop", Pull::Panic),
        _ => Action::Hook(one_of(random, &FIRST_HOOKS), pull(random, clock != Clock::Virtual)),
    };
    Step { early: true, at_ms: 0, part: below(random, count), action }
}

fn blow(random: &mut Random, clock: Clock) -> Blow {
    // Virtual time stands while a thread is kept.
    match clock != Clock::Virtual && random.chance(0.5) {
        true => Blow::Block(one_of(random, &[5, 30, 250, 400])),
        false => Blow::Panic,
    }
}

fn action(random: &mut Random, parts: &[PartPlan], clock: Clock) -> Action {
    let real = clock != Clock::Virtual;
    match random.below(24) {
        0..=3 => Action::Tell(deed(random, parts, real)),
        4..=9 => {
            let deadline = one_of(random, &[20, 200, 1_000, 5_000]);
            Action::Ask(deed(random, parts, real), deadline)
        }
        10..=12 => Action::Hook(one_of(random, &HOOKS), pull(random, real)),
        13 => Action::Condition(blow(random, clock)),
        14 => Action::Kill,
        15 => Action::Hang,
        16 => match random.below(3) {
            0 => Action::Silence,
            1 => Action::FailInit(1 + u32::try_from(random.below(4)).expect("a small number")),
            _ => Action::Slow(if real { 10 } else { one_of(random, &[1, 30, 700]) }),
        },
        17 => Action::Heal,
        18 => Action::Flood(one_of(random, &[2, 10, 100, 1_500])),
        19 => Action::Hook("drop", Pull::Panic),
        20 => Action::Unplug,
        21 => Action::PlugIn,
        22 => Action::Remove,
        _ => Action::RestartChild,
    }
}

fn deed(random: &mut Random, parts: &[PartPlan], real: bool) -> Deed {
    let soon = one_of(random, &[0, 1, 20]);
    match random.below(15) {
        0 | 1 => Deed::Panic,
        2 => Deed::PanicInTask(soon),
        3 => Deed::PanicInTimer(soon),
        4 => Deed::Fail,
        5 => Deed::FailFatally,
        6 => Deed::Stop,
        7 => Deed::Await(if real { 600 } else { one_of(random, &[3_600_000, 20_000]) }),
        8 => Deed::Await(one_of(random, if real { &[5, 50] } else { &[5, 300, 900] })),
        9 if real => Deed::Block(one_of(random, &[5, 30, 250, 400, 700])),
        9 | 10 => Deed::Publish(one_of(random, &[1, 3, 70, 1_100])),
        11 => Deed::Declare,
        12 | 13 => Deed::Consult(random.below(parts.len() as u64), one_of(random, &[10, 100, 400])),
        _ => Deed::Nothing,
    }
}

fn pull(random: &mut Random, real: bool) -> Pull {
    match random.below(7) {
        0 | 1 => Pull::Fail,
        2 => Pull::Fatal,
        3 => Pull::Panic,
        4 => Pull::Unavailable(1 + u32::try_from(random.below(4)).expect("a small number")),
        _ if real => Pull::Wait(one_of(random, &[5, 50, 600])),
        _ => Pull::Wait(one_of(random, &[10, 300, 3_600_000])),
    }
}

impl fmt::Display for Robot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "seed {} on {:?}", self.seed, self.clock)?;
        for (kind, action) in &self.answers {
            writeln!(f, "  answers {kind} by {action}")?;
        }
        self.branch(f, &self.root, 1)?;
        for late in self.parts.iter().filter(|part| part.late) {
            writeln!(f, "  later {late}")?;
        }
        for Step { early, at_ms, part, action } in &self.steps {
            let early = if *early { "before the start, " } else { "" };
            writeln!(f, "{at_ms:>8} ms {early}{}: {action:?}", self.parts[*part].name)?;
        }
        Ok(())
    }
}

impl Robot {
    fn branch(&self, f: &mut fmt::Formatter<'_>, group: &Group, depth: usize) -> fmt::Result {
        let Group { name, strategy, escalates, intensity, children } = group;
        let indent = "  ".repeat(depth);
        let escalates = if *escalates { ", escalates" } else { "" };
        writeln!(f, "{indent}{name}: {strategy:?}, {intensity} in 10 s{escalates}")?;
        for child in children {
            match child {
                Branch::Group(below) => self.branch(f, below, depth + 1)?,
                Branch::Part(index) => writeln!(f, "{indent}  {}", self.parts[*index])?,
            }
        }
        Ok(())
    }
}

impl fmt::Display for PartPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {:?}, queue {:?}", self.name, self.restart, self.queue)?;
        write!(f, ", max_wait {} ms", self.max_wait_ms)?;
        let flags = [
            (self.essential, "essential"),
            (self.push, "push"),
            (self.pull, "pull"),
            (self.own_thread, "own thread"),
            (self.broken_ports, "broken ports"),
        ];
        for (_, flag) in flags.iter().filter(|(set, _)| *set) {
            write!(f, ", {flag}")?;
        }
        if let Some(hz) = self.rate_hz {
            write!(f, ", {hz} Hz")?;
        }
        if let Some(topic) = self.publishes {
            write!(f, ", publishes t{topic}")?;
        }
        for (topic, each) in &self.listens {
            write!(f, ", listens to each {each}th of t{topic}")?;
        }
        if let Some(on) = self.depends_on {
            write!(f, ", depends on part{on}")?;
        }
        if self.work_ms > 0 {
            write!(f, ", {} ms of work", self.work_ms)?;
        }
        Ok(())
    }
}
