//! Every finding in every state, roots and symptoms, and what is said of them.

use super::*;
use crate::detection::{Exit, Finding, LinkCondition, NodeCondition};
use crate::{ObjectAddress, Severity};
use proptest::prelude::*;
use std::sync::Arc;

const ONE: Incarnation = Incarnation(1);
const TWO: Incarnation = Incarnation(2);

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn object(name: &str) -> ObjectName {
    ObjectName::new(name).expect("a name")
}

fn node(name: &str) -> NodeName {
    NodeName::new(name).expect("a name")
}

/// A place as it is written: `arm` is an object here, `n:arm` one there, `-eth-n` a link to n, `@n`
/// a node.
fn place(text: &str) -> Place {
    if let Some(name) = text.strip_prefix('@') {
        return Place::Node(node(name));
    }
    if let Some((link, neighbour)) = text.strip_prefix('-').and_then(|t| t.split_once('-')) {
        return Place::Link {
            node: node("m"),
            link: link.into(),
            neighbour: Some(node(neighbour)),
        };
    }
    Place::Object(address(text))
}

fn address(text: &str) -> ObjectAddress {
    let local = || ObjectAddress::new(node("m"), object(text));
    text.parse().unwrap_or_else(|_| local())
}

/// A detector with its clock and numbering.
struct Bench {
    detector: Detector,
    number: u64,
    now: Instant,
}

impl Bench {
    fn new() -> Self {
        Bench::with(DetectorLimits::default())
    }

    fn with(limits: DetectorLimits) -> Self {
        Bench { detector: Detector::new(node("m"), limits, at(0)), number: 0, now: at(0) }
    }

    fn see(&mut self, text: &str, incarnation: Incarnation, finding: Finding) {
        self.number += 1;
        let (place, seen_at) = (place(text), self.now);
        let observation = Observation { place, incarnation, finding, seen_at };
        self.detector.handle_observed(self.number, observation, self.now);
    }

    fn depend(&mut self, object: &str, on: &[&str]) {
        let depends_on: Arc<[ObjectAddress]> = on.iter().map(|text| address(text)).collect();
        self.see(object, ONE, Finding::Enrolled { may_end: false, depends_on });
    }

    /// What was told ("Found 1") and handed over ("+1", "-1"), all of it confirmed.
    fn said(&mut self) -> Vec<String> {
        let mut said = Vec::new();
        while let Some(output) = self.detector.poll_output() {
            match output {
                DetectorOutput::Tell { fault, turn, .. } => {
                    let turn = format!("{turn:?}");
                    let turn = turn.split([' ', '{']).next().unwrap_or_default();
                    said.push(format!("{turn} {}", fault.id.0));
                }
                DetectorOutput::HandOver { number, notice } => {
                    let sign = if matches!(notice, Notice::Found(_)) { '+' } else { '-' };
                    said.push(format!("{sign}{}", notice.id().0));
                    self.detector.handle_confirmed(number, self.now);
                }
                DetectorOutput::GivenUp { notice, .. } => {
                    said.push(format!("given up {}", notice.id().0));
                }
            }
        }
        said
    }

    fn run_until(&mut self, until: u64) -> Vec<String> {
        let mut said = self.said();
        while let Some(due) = self.detector.poll_timeout().filter(|&due| due <= at(until)) {
            self.now = due;
            self.detector.handle_timeout(due);
            said.extend(self.said());
        }
        self.now = at(until);
        said
    }

    fn entries(&self) -> Vec<super::super::Entry> {
        self.detector.read_record().entries
    }

    fn fault(&self, id: u64) -> Fault {
        let entry = self.detector.chronicle.entry(FaultId(id)).expect("it is recorded");
        entry.fault.clone()
    }
}

fn exited(exit: Exit) -> Finding {
    Finding::Exited { exit, restarted_as: None }
}

fn panicked() -> Exit {
    Exit::Panicked { text: "boom".into(), at: "arm.rs:7".into(), during: "Move" }
}

fn state(state: Lifecycle) -> Finding {
    Finding::State { state, reason: Some("why".into()) }
}

fn silent() -> Finding {
    Finding::Silent { age: Duration::from_millis(350) }
}

fn declared() -> Finding {
    Finding::Declared { kind: FaultKind::CheckFailed, detail: "speed is 9".into() }
}

fn down() -> Finding {
    Finding::Link(LinkCondition::Down { reason: "no hello".into() })
}

fn lost() -> Finding {
    Finding::Node(NodeCondition::Lost { reason: "no path".into() })
}

fn hangs(victims: &[&str]) -> Finding {
    let victims = victims.iter().map(|name| object(name)).collect();
    Finding::Hangs { during: "Scan", age: Duration::from_millis(500), victims }
}

#[test]
fn everything_on_the_list_is_found_under_its_kind() {
    let age = Duration::from_millis(500);
    let reason = || "why".to_string();
    let cases: [(&str, Finding, FaultKind); 17] = [
        ("arm", exited(panicked()), FaultKind::Panic),
        ("arm", exited(Exit::Returned), FaultKind::UnexpectedExit),
        ("arm", exited(Exit::Aborted), FaultKind::UnexpectedExit),
        ("arm", hangs(&[]), FaultKind::Hang),
        ("arm", Finding::Waits { during: "Scan", age }, FaultKind::Hang),
        ("arm", Finding::Stuck { oldest: age, queued: 3 }, FaultKind::Hang),
        ("arm", Finding::Lost { culprit: object("a") }, FaultKind::Hang),
        ("arm", silent(), FaultKind::Silence),
        ("arm", state(Lifecycle::Error), FaultKind::ErrorState),
        ("arm", state(Lifecycle::Fatal), FaultKind::InitializationFailed),
        ("arm", declared(), FaultKind::CheckFailed),
        ("arm", Finding::Overloaded { oldest: age, queued: 3 }, FaultKind::Overload),
        ("-eth-n", down(), FaultKind::LinkDown),
        (
            "-eth-n",
            Finding::Link(LinkCondition::Degraded { reason: reason() }),
            FaultKind::LinkDegraded,
        ),
        ("@n", lost(), FaultKind::NodeLost),
        ("@n", Finding::Node(NodeCondition::AtRest { reason: reason() }), FaultKind::NodeAtRest),
        (
            "arm",
            Finding::Declared { kind: FaultKind::Custom("X1".into()), detail: reason() },
            FaultKind::Custom("X1".into()),
        ),
    ];
    for (place, finding, kind) in cases {
        let mut bench = Bench::new();

        bench.see(place, ONE, finding.clone());

        assert_eq!(bench.said(), ["Found 1", "+1"], "{finding:?}");
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

    assert_eq!(bench.said(), ["Found 1", "Repeated 1", "+1"]);
    assert_eq!(
        (bench.fault(1).detail.as_str(), bench.fault(1).count),
        ("node a has the address", 2)
    );
}

#[test]
fn what_is_no_fault_is_not_recorded() {
    let harmless = [
        ("arm", exited(Exit::Stopped)),
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
    for (place, finding) in harmless {
        let mut bench = Bench::new();

        bench.see(place, ONE, finding.clone());

        assert_eq!(bench.said(), [""; 0], "{finding:?}");
    }
}

#[test]
fn a_life_that_ends_itself_is_missed_unless_it_was_known_to_end() {
    let cases = [
        (vec![Lifecycle::Finalized], FaultKind::UnexpectedExit),
        (vec![Lifecycle::Fatal, Lifecycle::Finalized], FaultKind::Fatal),
    ];
    for (states, kind) in cases {
        let mut bench = Bench::new();
        bench.see("arm", ONE, state(Lifecycle::Active));
        states.iter().for_each(|&to| bench.see("arm", ONE, state(to)));

        bench.see("arm", ONE, exited(Exit::Returned));

        assert_eq!(bench.said(), ["Found 1", "+1"], "{states:?}");
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
        ("arm", Finding::Stuck { oldest: age, queued: 3 }, Finding::Flows),
        ("arm", Finding::Overloaded { oldest: age, queued: 3 }, Finding::Flows),
        ("arm", declared(), Finding::Dismissed),
        ("-eth-n", down(), Finding::Link(LinkCondition::Up)),
        (
            "-eth-n",
            Finding::Link(LinkCondition::Degraded { reason: reason() }),
            Finding::Link(LinkCondition::Up),
        ),
        ("@n", lost(), Finding::Node(NodeCondition::Reachable)),
    ];
    for (place, fault, end) in cases {
        let mut bench = Bench::new();
        bench.see(place, ONE, fault.clone());
        bench.said();

        bench.see(place, ONE, end);

        assert_eq!(bench.said(), ["Cleared 1", "-1"], "{fault:?}");
        bench.see(place, ONE, fault.clone());
        assert_eq!(bench.said(), ["Found 2", "+2"], "{fault:?}");
    }
}

#[test]
fn a_fault_that_is_over_before_it_was_handed_over_is_handed_to_nobody() {
    let mut bench = Bench::new();
    bench.see("a", ONE, silent());
    bench.see("b", ONE, silent());

    bench.see("b", ONE, Finding::Spoke);

    assert_eq!(bench.said(), ["Found 1", "Found 2", "Cleared 2", "+1"]);
}

#[test]
fn the_same_fault_again_is_counted_and_told_at_powers_of_two() {
    let mut bench = Bench::new();
    for _ in 0..9 {
        bench.see("arm", ONE, declared());
    }

    assert_eq!(bench.fault(1).count, 9);
    assert_eq!(bench.said(), ["Found 1", "Repeated 1", "Repeated 1", "Repeated 1", "+1"]);
}

#[test]
fn a_repetition_of_a_hand_over_is_not_a_repetition_of_the_fault() {
    let mut bench = Bench::new();
    bench.see("arm", ONE, declared());

    bench.number -= 1;
    bench.see("arm", ONE, declared());

    assert_eq!(bench.fault(1).count, 1);
}

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
    for exit in [Exit::Returned, Exit::Fatal, Exit::Aborted, Exit::Stopped] {
        let mut bench = Bench::new();
        bench.see("arm", ONE, state(Lifecycle::Fatal));

        bench.see("arm", ONE, exited(exit));

        assert_eq!(bench.entries().len(), 1);
        assert_eq!(bench.fault(1).kind, FaultKind::InitializationFailed);
    }
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
            assert_eq!(bench.detector.state_of(&object("arm")), Some((ONE, to)));
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
    for own in [exited(panicked()), exited(Exit::Returned), hangs(&[])] {
        let mut bench = Bench::new();
        bench.depend("map", &["laser"]);
        bench.see("laser", ONE, exited(panicked()));

        bench.see("map", ONE, own);

        assert_eq!(bench.fault(2).symptom_of, None);
    }
}

#[test]
fn a_root_that_is_found_shortly_after_its_symptom_explains_it() {
    let mut bench = Bench::new();
    bench.depend("planner", &["laser"]);
    bench.see("planner", ONE, silent());
    bench.said();

    bench.now = at(1900);
    bench.see("laser", ONE, exited(panicked()));

    assert_eq!(bench.said(), ["Found 2", "Explained 1", "+2"]);
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
fn a_victim_that_is_lost_is_a_symptom_also_when_the_culprit_was_replaced_long_ago() {
    let mut bench = Bench::new();
    bench.depend("map", &[]);
    bench.see("laser", ONE, hangs(&["map"]));
    bench.detector.handle_outcome(FaultId(1), at(5), Outcome::Recovered);

    bench.see("map", ONE, Finding::Lost { culprit: object("laser") });

    assert_eq!(bench.fault(2).symptom_of, Some(FaultId(1)));
}

#[test]
fn a_victim_that_is_silent_is_a_symptom_also_when_the_culprit_was_replaced_before() {
    let mut bench = Bench::new();
    bench.depend("map", &[]);
    bench.see("laser", ONE, hangs(&["map"]));
    bench.detector.handle_outcome(FaultId(1), at(5), Outcome::Recovered);

    bench.see("map", ONE, silent());

    assert_eq!(bench.fault(2).symptom_of, Some(FaultId(1)));
}

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
fn nobody_is_reminded_of_a_symptom_while_its_root_stands() {
    let mut bench = Bench::new();
    bench.depend("map", &["laser"]);
    bench.see("laser", ONE, exited(panicked()));
    let decided = Outcome::Decided { measure: "restart".into() };
    bench.detector.handle_outcome(FaultId(1), at(0), decided);
    bench.see("map", ONE, silent());
    bench.said();
    assert_eq!(bench.run_until(30_500), [""; 0]);

    bench.detector.handle_outcome(FaultId(1), at(30_500), Outcome::Recovered);

    assert_eq!(bench.run_until(31_500), ["Recovered 1", "+2"]);
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
