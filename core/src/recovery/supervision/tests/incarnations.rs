//! The start, the end and the reports of one incarnation.

use super::*;

#[test]
fn a_start_that_fails_answers_its_own_request_and_may_be_tried_again() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Died, 1);

    assert_eq!(
        rig.start_failed("b", 2),
        ["1 gave b up: its next incarnation did not start: no device"]
    );
    assert_eq!(rig.restart("b", Died, 1), ["start b #3"]);
    assert_eq!(rig.started("b", 3), ["2 recovered b #3"]);
}

#[test]
fn a_first_start_that_fails_holds_the_rest_back_until_it_is_decided() {
    let children = ["a", "b"].map(|child| (child, permanent()));
    let mut rig = Rig::of(SupervisorRules::default(), &children);
    rig.begin();

    assert_eq!(rig.start_failed("a", 1), [""; 0]);
    assert_eq!(rig.restart("a", Died, 1), ["start a #2"]);
    assert_eq!(
        rig.start_failed("a", 2),
        ["1 gave a up: its next incarnation did not start: no device"]
    );
    assert_eq!(rig.rest("a", Died), ["isolate a", "retire a", "start b #1", "2 let a go"]);
    assert_eq!(rig.started("b", 1), ["all started"]);
    assert_eq!(rig.state("a"), ChildState::Resting);
}

#[test]
fn a_start_that_takes_too_long_is_given_up_and_declared() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Died, 1);
    assert_eq!(rig.machine.poll_timeout(), Some(rig.now + Duration::from_secs(5)));

    assert_eq!(
        rig.pass(5),
        ["overdue b", "1 gave b up: its next incarnation did not start: not at work within 5s"]
    );
    assert_eq!(rig.started("b", 2), [""; 0]);
    assert_eq!(rig.restart("b", Died, 2), ["start b #3"]);
}

#[test]
fn the_last_hooks_of_a_start_that_fails_have_the_time_of_a_stop() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Died, 1);
    assert_eq!(rig.pass(4), [""; 0]);
    assert_eq!(rig.fails_to_start("b", 2), [""; 0]);
    assert_eq!(rig.machine.poll_timeout(), Some(rig.now + Duration::from_secs(5)));
    assert_eq!(rig.started("b", 2), [""; 0], "it does not come to work any more");

    assert_eq!(
        rig.pass(5),
        [
            "cut off b",
            "1 gave b up: its next incarnation did not start: its last hooks took too long"
        ]
    );
    assert_eq!(rig.fails_to_start("b", 2), [""; 0]);
    assert_eq!(rig.machine.poll_timeout(), None);
    assert_eq!(rig.restart("b", Died, 2), ["start b #3"]);
}

#[test]
fn a_child_that_does_not_stop_in_time_is_given_up() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    assert_eq!(rig.end(), ["stop c"]);

    assert_eq!(rig.pass(5), ["cut off c", "stop b"]);
    assert_eq!(rig.died("b", 1), ["stop a"]);
    assert_eq!(rig.stopped("a", 1), ["all stopped"]);
    assert_eq!(rig.machine.poll_timeout(), None);
}

#[test]
fn a_fault_of_an_earlier_incarnation_is_answered_by_the_present_one() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Died, 1);

    assert_eq!(rig.restart("b", Stuck, 1), [""; 0]);
    assert_eq!(rig.started("b", 2), ["1 recovered b #2", "2 recovered b #2"]);
    assert_eq!(rig.restart("b", Died, 1), ["3 recovered b #2"]);
    assert_eq!(rig.machine.restarts_left(rig.now), 2);
}

#[test]
fn reports_of_an_earlier_incarnation_change_nothing() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Stuck, 1);

    assert_eq!(rig.started("b", 1), [""; 0]);
    assert_eq!(rig.start_failed("b", 1), [""; 0]);
    assert_eq!(rig.stopped("b", 1), [""; 0]);
    assert_eq!(rig.died("b", 1), [""; 0]);
    assert_eq!(rig.died_on_the_spot("b", 1), [""; 0]);
    assert_eq!(rig.reset_done("b", 1, Ok(())), [""; 0]);
    assert_eq!(rig.escalated("b", 1), [""; 0]);
    assert_eq!(rig.state("b"), ChildState::Starting);
}

#[test]
fn a_death_is_noted_and_waits_for_the_recoverer() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    assert_eq!(rig.died("b", 1), [""; 0]);
    assert_eq!(rig.state("b"), ChildState::Failed);
    assert_eq!(rig.restart("b", Died, 1), ["start b #2"]);
}

#[test]
fn a_transient_child_may_return_and_a_temporary_one_may_also_die() {
    let children =
        [("t", kept(Restart::Transient)), ("u", kept(Restart::Temporary)), ("p", permanent())];
    let mut rig = Rig::with(Strategy::OneForOne, 3, &children).at_work();

    assert_eq!(rig.returned("t", 1), ["retire t"]);
    assert_eq!(rig.state("t"), ChildState::Finished);
    assert_eq!(rig.restart("t", Died, 1), ["1 let t go"]);
    assert_eq!(rig.restart("u", Died, 1), ["retire u", "2 let u go"]);
    assert_eq!(rig.state("u"), ChildState::Finished);
    assert_eq!(rig.returned("p", 1), [""; 0]);
    assert_eq!(rig.restart("p", Died, 1), ["start p #2"]);
    assert_eq!(rig.restart_by_hand("t"), ["start t #2"]);
    assert_eq!(rig.died("t", 2), ["4 gave t up: its next incarnation did not start: it died"]);
    assert_eq!(rig.restart("t", Died, 2), ["start t #3"]);
}

#[test]
fn a_transient_child_that_could_not_go_on_did_not_end_in_order() {
    let mut rig = Rig::with(Strategy::OneForOne, 3, &[("t", kept(Restart::Transient))]).at_work();
    rig.died("t", 1);

    assert_eq!(rig.restart("t", Faulty, 1), ["start t #2"]);
}

#[test]
fn a_temporary_child_that_is_stuck_or_faulty_is_ended_and_let_go() {
    let children = [("u", kept(Restart::Temporary)), ("v", kept(Restart::Temporary))];
    let mut rig = Rig::with(Strategy::OneForAll, 3, &children).at_work();

    assert_eq!(rig.restart("u", Stuck, 1), ["abandon u", "retire u", "1 let u go"]);
    assert_eq!(rig.restart("v", Faulty, 1), ["stop v"]);
    assert_eq!(rig.stopped("v", 1), ["retire v", "2 let v go"]);
}

#[test]
fn a_reset_is_passed_on_and_answered() {
    let mut rig = Rig::with(Strategy::OneForOne, 9, &[("b", permanent())]).at_work();

    assert_eq!(rig.reset("b"), ["reset b"]);
    assert_eq!(rig.reset("b"), ["2 gave b up: it has no incarnation that could be reset"]);
    assert_eq!(rig.reset_done("b", 1, Ok(())), ["1 recovered b #1"]);
    rig.reset("b");
    assert_eq!(
        rig.reset_done("b", 1, Err("still hot")),
        ["3 gave b up: it could not reset itself: still hot"]
    );
    rig.reset("b");
    assert_eq!(rig.pass(5), ["4 gave b up: it did not answer within 5s"]);
    rig.reset("b");
    assert_eq!(
        rig.restart("b", Died, 1),
        ["5 gave b up: it has no incarnation that could be reset", "start b #2"]
    );
    assert_eq!(rig.reset("x"), ["7 gave x up: no such child"]);
}

#[test]
fn a_child_is_told_whether_another_incarnation_follows() {
    let reported = |rig: &mut Rig| {
        let mut reported = Vec::new();
        while let Some(action) = rig.machine.poll_output() {
            if let SupervisorOutput::Order { child, order: ChildOrder::Stop { again } } = action {
                reported.push((child.to_string(), again));
            }
        }
        reported
    };
    let mut rig = Rig::serving(Strategy::OneForAll);
    let (now, calls) = (rig.now, [CallId(1), CallId(2)]);

    rig.machine.handle_restart(&object("a"), calls[0], Died, None, now);
    assert_eq!(reported(&mut rig), [("c".into(), true)]);

    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.machine.handle_rest(&object("b"), calls[1], Faulty, now);
    assert_eq!(reported(&mut rig), [("b".into(), false)]);
    rig.machine.handle_end(now);
    rig.machine.handle_stopped(&object("b"), Incarnation::FIRST, now);
    assert_eq!(reported(&mut rig), [("c".into(), false)]);
}
