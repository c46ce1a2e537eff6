//! Children that are added whole: each comes to work, or is forgotten.

use super::*;

#[test]
fn an_added_child_is_answered_when_it_is_at_work_and_is_the_last_of_its_group_then() {
    for (strategy, struck) in [(Strategy::OneForAll, "a"), (Strategy::RestForOne, "c")] {
        let mut rig = Rig::serving(strategy);

        assert_eq!(rig.add("d", permanent()), ["start d #1"]);
        assert_eq!(rig.started("d", 1), ["1 recovered d #1"]);

        assert_eq!(rig.died(struck, 1), [""; 0]);
        assert_eq!(rig.restart(struck, Died, 1), ["stop d"], "{strategy:?}");
        assert_eq!(
            rig.add("d", permanent()),
            ["3 gave d up: there already is a child of this name"]
        );
    }
}

#[test]
fn one_whose_start_fails_is_forgotten_without_a_restart_of_others_whatever_its_rules() {
    let essential = ChildRules { essential: true, ..permanent() };
    for rules in [permanent(), kept(Restart::Temporary), essential] {
        for strategy in [Strategy::OneForOne, Strategy::OneForAll, Strategy::RestForOne] {
            let mut rig = Rig::serving(strategy);
            rig.add("d", rules);

            let gave_up = "1 gave d up: its next incarnation did not start: no device";
            assert_eq!(rig.start_failed("d", 1), ["left d", gave_up]);

            let late = rig.restart("d", Faulty, 1);
            assert_eq!(late, ["2 gave d up: no such child"], "{strategy:?}");
            assert_eq!(rig.machine.restarts_left(rig.now), 3);
            assert_eq!(rig.add("d", rules), ["start d #1"], "its name is free");
        }
    }
}

#[test]
fn one_that_is_late_or_hangs_in_its_start_or_is_put_to_rest_is_forgotten() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    rig.add("d", permanent());
    let late = [
        "overdue d",
        "left d",
        "1 gave d up: its next incarnation did not start: not at work within 5s",
    ];
    assert_eq!(rig.pass(5), late);

    rig.add("d", permanent());
    let stopped =
        "gave d up: its next incarnation did not start: it was stopped before it was at work";
    let given_up = format!("2 {stopped}");
    let hangs = rig.restart("d", Stuck, 1);
    assert_eq!(
        hangs,
        [
            "abandon d",
            "left d",
            &given_up,
            "3 gave d up: its next incarnation did not start: it was stopped before it was at work"
        ]
    );

    rig.add("d", ChildRules { essential: true, ..permanent() });
    assert_eq!(rig.rest("d", Faulty), ["isolate d", "stop d"]);
    let ended = rig.stopped("d", 1);
    assert_eq!(ended[..2], ["left d".to_owned(), format!("4 {stopped}")], "{ended:?}");
    assert!(rig.machine.at_work(), "what was never at work is not essential");
}

#[test]
fn a_supervisor_that_escalates_in_its_first_start_is_forgotten_and_counts_for_nothing() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.add("below", ChildRules::supervisor());

    let gave_up = "1 gave below up: its next incarnation did not start: too much";
    assert_eq!(rig.escalated("below", 1), ["left below", gave_up]);
    assert_eq!(rig.machine.restarts_left(rig.now), 3);
}

#[test]
fn an_addition_during_a_recovery_waits_for_it_and_a_removal_does_not() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    assert_eq!(rig.restart("b", Faulty, 1), ["stop c"]);

    assert_eq!(rig.add("d", permanent()), [""; 0]);
    assert_eq!(rig.remove("a"), ["stop a"]);
    assert_eq!(rig.stopped("a", 1), ["left a", "3 let a go"]);
    assert_eq!(rig.stopped("c", 1), ["stop b"]);
    assert_eq!(rig.stopped("b", 1), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["start d #1"]);
    assert_eq!(rig.started("d", 1), ["1 recovered b #2", "2 recovered d #1"]);
}

#[test]
fn an_addition_ends_with_the_incarnation_of_the_supervisor() {
    let undone =
        "1 gave d up: its next incarnation did not start: it was stopped before it was at work";
    let waits = |rig: &mut Rig| rig.add("d", permanent());

    let mut rig = Rig::serving(Strategy::OneForOne);
    waits(&mut rig);
    assert_eq!(rig.end(), ["stop d"]);
    assert_eq!(rig.stopped("d", 1), ["left d", undone, "stop c"]);
    assert_eq!(rig.add("e", permanent()), ["2 gave e up: its supervisor is not at work"]);

    let mut rig = Rig::serving(Strategy::OneForAll);
    rig.restart("a", Faulty, 1);
    rig.machine.handle_add(&object("d"), permanent(), CallId(1), rig.now);
    assert_eq!(rig.end()[..2], ["left d".to_owned(), undone.to_owned()], "it had not begun");

    let mut rig = Rig::serving(Strategy::OneForOne);
    waits(&mut rig);
    rig.machine.handle_forsake(rig.now);
    let outputs = rig.outputs();
    assert_eq!(outputs[..3], ["abandon d", "left d", undone].map(str::to_owned), "{outputs:?}");
}

#[test]
fn rounds_of_additions_and_removals_leave_nothing() {
    let mut rig = Rig::serving(Strategy::RestForOne);
    for round in 0..1000 {
        rig.add("d", permanent());
        if round % 2 == 0 {
            rig.started("d", 1);
            rig.remove("d");
            rig.stopped("d", 1);
        } else {
            rig.start_failed("d", 1);
        }
    }
    let Supervisor { children, index, going, coming, timed, pending, .. } = &rig.machine;
    assert_eq!((children.len(), index.len(), pending.len()), (3, 3, 0));
    assert!(going.is_empty() && coming.is_empty() && timed.is_empty());
}
