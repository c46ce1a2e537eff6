//! How many restarts there are, and what follows when there were too many.

use super::*;

#[test]
fn one_restart_too_many_ends_everything_and_escalates() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    for incarnation in 1..=3 {
        rig.restart("b", Died, incarnation);
        rig.started("b", incarnation + 1);
    }

    assert_eq!(rig.restart("b", Died, 4), ["stop c"]);
    assert_eq!(rig.restart("a", Died, 1), [""; 0]);
    assert_eq!(rig.stopped("c", 1), ["stop a"]);
    assert_eq!(rig.stopped("a", 1), ["escalate: b needed more than 3 restarts in 60s: it died"]);

    // What was asked of the old incarnation is answered by the new one.
    assert_eq!(rig.begin(), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start b #5", "5 recovered a #2"]);
    assert_eq!(rig.started("b", 5), ["start c #2", "4 recovered b #5"]);
}

#[test]
fn the_end_of_the_root_is_the_end_of_hope() {
    let rules = SupervisorRules { root: true, intensity: 0, ..together() };
    let mut machine = Supervisor::new(rules);
    let now = Instant::from_millis(1);
    machine.add_child(object("a"), permanent(), now).expect("a free name");
    let mut rig = Rig { machine, now, calls: 0 };
    rig.begin();
    rig.started("a", 1);

    assert_eq!(
        rig.restart("a", Died, 1),
        [
            "give up: a needed more than 0 restarts in 60s: it died",
            "escalate: a needed more than 0 restarts in 60s: it died",
            "1 gave a up: given up: a needed more than 0 restarts in 60s: it died"
        ]
    );
    assert!(rig.restart("a", Died, 1)[0].starts_with("2 gave a up"));
}

#[test]
fn old_restarts_are_forgotten() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    for incarnation in 1..=20 {
        assert_eq!(rig.restart("b", Died, incarnation), [format!("start b #{}", incarnation + 1)]);
        rig.started("b", incarnation + 1);
        rig.pass(21);
    }
}

#[test]
fn a_supervisor_below_that_escalates_is_restarted_without_being_asked() {
    let mut rig = Rig::serving(Strategy::RestForOne);

    assert_eq!(rig.escalated("b", 1), ["stop c"]);
    assert_eq!(rig.stopped("c", 1), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), [""; 0]);
    assert_eq!(rig.machine.restarts_left(rig.now), 2);
}

#[test]
fn a_grant_draws_from_the_budget_and_is_given_again_when_the_child_has_started() {
    let children = ["a", "b"].map(|child| (child, on_the_spot()));
    let mut rig = Rig::with(Strategy::OneForOne, 2, &children);
    rig.begin();
    assert_eq!(rig.started("a", 1), ["grant a", "start b #1"]);
    assert_eq!(rig.started("b", 1), ["grant b", "all started"]);

    assert_eq!(rig.died_on_the_spot("a", 1), [""; 0]);
    assert_eq!(rig.started("a", 2), ["grant a"]);
    assert_eq!(rig.died_on_the_spot("b", 1), ["withdraw a"]);
    assert_eq!(rig.started("b", 2), [""; 0], "the budget is used up");
    rig.pass(61);
    assert_eq!(rig.restart("b", Died, 2), ["start b #3"]);
    assert_eq!(rig.started("b", 3), ["grant b", "1 recovered b #3"]);
    assert_eq!(rig.machine.poll_timeout(), None);
}

#[test]
fn a_restart_on_the_spot_has_recovered_the_child_when_it_is_active() {
    let mut rig = Rig::with(Strategy::OneForOne, 3, &[("a", on_the_spot())]).at_work();

    assert_eq!(rig.died_on_the_spot("a", 1), [""; 0]);
    assert_eq!(rig.restart("a", Died, 1), [""; 0], "it has not started yet");
    assert_eq!(rig.state("a"), ChildState::Starting);
    assert_eq!(rig.started("a", 2), ["grant a", "1 recovered a #2"]);
}

#[test]
fn a_panic_before_the_next_grant_is_answered_as_any_other_fault() {
    let mut rig = Rig::with(Strategy::OneForOne, 1, &[("a", on_the_spot())]).at_work();

    assert_eq!(rig.died_on_the_spot("a", 1), [""; 0]);
    assert_eq!(rig.died("a", 2), [""; 0]);
    assert_eq!(
        rig.restart("a", Died, 2),
        ["escalate: a needed more than 1 restarts in 60s: it died"]
    );
}

#[test]
fn a_grant_is_given_only_where_the_rules_allow_it() {
    let given = |strategy, rules| {
        let mut rig = Rig::with(strategy, 3, &[("a", rules)]);
        rig.begin();
        rig.started("a", 1)
    };

    assert_eq!(given(Strategy::OneForOne, on_the_spot()), ["grant a", "all started"]);
    assert_eq!(given(Strategy::OneForAll, on_the_spot()), ["all started"]);
    assert_eq!(given(Strategy::RestForOne, on_the_spot()), ["all started"]);
    assert_eq!(given(Strategy::OneForOne, permanent()), ["all started"]);
    let temporary = ChildRules { restart: Restart::Temporary, ..on_the_spot() };
    assert_eq!(given(Strategy::OneForOne, temporary), ["all started"]);
}

#[test]
fn a_grant_is_withdrawn_before_a_stop_and_while_isolated() {
    let mut rig = Rig::with(Strategy::OneForOne, 3, &[("a", on_the_spot())]).at_work();

    assert_eq!(rig.isolate("a", true), ["isolate a", "withdraw a", "1 recovered a #1"]);
    assert_eq!(rig.isolate("a", false), ["admit a", "grant a", "2 recovered a #1"]);
    assert_eq!(rig.end(), ["withdraw a", "stop a"]);
}

#[test]
fn a_reset_counts_as_a_restart_does() {
    let mut rig = Rig::with(Strategy::OneForOne, 2, &[("a", permanent())]).at_work();

    for call in 1..=2 {
        assert_eq!(rig.reset("a"), ["reset a"]);
        assert_eq!(rig.reset_done("a", 1, Ok(())), [format!("{call} recovered a #1")]);
    }
    let third = rig.reset("a");
    assert!(third[0].contains("3 gave a up: it is not restarted any more"), "{third:?}");
    assert!(third.iter().any(|output| output.starts_with("stop a")), "{third:?}");
}
