//! Workers, one look after the other.

use super::*;
use crate::Incarnation;
use crate::testing::{at, object as name};
use std::sync::Arc;

/// An event of a component of which this was found.
macro_rules! found {
    ($finding:pat) => {
        LivenessEvent::Component { finding: $finding, .. }
    };
}

const HOME: ArbiterId = 7;

fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn judged(object: &str) -> JudgedComponent {
    JudgedComponent { object: name(object), arbiter: HOME, limits: Arc::new(limits()) }
}

fn judged_by(object: &str, limits: HangLimits) -> JudgedComponent {
    JudgedComponent { limits: Arc::new(limits), ..judged(object) }
}

fn limits() -> HangLimits {
    HangLimits {
        max_block: ms(500),
        max_wait: ms(1000),
        max_silence: Some(MaxSilence { first: ms(600), between: ms(300) }),
        max_unanswered: None,
        max_delay: ms(1000),
        max_missed_percent: 25,
    }
}

/// A scanner with a culprit in slot 0 and a victim in slot 2, and the world that it looks at.
struct World {
    scanner: HangDetector,
    now: u64,
    heartbeat: ArbiterSample,
    samples: Samples,
    /// Activity records are looked at with every so many heartbeats.
    every: u64,
    /// What the arbiter's thread has had of the processors, where the system reports it.
    processor: Option<ProcessorTime>,
}

struct Samples {
    activities: [ComponentSample; 3],
    queues: [QueueReading; 3],
}

impl Looked for Samples {
    fn activity(&self, slot: SlotId) -> ComponentSample {
        self.activities[slot as usize]
    }

    fn during(&self, _: SlotId) -> &'static str {
        "Turn"
    }

    fn queue(&self, slot: SlotId) -> QueueReading {
        self.queues[slot as usize]
    }
}

impl World {
    fn new() -> Self {
        let mut scanner = HangDetector::new(HangDetectorConfig::default());
        scanner.handle_enter(0, judged("culprit"));
        scanner.handle_enter(2, judged("victim"));
        let activity = ComponentSample {
            turn: 0,
            alive: 0,
            incarnation: Incarnation(1),
            speaks: false,
            allowance: Duration::ZERO,
            interval: Duration::ZERO,
            ticks: 0,
            missed_ticks: 0,
            expired: 0,
        };
        let heartbeat = ArbiterSample {
            beat: 0,
            running: None,
            activity: None,
            during: "Scan",
            fenced: false,
            used: None,
        };
        let queues = [QueueReading::default(); 3];
        World {
            scanner,
            now: 0,
            heartbeat,
            samples: Samples { activities: [activity; 3], queues },
            every: 1,
            processor: None,
        }
    }

    /// Time passes; the arbiter stands, ready to run, and gets so many of ten milliseconds.
    fn starve(&mut self, millis: u64, share: u64) -> Vec<LivenessEvent> {
        let mut seen = Vec::new();
        for _ in 0..millis / 10 {
            let used = self.heartbeat.used.unwrap_or_default() + ms(share);
            self.heartbeat.used = Some(used);
            seen.extend(self.pass(10, false));
        }
        seen
    }

    /// Time passes; the arbiter beats or stands.
    fn pass(&mut self, millis: u64, beats: bool) -> Vec<LivenessEvent> {
        let mut seen = Vec::new();
        for _ in 0..millis / 10 {
            self.now += 10;
            self.heartbeat.beat += u64::from(beats);
            seen.extend(self.look());
        }
        seen
    }

    fn look(&mut self) -> Vec<LivenessEvent> {
        let now = at(self.now);
        self.scanner.handle_look(now);
        // As the watch does: the culprit's activity record is read with the heartbeat.
        let read = |slot: SlotId| self.samples.activities.get(slot as usize).copied();
        let activity = self.heartbeat.running.filter(|slot| self.scanner.judged(*slot).is_some());
        let heartbeat = ArbiterSample { activity: activity.and_then(read), ..self.heartbeat };
        self.scanner.handle_heartbeat(HOME, heartbeat);
        if (self.now / 10).is_multiple_of(self.every) {
            if let Some(time) = self.processor {
                self.scanner.handle_processor_time(HOME, time);
            }
            self.scanner.handle_activities(&self.samples);
        }
        std::iter::from_fn(|| self.scanner.poll_output()).collect()
    }
}

#[test]
fn an_arbiter_that_turns_is_left_alone() {
    let mut world = World::new();
    world.heartbeat.running = Some(0);
    assert_eq!(world.pass(5000, true), []);
}

#[test]
fn a_handler_that_keeps_its_arbiter_is_the_culprit_and_is_named_once() {
    let mut world = World::new();
    world.pass(100, true);
    world.heartbeat.running = Some(0);
    world.samples.activities[0].turn = 1;

    let seen = world.pass(2000, false);

    let victims = [name("victim")].into();
    let (object, incarnation, during) = (name("culprit"), Incarnation(1), "Scan");
    let age = ms(500);
    assert_eq!(
        seen,
        [LivenessEvent::Component {
            object,
            incarnation,
            finding: Finding::Hangs { during, age, victims }
        }]
    );
    assert_eq!(world.scanner.poll_timeout(), None);
    world.scanner.handle_timeout(at(3000));
    assert_eq!(world.scanner.poll_output(), None);
}

#[test]
fn an_arbiter_on_which_no_component_runs_has_no_culprit() {
    let mut world = World::new();
    assert_eq!(world.pass(5000, false), []);
    world.heartbeat.running = Some(1); // A slot without a component.
    assert_eq!(world.pass(5000, false), []);
}

#[test]
fn many_turns_in_one_poll_are_no_hang() {
    let mut world = World::new();
    world.heartbeat.running = Some(0);
    for turns in 1..20 {
        world.samples.activities[0].turn = 2 * turns;
        assert_eq!(world.pass(400, false), []);
    }
}

#[test]
fn a_declared_long_operation_is_no_hang_before_its_time() {
    let mut world = World::new();
    world.samples.activities[0].allowance = ms(2000);
    world.samples.activities[0].turn = 1;
    world.pass(20, true);
    world.heartbeat.running = Some(0);

    assert_eq!(world.pass(2000, false), []);

    assert!(matches!(world.pass(20, false)[..], [found!(Finding::Hangs { .. })]));
}

#[test]
fn an_operation_declared_after_sampling_is_no_hang_with_a_short_limit() {
    let mut world = World::new();
    world.every = 10;
    let quick = judged_by("culprit", HangLimits { max_block: ms(20), ..limits() });
    world.scanner.handle_enter(0, quick);
    world.pass(110, true);

    (world.samples.activities[0].turn, world.samples.activities[0].allowance) = (1, ms(2000));
    world.heartbeat.running = Some(0);

    assert_eq!(world.pass(1990, false), []);
    assert!(matches!(world.pass(20, false)[..], [found!(Finding::Hangs { .. })]));
}

#[test]
fn what_follows_a_declared_operation_in_its_turn_has_a_time_of_its_own() {
    let mut world = World::new();
    (world.samples.activities[0].turn, world.samples.activities[0].allowance) = (1, ms(2000));
    world.heartbeat.running = Some(0);
    assert_eq!(world.pass(1500, false), []);

    world.samples.activities[0].allowance = Duration::ZERO;

    assert_eq!(world.pass(490, false), []);
    assert!(matches!(world.pass(30, false)[..], [found!(Finding::Hangs { .. })]));
}

#[test]
fn who_was_given_up_before_it_was_found_to_hang_still_moves_its_victims() {
    let mut world = World::new();
    world.heartbeat.running = Some(0);
    world.pass(100, false);
    world.scanner.handle_leave(0);
    world.heartbeat.fenced = true;

    let seen = world.pass(1000, false);

    let (culprit, victims) = (name("culprit"), [name("victim")].into());
    assert_eq!(seen, [LivenessEvent::Lost { arbiter: HOME, culprit, victims }]);
}

#[test]
fn a_victim_is_measured_from_the_end_of_the_hang() {
    let mut world = World::new();
    world.samples.activities[2].speaks = true;
    world.look();
    world.heartbeat.running = Some(0);
    let seen = world.pass(1000, false);
    let (object, incarnation) = (name("victim"), Incarnation(1));
    let silent = |silent_for| LivenessEvent::Component {
        object: object.clone(),
        incarnation,
        finding: Finding::Silent { age: silent_for },
    };
    let [found!(Finding::Hangs { .. }), after] = &seen[..] else { panic!("{seen:?}") };
    assert_eq!(*after, silent(ms(600)));

    world.heartbeat.running = None;
    let seen = world.pass(500, true);

    let objects = [name("victim"), name("culprit")].into();
    assert_eq!(seen, [LivenessEvent::Resumed { objects }]);
    assert_eq!(world.pass(200, true), [silent(ms(600))], "it is silent of itself");
    world.samples.activities[2].alive += 1;
    let spoke =
        LivenessEvent::Component { object: object.clone(), incarnation, finding: Finding::Spoke };
    assert_eq!(world.pass(100, true), [spoke], "once");
}

#[test]
fn a_fenced_arbiter_is_lost_when_its_grace_is_over() {
    let mut world = World::new();
    world.heartbeat.running = Some(0);
    world.pass(600, false);
    world.scanner.handle_leave(0); // The culprit was given up.
    world.heartbeat.fenced = true;

    let seen = world.pass(1000, false);

    let (culprit, victims) = (name("culprit"), [name("victim")].into());
    assert_eq!(seen, [LivenessEvent::Lost { arbiter: HOME, culprit, victims }]);
    assert_eq!(world.pass(100, true), [], "what comes back now comes too late");
    world.scanner.handle_gone(HOME);
    assert_eq!(world.pass(100, true), []);
}

#[test]
fn a_fence_that_is_lifted_in_time_loses_nothing() {
    let mut world = World::new();
    world.heartbeat.running = Some(0);
    world.pass(600, false);
    world.scanner.handle_leave(0);
    world.heartbeat.fenced = true;
    assert_eq!(world.pass(150, false), []);

    world.heartbeat.fenced = false;
    let seen = world.pass(1000, true);

    assert_eq!(seen, [LivenessEvent::Resumed { objects: [name("victim")].into() }]);
}

#[test]
fn a_handler_that_awaits_too_long_waits_and_is_named_once_per_turn() {
    let mut world = World::new();
    world.look();
    world.samples.activities[2].turn = 1;

    let seen = world.pass(3000, true);

    let (object, incarnation) = (name("victim"), Incarnation(1));
    let (during, age) = ("Turn", ms(1000));
    let waits =
        LivenessEvent::Component { object, incarnation, finding: Finding::Waits { during, age } };
    assert_eq!(seen, [waits]);
    let busy: Vec<_> = world.scanner.busy().map(|(slot, turn, _)| (slot, turn)).collect();
    assert_eq!(busy, [(2, 1)]);
    world.samples.activities[2].turn = 3;
    let seen = world.pass(3000, true);
    assert!(matches!(seen[..], [LivenessEvent::Resumed { .. }, found!(Finding::Waits { .. })]));
}

#[test]
fn the_end_of_a_long_wait_is_reported_once() {
    let mut world = World::new();
    world.look();
    world.samples.activities[2].turn = 1;
    world.pass(1500, true);

    world.samples.activities[2].turn = 2;

    assert_eq!(
        world.pass(100, true),
        [LivenessEvent::Resumed { objects: [name("victim")].into() }]
    );
    world.samples.activities[2].turn = 4;
    assert_eq!(world.pass(3000, true), []);
}

#[test]
fn an_excused_silence_does_not_move_the_last_sign_of_life() {
    let mut world = World::new();
    world.samples.activities[2].speaks = true;
    world.look();
    let last = |world: &World| world.scanner.last_signs().collect::<Vec<_>>();
    assert_eq!(last(&world), [(2, None)], "it gave none so far, and the other need give none");

    world.samples.activities[2].alive = 1;
    world.pass(10, true);
    world.pass(100, true);
    assert_eq!(last(&world), [(2, Some(at(10)))]);
    world.heartbeat.running = Some(0);
    world.pass(5000, false);
    assert_eq!(last(&world), [(2, Some(at(10)))], "a victim gives none");
    world.samples.activities[2].incarnation = Incarnation(2);
    world.look();
    assert_eq!(last(&world), [(2, None)]);
}

#[test]
fn silence_is_reported_once_and_ended_by_a_sign_of_life() {
    let mut world = World::new();
    world.samples.activities[0].speaks = true;
    world.look();
    for _ in 0..5 {
        world.samples.activities[0].alive += 1;
        assert_eq!(world.pass(290, true), []);
    }

    let seen = world.pass(1000, true);
    let (object, incarnation) = (name("culprit"), Incarnation(1));
    let silent_for = ms(300);
    let silent = LivenessEvent::Component {
        object: object.clone(),
        incarnation,
        finding: Finding::Silent { age: silent_for },
    };
    assert_eq!(seen, [silent]);

    world.samples.activities[0].alive += 1;
    assert_eq!(
        world.pass(100, true),
        [LivenessEvent::Component { object, incarnation, finding: Finding::Spoke }]
    );
}

#[test]
fn silence_counts_only_where_signs_are_expected() {
    let mut world = World::new();
    assert_eq!(world.pass(1000, true), []);
    world.samples.activities[0].speaks = true;
    assert_eq!(world.pass(590, true), []);
    world.samples.activities[0].allowance = ms(1000);
    assert_eq!(world.pass(400, true), [], "a long operation was declared");
    let quiet = judged_by("quiet", HangLimits { max_silence: None, ..limits() });
    world.scanner.handle_enter(0, quiet);
    assert_eq!(world.pass(5000, true), []);
}

#[test]
fn a_new_incarnation_begins_with_a_clean_record() {
    let mut world = World::new();
    (world.samples.activities[0].speaks, world.samples.activities[0].turn) = (true, 1);
    world.look();
    assert_eq!(world.pass(1000, true).len(), 2, "silent and waiting");

    world.samples.activities[0].incarnation = Incarnation(2);
    assert_eq!(world.pass(590, true), [], "its first sign may take longer");
    assert_eq!(world.pass(100, true).len(), 1, "silent again");
}

#[test]
fn what_the_scanner_missed_condemns_nobody() {
    let mut world = World::new();
    world.samples.activities[0].speaks = true;
    world.samples.activities[2].turn = 1;
    world.heartbeat.running = Some(0);
    world.heartbeat.fenced = true;
    world.look();

    world.now += 60_000;
    let seen = world.look();

    assert_eq!(seen, [LivenessEvent::Stalled { gap: ms(60_000) }]);
    assert_eq!(world.pass(170, false), []);
}

#[test]
fn a_hang_is_found_though_the_scanner_is_late_at_every_look() {
    let mut world = World::new();
    world.heartbeat.running = Some(0);
    world.samples.activities[0].turn = 1;
    world.look();

    let mut seen = Vec::new();
    for _ in 0..30 {
        world.now += 150;
        seen.extend(world.look());
    }

    let reported = seen.iter().filter(|reported| matches!(reported, found!(Finding::Hangs { .. })));
    assert_eq!(reported.count(), 1, "{seen:?}");
    let (_, status) = world.scanner.arbiters().next().expect("it was shown one");
    assert_eq!(status.hangs.map(|(_, since)| since), Some(at(0)));
}

#[test]
fn a_handler_hangs_by_the_time_that_its_thread_was_given_the_processor() {
    let mut world = World::new();
    world.heartbeat.running = Some(0);
    world.samples.activities[2].speaks = true;
    world.look();

    assert_eq!(world.starve(1500, 2), [], "neither is its victim silent: it had 300 ms");
    let seen = world.starve(1500, 2);
    let [found!(Finding::Hangs { age, .. }), found!(Finding::Silent { .. })] = seen[..] else {
        panic!("{seen:?}")
    };
    assert!(age > ms(2400) && age < ms(2600), "{age:?}");
}

#[test]
fn a_handler_whose_thread_is_not_run_hangs_only_once_it_was_run_for_its_limit() {
    let mut world = World::new();
    world.heartbeat.running = Some(0);
    world.look();

    assert_eq!(world.starve(60_000, 0), []);
    assert_eq!(world.starve(480, 10), []);
    assert!(matches!(world.starve(30, 10)[..], [found!(Finding::Hangs { .. })]));
}

/// Looks that come late, and see the thread ready to run, until one finds a hang. Between two of
/// them it is run for so many milliseconds. Answers when it is found.
fn looks_until_a_hang(world: &mut World, late: u64, mut run: impl FnMut(u64) -> u64) -> u64 {
    world.heartbeat.used = Some(Duration::ZERO);
    world.heartbeat.running = Some(0);
    world.look();
    for look in 1..1000 {
        world.now += late;
        world.heartbeat.used = world.heartbeat.used.map(|used| used + ms(run(look)));
        let hangs = |seen: &LivenessEvent| matches!(seen, found!(Finding::Hangs { .. }));
        if world.look().iter().any(hangs) {
            return world.now;
        }
    }
    panic!("it is found")
}

#[test]
fn all_that_a_thread_was_run_for_between_late_looks_is_charged() {
    assert_eq!(looks_until_a_hang(&mut World::new(), 90, |_| 50), 10 * 90);
    let in_turns = |look: u64| if look.is_multiple_of(5) { 100 } else { 0 };
    assert_eq!(looks_until_a_hang(&mut World::new(), 90, in_turns), 25 * 90);
}

#[test]
fn a_thread_whose_time_is_counted_late_is_charged_no_more_than_has_passed() {
    // The kernel counts once a second, and what was run before this handler with it.
    let count = |look: u64| if look % 100 == 1 { 1000 } else { 0 };
    assert_eq!(looks_until_a_hang(&mut World::new(), 10, count), 101 * 10);
}

#[test]
fn a_handler_that_waits_or_is_run_all_the_time_hangs_after_its_limit() {
    for share in [None, Some(10)] {
        let mut world = World::new();
        world.heartbeat.running = Some(0);
        world.look();
        let mut pass = |millis| match share {
            Some(share) => world.starve(millis, share),
            None => world.pass(millis, false),
        };

        assert_eq!(pass(490), []);
        assert!(matches!(pass(20)[..], [found!(Finding::Hangs { .. })]));
    }
}

#[test]
fn a_stall_of_the_scanner_does_not_end_a_hang() {
    let mut world = World::new();
    world.heartbeat.running = Some(0);
    assert_eq!(world.pass(600, false).len(), 1);

    world.now += 60_000;

    assert_eq!(world.look(), [LivenessEvent::Stalled { gap: ms(60_000) }]);
    assert_eq!(world.pass(1000, false), [], "it was named before");
}

mod overload;

/// What a scanner looks at, and how often it looks at it closely.
struct Counted<'a> {
    samples: &'a Samples,
    looks: std::cell::Cell<u32>,
}

impl Looked for Counted<'_> {
    fn activity(&self, slot: SlotId) -> ComponentSample {
        self.looks.set(self.looks.get() + 1);
        self.samples.activity(slot)
    }

    fn mark(&self, slot: SlotId) -> ActivityMark {
        self.samples.mark(slot)
    }

    fn during(&self, _: SlotId) -> &'static str {
        "Turn"
    }

    fn queue(&self, slot: SlotId) -> QueueReading {
        self.looks.set(self.looks.get() + 1);
        self.samples.queue(slot)
    }
}

/// Two components, of which no sign is expected, that have been looked at until they rest.
fn at_rest() -> World {
    let mut world = World::new();
    let quiet = |name| judged_by(name, HangLimits { max_silence: None, ..limits() });
    world.scanner.handle_enter(0, quiet("culprit"));
    world.scanner.handle_enter(2, quiet("victim"));
    assert_eq!(world.pass(100, true), []);
    world
}

#[test]
fn a_component_that_rests_is_only_compared_with_its_mark() {
    let mut world = at_rest();
    let close = |world: &mut World| {
        world.now += 100;
        world.scanner.handle_look(at(world.now));
        let looked = Counted { samples: &world.samples, looks: Default::default() };
        world.scanner.handle_activities(&looked);
        looked.looks.get()
    };
    assert_eq!(close(&mut world), 0);

    world.samples.activities[2].turn += 2;
    assert!(close(&mut world) > 0, "it has served something");
    assert!(close(&mut world) > 0, "it may do so again");
    assert_eq!(close(&mut world), 0, "it rests again");
}

#[test]
fn a_component_that_has_rested_is_judged_from_when_it_took_something_up() {
    let mut world = at_rest();
    world.pass(5000, true);

    world.samples.activities[2].turn += 1;

    assert_eq!(world.pass(1000, true), []);
    assert!(matches!(world.pass(20, true)[..], [found!(Finding::Waits { .. })]));
    assert_eq!(
        world.scanner.busy().map(|(slot, turn, _)| (slot, turn)).collect::<Vec<_>>(),
        [(2, 1)]
    );
}

#[test]
fn messages_that_expire_while_a_component_has_nothing_in_service_are_counted() {
    let mut world = at_rest();
    let mut seen = Vec::new();
    for _ in 0..30 {
        world.samples.activities[2].expired += 1;
        seen.extend(world.pass(100, true));
    }
    assert!(matches!(seen[..], [found!(Finding::Overloaded { .. }), ..]), "{seen:?}");
}

#[test]
fn one_that_rests_is_named_as_a_victim_and_as_a_culprit() {
    let mut world = at_rest();
    world.heartbeat.running = Some(0);
    let seen = world.pass(600, false);
    let [LivenessEvent::Component { object, finding: Finding::Hangs { victims, .. }, .. }] =
        &seen[..]
    else {
        panic!("{seen:?}")
    };
    assert_eq!((object, &victims[..]), (&name("culprit"), &[name("victim")][..]));
}
