//! Which findings are faults, and how often a fault is reported.

use super::*;

#[test]
fn of_a_long_detail_the_beginning_is_kept() {
    let mut bench = Bench::new();
    let detail = "ä".repeat(10_000);
    bench.see("arm", ONE, Finding::Declared { kind: FaultKind::CheckFailed, detail });
    assert_eq!(bench.fault(1).detail, "ä".repeat(1_024));
}

#[test]
fn everything_on_the_list_is_found_under_its_kind() {
    let age = Duration::from_millis(500);
    let reason = || "why".to_string();
    let cases: [(&str, Finding, FaultKind); 16] = [
        ("arm", exited(panicked()), FaultKind::Panic),
        ("arm", exited(ExitReason::Returned), FaultKind::UnexpectedExit),
        ("arm", exited(ExitReason::Aborted), FaultKind::UnexpectedExit),
        ("arm", hangs(&[]), FaultKind::Hang),
        ("arm", Finding::Waits { during: "Scan", age }, FaultKind::Hang),
        ("arm", Finding::Lost { culprit: object("a") }, FaultKind::Hang),
        ("arm", silent(), FaultKind::Silence),
        ("arm", state(Lifecycle::Error), FaultKind::ErrorState),
        ("arm", state(Lifecycle::Fatal), FaultKind::InitializationFailed),
        ("arm", declared(), FaultKind::CheckFailed),
        ("arm", overloaded(&[]), FaultKind::Overload),
        ("-eth-n", down(), FaultKind::LinkDown),
        (
            "-eth-n",
            Finding::Link(LinkCondition::Degraded { reason: reason() }),
            FaultKind::LinkDegraded,
        ),
        ("@n", lost(), FaultKind::NodeLost),
        (
            "@n",
            Finding::Node(NodeCondition::InSafeState { reason: reason() }),
            FaultKind::NodeInSafeState,
        ),
        (
            "arm",
            Finding::Declared { kind: FaultKind::Custom("X1".into()), detail: reason() },
            FaultKind::Custom("X1".into()),
        ),
    ];
    for (location, finding, kind) in cases {
        let mut bench = Bench::new();

        bench.see(location, ONE, finding.clone());

        assert_eq!(bench.outputs(), ["Found 1", "+1"], "{finding:?}");
        let fault = bench.fault(1);
        assert_eq!((fault.kind.clone(), fault.count, fault.symptom_of), (kind, 1, None));
        assert!(!fault.detail.is_empty(), "{finding:?} says nothing");
    }
}

#[test]
fn a_fault_that_is_found_again_is_told_in_its_newest_words() {
    let mut bench = Bench::new();
    let down = |reason: &str| Finding::Link(LinkCondition::Down { reason: reason.into() });

    bench.see("-eth-n", ONE, down("the adapter does not answer"));
    bench.see("-eth-n", ONE, down("node a has the address"));

    assert_eq!(bench.outputs(), ["Found 1", "Repeated 1", "+1"]);
    assert_eq!(
        (bench.fault(1).detail.as_str(), bench.fault(1).count),
        ("node a has the address", 2)
    );
}

#[test]
fn what_is_no_fault_is_not_recorded() {
    let harmless = [
        ("arm", exited(ExitReason::Stopped)),
        ("arm", Finding::Spoke),
        ("arm", Finding::Resumed),
        ("arm", Finding::Flows),
        ("arm", Finding::Dismissed),
        ("arm", state(Lifecycle::Initialized)),
        ("arm", state(Lifecycle::Active)),
        ("arm", state(Lifecycle::Finalized)),
        ("-eth-n", Finding::Link(LinkCondition::Up)),
        ("@n", Finding::Node(NodeCondition::Reachable)),
    ];
    for (location, finding) in harmless {
        let mut bench = Bench::new();

        bench.see(location, ONE, finding.clone());

        assert_eq!(bench.outputs(), [""; 0], "{finding:?}");
    }
}

#[test]
fn an_incarnation_that_ends_itself_is_missed_unless_it_was_known_to_end() {
    let cases = [
        (vec![Lifecycle::Finalized], FaultKind::UnexpectedExit),
        (vec![Lifecycle::Fatal, Lifecycle::Finalized], FaultKind::Fatal),
    ];
    for (states, kind) in cases {
        let mut bench = Bench::new();
        bench.see("arm", ONE, state(Lifecycle::Active));
        states.iter().for_each(|&to| bench.see("arm", ONE, state(to)));

        bench.see("arm", ONE, exited(ExitReason::Returned));

        assert_eq!(bench.outputs(), ["Found 1", "+1"], "{states:?}");
        assert_eq!(bench.fault(1).kind, kind);
    }
}

#[test]
fn each_fault_that_goes_by_itself_is_cleared_by_what_says_so() {
    let age = Duration::from_millis(500);
    let reason = || "why".to_string();
    let cases = [
        ("arm", silent(), Finding::Spoke),
        ("arm", hangs(&[]), Finding::Resumed),
        ("arm", Finding::Waits { during: "Scan", age }, Finding::Resumed),
        ("arm", overloaded(&[]), Finding::Flows),
        ("arm", declared(), Finding::Dismissed),
        ("-eth-n", down(), Finding::Link(LinkCondition::Up)),
        (
            "-eth-n",
            Finding::Link(LinkCondition::Degraded { reason: reason() }),
            Finding::Link(LinkCondition::Up),
        ),
        ("@n", lost(), Finding::Node(NodeCondition::Reachable)),
    ];
    for (location, fault, end) in cases {
        let mut bench = Bench::new();
        bench.see(location, ONE, fault.clone());
        bench.outputs();

        bench.see(location, ONE, end);

        assert_eq!(bench.outputs(), ["Cleared 1", "-1"], "{fault:?}");
        bench.see(location, ONE, fault.clone());
        assert_eq!(bench.outputs(), ["Found 2", "+2"], "{fault:?}");
    }
}

#[test]
fn a_fault_that_is_over_before_it_was_handed_over_is_handed_to_nobody() {
    let mut bench = Bench::new();
    bench.see("a", ONE, silent());
    bench.see("b", ONE, silent());

    bench.see("b", ONE, Finding::Spoke);

    assert_eq!(bench.outputs(), ["Found 1", "Found 2", "Cleared 2", "+1"]);
}

#[test]
fn the_same_fault_again_is_counted_and_told_at_powers_of_two() {
    let mut bench = Bench::new();
    for _ in 0..9 {
        bench.see("arm", ONE, declared());
    }

    assert_eq!(bench.fault(1).count, 9);
    assert_eq!(bench.outputs(), ["Found 1", "Repeated 1", "Repeated 1", "Repeated 1", "+1"]);
}

#[test]
fn every_way_that_does_not_exist_is_a_fault_and_every_other_is_none() {
    use Lifecycle::{Active, Created, Error, Fatal, Finalized, Initialized};
    let all = [Created, Initialized, Active, Error, Fatal, Finalized];
    for from in all {
        for to in all {
            let mut bench = Bench::new();
            bench.see("arm", ONE, state(from));

            bench.see("arm", ONE, state(to));

            let entries = bench.entries();
            let wrong = entries.iter().filter(|e| e.fault.kind == FaultKind::CheckFailed);
            let expected = from != to && !from.may_reach(to);
            assert_eq!(wrong.count(), usize::from(expected), "{from} to {to}");
            assert_eq!(bench.state_of("arm"), Some((ONE, to)));
        }
    }
}

#[test]
fn fatal_after_initialisation_is_fatal() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, state(Lifecycle::Initialized));

    bench.see("arm", ONE, state(Lifecycle::Fatal));

    let fault = bench.fault(1);
    assert_eq!((fault.kind, fault.severity), (FaultKind::Fatal, Severity::Critical));
    assert_eq!(fault.detail, "why");
}
