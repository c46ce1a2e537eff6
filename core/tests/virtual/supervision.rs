//! The supervision machine against a simple model of the world: children that start, stop, die and
//! hang at random, and a recoverer that asks for a restart of whatever has failed.
//!
//! The model sees only what the machine says. It knows which incarnations are present, and holds
//! against it: no child has two incarnations, a group starts in order, the budget is kept, every
//! request is answered once, and when the world calms down, all that should be at work is.

use blastema_core::recovery::{
    CallId, ChildOrder, ChildRules, ChildState, ReplacementCause, Restart, Strategy, Supervisor,
    SupervisorOutput, SupervisorRules, WhenExceeded,
};
use blastema_core::{Incarnation, Instant, Machine, ObjectName};
use proptest::prelude::{Just, ProptestConfig, Strategy as _, prop, prop_assert, prop_assert_eq};
use proptest::{prop_oneof, proptest};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

const PERIOD: Duration = Duration::from_secs(10);

#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    Starting,
    /// For what is not there yet.
    Waiting,
    Present,
    Stopping,
}

#[derive(Clone, Debug)]
enum Turn {
    /// The present step of this child succeeds: it has started, or stopped.
    Answer(usize),
    StartFails(usize),
    /// Something that it needs is not there yet.
    Waits(usize),
    /// It dies; the guard tells the supervisor, and the recoverer orders a restart.
    Dies(usize),
    /// It dies, and only the recoverer hears of it.
    DiesUnheard(usize),
    Hangs(usize),
    IsFaulty(usize),
    DiesOnTheSpot(usize),
    Rest(usize),
    ByHand(usize),
    Time(u16),
    End,
    Begin,
    OwnRestart,
}

struct World {
    machine: Supervisor,
    strategy: Strategy,
    intensity: u32,
    names: Vec<ObjectName>,
    present: BTreeMap<ObjectName, (Incarnation, Phase)>,
    last: BTreeMap<ObjectName, Incarnation>,
    /// The incarnation of each child that came to work last.
    worked: BTreeMap<ObjectName, Incarnation>,
    orders: BTreeSet<ObjectName>,
    open: BTreeSet<CallId>,
    ordered_restarts: Vec<Instant>,
    now: Instant,
    calls: u64,
    escalated: bool,
    all_started: bool,
}

impl World {
    fn new(strategy: Strategy, intensity: u32, restarts: &[Restart]) -> Self {
        World::with(WhenExceeded::Escalate, strategy, intensity, restarts)
    }

    fn with(
        when_exceeded: WhenExceeded,
        strategy: Strategy,
        intensity: u32,
        restarts: &[Restart],
    ) -> Self {
        let rules = SupervisorRules {
            strategy,
            intensity,
            period: PERIOD,
            when_exceeded,
            root: true,
            ..SupervisorRules::default()
        };
        let mut machine = Supervisor::new(rules);
        let mut names = Vec::new();
        let now = Instant::from_millis(1);
        for (at, &restart) in restarts.iter().enumerate() {
            let name = ObjectName::new(&format!("child{at}")).expect("a good name");
            let rules = ChildRules { restart, on_the_spot: at % 2 == 0, ..ChildRules::default() };
            machine.add_child(name.clone(), rules, now).expect("a free name");
            names.push(name);
        }
        World {
            machine,
            strategy,
            intensity,
            names,
            present: BTreeMap::new(),
            last: BTreeMap::new(),
            worked: BTreeMap::new(),
            orders: BTreeSet::new(),
            open: BTreeSet::new(),
            ordered_restarts: Vec::new(),
            now,
            calls: 0,
            escalated: false,
            all_started: false,
        }
    }

    fn place(&self, name: &ObjectName) -> usize {
        self.names.iter().position(|other| other == name).expect("a known child")
    }

    /// Carries out what the machine wants, and holds the invariants against it.
    fn look(&mut self) {
        while let Some(action) = self.machine.poll_output() {
            match action {
                SupervisorOutput::Start { child, incarnation } => {
                    assert!(!self.present.contains_key(&child), "{child} would live twice");
                    let last = self.last.insert(child.clone(), incarnation);
                    assert!(last.is_none_or(|last| last < incarnation), "{child} {incarnation}");
                    if self.strategy != Strategy::OneForOne {
                        let mut present = self.present.values();
                        assert!(
                            present.all(|(_, phase)| *phase != Phase::Starting),
                            "two start at once"
                        );
                    }
                    self.present.insert(child, (incarnation, Phase::Starting));
                }
                SupervisorOutput::Order { child, order: ChildOrder::Stop { .. } } => {
                    assert!(!self.orders.contains(&child), "{child} stops under a grant");
                    if let Some((_, phase)) = self.present.get_mut(&child) {
                        *phase = Phase::Stopping;
                    }
                }
                SupervisorOutput::Order {
                    child,
                    order: ChildOrder::Abandon | ChildOrder::CutOff,
                }
                | SupervisorOutput::Overdue { child, .. } => {
                    self.orders.remove(&child);
                    self.present.remove(&child);
                }
                SupervisorOutput::Order { child, order: ChildOrder::GrantRestart(true) } => {
                    assert_eq!(self.strategy, Strategy::OneForOne);
                    assert!(self.intensity > 0);
                    assert!(self.orders.insert(child), "it is granted twice");
                }
                SupervisorOutput::Order { child, order: ChildOrder::GrantRestart(false) } => {
                    self.orders.remove(&child);
                }
                SupervisorOutput::Recovered { call, child, incarnation } => {
                    assert!(self.open.remove(&call), "{call:?} is answered twice");
                    if let Some(expected) = incarnation {
                        let known = self.present.get(&child).map(|&(known, _)| known);
                        // It may have died again before its group was whole.
                        let known = known.or_else(|| self.worked.get(&child).copied());
                        assert_eq!(known, Some(expected));
                    }
                }
                SupervisorOutput::Waits { call, child, incarnation } => {
                    assert!(self.open.remove(&call), "{call:?} is answered twice");
                    let known = self.present.get(&child).map(|&(known, _)| known);
                    assert_eq!(known, Some(incarnation));
                }
                SupervisorOutput::GaveUp { call, .. } => {
                    assert!(self.open.remove(&call), "{call:?} is answered twice");
                }
                SupervisorOutput::Escalate(_) => {
                    assert!(self.present.is_empty(), "it escalates over running children");
                    self.escalated = true;
                }
                SupervisorOutput::AllStopped => assert!(self.present.is_empty()),
                SupervisorOutput::AllStarted => self.all_started = true,
                SupervisorOutput::GiveUp(_) => {
                    assert!(!self.escalated, "it is said before all else");
                }
                SupervisorOutput::Order { .. }
                | SupervisorOutput::Refused { .. }
                | SupervisorOutput::Unavailable(_)
                | SupervisorOutput::Left(_) => {}
            }
        }
    }

    fn call(&mut self) -> CallId {
        self.calls += 1;
        self.open.insert(CallId(self.calls));
        CallId(self.calls)
    }

    fn restart(&mut self, name: &ObjectName, cause: ReplacementCause, faulty: Incarnation) {
        let call = self.call();
        let before = self.machine.restarts_left(self.now);
        self.machine.handle_restart(name, call, cause, Some(faulty), self.now);
        if self.machine.restarts_left(self.now) < before {
            self.ordered_restarts.push(self.now);
        }
        self.look();
    }

    fn is_found(&mut self, name: &ObjectName, cause: ReplacementCause) {
        if let Some(&(incarnation, _)) = self.present.get(name) {
            self.restart(name, cause, incarnation);
        }
    }

    fn take(&mut self, turn: Turn) {
        let count = self.names.len();
        let name = |at: usize| self.names[at % count].clone();
        match turn {
            Turn::Answer(at) => self.answer(&name(at)),
            Turn::StartFails(at) => {
                let name = name(at);
                if let Some(&(incarnation, Phase::Starting)) = self.present.get(&name) {
                    self.machine.handle_fails_to_start(&name, incarnation, self.now);
                    self.look();
                    self.present.remove(&name);
                    self.machine.handle_start_failed(&name, incarnation, "no".into(), self.now);
                    self.look();
                    self.restart(&name, ReplacementCause::Died, incarnation);
                }
            }
            Turn::Waits(at) => {
                let name = name(at);
                if let Some((incarnation, state @ (Phase::Starting | Phase::Present))) =
                    self.present.get_mut(&name)
                {
                    let incarnation = *incarnation;
                    *state = Phase::Waiting;
                    self.machine.handle_unavailable(&name, incarnation, "no".into(), self.now);
                }
            }
            Turn::Dies(at) => {
                let name = name(at);
                if let Some((incarnation, _)) = self.present.remove(&name) {
                    self.orders.remove(&name);
                    self.machine.handle_died(&name, incarnation, false, None, self.now);
                    self.look();
                    self.restart(&name, ReplacementCause::Died, incarnation);
                }
            }
            Turn::DiesUnheard(at) => {
                let name = name(at);
                if let Some((incarnation, _)) = self.present.remove(&name) {
                    self.orders.remove(&name);
                    self.restart(&name, ReplacementCause::Died, incarnation);
                }
            }
            Turn::Hangs(at) => self.is_found(&name(at), ReplacementCause::Stuck),
            Turn::IsFaulty(at) => self.is_found(&name(at), ReplacementCause::Faulty),
            Turn::DiesOnTheSpot(at) => {
                let name = name(at);
                if self.present.contains_key(&name)
                    && self.orders.remove(&name)
                    && let Some((incarnation, phase)) = self.present.get_mut(&name)
                {
                    let old = *incarnation;
                    if *phase != Phase::Stopping {
                        *phase = Phase::Starting;
                    }
                    *incarnation = incarnation.next();
                    let next = *incarnation;
                    self.last.insert(name.clone(), next);
                    self.machine.handle_died(&name, old, false, Some(next), self.now);
                }
            }
            Turn::Rest(at) => {
                let (name, call) = (name(at), self.call());
                self.machine.handle_rest(&name, call, ReplacementCause::Faulty, self.now);
            }
            Turn::ByHand(at) => {
                let (name, call) = (name(at), self.call());
                self.machine.handle_restart(&name, call, ReplacementCause::Faulty, None, self.now);
            }
            Turn::Time(millis) => {
                self.now = self.now + Duration::from_millis(u64::from(millis));
                self.machine.handle_timeout(self.now);
            }
            Turn::End => self.machine.handle_end(self.now),
            Turn::Begin => {
                self.escalated = false;
                self.machine.handle_begin(Incarnation::FIRST, self.now);
            }
            Turn::OwnRestart => {
                self.open.clear();
                self.machine.handle_own_restart(self.now);
            }
        }
        self.look();
    }

    fn answer(&mut self, name: &ObjectName) {
        match self.present.get(name).copied() {
            Some((incarnation, Phase::Starting | Phase::Waiting)) => {
                self.present.insert(name.clone(), (incarnation, Phase::Present));
                self.worked.insert(name.clone(), incarnation);
                self.machine.handle_started(name, incarnation, self.now);
            }
            Some((incarnation, Phase::Stopping)) => {
                self.present.remove(name);
                self.orders.remove(name);
                self.machine.handle_stopped(name, incarnation, self.now);
            }
            Some((_, Phase::Present)) => {}
            None => {
                // As `ChildOrder::Stop` says: a child that is not alive answers at once.
                let incarnation = self.last.get(name).copied().unwrap_or_default();
                self.machine.handle_stopped(name, incarnation, self.now);
            }
        }
        self.look();
    }

    /// The world answers everything, and the recoverer decides about whatever has failed.
    fn calm_down(&mut self) {
        for round in 0..50 {
            for name in self.names.clone() {
                self.answer(&name);
            }
            for child in self.machine.children().collect::<Vec<_>>() {
                if child.state == ChildState::Failed && round >= 40 {
                    let call = self.call();
                    self.machine.handle_rest(&child.name, call, ReplacementCause::Faulty, self.now);
                    self.look();
                } else if child.state == ChildState::Failed {
                    self.take(Turn::Time(10_001));
                    self.restart(&child.name, ReplacementCause::Died, child.incarnation);
                }
            }
        }
        self.take(Turn::Time(60_000));
    }
}

fn turns() -> impl proptest::strategy::Strategy<Value = Turn> {
    let child = 0usize..5;
    prop_oneof![
        8 => child.clone().prop_map(Turn::Answer),
        1 => child.clone().prop_map(Turn::StartFails),
        1 => child.clone().prop_map(Turn::Waits),
        2 => child.clone().prop_map(Turn::Dies),
        1 => child.clone().prop_map(Turn::DiesUnheard),
        1 => child.clone().prop_map(Turn::Hangs),
        1 => child.clone().prop_map(Turn::IsFaulty),
        2 => child.clone().prop_map(Turn::DiesOnTheSpot),
        1 => child.clone().prop_map(Turn::Rest),
        1 => child.prop_map(Turn::ByHand),
        3 => (0u16..6000).prop_map(Turn::Time),
        1 => Just(Turn::End),
        2 => Just(Turn::Begin),
        1 => Just(Turn::OwnRestart),
    ]
}

fn strategies() -> impl proptest::strategy::Strategy<Value = Strategy> {
    prop_oneof![Just(Strategy::OneForOne), Just(Strategy::OneForAll), Just(Strategy::RestForOne)]
}

fn restarts() -> impl proptest::strategy::Strategy<Value = Vec<Restart>> {
    let one = prop_oneof![
        4 => Just(Restart::Permanent),
        1 => Just(Restart::Transient),
        1 => Just(Restart::Temporary),
    ];
    prop::collection::vec(one, 1..5)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300,
        failure_persistence: None,
        ..ProptestConfig::default() })]

    #[test]
    fn whatever_happens_the_tree_comes_to_rest_or_to_work(
        when_exceeded in prop_oneof![Just(WhenExceeded::StopChild), Just(WhenExceeded::Escalate)],
        strategy in strategies(),
        intensity in 0u32..6,
        restarts in restarts(),
        turns in prop::collection::vec(turns(), 0..80),
    ) {
        let mut world = World::with(when_exceeded, strategy, intensity, &restarts);
        world.take(Turn::Begin);
        for turn in turns {
            world.take(turn);
        }

        world.calm_down();

        prop_assert!(world.machine.poll_timeout().is_none(), "{:?}", world.machine);
        for child in world.machine.children() {
            let at_work = world.present.get(&child.name).map(|&(_, phase)| phase);
            match child.state {
                ChildState::Running => prop_assert_eq!(at_work, Some(Phase::Present)),
                ChildState::Resting | ChildState::Finished => prop_assert_eq!(at_work, None),
                ChildState::Waiting => prop_assert!(world.present.is_empty(), "{child:?}"),
                _ => prop_assert!(false, "{child:?}"),
            }
        }
    }

    #[test]
    fn restarts_that_were_ordered_never_exceed_the_intensity(
        intensity in 0u32..6,
        turns in prop::collection::vec(turns(), 0..120),
    ) {
        let mut world = World::new(Strategy::OneForOne, intensity, &[Restart::Permanent; 3]);
        world.take(Turn::Begin);
        for turn in turns {
            // A new incarnation of the supervisor has a new budget.
            if !matches!(turn, Turn::Begin | Turn::End) && !world.escalated {
                world.take(turn);
            }
        }

        for (at, &first) in world.ordered_restarts.iter().enumerate() {
            let later = world.ordered_restarts[at..].iter();
            let within = later.filter(|&&later| later - first <= PERIOD).count();
            prop_assert!(within <= intensity as usize);
        }
    }

    #[test]
    fn a_group_is_stopped_in_reverse_and_started_in_order(
        failed in 0usize..5,
        group in prop_oneof![Just(Strategy::OneForAll), Just(Strategy::RestForOne)],
    ) {
        let mut world = World::new(group, 3, &[Restart::Permanent; 5]);
        world.take(Turn::Begin);
        for at in 0..5 {
            world.take(Turn::Answer(at));
        }
        prop_assert!(world.all_started);

        let name = world.names[failed].clone();
        let call = world.call();
        let faulty = Some(Incarnation::FIRST);
        world.machine.handle_restart(&name, call, ReplacementCause::Died, faulty, world.now);
        let (mut stops, mut starts) = (Vec::new(), Vec::new());
        while let Some(action) = world.machine.poll_output() {
            match action {
                SupervisorOutput::Order { child, order: ChildOrder::Stop { .. } } => {
                    stops.push(world.place(&child));
                    world.machine.handle_stopped(&child, Incarnation::FIRST, world.now);
                }
                SupervisorOutput::Start { child, incarnation } => {
                    starts.push(world.place(&child));
                    world.machine.handle_started(&child, incarnation, world.now);
                }
                _ => {}
            }
        }

        let first = if group == Strategy::OneForAll { 0 } else { failed };
        prop_assert_eq!(stops, (first..5).rev().filter(|&at| at != failed).collect::<Vec<_>>());
        prop_assert_eq!(starts, (first..5).collect::<Vec<_>>());
    }
}
