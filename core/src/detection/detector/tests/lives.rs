//! Faults of lives that end, begin, and were mended.

use super::*;

#[test]
fn a_life_that_becomes_active_ends_the_faults_of_the_lives_before() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));
    bench.see("arm", ONE, declared());
    bench.said();

    bench.see("arm", TWO, state(Lifecycle::Initialized));
    assert_eq!(bench.said(), [""; 0]);
    bench.see("arm", TWO, state(Lifecycle::Active));

    assert_eq!(bench.said(), ["Recovered 1", "Recovered 2", "-1", "-2"]);
}

#[test]
fn a_life_that_dies_before_it_is_active_is_the_same_fault_still() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));

    bench.see("arm", TWO, exited(panicked()));

    assert_eq!((bench.fault(1).count, bench.fault(1).incarnation), (2, TWO));
    assert_eq!(bench.entries().len(), 1);
}

#[test]
fn a_component_that_was_reset_is_recovered_when_it_is_active_again() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, state(Lifecycle::Active));
    bench.see("arm", ONE, state(Lifecycle::Error));
    bench.see("arm", ONE, state(Lifecycle::Initialized));
    assert_eq!(bench.said(), ["Found 1", "+1"]);

    bench.see("arm", ONE, state(Lifecycle::Active));

    assert_eq!(bench.said(), ["Recovered 1", "-1"]);
}

#[test]
fn a_death_that_the_guard_has_mended_is_recorded_and_handed_to_nobody() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, state(Lifecycle::Active));

    bench.see("arm", ONE, Finding::Exited { exit: panicked(), restarted_as: Some(TWO) });

    assert_eq!(bench.said(), ["Found 1", "Recovered 1"]);
    assert_eq!(bench.detector.state_of(&object("arm")), Some((TWO, Lifecycle::Created)));
    assert_eq!(bench.entries()[0].recovered_after(), Some(Duration::ZERO));
    assert_eq!(bench.run_until(60_000), [""; 0]);
}

#[test]
fn what_is_seen_of_an_older_life_is_ignored_and_counted() {
    let findings = [exited(panicked()), silent(), declared(), state(Lifecycle::Error), hangs(&[])];
    for finding in findings {
        let mut bench = Bench::new();
        bench.see("arm", TWO, state(Lifecycle::Active));

        bench.see("arm", ONE, finding);

        assert_eq!(bench.said(), [""; 0]);
        assert_eq!(bench.detector.stale(), 1);
    }
}

#[test]
fn a_life_that_was_over_already_ends_without_a_second_fault() {
    for exit in [ExitReason::Returned, ExitReason::Fatal, ExitReason::Aborted, ExitReason::Stopped]
    {
        let mut bench = Bench::new();
        bench.see("arm", ONE, state(Lifecycle::Fatal));

        bench.see("arm", ONE, exited(exit));

        assert_eq!(bench.entries().len(), 1);
        assert_eq!(bench.fault(1).kind, FaultKind::InitializationFailed);
    }
}
