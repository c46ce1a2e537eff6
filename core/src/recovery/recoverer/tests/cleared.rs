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
    assert_eq!(outputs, ["1 recovered", "#3 reset here:arm against error state, 1"]);
}

#[test]
fn a_fault_that_outlives_the_one_before_it_begins_at_its_own_first_attempt() {
    let homing = RecoveryAction::Custom("homing".into());
    let plan = Plan::default().on(FaultKind::CheckFailed, Ladder::first(homing).times(3));
    for clears_while_waiting in [true, false] {
        let mut rig = Rig::with(plan.clone());
        rig.find(fault(1, FaultKind::CheckFailed, at("arm"), 1));
        rig.find(fault(2, FaultKind::ErrorState, at("arm"), 1));
        let treated = if clears_while_waiting {
            assert_eq!(rig.outcome(1, fails()), [""; 0]);
            rig.stand_down(1, "arm")
        } else {
            assert_eq!(rig.stand_down(1, "arm"), [""; 0]);
            rig.outcome(1, fails())
        };

        assert_eq!(treated, ["#2 reset here:arm against error state, 1"]);
        assert_eq!(rig.outcome(2, works(1)), ["2 recovered"]);
    }
}

/// Each incarnation comes to work, which clears the panic before it, and dies before its group is
/// whole.
#[test]
fn a_panic_after_each_recovery_is_answered_by_a_first_attempt_each_time() {
    let mut rig = Rig::new();
    for number in 1..=20 {
        let panicked = rig.find(panic_of(number, "arm", number));
        let answered = match number {
            1 => panicked,
            _ => {
                assert_eq!(rig.stand_down(number - 1, "arm"), [""; 0]);
                // The restart has been at work, or was given up because the group is late.
                let outcome = if number % 2 == 0 { works(number) } else { fails() };
                rig.outcome(number - 1, outcome)
            }
        };
        let restart = format!("#{number} restart here:arm against panic, 1");
        assert_eq!(answered.last(), Some(&restart));
    }
}
