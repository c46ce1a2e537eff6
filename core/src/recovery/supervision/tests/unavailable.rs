//! A child whose device is not there yet.

use super::*;

#[test]
fn those_behind_one_that_waits_are_started_unless_they_depend_on_it() {
    let children = ["a", "b"].map(|child| (child, permanent()));
    let mut rig = Rig::with(Strategy::OneForOne, 3, &children);
    rig.begin();
    assert_eq!(rig.unavailable("a", 1), ["start b #1"]);
    assert_eq!(rig.state("a"), ChildState::Unavailable);
    assert_eq!(rig.started("b", 1), ["all started"]);
    assert_eq!(rig.machine.poll_timeout(), None, "it may take for ever");
    assert_eq!(rig.started("a", 1), [""; 0]);
    assert_eq!(rig.state("a"), ChildState::Running);

    let mut rig = Rig::with(Strategy::RestForOne, 3, &children);
    rig.begin();
    assert_eq!(rig.unavailable("a", 1), ["waits: no device"]);
    assert_eq!(rig.pass(3600), [""; 0]);
    assert_eq!(rig.started("a", 1), ["start b #1"]);
    assert_eq!(rig.started("b", 1), ["all started"]);
}

#[test]
fn a_restart_that_comes_to_wait_is_said_to_wait_and_costs_no_more() {
    for strategy in [Strategy::OneForOne, Strategy::RestForOne] {
        let mut rig = Rig::with(strategy, 1, &[("a", permanent())]).at_work();
        assert_eq!(rig.restart("a", Died, 1), ["start a #2"]);

        assert_eq!(rig.unavailable("a", 2), ["1 a #2 waits"]);
        assert_eq!(rig.unavailable("a", 2), [""; 0]);
        assert_eq!(rig.machine.restarts_left(rig.now), 0, "the panic was counted, the wait not");
        assert_eq!(rig.started("a", 2), [""; 0]);
        assert_eq!(rig.state("a"), ChildState::Running);
    }
}

#[test]
fn a_reset_that_comes_to_wait_is_said_to_wait() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    assert_eq!(rig.reset("a"), ["reset a"]);

    assert_eq!(rig.unavailable("a", 1), ["1 a #1 waits"]);

    assert_eq!(rig.state("a"), ChildState::Unavailable);
    assert_eq!(rig.machine.poll_timeout(), None);
}

#[test]
fn one_that_waits_can_fail_and_be_stopped_as_any_other() {
    let mut rig = Rig::with(Strategy::OneForOne, 3, &[("a", permanent())]);
    rig.begin();
    rig.unavailable("a", 1);
    assert_eq!(rig.start_failed("a", 1), [""; 0]);
    assert_eq!(rig.state("a"), ChildState::Failed);
    assert_eq!(rig.restart("a", Died, 1), ["start a #2"]);
    rig.unavailable("a", 2);

    assert_eq!(rig.end(), ["stop a"]);
    assert_eq!(rig.unavailable("a", 2), [""; 0], "it was late");
    assert_eq!(rig.stopped("a", 2), ["all stopped"]);
}

#[test]
fn an_incarnation_begun_by_the_guard_is_not_the_ordered_one() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    assert_eq!(rig.restart("a", Stuck, 1), ["abandon a", "start a #2"]);
    // Its guard had restarted it as #2 just before, so that the new one is #3.
    rig.machine.handle_begun(&object("a"), Incarnation(3));

    assert_eq!(rig.died("a", 2), [""; 0], "that is the incarnation that was given up");
    assert_eq!(rig.started("a", 2), [""; 0]);
    assert_eq!(rig.started("a", 3), ["1 recovered a #3"]);
}
