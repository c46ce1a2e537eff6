//! Runs of the scenario on a simulated robot, in virtual time.

use super::*;
use crate::faults::{Blow, DemoFault};
use crate::flow_account::FlowLosses;
use crate::messages::{SinkReport, Strike};
use crate::robot_state::fake;
use blastema::core::{NodeName, ObjectAddress, ObjectName};

/// The promise that the simulated robot breaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Flaw {
    None,
    NotFound,
    NotReported,
    NotBack,
    WrongCulprit,
    LosesOne,
    DoublesOne,
    DiesByItself,
    DiesAgain,
    Refuses,
    FalseAlarm,
    NeverTogether,
    CableStaysDown,
    GivesUp,
    /// Dead letters of an interruption that a session survives.
    ReturnsEarly,
    /// Dead letters of one that no session survives: no flaw.
    ReturnsLate,
    /// The computer is too busy: no flaw.
    MissesRounds,
    /// An overload of the computer stands, and the fault is found as no other: no flaw.
    HasNoTime,
}

/// How long after the fault it is found, in milliseconds.
const FOUND: u64 = 20;

fn node(module: Module) -> NodeName {
    NodeName::new(module.name()).expect("a name")
}

fn object(module: Module, name: &str) -> FaultLocation {
    let name = ObjectName::new(name).expect("a name");
    FaultLocation::Object(ObjectAddress::new(node(module), name))
}

/// Where the middleware finds a fault.
fn place_of(fault: &DemoFault) -> FaultLocation {
    match fault.blow {
        Blow::Cut(cable) => {
            FaultLocation::Link { node: node(Module::Module1), link: cable.into(), neighbour: None }
        }
        Blow::Blackout | Blow::Kill => FaultLocation::Node(node(fault.module)),
        Blow::Router => object(fault.module, "net/stack"),
        _ => object(fault.module, fault.object),
    }
}

/// Runs the whole scenario with a robot that has this flaw at the fault of this title.
fn run(flaw: Flaw, title: &str) -> Report {
    let mut scenario = Scenario::new(Instant::default());
    let mut struck: Option<(u32, u64)> = None;
    let (mut found, mut lost, mut doubled, mut returned, mut killed_at) = (vec![], 0, 0, 0, 0);
    for now in (100..).step_by(100) {
        let at = Instant::from_millis(now);
        let is_now = struck.is_some_and(|(fault, _)| FAULTS[fault as usize].title == title);
        for module in Module::ALL {
            if flaw == Flaw::NeverTogether && module == Module::Module3 {
                continue;
            }
            let mut report = fake::report(module, now, now);
            report.since = scenario.watched_since().as_nanos();
            report.process += if module == Module::Module3 { killed_at } else { 0 };
            for sink in &mut report.sinks {
                if killed_at > 0 && module == Module::Module3 {
                    sink.first = killed_at / 1_000_000 + 1;
                }
                let is_source = killed_at > 0 && sink.flow.starts_with("flow/3");
                sink.source += if is_source { killed_at } else { 0 };
                sink.passed = Some(report.since + 1_000_000);
                if sink.flow == "flow/2-1" {
                    let SinkReport { missing, doubled: again, .. } = sink;
                    (*missing, *again) = (lost + returned, doubled);
                }
            }
            for source in report.sources.iter_mut().filter(|source| source.flow == "flow/2-1") {
                source.returned = returned;
            }
            if module == Module::Module1 {
                report.faults.clone_from(&found);
            }
            if flaw == Flaw::CableStaysDown && is_now {
                report.cables.iter_mut().for_each(|cable| cable.1 = false);
            }
            report.served = struck
                .filter(|_| flaw != Flaw::NotBack || !is_now)
                .map(|(fault, since)| (fault, (since + 1) * 1_000_000));
            scenario.handle_report(module, report, at);
        }
        match scenario.advance(at) {
            Some(ScenarioOrder::Strike(Strike { fault: number, repair: false })) => {
                let fault = &FAULTS[number as usize];
                let is_now = fault.title == title;
                struck = Some((number, now));
                if flaw == Flaw::Refuses && is_now {
                    scenario.handle_struck(Err("no such object".into()), at);
                    continue;
                }
                scenario.handle_struck(Ok([at, at]), at);
                if fault.blow == Blow::Kill {
                    killed_at = now * 1_000_000;
                    scenario.handle_end(fault.module, "ended by signal 9", at);
                }
                let id = found.len() as u64 + 1;
                let mut report = fake::fault(id, fault.kind.clone(), place_of(fault));
                report.found_at = (now + FOUND) * 1_000_000;
                report.recovered = flaw != Flaw::NotReported || !is_now;
                if !(matches!(flaw, Flaw::NotFound | Flaw::HasNoTime) && is_now) {
                    found.push(report);
                }
                let another = |kind, place| fake::fault(100 + id, kind, place);
                match flaw {
                    Flaw::LosesOne if is_now => lost += 1,
                    Flaw::DoublesOne if is_now => doubled += 1,
                    Flaw::ReturnsEarly | Flaw::ReturnsLate if is_now => returned += 5,
                    Flaw::WrongCulprit if is_now => {
                        found.push(another(FaultKind::Hang, object(Module::Module2, "operator")));
                    }
                    Flaw::HasNoTime if number == 0 => {
                        let computer = FaultLocation::Node(node(Module::Module2));
                        found.push(another(FaultKind::Overload, computer));
                    }
                    Flaw::MissesRounds => {
                        found.push(another(FaultKind::Overload, object(Module::Module1, "safety")));
                    }
                    Flaw::GivesUp if is_now => {
                        found.last_mut().expect("it was found").given_up = Some("too often".into());
                    }
                    Flaw::DiesAgain if is_now => {
                        scenario.handle_end(fault.module, "exit status 101", at);
                    }
                    Flaw::DiesByItself if is_now => {
                        scenario.handle_end(Module::Module2, "exit status 101", at);
                    }
                    _ => {}
                }
            }
            Some(ScenarioOrder::Strike(Strike { repair: true, .. })) => {
                // A repair that comes late ends sessions.
                let late = if flaw == Flaw::ReturnsLate { 2_000 } else { 0 };
                let at = Instant::from_millis(now + late);
                scenario.handle_struck(Ok([at, at]), at);
            }
            Some(ScenarioOrder::End) => break,
            Some(ScenarioOrder::NotAssembled(text)) => {
                let mut report = scenario.report();
                report.problems.push(text);
                return report;
            }
            None => {}
        }
        let is_between = matches!(scenario.scene, Scene::Pausing { .. }) && scenario.number == 1;
        if flaw == Flaw::FalseAlarm && is_between && found.len() == 1 {
            let mut alarm = fake::fault(77, FaultKind::Hang, object(Module::Module2, "laser"));
            found.push(alarm.clone());
            // A symptom is none.
            (alarm.id, alarm.symptom_of) = (blastema::FaultId(78), Some(blastema::FaultId(77)));
            found.push(alarm);
        }
    }
    scenario.report()
}

#[test]
fn a_robot_that_recovers_keeps_every_promise_in_less_than_thirty_seconds() {
    let report = run(Flaw::None, "");

    let problems: Vec<_> = report.rows.iter().flat_map(|row| &row.problems).collect();
    assert!(report.promises_kept, "{problems:?} {:?}", report.problems);
    assert!(report.took < Duration::from_secs(25), "{:?}", report.took);
    let faults: Vec<_> = report.rows.iter().map(|row| row.fault.title).collect();
    assert!(faults.into_iter().eq(FAULTS.iter().map(|fault| fault.title)));
    for row in &report.rows {
        assert_eq!(row.detected_after, Some(Duration::from_millis(FOUND)), "{row:?}");
        assert_eq!(row.recovered_after, Some(Duration::from_millis(1)), "{row:?}");
    }
    assert_eq!(report.messages, FlowLosses::default());
}

#[test]
fn what_the_robot_does_wrong_breaks_the_row_in_which_it_happens() {
    let check = |flaw, title: &str, problem: &str| {
        let report = run(flaw, title);
        assert!(!report.promises_kept && report.finished, "{flaw:?}");
        for row in &report.rows {
            let is_hit = row.problems.iter().any(|text| text.contains(problem));
            assert_eq!(is_hit, row.fault.title == title, "{flaw:?}: {row:?}");
        }
        assert!(report.rows.iter().any(|row| row.fault.title == title), "{flaw:?}");
    };
    check(Flaw::NotFound, "hang", "was not found");
    check(Flaw::NotFound, "flood", "was not found");
    check(Flaw::NotReported, "error state", "not reported");
    check(Flaw::NotBack, "silent object", "service is not back");
    check(Flaw::WrongCulprit, "hang", "module1 named hang in module2:operator");
    check(Flaw::LosesOne, "cable cut", "1 reliable message lost");
    check(Flaw::DoublesOne, "panic in the router", "1 reliable message doubled");
    check(Flaw::DiesByItself, "panic", "module2 ended by itself: exit status 101");
    check(Flaw::DiesAgain, "kill -9, rejoin", "module3 ended by itself: exit status 101");
    check(Flaw::ReturnsEarly, "both cables cut, return", "5 reliable messages became dead letters");
    check(Flaw::Refuses, "flood", "an order was not carried out: no such object");
    check(
        Flaw::CableStaysDown,
        "panic in the router",
        "not as before: ethernet to module2 is down",
    );
    check(Flaw::GivesUp, "failed initialisation", "module1 gave fault 4 up: too often");
}

#[test]
fn what_an_interruption_longer_than_a_session_returns_is_told_and_breaks_no_promise() {
    let report = run(Flaw::ReturnsLate, "both cables cut, return");

    assert!(report.promises_kept, "{:?} {:?}", report.rows, report.problems);
    assert_eq!((report.messages.lost, report.messages.returned), (0, 5));
}

#[test]
fn overloads_of_a_busy_computer_are_told_and_break_no_promise() {
    let report = run(Flaw::MissesRounds, "");

    assert!(report.promises_kept, "{:?} {:?}", report.rows, report.problems);
    assert_eq!((report.overloads, run(Flaw::None, "").overloads), (10, 0));
}

#[test]
fn a_flood_on_a_computer_that_has_no_time_is_found_as_the_overload_that_stands() {
    let report = run(Flaw::HasNoTime, "flood");

    assert!(report.promises_kept, "{:?} {:?}", report.rows, report.problems);
    let row = report.rows.last().expect("it was tried");
    let named = row.named.as_ref().expect("it was found");
    assert_eq!(row.detected_after, None, "it stood before");
    assert_eq!((&named.code[..], &named.location[..], report.overloads), ("B09", "module2", 1));
    let report = run(Flaw::HasNoTime, "hang");
    assert!(!report.promises_kept, "it is no other fault");
}

#[test]
fn a_fault_that_was_not_injected_is_a_broken_promise() {
    let report = run(Flaw::FalseAlarm, "");

    assert!(!report.promises_kept && report.finished);
    assert_eq!(report.problems.len(), 1, "{:?}", report.problems);
    assert!(report.problems[0].contains("where no fault was injected"), "{:?}", report.problems);
}

#[test]
fn a_robot_that_never_comes_together_says_what_is_missing() {
    let report = run(Flaw::NeverTogether, "");

    assert!(!report.promises_kept && !report.finished && report.rows.is_empty());
    assert!(report.problems[0].contains("module3 is not ready"), "{:?}", report.problems);
}

#[test]
fn after_a_broken_promise_nothing_is_tried_any_more_when_time_is_up() {
    let report = run(Flaw::NotBack, "silent object");

    let last = report.problems.last().expect("what was left out is said");
    assert!(last.contains("5 faults not tried"), "{last}");
    assert!(report.took < Duration::from_secs(45), "{:?}", report.took);
}
