//! What becomes of faults while the node ends, and in the safe state.

use super::*;

#[test]
fn incarnations_that_hang_as_the_node_ends_are_given_up_and_not_restarted() {
    let mut rig = Rig::new();
    rig.find(fault(1, FaultKind::Hang, at("arm"), 1));
    rig.machine.handle_node_end(rig.now);
    let expected = |id| format!("{id} given up: the node ends, and restarts nothing");
    assert_eq!(rig.outputs(), ["give up here:arm #1".to_owned(), expected(1)]);

    let leg = fault(2, FaultKind::Hang, at("leg"), 3);
    assert_eq!(rig.find(leg), ["give up here:leg #3".to_owned(), expected(2)]);
    assert_eq!(rig.find(panic_of(3, "leg", 3)), [expected(3)], "it has ended");
    assert_eq!(rig.machine.cases.len(), 0);
}

#[test]
fn at_safe_rest_nothing_of_the_node_is_treated_and_everything_is_settled() {
    let mut rig = Rig::new();
    let given_up = "given up: the node is in the safe state, where nothing is restarted";
    rig.find(panic_of(1, "laser", 1));
    rig.find(symptom(2, "map", 1));
    rig.machine.handle_rest(rig.now);
    assert_eq!(rig.outputs(), [format!("1 {given_up}")]);

    assert_eq!(rig.outcome(1, fails()), [""; 0], "what was under way is over");
    assert_eq!(rig.find(panic_of(3, "lamp", 1)), [format!("3 {given_up}")]);
    assert_eq!(rig.pass(Duration::from_millis(200)), [format!("2 {given_up}")]);
    let checked = fault(4, FaultKind::CheckFailed, at("lamp"), 1);
    assert_eq!(rig.find(checked), ["4 observed"]);
    // The network goes on.
    let link = FaultLocation::Link { node: node(), link: "eth".into(), neighbour: None };
    let down = fault(5, FaultKind::LinkDown, link, 0);
    assert_eq!(rig.find(down), ["#2 reroute here -eth- against link down, 1"]);
    assert_eq!(rig.machine.cases.len(), 1);

    rig.machine = rig.machine.restarted(rig.now);
    rig.outputs();
    assert_eq!(rig.find(panic_of(6, "lamp", 1)), [format!("6 {given_up}")]);
    rig.machine.handle_work();
    let again = rig.find(panic_of(7, "lamp", 2));
    assert_eq!(again, ["#4 restart here:lamp against panic, 1"]);
}
