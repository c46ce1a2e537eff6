//! Who hangs, who waits too long, who is silent: judged from what workers write in passing.
//!
//! Workers count; they read no clock. The scanner is shown the counters at even intervals and keeps
//! for each the time at which it first saw it stand. An arbiter whose beat stands while a component is
//! on its thread *hangs*, and that component is the culprit; all others there are victims and are not
//! judged for as long as it lasts. Where the beat goes on, a handler whose turn stands *waits*.
//!
//! A culprit is not condemned by what the scanner itself missed: when it was not scheduled for a
//! while, everything seen before is void.

use crate::occupancy::Occupancy;
use crate::{Incarnation, Instant, Machine, ObjectName};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// The number of an arbiter.
pub type ArbiterId = u64;
/// The number of a component's place in the table of stamps.
pub type SlotId = u32;

/// When the scanner believes what it sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ScannerConfig {
    /// How long a fenced arbiter may take to come back before its components are re-created
    /// elsewhere. Longer spares more restarts; the victims stand still meanwhile.
    pub grace: Duration,
    /// How far apart two looks may be. More means that the scanner itself was not scheduled. Ten of
    /// the usual intervals: shorter voids good observations on a busy machine.
    pub gap: Duration,
    /// How long a beat may stand before the arbiter's components are no longer judged for silence.
    /// Several beats, and well below the shortest tolerance for silence.
    pub standstill: Duration,
}

impl Default for ScannerConfig {
    fn default() -> Self {
        ScannerConfig {
            grace: Duration::from_millis(200),
            gap: Duration::from_millis(100),
            standstill: Duration::from_millis(50),
        }
    }
}

/// How one component is judged.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Judged {
    /// Who.
    pub object: ObjectName,
    /// The arbiter that it lives on.
    pub arbiter: ArbiterId,
    /// How long its handler may keep the arbiter.
    pub max_block: Duration,
    /// How long its handler may await something.
    pub max_wait: Duration,
    /// How long it may give no sign of life, if it is expected to.
    pub max_silence: Option<MaxSilence>,
}

/// How long a component may give no sign of life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MaxSilence {
    /// From being at work to a life's first sign.
    pub first: Duration,
    /// From then on, between two of them.
    pub between: Duration,
}

/// What an arbiter says about itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PulseReading {
    /// Counts up while the event loop turns.
    pub beat: u64,
    /// The component that is on the thread.
    pub running: Option<SlotId>,
    /// That component's turn; `None` where it is no longer judged.
    pub turn: Option<u64>,
    /// It has been fenced and has not come back yet.
    pub fenced: bool,
}

/// What a component says about itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StampReading {
    /// Odd while something is in service.
    pub turn: u64,
    /// Signs of life.
    pub alive: u64,
    /// Which of its lives.
    pub incarnation: Incarnation,
    /// Signs of life are to be expected now.
    pub speaks: bool,
    /// The component has announced that it takes up to so long; zero for as usual.
    pub allowance: Duration,
}

/// What the scanner has seen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sighting {
    /// A handler keeps its arbiter.
    Hangs {
        /// The culprit's place.
        slot: SlotId,
        /// The culprit.
        object: ObjectName,
        /// Since when, at least.
        age: Duration,
        /// Who stands still behind it.
        victims: Vec<ObjectName>,
    },
    /// A handler awaits something for too long.
    Waits {
        /// Its component's place.
        slot: SlotId,
        /// Its component.
        object: ObjectName,
        /// Which life.
        incarnation: Incarnation,
        /// Since when, at least.
        age: Duration,
    },
    /// A component that should give signs of life gives none.
    Silent {
        /// Who.
        object: ObjectName,
        /// Which life.
        incarnation: Incarnation,
        /// For how long, at least.
        silent_for: Duration,
    },
    /// A component that was silent gives signs of life again.
    Spoke {
        /// Who.
        object: ObjectName,
        /// Which life.
        incarnation: Incarnation,
    },
    /// An arbiter that hung turns again.
    Resumed {
        /// Who stood still on it and still lives there.
        objects: Vec<ObjectName>,
    },
    /// The grace time of a fenced arbiter is over.
    Lost {
        /// Which.
        arbiter: ArbiterId,
        /// Whose handler keeps it.
        culprit: ObjectName,
        /// Who still lives on it and must be re-created elsewhere.
        victims: Vec<ObjectName>,
    },
    /// The scanner was not scheduled; everything seen before is void.
    Stalled {
        /// For how long.
        gap: Duration,
    },
}

/// What is known of an arbiter, for people.
#[derive(Clone, Debug, PartialEq)]
pub struct ArbiterSeen {
    /// The share of the latest looks that found a component on its thread; `None` before the first.
    pub busy: Option<f32>,
    /// Whose handler keeps it for longer than it may, and since when, at least.
    pub hangs: Option<(ObjectName, Instant)>,
}

#[derive(Debug)]
struct Arbiter {
    beat: u64,
    running: Option<SlotId>,
    turn: Option<u64>,
    /// When these were first seen.
    since: Instant,
    /// When this beat was first seen.
    beat_since: Instant,
    occupancy: Occupancy,
    hang: Option<Hang>,
    fenced_since: Option<Instant>,
    lost: bool,
}

#[derive(Debug)]
struct Hang {
    culprit: ObjectName,
    slot: SlotId,
}

#[derive(Debug)]
struct Component {
    judged: Judged,
    reading: Option<StampReading>,
    turn_since: Instant,
    alive_since: Instant,
    /// This turn has been reported.
    waits: bool,
    /// This life has given a sign.
    heard: bool,
    silent: bool,
}

/// The judge. Shown pulses often and stamps less often, each time between
/// [`handle_look`](Scanner::handle_look) and draining the outputs.
#[derive(Debug)]
pub struct Scanner {
    config: ScannerConfig,
    looked_at: Option<Instant>,
    arbiters: BTreeMap<ArbiterId, Arbiter>,
    /// By slot; slots are dense.
    components: Vec<Option<Component>>,
    outputs: VecDeque<Sighting>,
}

impl Scanner {
    /// A scanner that has seen nothing yet.
    pub fn new(config: ScannerConfig) -> Self {
        Scanner {
            config,
            looked_at: None,
            arbiters: BTreeMap::new(),
            components: Vec::new(),
            outputs: VecDeque::new(),
        }
    }

    /// This component is judged from now on.
    pub fn handle_enter(&mut self, slot: SlotId, judged: Judged, now: Instant) {
        let at = slot as usize;
        if self.components.len() <= at {
            self.components.resize_with(at + 1, || None);
        }
        let (turn_since, alive_since) = (now, now);
        self.components[at] = Some(Component {
            judged,
            reading: None,
            turn_since,
            alive_since,
            waits: false,
            heard: false,
            silent: false,
        });
    }

    /// It is no longer.
    pub fn handle_leave(&mut self, slot: SlotId) {
        if let Some(place) = self.components.get_mut(slot as usize) {
            *place = None;
        }
    }

    /// An arbiter is no more.
    pub fn handle_gone(&mut self, arbiter: ArbiterId) {
        self.arbiters.remove(&arbiter);
    }

    /// A look begins.
    pub fn handle_look(&mut self, now: Instant) {
        let gap = self.looked_at.map_or(Duration::ZERO, |before| now - before);
        self.looked_at = Some(now);
        if gap <= self.config.gap {
            return;
        }
        for arbiter in self.arbiters.values_mut() {
            (arbiter.since, arbiter.beat_since) = (now, now);
            arbiter.fenced_since = arbiter.fenced_since.map(|_| now);
        }
        for component in self.components.iter_mut().flatten() {
            (component.turn_since, component.alive_since) = (now, now);
        }
        self.outputs.push_back(Sighting::Stalled { gap });
    }

    /// What an arbiter says.
    pub fn handle_pulse(&mut self, id: ArbiterId, reading: PulseReading, now: Instant) {
        let arbiter = self.arbiters.entry(id).or_insert(Arbiter {
            beat: reading.beat,
            running: reading.running,
            turn: reading.turn,
            since: now,
            beat_since: now,
            occupancy: Occupancy::default(),
            hang: None,
            fenced_since: None,
            lost: false,
        });
        arbiter.occupancy.note(reading.running.is_some());
        let beats = arbiter.beat != reading.beat;
        if beats {
            arbiter.beat_since = now;
        }
        // A culprit that was given up meanwhile has not thereby moved on.
        let turned = reading.turn.is_some() && arbiter.turn != reading.turn;
        let changed = beats || arbiter.running != reading.running || turned;
        if changed {
            (arbiter.beat, arbiter.running) = (reading.beat, reading.running);
            (arbiter.turn, arbiter.since) = (reading.turn, now);
        }
        arbiter.fenced_since = reading.fenced.then(|| arbiter.fenced_since.unwrap_or(now));
        let age = now - arbiter.since;
        let resumed = if changed { arbiter.hang.take() } else { None };
        let lost = !arbiter.lost
            && arbiter.fenced_since.is_some_and(|since| now - since >= self.config.grace);
        if let Some(hang) = resumed {
            self.resume(id, &hang, now);
        }
        self.judge_arbiter(id, age);
        if lost {
            self.lose(id, reading.running);
        }
    }

    fn judge_arbiter(&mut self, id: ArbiterId, age: Duration) {
        let Some(arbiter) = self.arbiters.get(&id) else { return };
        let (Some(slot), None) = (arbiter.running, &arbiter.hang) else { return };
        let Some(culprit) = self.component(slot) else { return };
        let allowance = culprit.reading.map_or(Duration::ZERO, |reading| reading.allowance);
        if age < culprit.judged.max_block.max(allowance) || culprit.judged.arbiter != id {
            return;
        }
        let object = culprit.judged.object.clone();
        let victims = self.others_on(id, slot);
        if let Some(arbiter) = self.arbiters.get_mut(&id) {
            arbiter.hang = Some(Hang { culprit: object.clone(), slot });
        }
        self.outputs.push_back(Sighting::Hangs { slot, object, age, victims });
    }

    fn resume(&mut self, id: ArbiterId, hang: &Hang, now: Instant) {
        let mut objects = self.others_on(id, hang.slot);
        let culprit = self.component(hang.slot);
        objects.extend(culprit.map(|culprit| culprit.judged.object.clone()));
        // Who stood still had no chance to speak.
        for component in self.components.iter_mut().flatten() {
            if component.judged.arbiter == id {
                (component.turn_since, component.alive_since) = (now, now);
            }
        }
        let lost = self.arbiters.get(&id).is_some_and(|arbiter| arbiter.lost);
        if !lost {
            self.outputs.push_back(Sighting::Resumed { objects });
        }
    }

    fn lose(&mut self, id: ArbiterId, running: Option<SlotId>) {
        let Some(arbiter) = self.arbiters.get_mut(&id) else { return };
        arbiter.lost = true;
        let hang = arbiter.hang.as_ref().map(|hang| (hang.culprit.clone(), hang.slot));
        let known = hang.or_else(|| {
            let slot = running?;
            Some((self.component(slot)?.judged.object.clone(), slot))
        });
        let Some((culprit, slot)) = known else { return };
        let victims = self.others_on(id, slot);
        self.outputs.push_back(Sighting::Lost { arbiter: id, culprit, victims });
    }

    fn component(&self, slot: SlotId) -> Option<&Component> {
        self.components.get(slot as usize)?.as_ref()
    }

    fn others_on(&self, arbiter: ArbiterId, but: SlotId) -> Vec<ObjectName> {
        let others = self.components.iter().enumerate().filter(|(at, _)| *at != but as usize);
        let others = others.filter_map(|(_, component)| component.as_ref());
        let here = others.filter(|component| component.judged.arbiter == arbiter);
        here.map(|component| component.judged.object.clone()).collect()
    }

    /// What is known of every arbiter.
    pub fn arbiters(&self) -> impl Iterator<Item = (ArbiterId, ArbiterSeen)> + '_ {
        self.arbiters.iter().map(|(id, arbiter)| {
            let hangs = arbiter.hang.as_ref().map(|hang| (hang.culprit.clone(), arbiter.since));
            (*id, ArbiterSeen { busy: arbiter.occupancy.share(), hangs })
        })
    }

    /// Which components have something in service, which turn it is, and since when at least; by slot.
    pub fn busy(&self) -> impl Iterator<Item = (SlotId, u64, Instant)> + '_ {
        let known = (0..).zip(&self.components);
        known.filter_map(|(slot, component)| {
            let component = component.as_ref()?;
            let turn = component.reading?.turn;
            (turn % 2 == 1).then_some((slot, turn, component.turn_since))
        })
    }

    /// Looks at all components; `read` gives what the component of a slot says.
    pub fn handle_stamps(&mut self, now: Instant, mut read: impl FnMut(SlotId) -> StampReading) {
        let Scanner { config, arbiters, components, outputs, .. } = self;
        for (slot, place) in (0..).zip(components) {
            let Some(component) = place else { continue };
            let arbiter = arbiters.get(&component.judged.arbiter);
            let stands =
                arbiter.is_some_and(|arbiter| now - arbiter.beat_since > config.standstill);
            component.handle(slot, read(slot), stands, now, outputs);
        }
    }
}

impl Component {
    fn handle(
        &mut self,
        slot: SlotId,
        reading: StampReading,
        stands: bool,
        now: Instant,
        outputs: &mut VecDeque<Sighting>,
    ) {
        let before = self.reading.replace(reading);
        if before.is_none_or(|before| before.incarnation != reading.incarnation) {
            (self.turn_since, self.alive_since) = (now, now);
            (self.waits, self.heard, self.silent) = (false, false, false);
            return;
        }
        let before = before.unwrap_or(reading);
        if before.turn != reading.turn {
            self.turn_since = now;
            self.waits = false;
        }
        let object = &self.judged.object;
        if before.alive != reading.alive || !reading.speaks {
            self.alive_since = now;
            self.heard |= before.alive != reading.alive;
            if self.silent && before.alive != reading.alive {
                self.silent = false;
                let (object, incarnation) = (object.clone(), reading.incarnation);
                outputs.push_back(Sighting::Spoke { object, incarnation });
            }
        }
        if stands {
            self.alive_since = now;
            return; // Judged as a victim, or as a culprit, not for itself.
        }
        let age = now - self.turn_since;
        let limit = self.judged.max_wait.max(reading.allowance);
        if reading.turn % 2 == 1 && !self.waits && age >= limit {
            self.waits = true;
            let (object, incarnation) = (object.clone(), reading.incarnation);
            outputs.push_back(Sighting::Waits { slot, object, incarnation, age });
        }
        let silent_for = now - self.alive_since;
        let limit = self.judged.max_silence;
        let limit = limit.map(|limit| if self.heard { limit.between } else { limit.first });
        if let Some(limit) = limit
            && !self.silent
            && silent_for >= limit.max(reading.allowance)
        {
            self.silent = true;
            let (object, incarnation) = (object.clone(), reading.incarnation);
            outputs.push_back(Sighting::Silent { object, incarnation, silent_for });
        }
    }
}

impl Machine for Scanner {
    type Output = Sighting;

    fn poll_output(&mut self) -> Option<Sighting> {
        self.outputs.pop_front()
    }

    /// The scanner is shown things at even intervals and wants nothing in between.
    fn poll_timeout(&self) -> Option<Instant> {
        None
    }

    fn handle_timeout(&mut self, _now: Instant) {}
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOME: ArbiterId = 7;

    fn name(text: &str) -> ObjectName {
        ObjectName::new(text).unwrap()
    }

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn ms(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    fn judged(object: &str) -> Judged {
        Judged {
            object: name(object),
            arbiter: HOME,
            max_block: ms(500),
            max_wait: ms(1000),
            max_silence: Some(MaxSilence { first: ms(600), between: ms(300) }),
        }
    }

    /// A scanner with a culprit in slot 0 and a victim in slot 2, and the world that it looks at.
    struct World {
        scanner: Scanner,
        now: u64,
        pulse: PulseReading,
        stamps: [StampReading; 3],
    }

    impl World {
        fn new() -> Self {
            let mut scanner = Scanner::new(ScannerConfig::default());
            scanner.handle_enter(0, judged("culprit"), at(0));
            scanner.handle_enter(2, judged("victim"), at(0));
            let stamp = StampReading {
                turn: 0,
                alive: 0,
                incarnation: Incarnation(1),
                speaks: false,
                allowance: Duration::ZERO,
            };
            let pulse = PulseReading { beat: 0, running: None, turn: None, fenced: false };
            World { scanner, now: 0, pulse, stamps: [stamp; 3] }
        }

        /// Time passes; the arbiter beats or stands.
        fn pass(&mut self, millis: u64, beats: bool) -> Vec<Sighting> {
            let mut seen = Vec::new();
            for _ in 0..millis / 10 {
                self.now += 10;
                self.pulse.beat += u64::from(beats);
                seen.extend(self.look());
            }
            seen
        }

        fn look(&mut self) -> Vec<Sighting> {
            let now = at(self.now);
            self.scanner.handle_look(now);
            self.scanner.handle_pulse(HOME, self.pulse, now);
            let stamps = self.stamps;
            self.scanner.handle_stamps(now, |slot| stamps[slot as usize]);
            std::iter::from_fn(|| self.scanner.poll_output()).collect()
        }
    }

    #[test]
    fn an_arbiter_that_turns_is_left_alone() {
        let mut world = World::new();
        world.pulse.running = Some(0);
        assert_eq!(world.pass(5000, true), []);
    }

    #[test]
    fn a_handler_that_keeps_its_arbiter_is_the_culprit_and_is_named_once() {
        let mut world = World::new();
        world.pass(100, true);
        (world.pulse.running, world.pulse.turn) = (Some(0), Some(1));
        world.stamps[0].turn = 1;

        let seen = world.pass(2000, false);

        let victims = vec![name("victim")];
        let object = name("culprit");
        assert_eq!(seen, [Sighting::Hangs { slot: 0, object, age: ms(500), victims }]);
        assert_eq!(world.scanner.poll_timeout(), None);
        world.scanner.handle_timeout(at(3000));
        assert_eq!(world.scanner.poll_output(), None);
    }

    #[test]
    fn an_arbiter_on_which_nobody_runs_has_no_culprit() {
        let mut world = World::new();
        assert_eq!(world.pass(5000, false), []);
        world.pulse.running = Some(1); // Nobody's place.
        assert_eq!(world.pass(5000, false), []);
    }

    #[test]
    fn many_turns_in_one_poll_are_no_hang() {
        let mut world = World::new();
        world.pulse.running = Some(0);
        for turns in 1..20 {
            world.pulse.turn = Some(2 * turns);
            assert_eq!(world.pass(400, false), []);
        }
    }

    #[test]
    fn a_declared_long_operation_is_no_hang_before_its_time() {
        let mut world = World::new();
        world.stamps[0].allowance = ms(2000);
        world.stamps[0].turn = 1;
        world.pass(20, true);
        (world.pulse.running, world.pulse.turn) = (Some(0), Some(1));

        assert_eq!(world.pass(2000, false), []);

        assert!(matches!(world.pass(20, false)[..], [Sighting::Hangs { .. }]));
    }

    #[test]
    fn a_hang_that_ends_is_resumed_and_nobody_is_silent_for_it() {
        let mut world = World::new();
        world.stamps.iter_mut().for_each(|stamp| stamp.speaks = true);
        world.look();
        world.pulse.running = Some(0);
        assert_eq!(world.pass(600, false).len(), 1);

        world.pulse.running = None;
        let seen = world.pass(200, true);

        let objects = vec![name("victim"), name("culprit")];
        assert_eq!(seen, [Sighting::Resumed { objects }]);
    }

    #[test]
    fn a_fenced_arbiter_is_lost_when_its_grace_is_over() {
        let mut world = World::new();
        (world.pulse.running, world.pulse.turn) = (Some(0), Some(1));
        world.pass(600, false);
        world.scanner.handle_leave(0); // The culprit was given up.
        (world.pulse.fenced, world.pulse.turn) = (true, None);

        let seen = world.pass(1000, false);

        let (culprit, victims) = (name("culprit"), vec![name("victim")]);
        assert_eq!(seen, [Sighting::Lost { arbiter: HOME, culprit, victims }]);
        assert_eq!(world.pass(100, true), [], "what comes back now comes too late");
        world.scanner.handle_gone(HOME);
        assert_eq!(world.pass(100, true), []);
    }

    #[test]
    fn a_fence_that_is_lifted_in_time_loses_nothing() {
        let mut world = World::new();
        world.pulse.running = Some(0);
        world.pass(600, false);
        world.scanner.handle_leave(0);
        world.pulse.fenced = true;
        assert_eq!(world.pass(150, false), []);

        world.pulse.fenced = false;
        let seen = world.pass(1000, true);

        assert_eq!(seen, [Sighting::Resumed { objects: vec![name("victim")] }]);
    }

    #[test]
    fn a_handler_that_awaits_too_long_waits_and_is_named_once_per_turn() {
        let mut world = World::new();
        world.look();
        world.stamps[2].turn = 1;

        let seen = world.pass(3000, true);

        let (object, incarnation) = (name("victim"), Incarnation(1));
        let waits = Sighting::Waits { slot: 2, object, incarnation, age: ms(1000) };
        assert_eq!(seen, [waits]);
        let busy: Vec<_> = world.scanner.busy().map(|(slot, turn, _)| (slot, turn)).collect();
        assert_eq!(busy, [(2, 1)]);
        world.stamps[2].turn = 3;
        assert_eq!(world.pass(3000, true).len(), 1);
        world.stamps[2].turn = 4;
        assert_eq!(world.pass(3000, true), []);
    }

    #[test]
    fn silence_is_reported_once_and_ended_by_a_sign_of_life() {
        let mut world = World::new();
        world.stamps[0].speaks = true;
        world.look();
        for _ in 0..5 {
            world.stamps[0].alive += 1;
            assert_eq!(world.pass(290, true), []);
        }

        let seen = world.pass(1000, true);
        let (object, incarnation) = (name("culprit"), Incarnation(1));
        let silent_for = ms(300);
        let silent = Sighting::Silent { object: object.clone(), incarnation, silent_for };
        assert_eq!(seen, [silent]);

        world.stamps[0].alive += 1;
        assert_eq!(world.pass(100, true), [Sighting::Spoke { object, incarnation }]);
    }

    #[test]
    fn silence_counts_only_where_signs_are_expected() {
        let mut world = World::new();
        assert_eq!(world.pass(1000, true), []);
        world.stamps[0].speaks = true;
        assert_eq!(world.pass(590, true), []);
        world.stamps[0].allowance = ms(1000);
        assert_eq!(world.pass(400, true), [], "a long operation was declared");
        let mut quiet = judged("quiet");
        quiet.max_silence = None;
        world.scanner.handle_enter(0, quiet, at(world.now));
        assert_eq!(world.pass(5000, true), []);
    }

    #[test]
    fn a_new_life_begins_with_a_clean_record() {
        let mut world = World::new();
        (world.stamps[0].speaks, world.stamps[0].turn) = (true, 1);
        world.look();
        assert_eq!(world.pass(1000, true).len(), 2, "silent and waiting");

        world.stamps[0].incarnation = Incarnation(2);
        assert_eq!(world.pass(590, true), [], "its first sign may take longer");
        assert_eq!(world.pass(100, true).len(), 1, "silent again");
    }

    #[test]
    fn what_the_scanner_missed_condemns_nobody() {
        let mut world = World::new();
        world.stamps[0].speaks = true;
        world.stamps[2].turn = 1;
        world.pulse.running = Some(0);
        world.pulse.fenced = true;
        world.look();

        world.now += 60_000;
        let seen = world.look();

        assert_eq!(seen, [Sighting::Stalled { gap: ms(60_000) }]);
        assert_eq!(world.pass(190, false), []);
    }

    #[test]
    fn a_stall_of_the_scanner_does_not_end_a_hang() {
        let mut world = World::new();
        world.pulse.running = Some(0);
        assert_eq!(world.pass(600, false).len(), 1);

        world.now += 60_000;

        assert_eq!(world.look(), [Sighting::Stalled { gap: ms(60_000) }]);
        assert_eq!(world.pass(1000, false), [], "it was named before");
    }
}
