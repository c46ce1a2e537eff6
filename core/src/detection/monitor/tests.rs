//! A table of one or two objects, and every input in every state of theirs.

use super::*;
use crate::detection::hang::LivenessEvent;
use crate::detection::{CurrentHandler, Opinion, OverloadFigures};
use crate::testing::{at, node, object};
use std::time::Duration;

const ONE: Incarnation = Incarnation(1);
const TWO: Incarnation = Incarnation(2);
const THREE: Incarnation = Incarnation(3);
const TENTH: Duration = Duration::from_millis(100);

fn monitor() -> Monitor {
    Monitor::new(node("m"))
}

fn watched() -> Monitor {
    let mut monitor = monitor();
    let registration = Registration { incarnation: TWO, ..Registration::new(object("laser")) };
    monitor.register(registration, at(0)).expect("there is room");
    seen(&mut monitor);
    monitor
}

/// The name of the finding's variant.
fn name(finding: &Finding) -> String {
    let text = format!("{finding:?}");
    text.split([' ', '(', '{']).next().unwrap_or_default().into()
}

/// Everything that is now to be observed.
fn seen(monitor: &mut Monitor) -> Vec<String> {
    let all = std::iter::from_fn(|| monitor.poll_output());
    all.map(|seen| format!("{} {}", seen.location, name(&seen.finding))).collect()
}

/// Wakes the machine exactly when it wants, up to `until`.
fn run(monitor: &mut Monitor, until: u64) -> Vec<(u64, String)> {
    let mut reported = Vec::new();
    loop {
        let now = monitor.poll_timeout().unwrap_or(at(until)).min(at(until));
        monitor.handle_timeout(now);
        let millis = now.as_nanos() / 1_000_000;
        reported.extend(seen(monitor).into_iter().map(|text| (millis, text)));
        if now == at(until) {
            return reported;
        }
    }
}

fn row(monitor: &Monitor, name: &str, now: u64) -> MonitorRow {
    let is_it = |row: &MonitorRow| row.location.to_string() == name;
    monitor.read_table(at(now)).into_iter().find(is_it).expect("it has a row")
}

fn of_laser(incarnation: Incarnation, finding: Finding) -> LivenessEvent {
    LivenessEvent::Component { object: object("laser"), incarnation, finding }
}

fn silent(incarnation: Incarnation) -> LivenessEvent {
    of_laser(incarnation, Finding::Silent { age: TENTH })
}

fn waits(incarnation: Incarnation, age: Duration) -> LivenessEvent {
    of_laser(incarnation, Finding::Waits { during: "Scan", age })
}

fn panicked() -> ExitReason {
    ExitReason::Panicked { text: "boom".into(), at: "laser.rs:1".into(), during: "Scan" }
}

#[test]
fn the_first_incarnation_of_an_object_is_no_restart() {
    let mut monitor = monitor();
    let laser = object("laser");
    let unborn = Incarnation::default();
    let registration = Registration { incarnation: unborn, ..Registration::new(laser.clone()) };
    monitor.register(registration, at(0)).unwrap();

    monitor.handle_state(&laser, ONE, Lifecycle::Created, None, at(60_000));

    let row = row(&monitor, "m:laser", 60_000);
    assert_eq!((row.incarnation, row.restarts, row.suspicions), (ONE, 0, 0));
}

#[test]
fn silence_is_observed_and_so_is_its_end() {
    let mut monitor = watched();
    monitor.handle_liveness(silent(TWO), at(360));

    assert_eq!(seen(&mut monitor), ["m:laser Silent"]);
    assert_eq!(row(&monitor, "m:laser", 3000).opinion, Opinion::Failed);

    let spoke = of_laser(TWO, Finding::Spoke);
    monitor.handle_liveness(spoke.clone(), at(3000));
    monitor.handle_liveness(spoke, at(3001));
    assert_eq!(seen(&mut monitor), ["m:laser Spoke"]);
    assert_eq!(row(&monitor, "m:laser", 3001).opinion, Opinion::Trusted);
}

fn answer(incarnation: Incarnation, state: Lifecycle) -> WorkProgress {
    WorkProgress { incarnation, state }
}

#[test]
fn an_overload_is_observed_with_its_victims_and_condemns_nobody() {
    let mut monitor = watched();
    let overloaded = |incarnation| {
        let (figures, victims) = (OverloadFigures::default(), [object("map")].into());
        of_laser(incarnation, Finding::Overloaded { figures, victims })
    };
    monitor.handle_liveness(overloaded(TWO), at(1));
    monitor.handle_liveness(overloaded(ONE), at(2));
    let flows = of_laser(TWO, Finding::Flows);
    monitor.handle_liveness(flows, at(3));

    assert_eq!(seen(&mut monitor), ["m:laser Overloaded", "m:laser Flows"]);
    assert_ne!(row(&monitor, "m:laser", 3).opinion, Opinion::Failed);
}

#[test]
fn answers_tell_the_state_of_an_object_only_while_no_guard_does() {
    let mut monitor = watched();
    let mut says = |state, now| {
        monitor.handle_alive(&object("laser"), answer(TWO, state), at(now));
        seen(&mut monitor)
    };
    assert_eq!(says(Lifecycle::Active, 1), ["m:laser State"]);
    assert_eq!(says(Lifecycle::Active, 2), [""; 0]);
    assert_eq!(says(Lifecycle::Error, 3), ["m:laser State"]);

    monitor.handle_state(&object("laser"), TWO, Lifecycle::Active, None, at(4));
    seen(&mut monitor);
    let late = answer(TWO, Lifecycle::Error);
    monitor.handle_alive(&object("laser"), late, at(5));

    assert_eq!(seen(&mut monitor), [""; 0]);
    assert_eq!(row(&monitor, "m:laser", 5).state, Some(Lifecycle::Active));
}

#[test]
fn an_object_that_does_not_answer_is_silent_until_it_does() {
    let mut monitor = watched();
    let laser = object("laser");
    monitor.handle_alive(&laser, answer(TWO, Lifecycle::Active), at(0));
    monitor.handle_unanswered(&laser, TENTH, at(100));
    assert_eq!(seen(&mut monitor), ["m:laser State", "m:laser Silent"]);
    assert_eq!(row(&monitor, "m:laser", 100).opinion, Opinion::Failed);

    monitor.handle_alive(&laser, answer(TWO, Lifecycle::Active), at(200));
    assert_eq!(seen(&mut monitor), ["m:laser Spoke"]);

    monitor.handle_exited(&laser, TWO, panicked(), None, at(300));
    monitor.handle_unanswered(&laser, TENTH, at(400));
    monitor.handle_unanswered(&object("ghost"), TENTH, at(400));
    assert_eq!(seen(&mut monitor), ["m:laser Exited"], "its end is reported already");
}

/// In which state the second incarnation of `laser` is when something comes.
#[derive(Clone, Copy, Debug, PartialEq)]
enum State {
    Going,
    Finalized,
    Stopped,
    Died,
}

const INPUTS: [&str; 8] =
    ["alive", "died", "stopped", "state", "declared", "waits", "silent", "resumed"];

fn feed(monitor: &mut Monitor, input: &str, incarnation: Incarnation, now: Instant) {
    let laser = object("laser");
    match input {
        "alive" => monitor.handle_alive(&laser, answer(incarnation, Lifecycle::Active), now),
        "died" => monitor.handle_exited(&laser, incarnation, panicked(), None, now),
        "stopped" => monitor.handle_exited(&laser, incarnation, ExitReason::Stopped, None, now),
        "state" => monitor.handle_state(&laser, incarnation, Lifecycle::Active, None, now),
        "declared" => {
            monitor.handle_declared(
                &laser,
                incarnation,
                FaultKind::CheckFailed,
                "1".into(),
                None,
                now,
            );
        }
        "waits" => monitor.handle_liveness(waits(incarnation, TENTH), now),
        "silent" => monitor.handle_liveness(silent(incarnation), now),
        "resumed" => monitor.handle_resumed(&[laser], now),
        other => panic!("no input is called {other}"),
    }
}

fn in_state(state: State) -> Monitor {
    let mut monitor = watched();
    let laser = object("laser");
    match state {
        State::Going => {}
        State::Finalized => {
            monitor.handle_state(&laser, TWO, Lifecycle::Finalized, None, at(0));
        }
        State::Stopped => monitor.handle_exited(&laser, TWO, ExitReason::Stopped, None, at(0)),
        State::Died => monitor.handle_exited(&laser, TWO, panicked(), None, at(0)),
    }
    seen(&mut monitor);
    monitor
}

#[test]
fn every_input_in_every_state_says_what_it_should() {
    let states = [State::Going, State::Finalized, State::Stopped, State::Died];
    for state in states {
        for input in INPUTS {
            let mut monitor = in_state(state);

            feed(&mut monitor, input, TWO, at(5));

            let reported = seen(&mut monitor);
            let over = state != State::Going;
            let expected = match input {
                "died" | "stopped" if matches!(state, State::Going | State::Finalized) => {
                    Some("Exited")
                }
                "state" => Some("State"),
                "alive" if !over => Some("State"),
                "resumed" => Some("Resumed"),
                "declared" => Some("Declared"),
                "waits" if !over => Some("Waits"),
                "silent" if !over => Some("Silent"),
                _ => None,
            };
            let expected: Vec<String> =
                expected.iter().map(|text| format!("m:laser {text}")).collect();
            assert_eq!(reported, expected, "{input} while {state:?}");
        }
    }
}

#[test]
fn of_an_older_incarnation_only_a_panic_is_passed_on() {
    for state in [State::Going, State::Finalized, State::Stopped, State::Died] {
        // The sampler reports which objects have resumed; it has no incarnations.
        for input in INPUTS.into_iter().filter(|&input| input != "resumed") {
            let mut monitor = in_state(state);
            let before = monitor.read_table(at(5));

            feed(&mut monitor, input, ONE, at(5));

            let passed: &[&str] = if input == "died" { &["m:laser Exited"] } else { &[] };
            assert_eq!(seen(&mut monitor), passed, "{input} while {state:?}");
            assert_eq!(monitor.read_table(at(5)), before, "{input} while {state:?}");
        }
    }
}

#[test]
fn whatever_a_newer_incarnation_says_begins_a_new_history() {
    for state in [State::Going, State::Finalized, State::Stopped, State::Died] {
        for input in INPUTS.into_iter().filter(|&input| input != "resumed") {
            let mut monitor = in_state(state);

            feed(&mut monitor, input, THREE, at(5));

            let row = row(&monitor, "m:laser", 5);
            assert_eq!((row.incarnation, row.restarts), (THREE, 1), "{input} while {state:?}");
        }
    }
}

#[test]
fn a_restart_by_the_guard_leaves_the_next_incarnation_in_the_table() {
    let mut monitor = watched();

    monitor.handle_exited(&object("laser"), TWO, panicked(), Some(THREE), at(210));

    assert_eq!(seen(&mut monitor), ["m:laser Exited"]);
    let row = row(&monitor, "m:laser", 220);
    assert_eq!((row.incarnation, row.restarts, row.suspicions), (THREE, 1, 0));
    assert_eq!((row.opinion, row.last_sign, row.state), (Opinion::Unheard, None, None));
}

#[test]
fn an_object_of_the_middleware_is_at_work_when_its_guard_has_restarted_it() {
    let mut registered = monitor();
    let kind = ObjectKind::Middleware;
    let registration = Registration { kind, ..Registration::new(object("laser")) };
    registered.register(registration, at(0)).expect("there is room");
    seen(&mut registered);

    for (case, mut monitor) in [("registered", registered), ("unknown", monitor())] {
        for (incarnation, next, millis) in [(ONE, TWO, 210), (TWO, THREE, 220)] {
            monitor.handle_exited(
                &object("laser"),
                incarnation,
                panicked(),
                Some(next),
                at(millis),
            );

            let reported = ["m:laser Exited", "m:laser State"];
            assert_eq!(seen(&mut monitor), reported, "{case} {incarnation}");
            let row = row(&monitor, "m:laser", millis);
            assert_eq!((row.incarnation, row.state), (next, Some(Lifecycle::Active)), "{case}");
        }
    }
}

#[test]
fn an_incarnation_that_is_over_is_not_shown_in_the_state_that_it_had_before() {
    for (exit, state, opinion) in [
        (panicked(), Lifecycle::Fatal, Opinion::Failed),
        (ExitReason::Aborted, Lifecycle::Fatal, Opinion::Failed),
        (ExitReason::Stopped, Lifecycle::Finalized, Opinion::Stopped),
    ] {
        let mut monitor = watched();
        monitor.handle_state(&object("laser"), TWO, Lifecycle::Active, None, at(0));

        monitor.handle_exited(&object("laser"), TWO, exit, None, at(1));

        let row = row(&monitor, "m:laser", 1);
        assert_eq!((row.state, row.opinion), (Some(state), opinion));
    }
}

#[test]
fn a_note_goes_when_its_cause_goes_and_no_earlier() {
    let mut monitor = watched();
    let laser = object("laser");
    let note = |monitor: &Monitor| row(monitor, "m:laser", 9).note;
    let state = |monitor: &mut Monitor, state, reason: Option<&str>| {
        monitor.handle_state(&laser, TWO, state, reason.map(str::to_owned), at(1));
    };
    let declare = |monitor: &mut Monitor, kind, detail: &str| {
        monitor.handle_declared(&laser, TWO, kind, detail.to_owned(), None, at(2));
    };
    state(&mut monitor, Lifecycle::Active, None);
    declare(&mut monitor, FaultKind::CheckFailed, "it is dark");
    state(&mut monitor, Lifecycle::Error, Some("no mirror"));
    assert_eq!(note(&monitor).as_deref(), Some("no mirror"));

    state(&mut monitor, Lifecycle::Active, None);
    assert_eq!(note(&monitor).as_deref(), Some("it is dark"), "that goes on");
    declare(&mut monitor, FaultKind::Overload, "too much");
    monitor.handle_declared_fault_cleared(&laser, TWO, FaultKind::CheckFailed, at(3));
    assert_eq!(note(&monitor).as_deref(), Some("too much"));
    monitor.handle_declared_fault_cleared(&laser, TWO, FaultKind::Overload, at(3));
    assert_eq!(note(&monitor), None);

    declare(&mut monitor, FaultKind::Unavailable, "no device");
    state(&mut monitor, Lifecycle::Initialized, None);
    assert_eq!(note(&monitor).as_deref(), Some("no device"), "another hook may wait for it");
    declare(&mut monitor, FaultKind::CheckFailed, "it is dark");
    assert_eq!(row(&monitor, "m:laser", 3).waiting_for.as_deref(), Some("no device"));
    monitor.handle_declared_fault_cleared(&laser, TWO, FaultKind::CheckFailed, at(3));
    state(&mut monitor, Lifecycle::Active, None);
    assert_eq!(note(&monitor), None);
    assert_eq!(row(&monitor, "m:laser", 3).waiting_for, None);

    monitor.handle_exited(&laser, TWO, ExitReason::Stopped, None, at(4));
    declare(&mut monitor, FaultKind::CheckFailed, "its cut-off blocks");
    assert_eq!(note(&monitor).as_deref(), Some("its cut-off blocks"));
    monitor.handle_declared_fault_cleared(&laser, TWO, FaultKind::CheckFailed, at(5));
    assert_ne!(note(&monitor).as_deref(), Some("its cut-off blocks"));
}

#[test]
fn a_hang_after_a_wait_of_the_same_handler_is_observed_and_makes_its_victims_suspect() {
    let mut monitor = watched();
    monitor.register(Registration::new(object("map")), at(0)).expect("there is room");
    seen(&mut monitor);
    let victims: Arc<[ObjectName]> = [object("laser"), object("map"), object("ghost")].into();

    monitor.handle_liveness(waits(TWO, Duration::from_millis(500)), at(500));
    let age = Duration::from_millis(600);
    let hangs = Finding::Hangs { during: "Scan", age, victims: victims.clone() };
    monitor.handle_found(&object("laser"), TWO, hangs, at(600));
    assert_eq!(seen(&mut monitor), ["m:laser Waits", "m:laser Hangs"]);
    let current = CurrentHandler { during: "Scan", age: Duration::from_millis(600) };
    assert_eq!(row(&monitor, "m:laser", 600).current, Some(current));
    assert_eq!(row(&monitor, "m:laser", 600).opinion, Opinion::Failed);
    assert_eq!(row(&monitor, "m:map", 600).opinion, Opinion::Suspect);

    monitor.handle_lost(&object("laser"), &victims, at(700));
    assert_eq!(seen(&mut monitor), ["m:map Lost"]);
    assert_eq!(row(&monitor, "m:map", 700).opinion, Opinion::Failed);

    monitor.handle_resumed(&victims, at(800));
    assert_eq!(seen(&mut monitor), ["m:laser Resumed", "m:map Resumed"]);
    assert_eq!(row(&monitor, "m:map", 800).opinion, Opinion::Trusted);
}

#[test]
fn a_stranger_that_dies_is_not_lost_and_one_that_was_stopped_is_no_news() {
    let mut monitor = monitor();

    monitor.handle_exited(&object("a"), ONE, panicked(), None, at(0));
    monitor.handle_exited(&object("b"), ONE, ExitReason::Stopped, None, at(0));
    monitor.handle_state(&object("c"), ONE, Lifecycle::Finalized, None, at(0));

    assert_eq!(seen(&mut monitor), ["m:a Exited"]);
    assert_eq!(monitor.read_table(at(0)).len(), 1);
}

#[test]
fn a_restart_with_a_smaller_number_is_a_new_incarnation() {
    let mut monitor = Monitor::new(node("m"));
    monitor.handle_node(node("n"), TWO, NodeCondition::Reachable, at(0));
    let lost = || NodeCondition::Lost { reason: "gone".to_owned() };
    monitor.handle_node(node("n"), TWO, lost(), at(10));

    monitor.handle_node(node("n"), ONE, NodeCondition::Reachable, at(20));
    monitor.handle_node(node("n"), TWO, lost(), at(30));

    let rows = monitor.read_table(at(30));
    assert_eq!(
        (rows[0].incarnation, rows[0].opinion, rows[0].restarts),
        (ONE, Opinion::Trusted, 1)
    );
}

#[test]
fn a_full_table_refuses_what_is_not_in_it() {
    let mut monitor = Monitor { rows_max: 1, ..Monitor::new(node("m")) };
    monitor.register(Registration::new(object("a")), at(0)).expect("there is room");

    let refused = monitor.register(Registration::new(object("b")), at(0));
    monitor.handle_exited(&object("c"), ONE, panicked(), None, at(0));
    monitor.handle_link(node("m"), "eth".into(), None, LinkCondition::Up, at(0));
    monitor.handle_node(node("n"), ONE, NodeCondition::Reachable, at(0));

    let text = refused.unwrap_err().to_string();
    assert_eq!(text, "b is not watched: the monitor's table already has 1 rows");
    assert_eq!(monitor.read_table(at(0)).len(), 1);
    monitor.register(Registration::new(object("a")), at(0)).expect("it has its row already");
}

#[test]
fn whoever_is_dismissed_is_forgotten() {
    let mut monitor = watched();

    monitor.dismiss(&object("laser"), at(10));
    monitor.dismiss(&object("laser"), at(10));

    assert_eq!(seen(&mut monitor), ["m:laser Dismissed"]);
    assert_eq!(run(&mut monitor, 9000), []);
    assert_eq!(monitor.read_table(at(20)), []);
}

#[test]
fn isolation_is_shown_and_outlives_a_restart() {
    let mut monitor = watched();

    monitor.handle_isolation(&object("laser"), true, at(0));
    monitor.handle_state(&object("laser"), THREE, Lifecycle::Created, None, at(0));

    assert!(row(&monitor, "m:laser", 0).isolated);
}

#[test]
fn a_fault_that_ends_with_its_node_is_not_handed_over() {
    let mut monitor = watched();
    let down = LinkCondition::Down { reason: "closed".into() };
    let lost = NodeCondition::Lost { reason: "no path".into() };
    monitor.handle_ending();

    monitor.handle_link(node("m"), "eth".into(), Some(node("n")), down, at(1));
    monitor.handle_node(node("n"), ONE, lost, at(1));
    monitor.handle_exited(&object("laser"), TWO, ExitReason::Aborted, None, at(1));
    monitor.handle_exited(&object("arm"), ONE, panicked(), None, at(1));

    assert_eq!(seen(&mut monitor), ["m:arm Exited"]);
}

#[test]
fn a_declared_fault_ends_when_it_is_not_declared_again_within_its_hold() {
    let mut monitor = monitor();
    let laser = object("laser");
    let declare = |monitor: &mut Monitor, hold, millis| {
        let detail = "it is dark".to_owned();
        monitor.handle_declared(&laser, TWO, FaultKind::CheckFailed, detail, hold, at(millis));
        seen(monitor);
    };
    let cleared = [(150, "m:laser Cleared".to_owned())];
    monitor.handle_state(&laser, TWO, Lifecycle::Active, None, at(0));
    declare(&mut monitor, Some(TENTH), 0);
    declare(&mut monitor, Some(TENTH), 50);
    assert_eq!(run(&mut monitor, 149), [], "it was declared again");
    assert_eq!(run(&mut monitor, 160), cleared);
    assert_eq!(row(&monitor, "m:laser", 160).note, None);

    declare(&mut monitor, Some(TENTH), 200);
    monitor.handle_isolation(&laser, true, at(210));
    seen(&mut monitor);
    assert_eq!(run(&mut monitor, 390), [], "it may declare nothing");
    monitor.handle_isolation(&laser, false, at(390));
    seen(&mut monitor);
    assert_eq!(run(&mut monitor, 410), [(400, "m:laser Cleared".to_owned())]);

    declare(&mut monitor, Some(TENTH), 600);
    declare(&mut monitor, None, 610);
    declare(&mut monitor, Some(TENTH), 620);
    assert_eq!(run(&mut monitor, 10_000), [], "its end is declared");
}
