//! A child that needs more restarts than are allowed, where its siblings go on.

use super::*;

/// Restarts are counted per child.
fn apart(intensity: u32, children: &[(&str, ChildRules)]) -> Rig {
    let rules = SupervisorRules { intensity, period: MINUTE, ..SupervisorRules::default() };
    Rig::of(rules, children).at_work()
}

fn essential() -> ChildRules {
    ChildRules { essential: true, ..ChildRules::default() }
}

#[test]
fn each_child_has_a_count_of_its_own() {
    let mut rig = apart(1, &[("a", permanent()), ("b", permanent())]);
    assert_eq!(rig.restart("a", Died, 1), ["start a #2"]);
    rig.started("a", 2);

    assert_eq!(rig.restart("b", Died, 1), ["start b #2"]);
    rig.started("b", 2);
    let refused = "3 gave a up: it is not restarted any more: \
                   a needed more than 1 restarts in 60s: it died";
    assert_eq!(rig.restart("a", Died, 2), [refused]);

    assert_eq!((rig.state("a"), rig.state("b")), (ChildState::Failed, ChildState::Running));
    assert_eq!(rig.rest("a", Faulty), ["isolate a", "retire a", "4 let a go"]);
    assert_eq!(rig.state("a"), ChildState::Resting);
}

#[test]
fn one_that_could_still_be_asked_is_left_to_the_next_measure() {
    let mut rig = apart(0, &[("a", permanent())]);

    let refused = rig.restart("a", Faulty, 1);

    assert_eq!(refused.len(), 1, "it is not stopped: {refused:?}");
    assert_eq!(rig.state("a"), ChildState::Running);
}

#[test]
fn a_stuck_child_without_restarts_left_goes_to_the_next_action() {
    let mut rig = apart(0, &[("a", permanent())]);

    let refused = rig.restart("a", Stuck, 1);

    assert_eq!(refused.len(), 1, "it may move again before that: {refused:?}");
    assert_eq!(rig.state("a"), ChildState::Running);
    let rest = rig.rest("a", Stuck);
    assert_eq!(rest, ["isolate a", "abandon a", "retire a", "2 let a go"]);
}

#[test]
fn one_that_is_stuck_is_given_up_at_once_where_its_supervisor_escalates() {
    let mut rig = apart(0, &[("a", essential()), ("b", permanent())]);

    let escalates = rig.restart("a", Stuck, 1);

    assert!(escalates.contains(&"abandon a".to_owned()), "{escalates:?}");
    assert!(!escalates.contains(&"stop a".to_owned()), "{escalates:?}");
}

#[test]
fn a_child_is_worth_a_restart_again_as_its_window_moves() {
    let mut rig = apart(1, &[("a", permanent())]);
    rig.restart("a", Died, 1);
    rig.started("a", 2);
    for _ in 0..5 {
        let refused = rig.restart("a", Died, 2);
        assert!(refused[0].contains("not restarted any more"), "{refused:?}");
    }

    rig.pass(61);

    assert_eq!(rig.restart("a", Died, 2), ["start a #3"]);
}

#[test]
fn a_grant_draws_from_the_childs_own_count() {
    let mut rig = apart(1, &[("a", on_the_spot()), ("b", on_the_spot())]);

    assert_eq!(rig.died_on_the_spot("a", 1), [""; 0]);
    assert_eq!(rig.started("a", 2), [""; 0], "its budget is used up");
    assert_eq!(rig.state("a"), ChildState::Running);
    assert_eq!(rig.machine.restarts_left(rig.now), 0);
    assert_eq!(rig.died_on_the_spot("b", 1), [""; 0]);
}

#[test]
fn an_essential_child_takes_its_supervisor_along() {
    let mut rig = apart(0, &[("a", essential()), ("b", permanent())]);
    assert_eq!(rig.restart("a", Died, 1), ["stop b"]);
    let escalates = ["escalate: a needed more than 0 restarts in 60s: it died"];
    assert_eq!(rig.stopped("b", 1), escalates);

    let mut rig = apart(3, &[("a", essential()), ("b", permanent())]);
    assert_eq!(rig.rest("a", Faulty), ["isolate a", "stop a", "stop b"], "for a fault");
    assert_eq!(rig.stopped("a", 1), ["retire a", "1 let a go"]);
    let escalates = ["escalate: a is essential, and was put into the safe state"];
    assert_eq!(rig.stopped("b", 1), escalates);

    let mut rig = apart(3, &[("a", essential()), ("b", permanent())]);
    rig.rest("a", Asked);
    assert_eq!(rig.stopped("a", 1), ["retire a", "1 let a go"], "as a person wished");
    assert_eq!(rig.state("b"), ChildState::Running);
}

#[test]
fn who_depend_on_each_other_escalate_together() {
    for strategy in [Strategy::OneForAll, Strategy::RestForOne] {
        let rules = SupervisorRules { strategy, intensity: 0, ..SupervisorRules::default() };
        let mut rig = Rig::of(rules, &[("a", permanent()), ("b", permanent())]).at_work();

        assert_eq!(rig.restart("a", Died, 1), ["stop b"]);
        let escalates = rig.stopped("b", 1);
        assert!(escalates[0].starts_with("escalate: a needed"), "{escalates:?}");
    }
}

#[test]
fn a_shared_restart_count_escalates_for_a_child_that_cannot_start() {
    let children = ["a", "b"].map(|child| (child, permanent()));
    let group = SupervisorRules { strategy: Strategy::RestForOne, ..SupervisorRules::default() };
    for rules in [group, together()] {
        let mut rig = Rig::of(rules, &children);
        rig.begin();
        rig.start_failed("a", 1);
        let escalates = ["isolate a", "retire a", "escalate: a could not be started: no device"];
        assert_eq!(rig.rest("a", Faulty)[..3], escalates, "as it starts");

        let mut rig = Rig::of(rules, &children).at_work();
        rig.died("b", 1);
        rig.restart("b", Died, 1);
        rig.start_failed("b", 2);
        assert_eq!(rig.rest("b", Died)[..3], ["isolate b", "retire b", "stop a"]);
        assert!(
            rig.stopped("a", 1).contains(&"escalate: b could not be started: no device".to_owned())
        );

        let mut rig = Rig::of(rules, &children).at_work();
        assert_eq!(rig.rest("a", Faulty), ["isolate a", "stop a"], "at work, as the plan says");
    }
    let mut rig = apart(3, &children);
    rig.died("a", 1);
    rig.restart("a", Died, 1);
    rig.start_failed("a", 2);
    let without = ["isolate a", "retire a", "2 let a go"];
    assert_eq!(rig.rest("a", Faulty), without, "they do without each other");
}

#[test]
fn a_nested_supervisor_without_restarts_is_left_to_the_recoverer() {
    let mut rig = apart(1, &[("drive", permanent()), ("b", permanent())]);
    assert_eq!(rig.escalated("drive", 1), ["start drive #2"]);
    rig.started("drive", 2);

    let refused = rig.escalated("drive", 2);

    assert_eq!(refused.len(), 1, "{refused:?}");
    assert!(refused[0].starts_with("refused drive #2: "), "{refused:?}");
    assert_eq!((rig.state("drive"), rig.state("b")), (ChildState::Failed, ChildState::Running));
}

#[test]
fn who_waits_for_a_supervisor_that_does_not_return_is_told() {
    let mut rig = Rig::with(Strategy::OneForAll, 0, &[("a", permanent())]).at_work();
    let escalated = rig.restart("a", Died, 1);
    assert_eq!(
        escalated,
        ["escalate: a needed more than 0 restarts in 60s: it died"],
        "its next incarnation says"
    );

    assert_eq!(rig.end(), ["all stopped"]);
    rig.machine.handle_retired();

    assert_eq!(rig.outputs(), ["1 gave a up: its supervisor is not at work"]);
    assert_eq!(rig.restart("a", Died, 1), ["2 gave a up: its supervisor is not at work"]);
}

#[test]
fn a_thousand_children_that_fail_at_once_are_all_replaced() {
    let names: Vec<String> = (0..1000).map(|n| format!("c{n}")).collect();
    let children: Vec<_> = names.iter().map(|name| (name.as_str(), permanent())).collect();
    let mut rig = apart(3, &children);

    for name in &names {
        assert_eq!(rig.restart(name, Died, 1), [format!("start {name} #2")]);
    }
    for (at, name) in names.iter().enumerate() {
        assert_eq!(rig.started(name, 2), [format!("{} recovered {name} #2", at + 1)]);
    }
    assert_eq!(rig.machine.poll_timeout(), None);
}

#[test]
fn a_whole_start_is_undone_by_the_first_child_that_cannot_be_started() {
    let rules = SupervisorRules { whole_start: true, ..SupervisorRules::default() };
    let children = [
        ("a", permanent()),
        ("b", kept(Restart::Temporary)),
        ("c", permanent()),
        ("d", permanent()),
    ];
    let mut rig = Rig::of(rules, &children);
    rig.begin();
    rig.started("a", 1);
    let next = rig.start_failed("b", 1);
    assert!(next.contains(&"start c #1".to_owned()), "a temporary child may be missing: {next:?}");
    rig.start_failed("c", 1);

    let undone = rig.rest("c", Died);

    assert!(undone.contains(&"stop a".to_owned()), "{undone:?}");
    assert!(!undone.contains(&"start d #1".to_owned()), "{undone:?}");
    assert_eq!(rig.stopped("a", 1), ["escalate: c could not be started: no device"]);

    // A supervisor below that has undone its start is not tried again.
    let mut rig = Rig::of(rules, &[("a", permanent()), ("b", ChildRules::supervisor())]);
    rig.begin();
    rig.started("a", 1);
    let undone = rig.escalated("b", 1);
    assert!(!undone.iter().any(|line| line.starts_with("start")), "{undone:?}");
    let escalates = rig.stopped("a", 1);
    assert!(escalates[0].starts_with("escalate: b could not be started: "), "{escalates:?}");

    // Once it has been whole, children rest by themselves.
    let mut rig = Rig::of(rules, &[("a", permanent()), ("b", permanent())]).at_work();
    rig.died("b", 1);
    rig.rest("b", Died);
    assert_eq!((rig.state("a"), rig.state("b")), (ChildState::Running, ChildState::Resting));
}
