//! A supervisor in each of its states, and what may come there.

use super::*;

#[test]
fn children_come_and_go_while_it_is_at_work() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    rig.machine.add_child(object("d"), permanent(), rig.now).expect("a free name");
    assert_eq!(rig.outputs(), ["start d #1"]);
    assert_eq!(rig.started("d", 1), [""; 0]);
    assert_eq!(
        rig.machine.add_child(object("d"), permanent(), rig.now),
        Err(GiveUpReason::NameTaken)
    );
    assert_eq!(rig.remove("b"), ["stop b"]);
    assert_eq!(
        rig.restart("b", Died, 1),
        ["left b", "1 let b go", "2 let b go"],
        "its stop is not waited for"
    );
    assert_eq!(rig.stopped("b", 1), [""; 0]);
    assert_eq!(rig.remove("b"), ["3 gave b up: no such child"]);
    assert_eq!(rig.end(), ["stop d"]);
    assert_eq!(rig.stopped("d", 1), ["stop c"]);
}

#[test]
fn a_child_that_is_added_after_the_end_is_retired_until_the_next_beginning() {
    let mut rig = Rig::with(Strategy::OneForOne, 3, &[("a", permanent())]).at_work();
    rig.end();
    assert_eq!(rig.stopped("a", 1), ["all stopped"]);

    rig.machine.add_child(object("b"), permanent(), rig.now).expect("a free name");

    assert_eq!(rig.outputs(), ["retire b"]);
    assert_eq!(rig.begin(), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start b #1"]);
}

#[test]
fn nothing_is_restarted_while_it_is_not_at_work() {
    let mut rig = Rig::with(Strategy::OneForOne, 3, &[("a", permanent())]);

    assert_eq!(rig.restart("a", Died, 0), ["1 gave a up: its supervisor is not at work"]);
    rig.begin();
    rig.started("a", 1);
    assert_eq!(rig.end(), ["stop a"]);
    assert_eq!(rig.restart_by_hand("a"), ["2 gave a up: its supervisor is not at work"]);
    assert_eq!(rig.restart("a", Faulty, 1), [""; 0], "its next incarnation says");
    assert_eq!(rig.stopped("a", 1), ["all stopped"]);
    rig.machine.handle_retired();
    assert_eq!(rig.outputs(), ["3 gave a up: its supervisor is not at work"]);
    assert_eq!(rig.remove("a"), ["left a", "4 let a go"]);
}

#[test]
fn abandoning_children_ends_all_and_a_new_start_starts_all() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Faulty, 1);
    rig.remove("c");

    rig.machine.handle_forsake(rig.now);
    assert_eq!(rig.outputs(), ["abandon c", "left c", "abandon b", "abandon a", "2 let c go"]);

    assert_eq!(rig.begin(), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["all started", "1 recovered b #2"]);
}

#[test]
fn a_second_beginning_without_an_end_leaves_no_incarnation_twice() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    assert_eq!(rig.begin(), ["abandon c", "abandon b", "abandon a", "start a #2"]);
}

#[test]
fn after_a_restart_of_its_own_children_at_work_stay_and_the_others_start_again() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Faulty, 1);
    rig.restart("c", Died, 1);

    rig.machine.handle_own_restart(rig.now);

    assert_eq!(rig.outputs(), ["abandon b", "abandon c", "start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #3"]);
    assert_eq!(rig.state("a"), ChildState::Running);
}

/// Puts child `b` of three into each state, throws each input at it, lets everything be answered,
/// and finds either a supervisor at work with all that it wants, or one that ended as it was told.
#[test]
fn every_state_takes_every_input_and_comes_to_an_end() {
    type Act = (&'static str, fn(&mut Rig));
    let states: [Act; 12] = [
        ("running", |_| {}),
        ("starting", |rig| drop(rig.restart("b", Died, 1))),
        ("failing", |rig| {
            rig.restart("b", Died, 1);
            rig.fails_to_start("b", 2);
        }),
        ("stopping", |rig| drop(rig.restart("b", Faulty, 1))),
        ("resetting", |rig| drop(rig.reset("b"))),
        ("resetting in its group", |rig| rig.reset_in_group("b")),
        ("failed", |rig| drop(rig.died("b", 1))),
        ("resting", |rig| drop(rig.rest("b", Died))),
        ("leaving", |rig| drop(rig.remove("b"))),
        ("isolated", |rig| drop(rig.isolate("b", true))),
        ("ending", |rig| drop(rig.end())),
        ("forsaken", |rig| rig.machine.handle_forsake(rig.now)),
    ];
    let inputs: [Act; 25] = [
        ("nothing", |_| {}),
        ("restart, died", |rig| drop(rig.restart("b", Died, 1))),
        ("restart, stuck", |rig| drop(rig.restart("b", Stuck, 1))),
        ("restart, behind another", |rig| drop(rig.restart("b", Behind, 1))),
        ("restart, faulty", |rig| drop(rig.restart("b", Faulty, 1))),
        ("restart, next incarnation", |rig| drop(rig.restart("b", Stuck, 2))),
        ("restart by hand", |rig| drop(rig.restart_by_hand("b"))),
        ("restart of a", |rig| drop(rig.restart("a", Stuck, 1))),
        ("reset", |rig| drop(rig.reset("b"))),
        ("reset", |rig| drop(rig.reset_done("b", 1, Ok(())))),
        ("reset failed", |rig| drop(rig.reset_done("b", 1, Err("still hot")))),
        ("rest", |rig| drop(rig.rest("b", Faulty))),
        ("rest, stuck", |rig| drop(rig.rest("b", Stuck))),
        ("isolate", |rig| drop(rig.isolate("b", true))),
        ("remove", |rig| drop(rig.remove("b"))),
        ("started", |rig| drop(rig.started("b", 2))),
        ("fails to start", |rig| drop(rig.fails_to_start("b", 2))),
        ("start failed", |rig| drop(rig.start_failed("b", 2))),
        ("stopped", |rig| drop(rig.stopped("b", 1))),
        ("died", |rig| drop(rig.died("b", 1))),
        ("died on the spot", |rig| drop(rig.died_on_the_spot("b", 1))),
        ("escalated", |rig| drop(rig.escalated("b", 1))),
        ("own restart", |rig| rig.machine.handle_own_restart(rig.now)),
        ("end", |rig| drop(rig.end())),
        ("time", |rig| drop(rig.pass(5))),
    ];
    for strategy in [Strategy::OneForOne, Strategy::OneForAll, Strategy::RestForOne] {
        for (state, prepare) in states {
            for (input, act) in inputs {
                let mut rig = Rig::serving(strategy);
                prepare(&mut rig);
                act(&mut rig);
                finish(&mut rig, &format!("{strategy:?}, {state}, {input}"));
            }
        }
    }
}

/// Answers whatever is asked for, decides whatever failed, until nothing moves any more.
fn finish(rig: &mut Rig, case: &str) {
    for _ in 0..100 {
        rig.outputs();
        let table: Vec<ChildStatus> = rig.machine.children().collect();
        let open = table.iter().find(|child| {
            !matches!(child.state, ChildState::Running | ChildState::Resting | ChildState::Finished)
        });
        let Some(child) = open else { break };
        let (name, incarnation) = (child.name.as_str(), child.incarnation.0);
        match child.state {
            ChildState::Starting => rig.finish_start(name, incarnation),
            ChildState::Stopping => drop(rig.stopped(name, incarnation)),
            ChildState::Failed => drop(rig.restart(name, Died, incarnation)),
            // Either another child must move first, or the supervisor does not want to.
            _ if !rig.machine.at_work() => break,
            _ => {
                let moving = table.iter().find(|child| {
                    matches!(child.state, ChildState::Starting | ChildState::Stopping)
                });
                // One is reset when those behind it have stopped, and those before it have started.
                let resetting = table.iter().find(|child| child.state == ChildState::Resetting);
                let child = moving.or(resetting);
                let child = child.unwrap_or_else(|| panic!("{case}: {name} waits for no other"));
                let (name, incarnation) = (child.name.as_str(), child.incarnation.0);
                match child.state {
                    ChildState::Starting => rig.finish_start(name, incarnation),
                    ChildState::Resetting => drop(rig.reset_done(name, incarnation, Ok(()))),
                    _ => drop(rig.stopped(name, incarnation)),
                }
            }
        }
    }
    // Those that are still to stop.
    for _ in 0..10 {
        let table: Vec<ChildStatus> = rig.machine.children().collect();
        let Some(child) = table.iter().find(|child| child.state == ChildState::Stopping) else {
            break;
        };
        rig.stopped(child.name.as_str(), child.incarnation.0);
    }
    let table: Vec<ChildStatus> = rig.machine.children().collect();
    let settled = |child: &ChildStatus| {
        let well =
            matches!(child.state, ChildState::Running | ChildState::Resting | ChildState::Finished);
        well == rig.machine.at_work() || matches!(child.state, ChildState::Resting)
    };
    assert!(table.iter().all(settled), "{case}: {table:?}");
    // Restarts are counted for so long.
    rig.pass(61);
    assert!(rig.machine.poll_timeout().is_none(), "{case}: {:?}", rig.machine);
}
