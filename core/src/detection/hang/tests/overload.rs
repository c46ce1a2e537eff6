//! A planner (slot 0) that keeps the thread, and a neighbour (slot 2) behind it.

use super::*;
use crate::detection::NodeCondition;

/// A thread that the planner keeps by short handlers, while the neighbour's rounds are due every 20
/// ms.
struct Road {
    world: World,
    /// The planner's handlers keep so many of ten looks.
    kept: u64,
    /// The neighbour runs one round in so many looks; 0 for none. One is due in two.
    rounds: u64,
    /// Its rounds that wait for their turn.
    due: u64,
    planner_speaks: bool,
    /// The arbiter beats once in so many looks: a turn of many messages holds it up.
    beats: u64,
    /// Of each look of 10 ms, its thread runs and waits for a processor for so long.
    processor: Option<(u64, u64)>,
}

impl Road {
    fn new(kept: u64, rounds: u64) -> Self {
        let mut world = World::new();
        world.every = 10;
        world.samples.activities[2].interval = ms(20);
        world.samples.activities[2].speaks = true;
        // The planner is not expected to give signs of life.
        world.samples.activities[0].speaks = true;
        world
            .scanner
            .handle_enter(0, judged_by("culprit", HangLimits { max_silence: None, ..limits() }));
        Road { world, kept, rounds, due: 0, planner_speaks: false, beats: 3, processor: None }
    }

    fn pass(&mut self, millis: u64) -> Vec<(u64, LivenessEvent)> {
        let mut seen = Vec::new();
        for _ in 0..millis / 10 {
            let look = self.world.now / 10;
            let runs = look % 10 < self.kept;
            self.world.heartbeat.running = runs.then_some(0);
            // Each handler ends within 30 ms, so that no beat stands for long.
            self.world.samples.activities[0].turn += if runs { 2 } else { 0 };
            self.world.samples.activities[0].alive += u64::from(runs && self.planner_speaks);
            let neighbour = &mut self.world.samples.activities[2];
            self.due += u64::from(look.is_multiple_of(2));
            if self.rounds > 0 && look.is_multiple_of(self.rounds) {
                (neighbour.turn, neighbour.ticks) = (neighbour.turn + 2, neighbour.ticks + 1);
                neighbour.alive += 1;
                self.due = self.due.saturating_sub(1);
            }
            // One waits for its turn, and those behind it are missed.
            neighbour.missed_ticks += self.due.saturating_sub(1);
            self.due = self.due.min(1);
            if let Some((used, waited)) = self.processor {
                let time = self.world.processor.get_or_insert_default();
                (time.used, time.waited) = (time.used + ms(used), time.waited + ms(waited));
            }
            let reported = self.world.pass(10, look.is_multiple_of(self.beats));
            seen.extend(reported.into_iter().map(|event| (self.world.now, event)));
        }
        seen
    }
}

fn names(seen: &[(u64, LivenessEvent)]) -> Vec<String> {
    let text = |event: &LivenessEvent| match event {
        LivenessEvent::Component {
            object, finding: Finding::Overloaded { victims, .. }, ..
        } => {
            format!("{object} overloads {victims:?}")
        }
        LivenessEvent::Component { object, finding: Finding::Flows, .. } => {
            format!("{object} flows")
        }
        LivenessEvent::Computer(NodeCondition::Overloaded { waited_percent, victims, .. }) => {
            format!("the computer overloads {victims:?}: {waited_percent} %")
        }
        LivenessEvent::Component { object, finding: Finding::Silent { .. }, .. } => {
            format!("{object} is silent")
        }
        LivenessEvent::Component { object, finding: Finding::Spoke, .. } => {
            format!("{object} spoke")
        }
        other => format!("{other:?}"),
    };
    seen.iter().map(|(_, event)| text(event)).collect()
}

fn overloads() -> String {
    format!("culprit overloads {:?}", [name("victim")])
}

#[test]
fn the_component_that_keeps_the_thread_is_the_root_of_missed_rounds() {
    let mut road = Road::new(10, 3);
    road.world.samples.queues[0] = QueueReading { queued: 7, oldest: ms(400) };

    let seen = road.pass(10_000);

    assert_eq!(names(&seen), [overloads()], "once");
    let (when, found!(Finding::Overloaded { figures, .. })) = &seen[0] else { panic!("{seen:?}") };
    assert!(*when <= 3000, "{when}");
    assert_eq!((figures.utilisation_percent, figures.queued, figures.oldest), (100, 7, ms(400)));
    assert!((14..=20).contains(&figures.missed_rounds), "16 of 50 each second: {figures:?}");
}

#[test]
fn an_overload_is_reported_again_each_time_a_figure_has_doubled() {
    let mut road = Road::new(10, 3);
    let mut reported = Vec::new();
    for oldest in [400, 450, 500, 790, 800, 300, 1700] {
        road.world.samples.queues[0] = QueueReading { queued: 7, oldest: ms(oldest) };
        reported.extend(road.pass(3000));
    }

    let ages = |(_, seen): &(u64, LivenessEvent)| match seen {
        found!(Finding::Overloaded { figures, .. }) => figures.oldest,
        other => panic!("{other:?}"),
    };
    assert_eq!(reported.iter().map(ages).collect::<Vec<_>>(), [ms(400), ms(800), ms(1700)]);
}

#[test]
fn an_overload_is_over_when_the_load_has_been_gone_for_a_while_and_not_before() {
    let mut road = Road::new(10, 3);
    road.pass(5000);

    (road.kept, road.rounds) = (1, 2);
    let seen = road.pass(10_000);

    assert_eq!(names(&seen), ["culprit flows"]);
    assert!(seen[0].0 >= 8000 && seen[0].0 <= 10_000, "{seen:?}");
    (road.kept, road.rounds) = (10, 3);
    assert_eq!(names(&road.pass(5000)), [overloads()], "and comes again with the load");
}

#[test]
fn a_load_about_the_limit_is_one_overload_with_one_root() {
    let mut road = Road::new(10, 3);
    let mut seen = Vec::new();
    for _ in 0..8 {
        // A third of the rounds is missed, then none.
        for (rounds, millis) in [(3, 2300), (2, 1000)] {
            road.rounds = rounds;
            seen.extend(road.pass(millis));
        }
    }

    let all = names(&seen);
    assert!(all.iter().all(|name| *name == overloads()), "it stands: {all:?}");
    assert!(all.len() <= 2, "{all:?}");
}

#[test]
fn rounds_missed_for_lack_of_processor_are_the_computers_fault() {
    let mut road = Road::new(10, 3);
    road.processor = Some((2, 8));
    road.world.samples.queues[0] = QueueReading { queued: 64, oldest: ms(1500) };

    let seen = road.pass(20_000);

    let victims = [name("culprit"), name("victim")];
    let [first, rest @ ..] = &names(&seen)[..] else { panic!("{seen:?}") };
    assert!(first.starts_with("the computer overloads"), "{seen:?}");
    assert!(rest.len() <= 1, "once for each victim: {seen:?}");
    let last = names(&seen).pop().unwrap();
    assert_eq!(last, format!("the computer overloads {victims:?}: 80 %"));
}

#[test]
fn a_silence_for_lack_of_processor_is_the_computers_fault_alone() {
    let mut road = Road::new(10, 2);
    road.processor = Some((9, 1));
    road.pass(3000);
    (road.rounds, road.processor, road.beats) = (0, Some((1, 9)), 100);

    let seen = names(&road.pass(10_000));

    assert!(seen.iter().all(|seen| seen.starts_with("the computer overloads")), "{seen:?}");
    assert!(seen.len() <= 2, "once for each victim: {seen:?}");
}

#[test]
fn a_component_that_is_silent_though_its_thread_turns_is_so_of_itself_on_a_busy_computer_too() {
    let mut road = Road::new(1, 2);
    road.processor = Some((1, 9));
    road.pass(3000);
    road.rounds = 0;

    let seen = road.pass(20_000);

    let silent = |(_, name): &(usize, &String)| *name == "victim is silent";
    let all = names(&seen);
    let found: Vec<usize> = all.iter().enumerate().filter(silent).map(|(at, _)| at).collect();
    assert_eq!(found.len(), 1, "once: {all:?}");
    // The thread turns once in 30 ms, and in 10 ms where it is not kept from a processor.
    let when = seen[found[0]].0;
    assert!((3900..=4100).contains(&when), "{when}");

    road.rounds = 2;
    assert!(names(&road.pass(200)).contains(&"victim spoke".into()));
}

#[test]
fn a_thread_that_is_not_run_on_an_overloaded_computer_makes_no_component_silent_for_a_while() {
    let mut road = Road::new(3, 4);
    road.processor = Some((1, 5));
    assert!(names(&road.pass(10_000))[0].starts_with("the computer overloads"));

    // What it waits is added when it is run.
    (road.kept, road.rounds, road.beats, road.processor) = (0, 0, 1000, Some((0, 0)));
    let seen = names(&road.pass(2000));

    assert!(!seen.contains(&"victim is silent".into()), "{seen:?}");
}

#[test]
fn an_overload_of_the_computer_is_over_when_the_load_has_been_gone_for_a_while() {
    let mut road = Road::new(3, 4);
    road.processor = Some((1, 5));
    assert!(names(&road.pass(10_000))[0].starts_with("the computer overloads"));

    (road.rounds, road.processor) = (2, Some((1, 0)));
    let seen = road.pass(10_000);

    assert!(
        matches!(seen[..], [(_, LivenessEvent::Computer(NodeCondition::Relieved))]),
        "{seen:?}"
    );
    assert!(seen[0].0 >= 13_000 && seen[0].0 <= 15_500, "{seen:?}");
}

#[test]
fn who_keeps_a_thread_that_now_and_then_waits_for_a_processor_is_the_root() {
    let mut road = Road::new(10, 3);
    road.processor = Some((7, 3));
    assert_eq!(names(&road.pass(10_000)), [overloads()]);
}

#[test]
fn timers_that_miss_their_ticks_are_an_overload() {
    let mut world = World::new();
    let mut seen = Vec::new();
    for _ in 0..50 {
        let activity = &mut world.samples.activities[0];
        (activity.ticks, activity.missed_ticks) = (activity.ticks + 70, activity.missed_ticks + 30);
        activity.turn += 2;
        seen.extend(world.pass(100, true).into_iter().map(|seen| (0, seen)));
    }
    assert_eq!(names(&seen), ["culprit overloads []"]);

    let mut world = World::new();
    world.samples.activities[0].ticks = u32::MAX - 100;
    for _ in 0..50 {
        let activity = &mut world.samples.activities[0];
        activity.ticks = activity.ticks.wrapping_add(80);
        activity.missed_ticks += 20;
        activity.turn += 2;
        assert_eq!(world.pass(100, true), [], "a fifth may be missed");
    }
}

#[test]
fn a_neighbour_that_keeps_its_rounds_makes_no_overload_of_a_busy_thread() {
    let mut road = Road::new(10, 2);
    assert_eq!(names(&road.pass(20_000)), [""; 0]);
}

#[test]
fn a_single_delay_is_no_overload() {
    let mut road = Road::new(10, 2);
    road.pass(2000);
    road.rounds = 0;
    road.pass(250);
    road.rounds = 2;

    assert_eq!(names(&road.pass(10_000)), [""; 0]);
}

#[test]
fn a_component_that_misses_rounds_on_a_free_thread_is_overloaded_itself() {
    let mut road = Road::new(2, 4);
    assert_eq!(names(&road.pass(5000)), ["victim overloads []"]);
}

#[test]
fn a_silence_behind_a_kept_thread_is_reported_after_its_root() {
    let mut road = Road::new(10, 2);
    road.pass(1000);
    road.rounds = 0;

    let seen = road.pass(500);

    assert_eq!(names(&seen), [overloads(), "victim is silent".into()]);
    road.rounds = 2;
    assert_eq!(names(&road.pass(200)), ["victim spoke"]);
}

#[test]
fn a_neighbour_that_is_silent_on_a_free_thread_is_silent_of_itself() {
    let mut road = Road::new(5, 2);
    road.pass(1000);
    road.rounds = 0;
    assert_eq!(names(&road.pass(500)), ["victim is silent"]);
}

#[test]
fn a_victim_that_says_nothing_after_the_overload_is_silent_of_itself() {
    let mut road = Road::new(10, 2);
    road.pass(1000);
    road.rounds = 0;
    road.pass(500);
    road.kept = 0;

    let seen = names(&road.pass(5000));

    assert_eq!(seen[0], "culprit flows");
    assert_eq!(seen.iter().filter(|text| *text == "victim is silent").count(), 1, "{seen:?}");
}

#[test]
fn a_victim_is_silent_behind_one_long_handler_too_before_that_is_a_hang() {
    let mut world = World::new();
    world.samples.activities[2].speaks = true;
    world.look();
    world.samples.activities[2].alive += 1;
    world.pass(100, true);
    let patient = judged_by("culprit", HangLimits { max_block: ms(10_000), ..limits() });
    world.scanner.handle_enter(0, patient);
    world.heartbeat.running = Some(0);
    world.samples.activities[0].turn = 1;
    world.look();

    let seen: Vec<_> = world.pass(1000, false).into_iter().map(|seen| (0, seen)).collect();

    assert_eq!(names(&seen), [overloads(), "victim is silent".into()]);
}

#[test]
fn messages_that_wait_for_a_component_that_is_not_at_work_are_no_overload() {
    let mut road = Road::new(3, 2);
    road.world.samples.activities[0].speaks = false;
    road.world.samples.queues[0] = QueueReading { queued: 1, oldest: ms(1500) };

    assert_eq!(names(&road.pass(5000)), [""; 0]);

    road.world.samples.activities[0].speaks = true;
    assert_eq!(names(&road.pass(5000)), ["culprit overloads []"]);
}

#[test]
fn a_flooded_component_that_is_asked_is_alive_and_overloaded() {
    let mut road = Road::new(10, 2);
    let limits = HangLimits { max_silence: None, max_unanswered: Some(ms(300)), ..limits() };
    let asked = judged_by("culprit", limits);
    road.world.scanner.handle_enter(0, asked);
    road.world.samples.queues[0] = QueueReading { queued: 64, oldest: ms(1500) };

    assert_eq!(names(&road.pass(10_000)), ["culprit overloads []"]);
    road.world.samples.queues[0] = QueueReading::default();
    assert_eq!(names(&road.pass(5000)), ["culprit flows"]);
}

#[test]
fn messages_that_wait_are_seen_also_while_a_turn_of_many_holds_the_beat_up() {
    let mut road = Road::new(10, 2);
    road.beats = 200;
    road.world.samples.queues[0] = QueueReading { queued: 64, oldest: ms(1500) };
    assert_eq!(names(&road.pass(3000)), ["culprit overloads []"]);
}

#[test]
fn an_asked_component_that_takes_no_message_on_a_free_thread_is_overloaded() {
    let mut world = World::new();
    let asked = HangLimits { max_silence: None, max_unanswered: Some(ms(300)), ..limits() };
    let asked = judged_by("victim", HangLimits { max_wait: Duration::MAX, ..asked });
    world.scanner.handle_enter(2, asked);
    world.samples.activities[2].speaks = true;
    world.look();
    world.samples.activities[2].turn = 1;
    world.pass(1100, true);
    world.samples.queues[2] = QueueReading { queued: 5, oldest: ms(1050) };

    let seen: Vec<_> = world.pass(5000, true).into_iter().map(|seen| (0, seen)).collect();
    assert_eq!(names(&seen), ["victim overloads []"]);

    world.samples.queues[2] = QueueReading::default();
    let seen: Vec<_> = world.pass(4000, true).into_iter().map(|seen| (0, seen)).collect();
    assert_eq!(names(&seen), ["victim flows"]);
}

#[test]
fn a_flooded_component_with_rounds_is_overloaded_and_not_silent() {
    let mut road = Road::new(10, 0);
    road.world.scanner.handle_leave(2);
    road.world.scanner.handle_enter(0, judged("culprit"));
    road.planner_speaks = true;
    road.pass(500);
    road.planner_speaks = false;

    assert_eq!(names(&road.pass(3000)), ["culprit overloads []"]);
}

#[test]
fn messages_that_nobody_waits_for_any_more_are_an_overload() {
    let mut world = World::new();
    let mut seen = Vec::new();
    for _ in 0..50 {
        world.samples.activities[0].expired += 1;
        seen.extend(world.pass(100, true).into_iter().map(|seen| (0, seen)));
    }
    assert_eq!(names(&seen), ["culprit overloads []"]);
}

#[test]
fn rounds_that_are_missed_while_the_scanner_is_not_scheduled_are_no_overload() {
    let mut road = Road::new(10, 2);
    road.pass(3000);
    road.world.now += 60_000;
    road.world.samples.activities[2].missed_ticks += 3000;

    let seen = road.pass(10_000);

    assert!(matches!(seen[..], [(_, LivenessEvent::Stalled { .. })]), "{seen:?}");
}

#[test]
fn rounds_and_messages_that_the_computer_had_no_time_for_are_no_overload() {
    let mut world = World::new();
    world.samples.activities[2].interval = ms(20);
    world.samples.activities[2].speaks = true;
    for _ in 0..200 {
        // The looks come late: two of three rounds have been missed between two of them.
        world.now += 60;
        world.heartbeat.beat += 1;
        let activity = &mut world.samples.activities[2];
        (activity.turn, activity.alive) = (activity.turn + 2, activity.alive + 1);
        (activity.ticks, activity.missed_ticks) = (activity.ticks + 1, activity.missed_ticks + 2);
        activity.expired += 1;
        assert_eq!(world.look(), []);
    }
}
