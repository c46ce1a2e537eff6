//! Decisions in words: outputs are compared as lines such as `#1 restart laser, attempt 2`.

use super::*;
use crate::recovery::Backoff;
use crate::{Incarnation, ObjectAddress};
use std::sync::Arc;
use std::time::Duration;

mod cleared;
mod ending;

struct Rig {
    machine: Recoverer,
    now: Instant,
}

fn node() -> NodeName {
    NodeName::new("here").expect("a good name")
}

fn at(object: &str) -> FaultLocation {
    FaultLocation::Object(format!("here:{object}").parse::<ObjectAddress>().expect("a good name"))
}

fn fault(id: u64, kind: FaultKind, location: FaultLocation, incarnation: u64) -> Fault {
    Fault {
        id: FaultId(id),
        severity: kind.severity(),
        kind,
        location,
        incarnation: Incarnation(incarnation),
        detail: String::new(),
        found_at: Instant::ORIGIN,
        symptom_of: None,
        count: 1,
    }
}

fn panic_of(id: u64, object: &str, incarnation: u64) -> Fault {
    fault(id, FaultKind::Panic, at(object), incarnation)
}

fn symptom(id: u64, object: &str, root: u64) -> Fault {
    Fault { symptom_of: Some(FaultId(root)), ..fault(id, FaultKind::Silence, at(object), 1) }
}

fn works(incarnation: u64) -> Result<RecoveryDone, RecoveryFailed> {
    Ok(RecoveryDone { incarnation: Some(Incarnation(incarnation)), ..RecoveryDone::default() })
}

fn done() -> Result<RecoveryDone, RecoveryFailed> {
    Ok(RecoveryDone::default())
}

fn fails() -> Result<RecoveryDone, RecoveryFailed> {
    Err("broken".into())
}

impl Rig {
    fn new() -> Self {
        Rig::with(Plan::default())
    }

    fn with(plan: Plan) -> Self {
        Rig { machine: Recoverer::new(node(), plan, 7), now: Instant::from_millis(1000) }
    }

    fn outputs(&mut self) -> Vec<String> {
        let mut outputs = Vec::new();
        while let Some(action) = self.machine.poll_output() {
            outputs.push(match action {
                RecovererOutput::CarryOut(order) => {
                    let RecoveryOrder { number, action, fault, attempt, .. } = order;
                    format!(
                        "#{number} {action} {} against {}, {attempt}",
                        fault.location, fault.kind
                    )
                }
                RecovererOutput::Settle { fault: FaultId(id), outcome } => match outcome {
                    RecoveryOutcome::Decided { action } if action == "observe" => {
                        format!("{id} observed")
                    }
                    RecoveryOutcome::Decided { .. } | RecoveryOutcome::Failed { .. } => continue,
                    RecoveryOutcome::Recovered => format!("{id} recovered"),
                    RecoveryOutcome::Waits => format!("{id} waits"),
                    RecoveryOutcome::GaveUp { reason } => format!("{id} given up: {reason}"),
                },
                RecovererOutput::AbandonIncarnation { fault } => {
                    format!("give up {} {}", fault.location, fault.incarnation)
                }
                RecovererOutput::LastResort { fault, reason } => {
                    format!("last resort for {}: {reason}", fault.id.0)
                }
            });
        }
        outputs
    }

    fn find(&mut self, fault: Fault) -> Vec<String> {
        self.machine.handle_fault(fault, self.now);
        self.outputs()
    }

    fn outcome(
        &mut self,
        number: u64,
        outcome: Result<RecoveryDone, RecoveryFailed>,
    ) -> Vec<String> {
        self.machine.handle_outcome(number, outcome, self.now);
        self.outputs()
    }

    fn stand_down(&mut self, id: u64, object: &str) -> Vec<String> {
        self.machine.handle_stand_down(FaultId(id), &at(object), self.now);
        self.outputs()
    }

    fn pass(&mut self, span: Duration) -> Vec<String> {
        self.now = self.now + span;
        self.machine.handle_timeout(self.now);
        self.outputs()
    }

    fn pass_to_due(&mut self) -> Vec<String> {
        self.now = self.machine.poll_timeout().expect("something is due");
        self.machine.handle_timeout(self.now);
        self.outputs()
    }
}

#[test]
fn a_panic_is_answered_by_a_restart_at_once() {
    let mut rig = Rig::new();

    assert_eq!(rig.find(panic_of(1, "laser", 1)), ["#1 restart here:laser against panic, 1"]);
    assert_eq!(rig.outcome(1, works(2)), ["1 recovered"]);
    assert_eq!(rig.machine.cases.len(), 0);
}

#[test]
fn a_fault_that_is_reported_again_is_treated_once() {
    let mut rig = Rig::new();
    rig.find(panic_of(1, "laser", 1));

    assert_eq!(rig.find(panic_of(1, "laser", 1)), [""; 0]);
    assert_eq!(rig.outcome(1, works(2)), ["1 recovered"]);
    assert_eq!(rig.outcome(1, works(2)), [""; 0]);
}

#[test]
fn a_restart_whose_incarnation_waits_closes_the_case_unrecovered() {
    let mut rig = Rig::new();
    rig.find(panic_of(1, "laser", 1));
    let waits = RecoveryDone { waits: true, ..works(2).expect("it works") };

    assert_eq!(rig.outcome(1, Ok(waits)), ["1 waits"]);

    assert_eq!(rig.machine.cases.len(), 0);
    assert_eq!(rig.pass(Duration::from_secs(20)), [""; 0], "it may take for ever");
    assert_eq!(rig.find(panic_of(1, "laser", 2)), ["#2 restart here:laser against panic, 1"]);
}

#[test]
fn a_restart_without_a_next_incarnation_ends_the_case_unrecovered() {
    let mut rig = Rig::new();
    rig.find(panic_of(1, "laser", 1));
    let finished = RecoveryDone { finished: true, ..RecoveryDone::default() };

    let expected = "1 given up: it is not restarted: its end was final, as its rules say";
    assert_eq!(rig.outcome(1, Ok(finished)), [expected]);

    assert_eq!(rig.machine.cases.len(), 0);
    assert_eq!(rig.pass(Duration::from_secs(20)), [""; 0]);
}

#[test]
fn a_restart_whose_incarnation_hangs_too_has_failed() {
    let mut rig = Rig::new();
    let hang = |incarnation| fault(1, FaultKind::Hang, at("laser"), incarnation);
    assert_eq!(rig.find(hang(1)), ["#1 restart here:laser against hang, 1"]);
    assert_eq!(rig.find(hang(1)), [""; 0], "the same incarnation");

    rig.find(hang(2));
    assert_eq!(rig.pass_to_due(), ["#2 restart here:laser against hang, 2"]);
    assert_eq!(rig.outcome(1, works(2)), [""; 0], "that order is closed");
    rig.find(hang(3));
    assert_eq!(rig.pass_to_due(), ["#3 restart here:laser against hang, 3"]);
    assert_eq!(rig.outcome(3, works(4)), ["1 recovered"]);
}

#[test]
fn the_ladder_is_climbed_with_back_off_until_safe_stop_holds() {
    let mut rig = Rig::new();
    rig.find(panic_of(1, "laser", 1));

    assert_eq!(rig.outcome(1, fails()), [""; 0]);
    let wait = rig.machine.poll_timeout().expect("a second attempt") - rig.now;
    assert!(wait >= Duration::from_millis(9) && wait <= Duration::from_millis(11), "{wait:?}");
    assert_eq!(rig.pass_to_due(), ["#2 restart here:laser against panic, 2"]);
    assert_eq!(rig.outcome(2, fails()), [""; 0]);
    assert_eq!(rig.pass_to_due(), ["#3 restart here:laser against panic, 3"]);
    assert_eq!(rig.outcome(3, fails()), ["#4 safe stop here:laser against panic, 1"]);
    assert_eq!(
        rig.outcome(4, done()),
        ["1 given up: contained by safe stop; service is not restored"]
    );
}

#[test]
fn a_step_that_is_refused_for_good_is_not_tried_again() {
    let backoff = Backoff { first: Duration::from_secs(1), ..Backoff::default() };
    let patient = Ladder::first(RecoveryAction::Restart).times(5).backoff(backoff);
    let patient = patient.then(RecoveryAction::SafeStop);
    for plan in [Plan::default(), Plan::default().on(FaultKind::Panic, patient)] {
        let mut rig = Rig::with(plan);
        rig.find(panic_of(1, "laser", 1));
        let refused = RecoveryFailed { reason: "too many".into(), is_final: true };

        assert_eq!(rig.outcome(1, Err(refused)), ["#2 safe stop here:laser against panic, 1"]);
        assert_eq!(
            rig.outcome(2, done()),
            ["1 given up: contained by safe stop; service is not restored"]
        );
    }
}

#[test]
fn each_failed_step_is_reported_once_with_its_reason() {
    let ladder =
        Ladder::first(RecoveryAction::Custom("homing".into())).then(RecoveryAction::Restart);
    let plan = Plan::default().on(FaultKind::Panic, ladder);
    let mut rig = Rig::with(plan);
    rig.find(panic_of(1, "laser", 1));
    let mut reasons = |number, reason: &str| {
        rig.machine.handle_outcome(number, Err(reason.into()), rig.now);
        let mut outputs = Vec::new();
        while let Some(output) = rig.machine.poll_output() {
            let RecovererOutput::Settle { outcome, .. } = output else { continue };
            outputs.push(match outcome {
                RecoveryOutcome::Failed { action, reason } => format!("{action}: {reason}"),
                RecoveryOutcome::GaveUp { reason } => format!("given up: {reason}"),
                RecoveryOutcome::Decided { action } => action,
                other => panic!("{other:?}"),
            });
        }
        outputs
    };

    assert_eq!(reasons(1, "it holds nothing"), ["homing: it holds nothing", "restart"]);
    assert_eq!(reasons(2, "no thread"), ["given up: no thread", "safe stop"]);
}

#[test]
fn what_not_even_safe_stop_can_contain_is_the_nodes_to_end() {
    let plan = Plan::default().on(FaultKind::Panic, Ladder::first(RecoveryAction::Restart));
    let mut rig = Rig::with(plan);
    rig.find(panic_of(1, "laser", 1));

    assert_eq!(
        rig.outcome(1, fails()),
        ["1 given up: broken", "#2 safe stop here:laser against panic, 1"]
    );
    assert_eq!(rig.outcome(2, fails()), ["last resort for 1: broken"]);
    assert_eq!(rig.machine.cases.len(), 0);
}

#[test]
fn a_strategy_that_is_silent_for_too_long_has_failed() {
    let mut rig = Rig::new();
    rig.find(panic_of(1, "laser", 1));

    assert_eq!(rig.pass(Duration::from_secs(29)), [""; 0]);
    rig.pass(Duration::from_secs(1));
    assert_eq!(rig.outcome(1, works(2)), [""; 0]);
    assert_eq!(rig.pass_to_due(), ["#2 restart here:laser against panic, 2"]);
}

#[test]
fn an_error_state_is_reset_first_and_restarted_when_it_comes_back() {
    let mut rig = Rig::new();
    let error = |id| fault(id, FaultKind::ErrorState, at("arm"), 1);

    assert_eq!(rig.find(error(1)), ["#1 reset here:arm against error state, 1"]);
    assert_eq!(rig.outcome(1, done()), ["1 recovered"]);
    assert_eq!(rig.find(error(2)), ["#2 restart here:arm against error state, 1"]);
    assert_eq!(rig.outcome(2, works(2)), ["2 recovered"]);
    assert_eq!(rig.find(error(3)), ["#3 reset here:arm against error state, 1"]);
    rig.outcome(3, done());
    rig.pass(Duration::from_secs(11));
    assert_eq!(rig.find(error(4)), ["#4 reset here:arm against error state, 1"]);
}

#[test]
fn a_second_fault_of_a_place_joins_its_case() {
    let mut rig = Rig::new();
    rig.find(fault(1, FaultKind::ErrorState, at("arm"), 1));

    assert_eq!(rig.find(fault(2, FaultKind::Hang, at("arm"), 1)), [""; 0]);
    assert_eq!(rig.outcome(1, fails()), ["#2 restart here:arm against hang, 1"]);
    assert_eq!(rig.outcome(2, works(2)), ["1 recovered", "2 recovered"]);
}

#[test]
fn a_fault_that_the_action_cannot_have_cured_is_treated_next() {
    let mut rig = Rig::new();
    rig.find(fault(1, FaultKind::ErrorState, at("arm"), 1));
    rig.find(panic_of(2, "arm", 1));

    assert_eq!(rig.outcome(1, done()), ["1 recovered", "#2 restart here:arm against panic, 1"]);

    rig.find(fault(3, FaultKind::Hang, at("arm"), 2));
    assert_eq!(rig.outcome(2, works(2)), ["2 recovered", "#3 restart here:arm against hang, 1"]);
}

#[test]
fn a_panic_of_the_new_incarnation_is_not_taken_for_cured_by_its_beginning() {
    let mut rig = Rig::new();
    rig.find(panic_of(1, "arm", 1));
    rig.find(panic_of(2, "arm", 2));

    assert_eq!(rig.outcome(1, works(2)), ["1 recovered", "#2 restart here:arm against panic, 1"]);
}

#[test]
fn a_symptom_waits_for_its_root_and_may_then_pass() {
    let mut rig = Rig::new();
    rig.find(fault(1, FaultKind::Hang, at("planner"), 1));

    assert_eq!(rig.find(symptom(2, "laser", 1)), [""; 0]);
    assert_eq!(rig.find(symptom(2, "laser", 1)), [""; 0]);
    assert_eq!(rig.find(symptom(3, "scan", 2)), [""; 0]);
    assert_eq!(rig.outcome(1, works(2)), ["1 recovered"]);
    assert_eq!(rig.stand_down(2, "laser"), [""; 0]);
    assert_eq!(rig.stand_down(3, "scan"), [""; 0]);
    assert_eq!(rig.pass(Duration::from_secs(1)), [""; 0]);
}

#[test]
fn a_symptom_that_stays_is_treated_itself() {
    let mut rig = Rig::new();
    rig.find(fault(1, FaultKind::Hang, at("planner"), 1));
    rig.find(symptom(2, "laser", 1));
    rig.outcome(1, works(2));

    assert_eq!(rig.pass(Duration::from_millis(200)), ["#2 restart here:laser against silence, 1"]);
    assert_eq!(rig.find(symptom(4, "scan", 1)), ["#3 restart here:scan against silence, 1"]);
}

#[test]
fn symptoms_of_a_cleared_root_may_pass_while_its_case_goes_on() {
    let mut rig = Rig::new();
    rig.find(panic_of(1, "laser", 1));
    rig.find(fault(2, FaultKind::Hang, at("laser"), 1));
    rig.find(symptom(3, "scan", 2));
    rig.outcome(1, fails());

    assert_eq!(rig.stand_down(2, "laser"), [""; 0]);
    assert_eq!(rig.machine.cases.len(), 1);
}

#[test]
fn a_component_on_the_lost_thread_of_another_is_treated_at_once() {
    let mut rig = Rig::new();
    rig.find(fault(1, FaultKind::Hang, at("planner"), 1));

    let behind = Fault { kind: FaultKind::Hang, ..symptom(2, "laser", 1) };
    assert_eq!(rig.find(behind), ["#2 restart here:laser against hang, 1"]);

    // What waits for something else than a hang waits with it.
    rig.find(panic_of(3, "arm", 1));
    assert_eq!(rig.find(Fault { kind: FaultKind::Hang, ..symptom(4, "hand", 3) }), [""; 0]);
}

#[test]
fn a_late_isolation_does_not_contain_the_next_incarnation() {
    let plan = Plan::default().on(FaultKind::Panic, Ladder::first(RecoveryAction::Isolate));
    let mut rig = Rig::with(plan);
    assert_eq!(rig.find(panic_of(1, "arm", 1)), ["#1 isolate here:arm against panic, 1"]);
    rig.find(panic_of(2, "arm", 2));

    let left_alone = ["1 recovered", "#2 isolate here:arm against panic, 1"];
    assert_eq!(rig.outcome(1, works(2)), left_alone);
    assert_eq!(
        rig.outcome(2, works(2)),
        ["2 given up: contained by isolate; service is not restored"]
    );
}

#[test]
fn kinds_without_an_action_are_observed_and_hold_no_symptoms_back() {
    let mut rig = Rig::new();

    assert_eq!(rig.find(fault(1, FaultKind::Overload, at("laser"), 1)), ["1 observed"]);
    assert_eq!(rig.find(fault(2, FaultKind::RestartStorm, at("drive"), 1)), ["2 observed"]);
    assert_eq!(rig.find(symptom(3, "scan", 1)).len(), 1);
}

#[test]
fn what_waits_behind_a_symptom_that_is_only_observed_is_treated() {
    let mut rig = Rig::new();
    rig.find(fault(1, FaultKind::Hang, at("planner"), 1));
    let load = Fault { kind: FaultKind::Overload, ..symptom(2, "laser", 1) };
    assert_eq!(rig.find(load.clone()), [""; 0]);
    assert_eq!(rig.find(symptom(3, "scan", 2)), [""; 0]);

    assert_eq!(rig.find(Fault { symptom_of: None, ..load }), ["2 observed"]);
    let restart = "#2 restart here:scan against silence, 1";
    assert_eq!(rig.pass(Duration::from_millis(200)), [restart]);
}

#[test]
fn a_lost_node_is_observed_when_no_other_way_leads_there() {
    let mut rig = Rig::new();
    let there = FaultLocation::Node(NodeName::new("there").expect("a good name"));

    assert_eq!(
        rig.find(fault(1, FaultKind::NodeLost, there, 1)),
        ["#1 reroute there against node lost, 1"]
    );
    assert_eq!(rig.outcome(1, fails()), ["1 observed"]);
}

#[test]
fn faults_of_other_nodes_are_left_to_them_unless_the_plan_takes_over() {
    let there = FaultLocation::Object("there:laser".parse().expect("a good name"));
    let mut rig = Rig::new();
    assert_eq!(rig.find(fault(1, FaultKind::Panic, there.clone(), 1)), [""; 0]);
    assert_eq!(rig.machine.cases.len(), 0);

    let take_over = Ladder::first(RecoveryAction::Custom(Arc::from("take over")));
    let plan = Plan::default().on_other_nodes(FaultKind::Panic, take_over);
    let mut rig = Rig::with(plan);
    assert_eq!(
        rig.find(fault(1, FaultKind::Panic, there, 1)),
        ["#1 take over there:laser against panic, 1"]
    );
    assert_eq!(rig.outcome(1, done()), [""; 0]);
}

#[test]
fn isolation_contains_and_does_not_recover() {
    let plan = Plan::default().on(FaultKind::CheckFailed, Ladder::first(RecoveryAction::Isolate));
    let mut rig = Rig::with(plan);
    rig.find(fault(1, FaultKind::CheckFailed, at("gps"), 1));

    assert_eq!(
        rig.outcome(1, done()),
        ["1 given up: contained by isolate; service is not restored"]
    );
}

#[test]
fn more_places_than_it_can_treat_are_given_up_loudly() {
    let mut rig = Rig::new();
    for id in 1..=CASES_MAX as u64 {
        rig.find(panic_of(id, &format!("laser{id}"), 1));
    }

    assert_eq!(
        rig.find(panic_of(5000, "arm", 1)),
        ["5000 given up: 4096 places are being treated already"]
    );
    assert_eq!(rig.outcome(1, works(2)), ["1 recovered"]);
    assert_eq!(rig.find(panic_of(5001, "arm", 1)).len(), 1, "there is a place for it");
}

#[test]
fn a_symptom_more_than_may_wait_is_acted_upon_at_once() {
    let mut rig = Rig::new();
    rig.find(panic_of(1, "laser", 1));
    for id in 2..2 + SYMPTOMS_MAX as u64 {
        assert_eq!(rig.find(symptom(id, &format!("arm{id}"), 1)), [""; 0]);
    }

    assert_eq!(rig.find(symptom(5000, "laser", 1)), [""; 0], "the attempt is for it too");
    assert_eq!(rig.outcome(1, works(2)), ["1 recovered", "5000 recovered"]);
}

#[test]
fn a_place_with_too_many_faults_gives_the_further_ones_up() {
    let kind = |id: u64| FaultKind::Custom(format!("F{id}").into());
    let ids = 1..=FAULTS_LIMIT as u64;
    let rest = |plan: Plan, id| plan.on(kind(id), Ladder::first(RecoveryAction::SafeStop));
    let plan = ids.clone().fold(Plan::default(), rest);
    let mut rig = Rig::with(plan);
    for id in ids {
        rig.find(fault(id, kind(id), at("arm"), 1));
    }

    assert!(rig.find(panic_of(99, "arm", 1))[0].starts_with("99 given up: 32 faults of here:arm"));
}

#[test]
fn a_restarted_recoverer_continues_open_cases() {
    let mut rig = Rig::new();
    rig.find(fault(1, FaultKind::Hang, at("planner"), 1));
    rig.find(symptom(2, "laser", 1));

    rig.machine = rig.machine.restarted(rig.now);

    assert_eq!(rig.outputs(), ["#2 restart here:planner against hang, 1"]);
    assert_eq!(rig.outcome(1, fails()), [""; 0]);
    assert_eq!(rig.outcome(2, works(2)), ["1 recovered"]);
}

#[test]
fn a_custom_strategy_is_called_by_name_and_not_for_ever() {
    let ladder =
        Ladder::first(RecoveryAction::Custom("homing".into())).backoff(Backoff::NONE).times(2);
    let plan = Plan::default().on(FaultKind::CheckFailed, ladder);
    let mut rig = Rig::with(plan);
    let check = |id| fault(id, FaultKind::CheckFailed, at("arm"), 1);

    assert_eq!(rig.find(check(1)), ["#1 homing here:arm against check failed, 1"]);
    rig.outcome(1, done());
    assert_eq!(rig.find(check(2)), ["#2 homing here:arm against check failed, 2"]);
    rig.outcome(2, done());
    assert_eq!(
        rig.find(check(3)),
        [
            "3 given up: it came back after it had been recovered",
            "#3 safe stop here:arm against check failed, 1"
        ]
    );
}

/// Every kind of fault, every answer: whatever the strategies say or do not say, every fault comes
/// to a final outcome in bounded time.
#[test]
fn every_fault_is_settled_whatever_the_strategies_do() {
    let locations = [
        at("arm"),
        FaultLocation::Node(NodeName::new("there").expect("a good name")),
        FaultLocation::Link { node: node(), link: "ethernet".into(), neighbour: None },
    ];
    for kind in FaultKind::built_in() {
        for location in &locations {
            for answers in 0..81 {
                let mut rig = Rig::new();
                let mut open = vec![1, 2];
                let second = FaultKind::built_in().nth(answers % 15).unwrap().clone();
                rig.machine.handle_fault(fault(1, kind.clone(), location.clone(), 1), rig.now);
                rig.machine.handle_fault(fault(2, second, location.clone(), 1), rig.now);
                let mut answers = answers;
                for _ in 0..60 {
                    while let Some(action) = rig.machine.poll_output() {
                        match action {
                            RecovererOutput::CarryOut(order) => {
                                let answer = answers % 3;
                                answers /= 3;
                                match answer {
                                    0 => rig.machine.handle_outcome(order.number, fails(), rig.now),
                                    1 => {
                                        rig.machine.handle_outcome(order.number, works(2), rig.now)
                                    }
                                    _ => {}
                                }
                            }
                            RecovererOutput::Settle { fault, outcome } => match outcome {
                                RecoveryOutcome::Decided { action } if action != "observe" => {}
                                _ => open.retain(|&id| id != fault.0),
                            },
                            _ => {}
                        }
                    }
                    if let Some(due) = rig.machine.poll_timeout() {
                        rig.now = due;
                        rig.machine.handle_timeout(due);
                    }
                }
                assert!(open.is_empty() && rig.machine.cases.is_empty(), "{kind} at {location}");
            }
        }
    }
}
