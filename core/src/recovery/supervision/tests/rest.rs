//! Children in the safe state, and isolated ones.

use super::*;

#[test]
fn a_child_in_safe_rest_stays_there_until_a_person_brings_it_back() {
    let mut rig = Rig::serving(Strategy::OneForAll);

    assert_eq!(rig.rest("b", Faulty), ["isolate b", "stop b"]);
    assert_eq!(rig.stopped("b", 1), ["retire b", "1 let b go"]);
    assert_eq!(rig.restart("b", Stuck, 1), ["2 gave b up: it is in the safe state"]);
    assert_eq!(rig.restart("a", Died, 1), ["stop c"]);
    assert_eq!(rig.stopped("c", 1), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["3 recovered a #2"]);
    assert_eq!(rig.restart_by_hand("b"), ["admit b", "stop c"]);
    assert_eq!(rig.stopped("c", 2), ["stop a"]);
}

#[test]
fn a_requested_restart_is_not_counted_and_needs_a_serving_supervisor() {
    let mut rig = Rig::with(Strategy::OneForOne, 1, &[("a", permanent())]).at_work();
    for incarnation in 1..5 {
        assert_eq!(rig.restart_by_hand("a"), ["stop a"]);
        assert_eq!(rig.stopped("a", incarnation), [format!("start a #{}", incarnation + 1)]);
        assert_eq!(
            rig.started("a", incarnation + 1),
            [format!("{incarnation} recovered a #{}", incarnation + 1)]
        );
    }
    assert_eq!(rig.machine.restarts_left(rig.now), 1);

    rig.end();
    rig.stopped("a", 5);
    assert_eq!(rig.restart_by_hand("a"), ["5 gave a up: its supervisor is not at work"]);
}

#[test]
fn a_stuck_child_is_put_to_rest_without_being_asked() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    let rests = ["isolate b", "abandon b", "retire b", "1 let b go"];
    assert_eq!(rig.rest("b", Stuck), rests);
    assert_eq!(rig.state("b"), ChildState::Resting);
    assert_eq!(rig.isolate("x", true), ["2 gave x up: no such child"]);
}

#[test]
fn what_waits_for_a_child_is_given_back_however_it_comes_to_rest() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.rest("a", Faulty);
    assert_eq!(rig.pass(5), ["cut off a", "retire a", "1 let a go"], "it does not stop");
    // It is to make way for its next incarnation when it is put to rest.
    assert_eq!(rig.restart("b", Faulty, 1), ["stop b"]);
    assert_eq!(rig.rest("b", Faulty), ["isolate b", "2 gave b up: it is in the safe state"]);
    assert_eq!(rig.stopped("b", 1), ["retire b", "3 let b go"]);
    rig.died("c", 1);
    let dead = ["isolate c", "retire c", "4 let c go"];
    assert_eq!(rig.rest("c", Died), dead);
}

#[test]
fn an_isolated_child_without_an_incarnation_is_not_waited_for() {
    let children = ["a", "b"].map(|child| (child, permanent()));
    let mut rig = Rig::with(Strategy::OneForOne, 3, &children);
    rig.begin();
    rig.start_failed("a", 1);

    assert_eq!(rig.isolate("a", true), ["isolate a", "retire a", "1 let a go", "start b #1"]);
}

#[test]
fn a_child_that_is_isolated_while_its_failed_start_ends_is_not_waited_for() {
    let children = ["a", "b"].map(|child| (child, permanent()));
    let mut rig = Rig::with(Strategy::RestForOne, 3, &children);
    rig.begin();

    assert_eq!(rig.isolate("a", true), ["isolate a", "1 recovered a #1"], "it runs its last hooks");
    assert_eq!(rig.start_failed("a", 1), ["retire a", "start b #1"]);

    assert_eq!(rig.state("a"), ChildState::Resting);
    assert_eq!(rig.started("b", 1), ["all started"]);
}

#[test]
fn what_has_followed_the_struck_incarnation_is_not_isolated_for_its_fault() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Died, 1);
    assert_eq!(rig.isolate_struck("b", 1), ["2 recovered b #2"], "while it starts");
    rig.started("b", 2);

    assert_eq!(rig.isolate_struck("b", 1), ["3 recovered b #2"], "at work");
    assert_eq!(rig.isolate_struck("b", 2), ["isolate b", "4 recovered b #2"]);
}

#[test]
fn isolating_all_reaches_every_child_once() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.isolate("b", true);

    rig.machine.handle_isolate_all(true, rig.now);
    assert_eq!(rig.outputs(), ["isolate a", "isolate c"]);
    rig.machine.handle_isolate_all(false, rig.now);
    assert_eq!(rig.outputs(), ["admit a", "admit b", "admit c"]);
}

#[test]
fn a_child_that_is_about_to_leave_is_let_go_when_it_has_left() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    assert_eq!(rig.remove("b"), ["stop b"]);

    assert_eq!(rig.rest("b", Faulty), ["isolate b"]);
    assert_eq!(rig.stopped("b", 1), ["left b", "1 let b go", "2 let b go"]);
}

#[test]
fn a_child_that_is_started_again_before_it_rests_is_not_put_to_rest() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    assert_eq!(rig.rest("b", Faulty), ["isolate b", "stop b"]);

    let outputs = rig.restart_by_hand("b");

    assert_eq!(outputs, ["admit b", "1 gave b up: it is started again, on request"]);
    assert_eq!(rig.stopped("b", 1), ["start b #2"]);
}
