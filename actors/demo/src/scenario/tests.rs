//! Runs of the scenario on a simulated robot.

use super::*;
use crate::fake::{FakeRobot, Flaw};

fn tell(plan: ScenarioPlan, flaw: Flaw) -> Report {
    FakeRobot::new(flaw).perform(Scenario::new(plan, MachineInstant::default()))
}

#[test]
fn a_robot_that_recovers_keeps_every_promise_in_less_than_thirty_seconds() {
    let report = tell(ScenarioPlan::default(), Flaw::None);

    let problems: Vec<_> = report.rows.iter().flat_map(|row| &row.problems).collect();
    assert!(report.promises_kept, "{problems:?} {:?}", report.problems);
    assert!(report.took < Duration::from_secs(25), "{:?}", report.took);
    let faults: Vec<_> = report.rows.iter().map(|row| row.fault).collect();
    let told: Vec<_> = script().iter().map(FaultInjection::title).collect();
    assert_eq!(faults, told);
    for row in &report.rows {
        assert!(row.named.is_some(), "{row:?}");
        assert!(row.detected_after.is_some_and(|span| span > Duration::ZERO), "{row:?}");
        assert!(row.recovered_after.is_some_and(|span| span > Duration::ZERO), "{row:?}");
    }
    assert_eq!(report.messages.lost + report.messages.doubled, 0);
    assert!(report.messages.perished > 0, "the kill took some along");
}

#[test]
fn what_the_robot_does_wrong_breaks_the_row_in_which_it_happens() {
    // Short enough that a run with a broken promise reaches its last fault.
    let timeouts = TrialTimeouts {
        strike: Duration::from_secs(2),
        recovery: Duration::from_secs(6),
        settling: Duration::from_secs(3),
        ..TrialTimeouts::default()
    };
    let check = |flaw, fault: &str, problem: &str| {
        let report = tell(ScenarioPlan { timeouts, ..ScenarioPlan::default() }, flaw);
        assert!(!report.promises_kept, "{flaw:?}");
        assert_eq!(report.rows.len(), 10, "{flaw:?}: the scenario goes on");
        for row in &report.rows {
            let hit = row.problems.iter().any(|text| text.contains(problem));
            assert_eq!(hit, row.fault == fault, "{flaw:?}: {row:?}");
        }
    };
    check(Flaw::NotFound, "hang", "was not found");
    check(Flaw::NotReported, "error state", "not reported");
    check(Flaw::NotBack, "silent object", "service is not back");
    check(Flaw::WrongCulprit, "hang", "module2 named hang in module2:operator");
    check(Flaw::LosesOne, "cable cut", "1 reliable message lost");
    check(Flaw::DoublesOne, "panic in the router", "1 reliable message doubled");
    check(Flaw::DiesOfPanic, "panic", "module1 ended by itself");
    check(Flaw::ReturnsEarly, "both cables cut, return", "5 reliable messages became dead letters");
    check(Flaw::Refuses, "flood", "module2 refused: no such object");
}

#[test]
fn what_an_interruption_longer_than_a_session_returns_is_told_and_breaks_no_promise() {
    let report = tell(ScenarioPlan::default(), Flaw::ReturnsLate);

    assert!(report.promises_kept, "{:?} {:?}", report.rows, report.problems);
    assert_eq!((report.messages.lost, report.messages.returned), (0, 5));
    for row in &report.rows {
        let is_blackout = row.fault == "both cables cut, return";
        assert_eq!(row.returned, if is_blackout { 5 } else { 0 }, "{row:?}");
    }
}

#[test]
fn overloads_of_a_busy_computer_are_told_and_break_no_promise() {
    let report = tell(ScenarioPlan::default(), Flaw::MissesRounds);

    assert!(report.promises_kept, "{:?} {:?}", report.rows, report.problems);
    // One for each fault in an object.
    assert_eq!(report.overloads, 6);
    assert_eq!(tell(ScenarioPlan::default(), Flaw::None).overloads, 0);
}

#[test]
fn a_fault_that_was_not_injected_is_a_broken_promise() {
    let report = tell(ScenarioPlan::default(), Flaw::FalseAlarm);

    assert!(!report.promises_kept);
    assert_eq!(report.problems.len(), 1, "a symptom is none: {:?}", report.problems);
    assert!(report.problems[0].contains("where no fault was injected"), "{:?}", report.problems);
}

#[test]
fn a_robot_that_never_comes_together_ends_the_story_and_says_what_is_missing() {
    let report = tell(ScenarioPlan::default(), Flaw::NeverTogether);

    assert!(!report.promises_kept && !report.finished && report.rows.is_empty());
    for told in ["module3 is not ready", "module1 found node lost in module3: as ordered"] {
        assert!(report.problems[0].contains(told), "{:?}", report.problems);
    }
}

#[test]
fn a_robot_with_a_module_that_is_stopped_for_good_ends_within_the_time_that_the_help_says() {
    let report = tell(ScenarioPlan::default(), Flaw::StopsForGood);

    // The director takes up to four seconds to end the processes.
    assert!(report.took <= Duration::from_secs(26), "{:?}", report.took);
    assert!(!report.promises_kept && report.finished);
    let last = report.problems.last().expect("what was left out is said");
    assert!(last.contains("not tried"), "{last}");
}

#[test]
fn what_a_row_counts_as_lost_and_comes_late_is_said_at_the_end() {
    let report = tell(ScenarioPlan::default(), Flaw::ComesLate);

    let in_rows: u64 = report.rows.iter().map(|row| row.lost).sum();
    assert!(in_rows > 0, "{report:?}");
    assert_eq!(in_rows, report.messages.lost + report.late);
    assert!(!report.promises_kept);
}

#[test]
fn chaos_goes_on_until_the_time_is_up_and_is_the_same_for_the_same_seed() {
    let minute = Some(Duration::from_secs(60));
    let plan = ScenarioPlan { chaos: true, seed: 5, length: minute, ..ScenarioPlan::default() };
    let report = tell(plan, Flaw::None);

    assert!(report.promises_kept, "{:?}", report.rows);
    assert!(report.took >= Duration::from_secs(60), "{:?}", report.took);
    assert!(report.rows.len() > 20);
    assert_eq!(tell(plan, Flaw::None), report);
}

#[test]
fn a_longer_story_is_told_again_and_no_cut_is_left_behind() {
    let plan = ScenarioPlan { length: Some(Duration::from_secs(24)), ..ScenarioPlan::default() };
    let report = tell(plan, Flaw::None);

    assert!(report.promises_kept);
    assert!(report.rows.len() > 10);
    assert_ne!(report.rows.last().map(|row| row.fault), Some("cable cut"));
}
