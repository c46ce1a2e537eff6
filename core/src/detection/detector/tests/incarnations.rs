//! Faults of incarnations that end, begin, and were restored.

use super::*;

#[test]
fn an_incarnation_that_becomes_active_ends_the_faults_of_the_incarnations_before() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));
    bench.see("arm", ONE, declared());
    bench.outputs();

    bench.see("arm", TWO, state(Lifecycle::Initialized));
    assert_eq!(bench.outputs(), [""; 0]);
    bench.see("arm", TWO, state(Lifecycle::Active));

    assert_eq!(bench.outputs(), ["Recovered 1", "Recovered 2", "Cleared 2", "-1", "-2"]);
}

#[test]
fn what_a_component_declared_stands_after_its_recovery_until_it_says_that_it_is_over() {
    let mut bench = Bench::new();
    let declared = |detail: &str| Finding::Declared {
        kind: FaultKind::Custom("OIL".into()),
        detail: detail.into(),
    };
    bench.see("arm", ONE, declared("10 % left"));
    bench.see("arm", ONE, declared("9 % left"));
    bench.detector.handle_outcome(FaultId(1), at(1), RecoveryOutcome::Recovered);
    assert_eq!(bench.outputs(), ["Found 1", "Repeated 1", "Recovered 1", "+1"]);
    let entry = bench.entries().remove(0);
    assert!(entry.stands());
    let details = (entry.first_detail.as_deref(), entry.fault.detail.as_str());
    assert_eq!(details, (Some("10 % left"), "9 % left"));

    bench.see("arm", ONE, declared("8 % left"));
    assert_eq!(bench.outputs(), ["Cleared 1", "Found 2", "+2"], "it has not helped");
    bench.detector.handle_outcome(FaultId(2), at(2), RecoveryOutcome::Recovered);
    bench.see("arm", ONE, Finding::Cleared { kind: FaultKind::Custom("OIL".into()) });
    assert_eq!(bench.outputs(), ["Recovered 2", "Cleared 2"]);
    assert!(!bench.entries()[1].stands());
}

#[test]
fn an_insecure_network_stands_whatever_incarnation_of_its_transport_is_at_work() {
    let mut bench = Bench::new();
    bench.see("transport/lan", ONE, insecure());
    bench.see("transport/lan", ONE, declared());
    bench.outputs();

    let restarted = Finding::Exited { exit: panicked(), restarted_as: Some(TWO) };
    bench.see("transport/lan", ONE, restarted);
    bench.see("transport/lan", TWO, state(Lifecycle::Active));

    let standing: Vec<_> = bench.entries().into_iter().filter(|entry| entry.stands()).collect();
    assert_eq!(standing.len(), 1);
    assert_eq!(standing[0].fault.kind, FaultKind::Insecure);
}

#[test]
fn an_incarnation_that_dies_before_it_is_active_is_the_same_fault_still() {
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
    assert_eq!(bench.outputs(), ["Found 1", "+1"]);

    bench.see("arm", ONE, state(Lifecycle::Active));

    assert_eq!(bench.outputs(), ["Recovered 1", "-1"]);
}

#[test]
fn a_death_with_a_restart_by_the_guard_is_not_handed_over() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, state(Lifecycle::Active));

    bench.see("arm", ONE, Finding::Exited { exit: panicked(), restarted_as: Some(TWO) });

    assert_eq!(bench.outputs(), ["Found 1"], "the next incarnation has not started yet");
    assert_eq!(bench.state_of("arm"), Some((TWO, Lifecycle::Created)));
    assert_eq!(bench.run_until(5), [""; 0]);
    bench.see("arm", TWO, state(Lifecycle::Active));
    assert_eq!(bench.outputs(), ["Recovered 1"]);
    assert_eq!(bench.entries()[0].recovered_after(), Some(Duration::from_millis(5)));
    assert_eq!(bench.run_until(60_000), [""; 0]);
}

#[test]
fn a_death_whose_restart_fails_is_handed_over() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, Finding::Exited { exit: panicked(), restarted_as: Some(TWO) });
    assert_eq!(bench.outputs(), ["Found 1"]);

    bench.see("arm", TWO, exited(panicked()));

    assert_eq!(bench.outputs(), ["Repeated 1", "+1"]);
}

/// What the detector of a node says when incarnation 1 of `arm` has panicked and was restarted.
fn restarted_on_the_spot() -> Bench {
    let mut bench = Bench::new();
    bench.see("arm", ONE, state(Lifecycle::Active));
    bench.see("arm", ONE, Finding::Exited { exit: panicked(), restarted_as: Some(TWO) });
    assert_eq!(bench.outputs(), ["Found 1"]);
    bench
}

fn gave_up() -> RecoveryOutcome {
    RecoveryOutcome::GaveUp { reason: "contained by safe stop".into() }
}

#[test]
fn a_death_whose_restart_fails_shares_the_outcome_of_the_next_fault() {
    for failure in [state(Lifecycle::Fatal), state(Lifecycle::Error), hangs(&[]), silent()] {
        let mut bench = restarted_on_the_spot();
        bench.see("arm", TWO, failure);
        assert_eq!(bench.outputs(), ["Found 2", "+2"]);

        let action = RecoveryOutcome::Decided { action: "restart".into() };
        bench.detector.handle_outcome(FaultId(2), at(5), action);
        assert_eq!(bench.outputs(), ["Decided 2", "Decided 1"]);
        bench.detector.handle_outcome(FaultId(2), at(9), gave_up());

        assert_eq!(bench.outputs(), ["GaveUp 2", "GaveUp 1"]);
        let status: Vec<_> = bench.entries().iter().map(|entry| entry.status()).collect();
        assert_eq!(status, [FaultStatus::GivenUp; 2]);
        bench.see("arm", Incarnation(3), state(Lifecycle::Active));
        assert_eq!(bench.outputs().len(), 3, "both are recovered, and 2 is withdrawn");
        assert!(bench.entries().iter().all(|entry| entry.status() == FaultStatus::Closed));
    }
}

#[test]
fn a_death_whose_restart_fails_is_given_up_without_a_decision() {
    let mut bench = restarted_on_the_spot();
    bench.see("arm", TWO, state(Lifecycle::Fatal));

    assert_eq!(bench.outputs(), ["Found 2", "+2"]);
    bench.detector.handle_outcome(FaultId(2), at(5), gave_up());

    assert_eq!(bench.outputs(), ["GaveUp 2", "GaveUp 1"]);
}

#[test]
fn an_orderly_end_of_the_next_incarnation_clears_the_fault() {
    let reported = |bench: &mut Bench| {
        assert_eq!(bench.run_until(999), [""; 0], "another incarnation may follow");
        let outputs = bench.run_until(2000);
        assert_eq!(outputs[0], "Cleared 1");
        assert_eq!(bench.entries()[0].status(), FaultStatus::Closed);
    };
    let mut bench = restarted_on_the_spot();
    bench.see("arm", TWO, exited(ExitReason::Stopped));
    reported(&mut bench);

    let mut bench = restarted_on_the_spot();
    bench.see("arm", TWO, Finding::Enrolled { may_end: true, depends_on: Arc::new([]) });
    bench.see("arm", TWO, exited(ExitReason::Returned));
    reported(&mut bench);

    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));
    assert_eq!(bench.outputs(), ["Found 1", "+1"]);
    bench.see("arm", TWO, exited(ExitReason::Stopped));
    bench.detector.handle_outcome(FaultId(1), at(5), RecoveryOutcome::Waits);
    reported(&mut bench);

    let mut bench = restarted_on_the_spot();
    bench.see("arm", TWO, exited(ExitReason::Stopped));
    bench.see("arm", Incarnation(3), state(Lifecycle::Initialized));
    assert_eq!(bench.run_until(60_000), [""; 0], "it was replaced");
    bench.see("arm", Incarnation(3), state(Lifecycle::Active));
    assert_eq!(bench.outputs(), ["Recovered 1"]);
}

#[test]
fn a_panic_reported_after_the_next_incarnation_ended_ends_likewise() {
    let mut bench = Bench::new();
    bench.see("arm", TWO, exited(ExitReason::Stopped));
    bench.see("arm", ONE, exited(panicked()));
    assert_eq!(bench.run_until(2000), ["Found 1", "Cleared 1"]);

    let mut bench = Bench::new();
    bench.see("arm", TWO, hangs(&[]));
    assert_eq!(bench.outputs(), ["Found 1", "+1"]);
    bench.detector.handle_outcome(FaultId(1), at(5), gave_up());
    assert_eq!(bench.outputs(), ["GaveUp 1"]);
    bench.see("arm", ONE, exited(panicked()));
    assert_eq!(bench.outputs(), ["Found 2", "GaveUp 2"]);
}

#[test]
fn a_fault_of_the_next_incarnation_too_is_handed_over_again() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));
    assert_eq!(bench.outputs(), ["Found 1", "+1"]);
    let decided = RecoveryOutcome::Decided { action: "restart".into() };
    bench.detector.handle_outcome(FaultId(1), at(0), decided);
    bench.outputs();

    bench.see("arm", TWO, exited(panicked()));

    assert_eq!(bench.outputs(), ["Repeated 1", "+1"]);
}

#[test]
fn a_fault_whose_restart_came_to_wait_stands_until_the_incarnation_is_at_work() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));
    assert_eq!(bench.outputs(), ["Found 1", "+1"]);
    bench.see("arm", TWO, unavailable());
    assert_eq!(bench.outputs(), ["Found 2", "+2"]);

    bench.detector.handle_outcome(FaultId(1), at(0), RecoveryOutcome::Waits);

    bench.detector.handle_outcome(FaultId(2), at(1), gave_up());
    assert_eq!(bench.outputs(), ["GaveUp 2", "GaveUp 1"], "1 is not in treatment");
    assert!(bench.entries()[0].stands());
    bench.see("arm", TWO, state(Lifecycle::Active));
    assert_eq!(bench.outputs(), ["Recovered 1", "Recovered 2", "-1", "-2"]);

    bench.see("arm", TWO, exited(panicked()));
    assert_eq!(bench.outputs(), ["Found 3", "+3"]);
    bench.detector.handle_outcome(FaultId(3), at(60_000), RecoveryOutcome::Waits);
    bench.see("arm", Incarnation(3), exited(panicked()));
    assert_eq!(bench.outputs(), ["Repeated 3", "+3"], "its treatment had ended");
}

#[test]
fn a_fault_whose_reset_waits_is_recovered_when_active_again() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, state(Lifecycle::Active));
    bench.see("arm", ONE, declared());
    bench.see("arm", ONE, state(Lifecycle::Error));
    assert_eq!(bench.outputs(), ["Found 1", "Found 2", "+1", "+2"]);

    bench.see("arm", ONE, unavailable());
    for id in [1, 2] {
        bench.detector.handle_outcome(FaultId(id), at(0), RecoveryOutcome::Waits);
    }
    assert_eq!(bench.outputs(), ["Found 3", "+3"]);

    bench.see("arm", ONE, state(Lifecycle::Active));
    let outputs = bench.outputs();
    assert_eq!(outputs[..4], ["Recovered 2", "Recovered 1", "Cleared 1", "Recovered 3"]);
}

#[test]
fn a_fault_whose_reset_waits_is_given_up_with_its_incarnation() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, state(Lifecycle::Active));
    bench.see("arm", ONE, state(Lifecycle::Error));
    bench.see("arm", ONE, unavailable());
    bench.detector.handle_outcome(FaultId(1), at(0), RecoveryOutcome::Waits);
    bench.see("arm", ONE, state(Lifecycle::Fatal));
    bench.outputs();

    bench.detector.handle_outcome(FaultId(3), at(5), gave_up());

    assert_eq!(bench.outputs(), ["GaveUp 3", "GaveUp 1"]);
}

#[test]
fn what_waits_no_more_is_not_unavailable_any_more() {
    let ends = [
        (ONE, exited(panicked()), "Panic"),
        (ONE, exited(ExitReason::Stopped), ""),
        (ONE, hangs(&[]), "Hang"),
        (ONE, state(Lifecycle::Fatal), "InitializationFailed"),
        (
            ONE,
            Finding::Declared { kind: FaultKind::InitializationFailed, detail: "late".into() },
            "InitializationFailed",
        ),
        (TWO, state(Lifecycle::Created), ""),
    ];
    for (incarnation, end, follows) in ends {
        let mut bench = Bench::new();
        bench.see("arm", ONE, unavailable());
        assert_eq!(bench.outputs(), ["Found 1", "+1"]);

        bench.see("arm", incarnation, end);

        let open_fault = bench.entries().into_iter().filter(|entry| entry.stands());
        let open_fault: Vec<String> = open_fault.map(|e| format!("{:?}", e.fault.kind)).collect();
        assert_eq!(open_fault.join(" "), follows);
        let outputs = bench.outputs();
        assert!(outputs.contains(&"Cleared 1".to_owned()), "{outputs:?}");
    }
}

#[test]
fn what_stands_when_the_node_ends_is_not_repaired_by_the_end_of_its_component() {
    let mut bench = restarted_on_the_spot();
    bench.see("arm", TWO, unavailable());
    bench.outputs();

    bench.detector.handle_node_end();
    bench.see("arm", TWO, state(Lifecycle::Finalized));
    bench.see("arm", TWO, exited(ExitReason::Stopped));

    let outputs = bench.run_until(60_000);
    assert!(!outputs.iter().any(|step| step.starts_with("Cleared")), "{outputs:?}");
    assert!(bench.entries().iter().all(|entry| entry.stands()));
}

#[test]
fn a_hang_of_the_incarnation_that_was_to_end_a_hang_is_handed_over_again() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, hangs(&[]));
    assert_eq!(bench.outputs(), ["Found 1", "+1"]);
    bench.see("arm", ONE, hangs(&[]));
    assert_eq!(bench.outputs(), ["Repeated 1"]);

    bench.see("arm", TWO, hangs(&[]));

    assert_eq!(bench.outputs(), ["+1"]);
    assert_eq!(bench.fault(1).incarnation, TWO);
}

#[test]
fn what_is_seen_of_an_older_incarnation_is_ignored() {
    let ended = exited(ExitReason::Aborted);
    let findings = [ended, silent(), declared(), state(Lifecycle::Error), hangs(&[])];
    for finding in findings {
        let mut bench = Bench::new();
        bench.see("arm", TWO, state(Lifecycle::Active));

        bench.see("arm", ONE, finding);

        assert_eq!(bench.outputs(), [""; 0]);
    }
}

#[test]
fn a_panic_of_an_older_incarnation_is_told_late_and_changes_nothing_else() {
    let mut bench = Bench::new();
    bench.see("arm", TWO, state(Lifecycle::Active));
    bench.see("arm", ONE, exited(panicked()));
    assert_eq!(bench.outputs(), ["Found 1", "Recovered 1"]);
    assert_eq!(bench.state_of("arm"), Some((TWO, Lifecycle::Active)));

    let mut bench = Bench::new();
    bench.see("arm", TWO, hangs(&[]));
    assert_eq!(bench.outputs(), ["Found 1", "+1"]);
    bench.see("arm", ONE, Finding::Exited { exit: panicked(), restarted_as: Some(TWO) });
    assert_eq!(bench.outputs(), ["Found 2"]);
    bench.see("arm", ONE, exited(panicked()));
    assert_eq!(bench.fault(2).count, 2);
    bench.see("arm", Incarnation(3), state(Lifecycle::Active));
    assert_eq!(bench.outputs(), ["Recovered 2", "Recovered 1", "-1"]);
}

#[test]
fn an_incarnation_that_was_over_already_ends_without_a_second_fault() {
    for exit in [ExitReason::Returned, ExitReason::Fatal, ExitReason::Aborted, ExitReason::Stopped]
    {
        let mut bench = Bench::new();
        bench.see("arm", ONE, state(Lifecycle::Fatal));

        bench.see("arm", ONE, exited(exit));

        assert_eq!(bench.entries().len(), 1);
        assert_eq!(bench.fault(1).kind, FaultKind::InitializationFailed);
    }
}

#[test]
fn a_fatal_end_is_a_fault_of_its_own_only_where_nothing_was_said_before() {
    for (states, kind) in [
        (vec![], FaultKind::UnexpectedExit),
        (
            vec![Lifecycle::Initialized, Lifecycle::Error, Lifecycle::Finalized],
            FaultKind::ErrorState,
        ),
        (vec![Lifecycle::Fatal, Lifecycle::Finalized], FaultKind::InitializationFailed),
    ] {
        let mut bench = Bench::new();
        states.iter().for_each(|&to| bench.see("arm", ONE, state(to)));

        bench.see("arm", ONE, exited(ExitReason::Fatal));

        assert_eq!(bench.entries().len(), 1, "{states:?}");
        assert_eq!(bench.fault(1).kind, kind);
    }
}

#[test]
fn a_hook_that_fails_while_an_incarnation_ends_is_recorded_and_not_handed_over() {
    let failed = |state, why: &str| Finding::State { state, reason: Some(why.to_owned()) };
    let mut bench = Bench::new();
    bench.see("arm", ONE, state(Lifecycle::Active));
    bench.outputs();

    bench.see("arm", ONE, failed(Lifecycle::Initialized, "on_deactivated failed: jammed"));
    assert_eq!(bench.outputs(), ["Found 1", "Cleared 1"]);
    bench.see("arm", ONE, failed(Lifecycle::Initialized, "on_shutdown was cut off"));
    assert_eq!(bench.outputs(), ["Found 2", "Cleared 2"]);
    bench.see("arm", ONE, failed(Lifecycle::Finalized, "on_finalize failed: bent"));
    assert_eq!(bench.outputs(), ["Found 3", "Cleared 3"]);
    bench.see("arm", ONE, exited(ExitReason::Stopped));

    assert!(bench.run_until(60_000).is_empty());
    let fault = bench.fault(1);
    assert_eq!(fault.kind, FaultKind::ErrorState);
    assert_eq!(fault.detail, "on_deactivated failed: jammed");
    assert!(bench.entries().iter().all(|entry| entry.status() == FaultStatus::Closed));
}

#[test]
fn a_hook_that_fails_in_error_is_counted_with_that_error() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, state(Lifecycle::Active));
    bench.see("arm", ONE, state(Lifecycle::Error));
    assert_eq!(bench.outputs(), ["Found 1", "+1"]);

    let reason = Some("on_aborting failed: jammed".to_owned());
    bench.see("arm", ONE, Finding::State { state: Lifecycle::Error, reason });

    assert_eq!(bench.outputs(), ["Repeated 1"]);
    assert_eq!((bench.fault(1).count, &*bench.fault(1).detail), (2, "on_aborting failed: jammed"));
}

#[test]
fn a_restart_storm_is_over_when_its_group_is() {
    let storm = || Finding::Declared { kind: FaultKind::RestartStorm, detail: "often".into() };
    let mut bench = Bench::new();
    bench.see("group", ONE, state(Lifecycle::Active));
    bench.see("group", ONE, storm());
    bench.outputs();

    bench.see("group", ONE, state(Lifecycle::Finalized));

    assert_eq!(bench.outputs()[0], "Cleared 1");
}
