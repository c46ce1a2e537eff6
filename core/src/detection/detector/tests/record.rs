//! What becomes of faults that stand, and what the record says of them.

use super::*;
use proptest::prelude::*;

#[test]
fn the_recoverer_s_word_is_recorded_and_told() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));
    bench.said();

    let decided = Outcome::Decided { measure: "restart".into() };
    bench.detector.handle_outcome(FaultId(1), at(3), decided);
    bench.detector.handle_outcome(FaultId(1), at(8), Outcome::Recovered);
    bench.detector.handle_outcome(FaultId(1), at(9), Outcome::GaveUp { reason: "late".into() });
    bench.detector.handle_outcome(FaultId(7), at(9), Outcome::Recovered);

    assert_eq!(bench.said(), ["Decided 1", "Recovered 1"]);
    let entry = &bench.entries()[0];
    assert_eq!(entry.decided, Some((at(3), "restart".into())));
    assert_eq!(entry.recovered_after(), Some(Duration::from_millis(8)));
    bench.see("arm", TWO, exited(panicked()));
    assert_eq!(bench.said(), ["Found 2", "+2"]);
}

#[test]
fn what_was_given_up_stays_latched_for_that_life_and_is_new_in_the_next() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, declared());
    bench.detector.handle_outcome(FaultId(1), at(3), Outcome::GaveUp { reason: "no".into() });
    bench.said();

    bench.see("arm", ONE, declared());
    assert_eq!(bench.said(), ["Repeated 1"]);
    bench.see("arm", TWO, declared());
    assert_eq!(bench.said(), ["Found 2", "+2"]);
}

#[test]
fn a_fault_on_which_nobody_decides_is_handed_over_again_and_in_the_end_given_up_loudly() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));

    let said = bench.run_until(60_000);

    assert_eq!(said, ["Found 1", "+1", "+1", "+1", "+1", "GaveUp 1"]);
}

#[test]
fn a_node_that_died_and_began_again_unnoticed_is_found_and_recovered_in_one() {
    let mut bench = Bench::new();

    bench.see("@n", Incarnation(9), Finding::Node(NodeCondition::Restarted));
    assert_eq!(bench.said(), ["Found 1", "Recovered 1"]);

    bench.see("@n", Incarnation(9), lost());
    bench.see("@n", Incarnation(10), Finding::Node(NodeCondition::Restarted));
    assert_eq!(bench.said(), ["Found 2", "Recovered 2", "+2", "-2"]);
}

#[test]
fn that_a_node_is_at_rest_stands_until_it_works_again_leaves_or_begins_anew() {
    for over in [NodeCondition::AtWork, NodeCondition::Left, NodeCondition::Restarted] {
        let mut bench = Bench::new();
        let rest = || Finding::Node(NodeCondition::AtRest { reason: "it panics".into() });
        bench.see("@n", Incarnation(9), rest());
        bench.see("@n", Incarnation(9), Finding::Node(NodeCondition::Reachable));
        assert_eq!(bench.said(), ["Found 1", "+1"], "{over:?}");

        bench.see("@n", Incarnation(9), Finding::Node(over.clone()));
        let ended = bench.said();
        assert_eq!(ended[0], "Cleared 1", "{over:?}: {ended:?}");
    }
}

#[test]
fn a_detector_that_was_struck_keeps_its_record_and_hands_over_again() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));
    while bench.detector.poll_output().is_some() {}

    bench.detector = bench.detector.clone().reborn(at(1));

    assert_eq!(bench.said(), ["+1"]);
    bench.see("arm", ONE, declared());
    assert_eq!(bench.said(), ["Found 2", "+2"]);
}

fn any_finding() -> impl Strategy<Value = Finding> {
    let age = Duration::from_millis(500);
    prop_oneof![
        Just(exited(panicked())),
        Just(exited(Exit::Returned)),
        Just(exited(Exit::Stopped)),
        Just(Finding::Exited { exit: panicked(), restarted_as: Some(TWO) }),
        Just(silent()),
        Just(Finding::Spoke),
        Just(declared()),
        Just(hangs(&["a", "b", "c"])),
        Just(Finding::Lost { culprit: object("a") }),
        Just(Finding::Resumed),
        Just(Finding::Stuck { oldest: age, queued: 1 }),
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
        let mut bench = Bench::with(DetectorLimits { record: 16, ..DetectorLimits::default() });
        bench.depend("a", &["b"]);
        bench.depend("b", &["c", "n:x"]);
        bench.depend("c", &["a"]);
        let mut now = 0;
        for (object, life, finding, wait) in seen {
            bench.see(object, Incarnation(life), finding);
            now += wait;
            bench.run_until(now);

            let entries = bench.entries();
            prop_assert!(entries.len() <= 16);
            let mut standing = BTreeSet::new();
            let mut passed = BTreeSet::new();
            for entry in &entries {
                let fault = &entry.fault;
                if bench.detector.chronicle.stands(fault.id) {
                    let kind = fault.kind.clone();
                    prop_assert!(standing.insert((fault.place.clone(), kind)));
                }
                if let Some(root) = fault.symptom_of {
                    prop_assert_ne!(root, fault.id);
                    prop_assert_ne!(bench.detector.chronicle.root(root), fault.id);
                    let known = bench.detector.chronicle.entry(root).is_some();
                    prop_assert!(!known || passed.contains(&bench.detector.chronicle.root(root)));
                }
                passed.insert(fault.id);
            }
        }
    }
}
