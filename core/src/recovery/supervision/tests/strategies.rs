//! Which children a failure affects, and in which order they end and begin.

use super::*;

#[test]
fn children_start_one_after_the_other_and_stop_in_reverse() {
    let children = ["a", "b"].map(|child| (child, permanent()));
    let mut rig = Rig::with(Strategy::OneForOne, 3, &children);

    assert_eq!(rig.begin(), ["start a #1"]);
    assert_eq!(rig.started("a", 1), ["start b #1"]);
    assert_eq!(rig.started("b", 1), ["all started"]);

    assert_eq!(rig.end(), ["stop b"]);
    assert_eq!(rig.stopped("b", 1), ["stop a"]);
    assert_eq!(rig.stopped("a", 1), ["all stopped"]);
}

#[test]
fn a_supervisor_without_children_starts_and_stops_at_once() {
    let mut rig = Rig::with(Strategy::OneForOne, 3, &[]);

    assert_eq!(rig.begin(), ["all started"]);
    assert_eq!(rig.end(), ["all stopped"]);
    assert_eq!(rig.end(), ["all stopped"]);
}

#[test]
fn one_for_one_replaces_only_the_child_that_failed() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    assert_eq!(rig.restart("b", Died, 1), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["1 recovered b #2"]);

    assert_eq!(rig.restart("b", Faulty, 2), ["stop b"]);
    assert_eq!(rig.stopped("b", 2), ["start b #3"]);
    assert_eq!(rig.started("b", 3), ["2 recovered b #3"]);

    assert_eq!(rig.restart("b", Stuck, 3), ["abandon b", "start b #4"]);
    assert_eq!(rig.started("b", 4), ["3 recovered b #4"]);
}

#[test]
fn an_incarnation_that_stood_behind_anothers_hang_costs_no_restart() {
    let mut rig = Rig::with(Strategy::OneForOne, 1, &[("b", ChildRules::default())]).at_work();

    for incarnation in 1..5 {
        let next = incarnation + 1;
        let replaced = rig.restart("b", Behind, incarnation);

        assert_eq!(replaced, ["abandon b".into(), format!("start b #{next}")]);
        rig.started("b", next);
    }
}

#[test]
fn independent_children_are_replaced_at_the_same_time() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    assert_eq!(rig.restart("c", Died, 1), ["start c #2"]);
    assert_eq!(rig.restart("a", Died, 1), ["start a #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered c #2"]);
    assert_eq!(rig.started("a", 2), ["2 recovered a #2"]);
}

#[test]
fn one_for_all_replaces_all_in_order_and_answers_when_all_are_at_work() {
    let mut rig = Rig::serving(Strategy::OneForAll);

    assert_eq!(rig.restart("b", Died, 1), ["stop c"]);
    assert_eq!(rig.stopped("c", 1), ["stop a"]);
    assert_eq!(rig.stopped("a", 1), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered b #2"]);
}

#[test]
fn rest_for_one_replaces_the_child_and_those_behind_it() {
    let mut rig = Rig::serving(Strategy::RestForOne);

    assert_eq!(rig.restart("b", Stuck, 1), ["abandon b", "stop c"]);
    assert_eq!(rig.stopped("c", 1), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered b #2"]);
    assert_eq!(rig.state("a"), ChildState::Running);
}

#[test]
fn a_failure_while_its_group_is_being_stopped_is_neither_lost_nor_doubled() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    rig.restart("b", Died, 1);

    assert_eq!(rig.restart("a", Died, 1), [""; 0]);
    assert_eq!(rig.stopped("c", 1), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered b #2", "2 recovered a #2"]);
    assert_eq!(rig.machine.restarts_left(rig.now), 2);
}

#[test]
fn a_child_that_hangs_while_it_should_stop_for_its_group_is_given_up() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    rig.restart("b", Died, 1);

    assert_eq!(rig.restart("c", Stuck, 1), ["abandon c", "stop a"]);
    assert_eq!(rig.stopped("c", 1), [""; 0]);
    assert_eq!(rig.stopped("a", 1), ["start a #2"]);
}

#[test]
fn a_failure_while_its_group_is_being_started_begins_the_group_again() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    rig.restart("c", Died, 1);
    rig.stopped("b", 1);
    rig.stopped("a", 1);
    assert_eq!(rig.started("a", 2), ["start b #2"]);

    assert_eq!(rig.restart("a", Died, 2), ["stop b"]);
    assert_eq!(rig.started("b", 2), [""; 0]);
    assert_eq!(rig.stopped("b", 2), ["start a #3"]);
    assert_eq!(rig.started("a", 3), ["start b #3"]);
    assert_eq!(rig.started("b", 3), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered c #2", "2 recovered a #3"]);
}

#[test]
fn a_start_that_fails_in_a_group_waits_for_a_decision_and_then_goes_on() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    rig.restart("c", Died, 1);
    rig.stopped("b", 1);
    rig.stopped("a", 1);
    rig.started("a", 2);

    assert_eq!(rig.start_failed("b", 2), [""; 0]);
    assert_eq!(rig.state("b"), ChildState::Failed);
    assert_eq!(rig.state("c"), ChildState::Waiting);
    assert_eq!(rig.restart("b", Died, 2), ["stop a"]);
    assert_eq!(rig.stopped("a", 2), ["start a #3"]);
    assert_eq!(rig.started("a", 3), ["start b #3"]);
    assert_eq!(rig.started("b", 3), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered c #2", "2 recovered b #3"]);
}

#[test]
fn who_is_at_work_does_not_wait_for_a_sibling_that_failed_in_turn() {
    let cases = [(Strategy::OneForAll, "stop a"), (Strategy::RestForOne, "start b #3")];
    for (strategy, next) in cases {
        let mut rig = Rig::serving(strategy);
        rig.restart("a", Died, 1);
        rig.stopped("c", 1);
        rig.stopped("b", 1);
        assert_eq!(rig.started("a", 2), ["start b #2"]);

        // What is done about b may wait for what is answered about a.
        assert_eq!(rig.start_failed("b", 2), ["1 recovered a #2"]);

        assert_eq!(rig.restart("b", Died, 2), [next]);
    }
}

#[test]
fn a_member_that_dies_at_work_before_its_group_is_whole_was_restarted_all_the_same() {
    for strategy in [Strategy::OneForAll, Strategy::RestForOne] {
        let mut rig = Rig::serving(strategy);
        rig.restart("a", Died, 1);
        rig.stopped("c", 1);
        rig.stopped("b", 1);
        assert_eq!(rig.started("a", 2), ["start b #2"]);

        assert_eq!(rig.died("a", 2), ["1 recovered a #2"]);

        assert_eq!(rig.restart("a", Died, 2), ["stop b"]);
    }
}

#[test]
fn a_temporary_member_ends_with_its_group_and_does_not_return() {
    for strategy in [Strategy::OneForAll, Strategy::RestForOne] {
        let guest = kept(Restart::Temporary);
        let children = [("a", permanent()), ("guest", guest), ("c", permanent())];
        let mut rig = Rig::with(strategy, 3, &children).at_work();

        assert_eq!(rig.restart("a", Died, 1), ["stop c"]);
        assert_eq!(rig.stopped("c", 1), ["stop guest"]);
        // What waits for one that does not even stop is given back.
        assert_eq!(rig.pass(5), ["cut off guest", "retire guest", "start a #2"]);
        assert_eq!(rig.started("a", 2), ["start c #2"]);
        assert_eq!(rig.started("c", 2), ["1 recovered a #2"]);
        assert_eq!(rig.state("guest"), ChildState::Finished);
    }
}

#[test]
fn what_waits_for_a_temporary_member_that_ends_before_its_turn_to_stop_is_given_back() {
    let guest = kept(Restart::Temporary);
    let children = [("a", permanent()), ("guest", guest), ("c", permanent())];
    for in_order in [true, false] {
        let mut rig = Rig::with(Strategy::OneForAll, 3, &children).at_work();

        assert_eq!(rig.restart("a", Died, 1), ["stop c"]);
        let ended = if in_order { rig.returned("guest", 1) } else { rig.died("guest", 1) };
        assert_eq!(ended, ["retire guest"]);
        assert_eq!(rig.stopped("c", 1), ["start a #2"]);
        assert_eq!(rig.state("guest"), ChildState::Finished);
    }
}

#[test]
fn a_temporary_member_behind_anothers_hang_is_abandoned_with_it() {
    let guest = kept(Restart::Temporary);
    let children = [("a", permanent()), ("guest", guest), ("c", permanent())];
    for hangs in ["a", "c"] {
        let mut rig = Rig::with(Strategy::OneForAll, 3, &children).at_work();

        rig.restart(hangs, Stuck, 1);
        let other = if hangs == "a" { "c" } else { "a" };
        let mut outputs = rig.restart(other, Behind, 1);
        outputs.extend(rig.restart("guest", Behind, 1));

        let abandoned = ["abandon guest", "start a #2"].map(str::to_owned);
        assert!(abandoned.iter().all(|output| outputs.contains(output)), "{outputs:?}");
        assert_eq!(rig.started("a", 2), ["start c #2"]);
    }
}

#[test]
fn a_supervisor_of_a_group_is_told_beforehand_that_the_group_restarts() {
    let sub = ChildRules::supervisor();
    let children = [("a", permanent()), ("sub", sub), ("c", permanent())];
    let mut rig = Rig::with(Strategy::RestForOne, 3, &children).at_work();

    let stuck = rig.restart("a", Stuck, 1);
    assert_eq!(stuck, ["abandon a", "announce_stops sub", "stop c"]);
    assert_eq!(rig.stopped("c", 1), ["stop sub"]);
    assert_eq!(rig.stopped("sub", 1), ["start a #2"]);
}

#[test]
fn an_ending_supervisor_starts_nothing_and_answers_after_its_restart() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.machine.handle_end_expected(rig.now);

    assert_eq!(rig.restart("a", Behind, 1), ["abandon a"]);
    assert_eq!(rig.died("b", 1), [""; 0]);
    assert_eq!(rig.restart("b", Died, 1), [""; 0]);
    assert_eq!(rig.restart("c", Faulty, 1), [""; 0], "it is no other one yet");
    assert_eq!(rig.end(), ["stop c"]);
    assert_eq!(rig.restart("c", Behind, 1), ["abandon c", "all stopped"]);

    rig.machine.handle_begin(Incarnation(2), rig.now);
    assert_eq!(rig.outputs(), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start b #2", "1 recovered a #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2", "2 recovered b #2"]);
    assert_eq!(rig.started("c", 2), ["all started", "3 recovered c #2", "4 recovered c #2"]);
}

#[test]
fn one_in_error_is_reset_at_its_place_while_the_others_of_its_group_restart_around_it() {
    let mut rig = Rig::serving(Strategy::OneForAll);

    assert_eq!(rig.reset("b"), ["stop c"]);
    assert_eq!(rig.stopped("c", 1), ["stop a"]);
    assert_eq!(rig.stopped("a", 1), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["reset b"]);
    assert_eq!(rig.reset_done("b", 1, Ok(())), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered b #1"]);

    let mut rig = Rig::serving(Strategy::RestForOne);
    assert_eq!(rig.reset("b"), ["stop c"]);
    assert_eq!(rig.stopped("c", 1), ["reset b"]);
    // Where the reset fails, the child is restarted, and its group with it.
    let failed = ["1 gave b up: it could not reset itself: still hot"];
    assert_eq!(rig.reset_done("b", 1, Err("still hot")), failed);
    assert_eq!(rig.restart("b", Faulty, 1), ["stop b"]);
    assert_eq!(rig.stopped("b", 1), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["2 recovered b #2"]);
}

#[test]
fn a_reset_that_the_recoverer_does_not_wait_for_gives_way_to_the_restart() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    assert_eq!(rig.reset("b"), ["stop c"]);

    let given_up = "1 gave b up: it has no incarnation that could be reset";
    assert_eq!(rig.restart("b", Faulty, 1), [given_up]);
    assert_eq!(rig.stopped("c", 1), ["stop b"]);
    assert_eq!(rig.stopped("b", 1), ["stop a"]);
    assert_eq!(rig.stopped("a", 1), ["start a #2"]);
}
