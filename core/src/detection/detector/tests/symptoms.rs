//! Roots, and what is only their consequence.

use super::*;

#[test]
fn what_an_object_suffers_while_something_it_depends_on_is_down_is_a_symptom() {
    for symptom in [declared(), silent(), state(Lifecycle::Error), state(Lifecycle::Fatal)] {
        let mut bench = Bench::new();
        bench.depend("planner", &["map"]);
        bench.depend("map", &["laser"]);
        bench.see("laser", ONE, exited(panicked()));

        bench.see("planner", ONE, symptom.clone());

        assert_eq!(bench.fault(2).symptom_of, Some(FaultId(1)), "{symptom:?}");
    }
}

#[test]
fn a_panic_and_a_hang_of_its_own_are_never_symptoms() {
    for own in [exited(panicked()), exited(ExitReason::Returned), hangs(&[])] {
        let mut bench = Bench::new();
        bench.depend("map", &["laser"]);
        bench.see("laser", ONE, exited(panicked()));

        bench.see("map", ONE, own);

        assert_eq!(bench.fault(2).symptom_of, None);
    }
}

#[test]
fn a_component_that_waits_for_one_that_hangs_is_a_symptom_until_it_keeps_its_own_thread() {
    let waits = Finding::Waits { during: "Move", age: Duration::from_millis(900) };
    let gave_up = || RecoveryOutcome::GaveUp { reason: "too often".into() };
    let mut bench = Bench::new();
    bench.depend("arm", &["encoder"]);
    bench.see("encoder", ONE, hangs(&[]));
    bench.see("arm", ONE, waits);
    assert_eq!(bench.outputs(), ["Found 1", "Found 2", "+1", "+2"]);
    assert_eq!(bench.fault(2).symptom_of, Some(FaultId(1)));

    bench.see("arm", ONE, hangs(&[]));

    assert_eq!(bench.outputs(), ["Repeated 2", "Explained 2", "+2"]);
    assert_eq!(bench.fault(2).symptom_of, None);
    bench.detector.handle_outcome(FaultId(2), bench.now, gave_up());
    assert_eq!(bench.given_up(2), "too often");
}

#[test]
fn a_symptom_that_is_given_up_names_its_root() {
    let mut bench = Bench::new();
    bench.depend("arm", &["encoder"]);
    bench.see("encoder", ONE, hangs(&[]));
    bench.see("arm", ONE, silent());

    let gave_up = RecoveryOutcome::GaveUp { reason: "too often".into() };
    bench.detector.handle_outcome(FaultId(2), bench.now, gave_up);

    assert_eq!(bench.given_up(2), "too often; it is a symptom of fault 1, hang of m:encoder");
}

#[test]
fn a_root_that_is_found_shortly_after_its_symptom_explains_it() {
    let mut bench = Bench::new();
    bench.depend("planner", &["laser"]);
    bench.see("planner", ONE, silent());
    bench.outputs();

    bench.now = at(1900);
    bench.see("laser", ONE, exited(panicked()));

    assert_eq!(bench.outputs(), ["Found 2", "Explained 1", "+2"]);
    assert_eq!(bench.fault(1).symptom_of, Some(FaultId(2)));
    let order: Vec<u64> = bench.entries().iter().map(|entry| entry.fault.id.0).collect();
    assert_eq!(order, [2, 1]);
}

#[test]
fn a_fault_that_is_found_long_after_another_does_not_explain_it() {
    let mut bench = Bench::new();
    bench.depend("planner", &["laser"]);
    bench.see("planner", ONE, silent());

    bench.now = at(2100);
    bench.see("laser", ONE, exited(panicked()));

    assert_eq!(bench.fault(1).symptom_of, None);
}

#[test]
fn of_two_that_depend_on_each_other_the_first_to_fail_is_the_root() {
    let mut bench = Bench::new();
    bench.depend("a", &["b"]);
    bench.depend("b", &["a"]);

    bench.see("a", ONE, silent());
    bench.see("b", ONE, silent());

    assert_eq!((bench.fault(1).symptom_of, bench.fault(2).symptom_of), (None, Some(FaultId(1))));
}

#[test]
fn links_and_what_depends_on_remote_objects_are_symptoms_of_the_lost_node() {
    let mut bench = Bench::new();
    bench.depend("planner", &["n:map"]);
    bench.see("-eth-n", Incarnation(0), down());
    bench.see("@n", Incarnation(9), lost());
    bench.see("planner", ONE, declared());
    bench.see("-usb-n", Incarnation(0), down());
    bench.see("-can-x", Incarnation(0), down());

    let symptoms = [1, 2, 3, 4, 5].map(|id| bench.fault(id).symptom_of.map(|root| root.0));
    assert_eq!(symptoms, [Some(2), None, Some(2), Some(2), None]);
    let order: Vec<u64> = bench.entries().iter().map(|entry| entry.fault.id.0).collect();
    assert_eq!(order, [2, 1, 3, 4, 5]);
}

#[test]
fn the_victims_of_a_hang_are_its_symptoms_before_and_after_it_is_found() {
    let mut bench = Bench::new();
    for name in ["laser", "map", "pose"] {
        bench.depend(name, &[]);
    }
    bench.see("map", ONE, silent());
    bench.see("laser", ONE, hangs(&["laser", "map", "pose"]));
    bench.see("pose", ONE, silent());
    bench.see("laser", ONE, silent());
    bench.see("map", ONE, Finding::Lost { culprit: object("laser") });

    let symptoms = [1, 2, 3, 4, 5].map(|id| bench.fault(id).symptom_of.map(|root| root.0));
    assert_eq!(symptoms, [Some(2), None, Some(2), Some(2), Some(2)]);
}

#[test]
fn a_lost_victim_is_a_symptom_after_its_culprit_was_replaced() {
    let mut bench = Bench::new();
    bench.depend("map", &[]);
    bench.see("laser", ONE, hangs(&["map"]));
    bench.detector.handle_outcome(FaultId(1), at(5), RecoveryOutcome::Recovered);

    bench.see("map", ONE, Finding::Lost { culprit: object("laser") });

    assert_eq!(bench.fault(2).symptom_of, Some(FaultId(1)));
}

#[test]
fn a_victim_whose_thread_ends_before_it_was_replaced_is_a_symptom_of_the_hang() {
    let mut bench = Bench::new();
    for name in ["map", "pose"] {
        bench.depend(name, &[]);
        bench.see(name, ONE, state(Lifecycle::Active));
    }
    bench.see("laser", ONE, hangs(&["map"]));
    bench.detector.handle_outcome(FaultId(1), at(5), RecoveryOutcome::Recovered);

    for name in ["map", "pose"] {
        bench.see(name, ONE, exited(ExitReason::Aborted));
    }

    assert_eq!([2, 3].map(|id| bench.fault(id).symptom_of), [Some(FaultId(1)), None]);
}

#[test]
fn a_silent_victim_is_a_symptom_after_its_culprit_was_replaced() {
    let mut bench = Bench::new();
    bench.depend("map", &[]);
    bench.see("laser", ONE, hangs(&["map"]));
    bench.detector.handle_outcome(FaultId(1), at(5), RecoveryOutcome::Recovered);

    bench.see("map", ONE, silent());

    assert_eq!(bench.fault(2).symptom_of, Some(FaultId(1)));
}

#[test]
fn a_component_silent_behind_an_overload_is_reported_and_not_treated() {
    let mut bench = Bench::new();
    ["planner", "safety"].iter().for_each(|name| bench.depend(name, &[]));
    bench.see("planner", ONE, overloaded(&["safety"]));
    assert_eq!(bench.outputs(), ["Found 1", "+1"]);

    bench.see("safety", ONE, silent());

    assert_eq!(bench.outputs(), ["Found 2"], "it is not handed over");
    assert_eq!(bench.fault(2).symptom_of, Some(FaultId(1)));
    bench.see("safety", ONE, Finding::Spoke);
    assert_eq!(bench.outputs(), ["Cleared 2"]);
}

#[test]
fn what_is_lost_after_an_overload_has_ended_is_no_symptom_of_it() {
    let mut bench = Bench::new();
    ["planner", "safety"].iter().for_each(|name| bench.depend(name, &[]));
    bench.see("planner", ONE, overloaded(&["safety"]));
    bench.see("planner", TWO, state(Lifecycle::Active));

    bench.see("safety", ONE, Finding::Lost { culprit: object("planner") });

    assert_eq!(bench.fault(2).symptom_of, None);
}

#[test]
fn a_component_that_is_silent_while_the_computer_is_overloaded_is_treated() {
    let mut bench = Bench::new();
    bench.depend("safety", &[]);
    let (figures, victims) = (OverloadFigures::default(), [object("safety")].into());
    let overloaded = NodeCondition::Overloaded { waited_percent: 83, figures, victims };
    bench.see("@m", ONE, Finding::Node(overloaded));
    assert_eq!(bench.outputs(), ["Found 1", "+1"]);
    let fault = bench.fault(1);
    assert_eq!((fault.kind, fault.location), (FaultKind::Overload, location("@m")));
    assert!(fault.detail.contains("83 %"), "{}", fault.detail);

    bench.see("safety", ONE, silent());

    assert_eq!(bench.outputs(), ["Found 2", "+2"], "however long the overload lasts");
    assert_eq!(bench.fault(2).symptom_of, None);
    bench.see("@m", ONE, Finding::Node(NodeCondition::Relieved));
    assert_eq!(bench.outputs(), ["Cleared 1", "-1"]);
}

#[test]
fn who_is_still_silent_when_the_overload_is_over_is_a_fault_of_its_own() {
    let mut bench = Bench::new();
    ["planner", "safety"].iter().for_each(|name| bench.depend(name, &[]));
    bench.see("planner", ONE, overloaded(&["safety"]));
    bench.see("safety", ONE, silent());
    bench.outputs();

    bench.see("planner", ONE, Finding::Flows);
    assert_eq!(bench.outputs(), ["Cleared 1", "-1"]);
    bench.see("safety", ONE, silent());

    assert_eq!(bench.outputs(), ["Repeated 2", "Explained 2", "+2"]);
    assert_eq!(bench.fault(2).symptom_of, None);
    bench.see("safety", ONE, Finding::Spoke);
    assert_eq!(bench.outputs(), ["Cleared 2", "-2"]);
}

fn paused() -> Finding {
    Finding::Node(NodeCondition::Paused { span: Duration::from_secs(3) })
}

#[test]
fn what_links_and_nodes_suffer_from_a_pause_of_this_node_is_its_symptom() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, exited(panicked()));
    bench.see("-old-k", ONE, down());
    bench.now = at(10_000);
    bench.see("-eth-n", ONE, down()); // its thread ran before that of the watch
    bench.outputs();

    bench.see("@m", ONE, paused());
    assert_eq!(bench.outputs(), ["Found 4", "Recovered 4", "Explained 3"]);
    bench.see("@n", ONE, lost());
    bench.see("map", ONE, exited(panicked()));

    let kind = |id| (bench.fault(id).kind, bench.fault(id).symptom_of);
    let of_pause = Some(FaultId(4));
    assert_eq!(kind(2), (FaultKind::LinkDown, None), "it was down long before");
    assert_eq!(kind(3), (FaultKind::LinkDown, of_pause));
    assert_eq!(kind(4), (FaultKind::NodePaused, None));
    assert_eq!(kind(5), (FaultKind::NodeLost, of_pause));
    assert_eq!(kind(6), (FaultKind::Panic, None), "a panic is its own cause");
    assert!(bench.detector.fault_log.stands(FaultId(4)));
}

#[test]
fn a_short_pause_of_this_node_is_a_fault_only_if_links_or_nodes_suffer_from_it() {
    let short = || Finding::Node(NodeCondition::Paused { span: Duration::from_millis(150) });
    let mut bench = Bench::new();
    bench.see("@m", ONE, short());
    bench.run_until(5_000);
    assert_eq!(bench.entries().len(), 0);

    bench.see("@m", ONE, short());
    bench.now = at(5_100);
    bench.see("-eth-n", ONE, down());
    bench.see("@n", ONE, lost());
    let kinds = [1, 2, 3].map(|id| (bench.fault(id).kind, bench.fault(id).symptom_of.is_some()));
    let [(FaultKind::NodePaused, false), (FaultKind::LinkDown, true), (FaultKind::NodeLost, true)] =
        kinds
    else {
        panic!("{kinds:?}")
    };

    bench.see("-eth-n", ONE, Finding::Link(LinkCondition::Up));
    bench.run_until(10_500);
    assert!(!bench.detector.fault_log.stands(FaultId(1)));
    assert_eq!(bench.fault(3).symptom_of, None, "the node is lost all the same");
    bench.see("-usb-k", ONE, down());
    bench.see("@m", ONE, short());
    assert_eq!(bench.fault(4).symptom_of, Some(FaultId(5)), "it was found before the pause was");
}

#[test]
fn what_outlives_the_time_after_a_pause_is_a_fault_of_its_own() {
    let mut bench = Bench::new();
    bench.see("@m", ONE, paused());
    bench.see("-eth-n", ONE, down());
    bench.see("-usb-k", ONE, down());
    bench.see("-usb-k", ONE, Finding::Link(LinkCondition::Up));

    let outputs = bench.run_until(6_000);
    assert!(outputs.ends_with(&["Cleared 1".into(), "Explained 2".into()]), "{outputs:?}");
    bench.see("@n", ONE, lost());

    let roots = [2, 4].map(|id| (bench.fault(id).kind, bench.fault(id).symptom_of));
    assert_eq!(roots, [(FaultKind::LinkDown, None), (FaultKind::NodeLost, None)]);
    assert_eq!(bench.fault(3).symptom_of, Some(FaultId(1)), "it was over before");
}

#[test]
fn a_second_pause_soon_after_the_first_is_counted() {
    let mut bench = Bench::new();
    bench.see("@m", ONE, paused());
    bench.run_until(4_000);
    bench.see("@m", ONE, paused());
    bench.run_until(8_000);
    assert!(bench.detector.fault_log.stands(FaultId(1)));

    bench.run_until(9_000);

    assert_eq!((bench.entries().len(), bench.fault(1).count), (1, 2));
    assert!(!bench.detector.fault_log.stands(FaultId(1)));
}

#[test]
fn messages_that_were_lost_with_a_session_are_a_symptom_of_the_lost_node_or_link() {
    let losses = || Finding::Node(NodeCondition::MessagesLost { detail: "7 messages".into() });
    let back = || Finding::Node(NodeCondition::Reachable);
    // Found while the node is lost; when it is back; long after that; and without any loss of it.
    for (back_at, lost_at, root) in
        [(None, 10, Some(1)), (Some(10), 1_000, Some(1)), (Some(10), 60_000, None)]
    {
        let mut bench = Bench::new();
        bench.see("@n", Incarnation(9), lost());
        if let Some(at_ms) = back_at {
            bench.now = at(at_ms);
            bench.see("@n", Incarnation(9), back());
        }
        bench.now = at(lost_at);
        bench.see("@n", Incarnation(9), losses());

        assert_eq!(bench.fault(2).kind, FaultKind::ConnectionLost);
        assert_eq!(bench.fault(2).symptom_of.map(|root| root.0), root, "{back_at:?}");
        bench.see("@n", Incarnation(9), Finding::Node(NodeCondition::InSession));
        let entries = bench.entries();
        assert!(!entries.iter().find(|entry| entry.fault.id == FaultId(2)).unwrap().stands());
    }
    let mut bench = Bench::new();
    bench.see("-eth-x", Incarnation(0), down());
    bench.see("-usb-n", Incarnation(0), down());
    bench.see("@n", Incarnation(9), losses());
    bench.see("@o", Incarnation(9), losses());
    let roots = [3, 4].map(|id| bench.fault(id).symptom_of.map(|root| root.0));
    assert_eq!(roots, [Some(2), None]);
}
