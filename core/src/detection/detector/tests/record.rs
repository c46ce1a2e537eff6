//! The treatment of open faults, and their record.

use super::*;
use proptest::prelude::*;
use std::collections::BTreeSet;

#[test]
fn the_recoverer_s_word_is_recorded_and_told() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));
    bench.outputs();

    let decided = RecoveryOutcome::Decided { action: "restart".into() };
    bench.detector.handle_outcome(FaultId(1), at(3), decided);
    let failed = RecoveryOutcome::Failed { action: "restart".into(), reason: "no".into() };
    bench.detector.handle_outcome(FaultId(1), at(5), failed);
    bench.detector.handle_outcome(FaultId(1), at(8), RecoveryOutcome::Recovered);
    bench.detector.handle_outcome(
        FaultId(1),
        at(9),
        RecoveryOutcome::GaveUp { reason: "late".into() },
    );
    bench.detector.handle_outcome(FaultId(7), at(9), RecoveryOutcome::Recovered);

    assert_eq!(bench.outputs(), ["Decided 1", "Failed 1", "Recovered 1"]);
    let entry = &bench.entries()[0];
    assert_eq!(entry.decided, Some((at(3), "restart".into())));
    assert_eq!(entry.recovered_after(), Some(Duration::from_millis(8)));
    bench.see("arm", TWO, exited(panicked()));
    assert_eq!(bench.outputs(), ["Found 2", "+2"]);
}

#[test]
fn what_was_given_up_stays_latched_for_that_incarnation_and_is_new_in_the_next() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, declared());
    bench.detector.handle_outcome(
        FaultId(1),
        at(3),
        RecoveryOutcome::GaveUp { reason: "no".into() },
    );
    bench.outputs();

    bench.see("arm", ONE, declared());
    assert_eq!(bench.outputs(), ["Repeated 1"]);
    bench.see("arm", TWO, declared());
    assert_eq!(bench.outputs(), ["Cleared 1", "Found 2", "-1", "+2"]);
}

#[test]
fn a_contained_fault_outlasts_its_incarnation_while_isolated() {
    let mut bench = Bench::new();
    let works = |bench: &mut Bench, incarnation| {
        bench.see("arm", incarnation, state(Lifecycle::Initialized));
        bench.see("arm", incarnation, state(Lifecycle::Active));
        bench.outputs()
    };
    bench.see("arm", ONE, silent());
    bench.see("arm", ONE, Finding::Isolated { isolated: true });
    let contained = RecoveryOutcome::GaveUp { reason: "contained".into() };
    bench.detector.handle_outcome(FaultId(1), at(3), contained);
    bench.see("arm", ONE, exited(panicked()));
    bench.outputs();

    assert_eq!(works(&mut bench, TWO), ["Recovered 2", "-2"]);
    assert_eq!(bench.entries()[0].status(), FaultStatus::GivenUp);

    bench.see("arm", TWO, Finding::Isolated { isolated: false });
    assert_eq!(works(&mut bench, Incarnation(3)), ["Recovered 1", "-1"]);
}

#[test]
fn a_link_fault_stands_until_the_link_is_up_though_re_routed() {
    let mut bench = Bench::new();
    bench.see("-eth-n", Incarnation(0), down());
    let decided = RecoveryOutcome::Decided { action: "re-route".into() };
    bench.detector.handle_outcome(FaultId(1), at(3), decided);
    bench.detector.handle_outcome(FaultId(1), at(8), RecoveryOutcome::Recovered);
    assert_eq!(bench.outputs(), ["Found 1", "Decided 1", "Recovered 1", "+1"]);

    let entry = &bench.entries()[0];
    assert_eq!((entry.recovered_at, entry.repaired_at), (Some(at(8)), None));
    assert_eq!(entry.status(), FaultStatus::Recovered);
    assert!(bench.run_until(60_000).is_empty(), "nothing more is decided about it");

    bench.see("-eth-n", Incarnation(0), Finding::Link(LinkCondition::Up));
    assert_eq!(bench.outputs(), ["Cleared 1"]);
    let entry = &bench.entries()[0];
    assert_eq!((entry.recovered_at, entry.repaired_at), (Some(at(8)), Some(at(60_000))));
    assert_eq!(entry.repaired_after(), Some(Duration::from_secs(60)));
    bench.see("-eth-n", Incarnation(0), down());
    assert_eq!(bench.outputs(), ["Found 2", "+2"]);
}

#[test]
fn a_restarted_component_is_recovered_and_repaired_at_once() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));
    bench.detector.handle_outcome(FaultId(1), at(8), RecoveryOutcome::Recovered);

    let entry = &bench.entries()[0];
    assert_eq!((entry.recovered_at, entry.repaired_at), (Some(at(8)), Some(at(8))));
    assert_eq!(entry.status(), FaultStatus::Closed);
}

#[test]
fn a_node_that_leaves_in_order_takes_the_faults_of_its_links_along() {
    let mut bench = Bench::new();
    bench.see("-eth-n", Incarnation(0), down());
    bench.see("-can-o", Incarnation(0), down());
    bench.outputs();

    bench.see("@n", Incarnation(9), Finding::Node(NodeCondition::Left));

    assert_eq!(bench.outputs(), ["Cleared 1", "-1"]);
}

#[test]
fn a_crash_loop_is_one_counted_fault_until_the_node_stays_up() {
    let mut bench = Bench::new();
    for incarnation in 1..=500 {
        bench.now = at(incarnation * 444);
        if incarnation % 2 == 0 {
            bench.see("@n", Incarnation(incarnation), lost());
        }
        bench.see("@n", Incarnation(incarnation + 1), Finding::Node(NodeCondition::Restarted));
        bench.outputs();
    }
    let of_kind = |bench: &Bench, kind| {
        bench.entries().into_iter().filter(|entry| entry.fault.kind == kind).collect::<Vec<_>>()
    };
    let loops = of_kind(&bench, FaultKind::CrashLoop);
    assert_eq!((loops.len(), loops[0].fault.count), (1, 498), "three restarts are the first");
    assert!(loops[0].stands() && loops[0].fault.detail.contains("500 times"));
    let deaths = of_kind(&bench, FaultKind::NodeLost);
    assert!(deaths.iter().all(|entry| !entry.stands()));
    let symptoms = deaths.iter().filter(|e| e.fault.symptom_of == Some(loops[0].fault.id));
    assert!(symptoms.count() >= deaths.len() - 3);

    let id = loops[0].fault.id.0;
    let observed = RecoveryOutcome::Decided { action: "observe".into() };
    bench.detector.handle_outcome(FaultId(id), bench.now, observed);
    assert_eq!(bench.outputs(), [format!("Decided {id}")]);
    assert!(bench.run_until(222_000 + 59_999).is_empty());
    assert_eq!(bench.run_until(222_000 + 60_000), [format!("Cleared {id}"), format!("-{id}")]);
}

#[test]
fn an_unnoticed_restart_of_a_node_is_found_and_recovered_at_once() {
    let mut bench = Bench::new();

    bench.see("@n", Incarnation(9), Finding::Node(NodeCondition::Restarted));
    assert_eq!(bench.outputs(), ["Found 1", "Recovered 1", "Cleared 1"]);

    bench.see("@n", Incarnation(9), lost());
    bench.see("@n", Incarnation(10), Finding::Node(NodeCondition::Restarted));
    assert_eq!(bench.outputs(), ["Found 2", "Recovered 2", "Cleared 2", "+2", "-2"]);
}

#[test]
fn a_safe_state_stands_until_the_node_works_leaves_or_restarts() {
    for over in [NodeCondition::AtWork, NodeCondition::Left, NodeCondition::Restarted] {
        let mut bench = Bench::new();
        let rest = || Finding::Node(NodeCondition::InSafeState { reason: "it panics".into() });
        bench.see("@n", Incarnation(9), rest());
        bench.see("@n", Incarnation(9), Finding::Node(NodeCondition::Reachable));
        assert_eq!(bench.outputs(), ["Found 1", "+1"], "{over:?}");

        bench.see("@n", Incarnation(9), Finding::Node(over.clone()));
        let ended = bench.outputs();
        assert_eq!(ended[0], "Cleared 1", "{over:?}: {ended:?}");
    }
}

fn any_finding() -> impl Strategy<Value = Finding> {
    prop_oneof![
        Just(exited(panicked())),
        Just(exited(ExitReason::Returned)),
        Just(exited(ExitReason::Stopped)),
        Just(Finding::Exited { exit: panicked(), restarted_as: Some(TWO) }),
        Just(silent()),
        Just(Finding::Spoke),
        Just(declared()),
        Just(hangs(&["a", "b", "c"])),
        Just(Finding::Lost { culprit: object("a") }),
        Just(Finding::Resumed),
        Just(Finding::Flows),
        Just(state(Lifecycle::Active)),
        Just(state(Lifecycle::Error)),
        Just(state(Lifecycle::Fatal)),
        Just(Finding::Dismissed),
    ]
}

proptest! {
    /// Whatever is seen, in whatever order: a place has at most one standing fault of a kind, roots
    /// come before their symptoms, no fault is its own cause, and the record stays bounded.
    #[test]
    fn the_record_stays_in_order_whatever_is_seen(
        seen in prop::collection::vec(
            (prop::sample::select(vec!["a", "b", "c"]), 1..4u64, any_finding(), 0..900u64), 0..120
        )
    ) {
        let mut bench = Bench::new();
        bench.detector.fault_log = FaultLog::new(16);
        bench.depend("a", &["b"]);
        bench.depend("b", &["c", "n:x"]);
        bench.depend("c", &["a"]);
        let mut now = 0;
        for (object, incarnation, finding, wait) in seen {
            bench.see(object, Incarnation(incarnation), finding);
            now += wait;
            bench.run_until(now);

            let entries = bench.entries();
            prop_assert!(entries.len() <= 16);
            let mut open_fault = BTreeSet::new();
            let mut passed = BTreeSet::new();
            for entry in &entries {
                let fault = &entry.fault;
                prop_assert_eq!(entry.stands(), bench.detector.fault_log.stands(fault.id));
                if entry.stands() {
                    let kind = fault.kind.clone();
                    prop_assert!(open_fault.insert((fault.location.clone(), kind)));
                }
                if let Some(root) = fault.symptom_of {
                    prop_assert_ne!(root, fault.id);
                    prop_assert_ne!(bench.detector.fault_log.root(root), fault.id);
                    let known = bench.detector.fault_log.entry(root).is_some();
                    prop_assert!(!known || passed.contains(&bench.detector.fault_log.root(root)));
                }
                passed.insert(fault.id);
            }
        }
    }
}
