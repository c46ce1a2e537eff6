//! Faults that clear, or are of an earlier incarnation, while they are treated.

use super::*;

#[test]
fn a_fault_that_clears_during_a_failed_action_is_not_treated_further() {
    let mut rig = Rig::new();
    assert_eq!(rig.find(panic_of(1, "laser", 1)), ["#1 restart here:laser against panic, 1"]);

    assert_eq!(rig.stand_down(1, "laser"), [""; 0]);
    assert_eq!(rig.outcome(1, fails()), [""; 0]);

    assert_eq!(rig.machine.cases.len(), 0);
}

#[test]
fn a_fault_that_clears_during_a_successful_action_is_closed() {
    let mut rig = Rig::new();
    rig.find(fault(1, FaultKind::Hang, at("arm"), 2));
    rig.stand_down(1, "arm");

    // The restart has found the incarnation of the fault, which moves again.
    assert_eq!(rig.outcome(1, works(2)), [""; 0]);

    assert_eq!(rig.machine.cases.len(), 0);
}

#[test]
fn a_restart_cures_no_fault_of_an_incarnation_that_it_finds_replaced() {
    let mut rig = Rig::new();
    let silence = fault(1, FaultKind::Silence, at("arm"), 5);
    assert_eq!(rig.find(silence), ["#1 restart here:arm against silence, 1"]);
    assert_eq!(rig.outcome(1, fails()), [""; 0]);
    assert_eq!(rig.find(fault(2, FaultKind::ErrorState, at("arm"), 8)), [""; 0]);

    assert_eq!(rig.pass_to_due(), ["#2 restart here:arm against error state, 2"]);

    // Incarnation 8 is the one that is in error.
    let outputs = rig.outcome(2, works(8));
    assert_eq!(outputs, ["1 recovered #8", "#3 reset here:arm against error state, 1"]);
}

#[test]
fn what_helped_is_remembered_of_the_fault_whose_ladder_was_climbed() {
    let homing = RecoveryAction::Custom("homing".into());
    let ladder = Ladder::first(RecoveryAction::Restart).then(homing).times(2);
    let plan = Plan::default()
        .on(FaultKind::CheckFailed, ladder)
        .on(FaultKind::ErrorState, Ladder::first(RecoveryAction::Reset));
    let mut rig = Rig::with(plan, RecovererLimits::default());
    rig.find(fault(1, FaultKind::CheckFailed, at("arm"), 1));
    rig.find(fault(2, FaultKind::ErrorState, at("arm"), 1));
    assert_eq!(rig.outcome(1, fails()), ["#2 homing here:arm against check failed, 1"]);
    assert_eq!(rig.outcome(2, fails()), [""; 0]);

    // The fault that the ladder belongs to clears before the next attempt.
    rig.stand_down(1, "arm");
    assert_eq!(rig.pass_to_due(), ["#3 homing here:arm against error state, 2"]);
    assert_eq!(rig.outcome(3, works(1)), ["2 recovered #1"]);

    let again = fault(3, FaultKind::ErrorState, at("arm"), 1);
    assert_eq!(rig.find(again), ["#4 reset here:arm against error state, 1"]);
}
