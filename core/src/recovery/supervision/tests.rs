//! Every state with every input, in words: outputs are compared as lines such as `start laser #2`.

use super::*;
use crate::recovery::{Restart, Strategy};

const MINUTE: Duration = Duration::from_secs(60);

struct Rig {
    machine: Supervision,
    now: Instant,
    tickets: u64,
}

fn name(text: &str) -> ObjectName {
    ObjectName::new(text).expect("a good name")
}

fn permanent() -> ChildRules {
    ChildRules::default()
}

fn on_the_spot() -> ChildRules {
    ChildRules { on_the_spot: true, ..ChildRules::default() }
}

fn kept(restart: Restart) -> ChildRules {
    ChildRules { restart, ..ChildRules::default() }
}

impl Rig {
    fn with(strategy: Strategy, intensity: u32, children: &[(&str, ChildRules)]) -> Self {
        let rules = SupervisorRules { strategy, intensity, period: MINUTE, root: false };
        let mut machine = Supervision::new(rules);
        let now = Instant::from_millis(1000);
        for (child, rules) in children {
            machine.add_child(name(child), *rules, now).expect("a free name");
        }
        Rig { machine, now, tickets: 0 }
    }

    /// Three permanent children at work.
    fn serving(strategy: Strategy) -> Self {
        let children = ["a", "b", "c"].map(|child| (child, permanent()));
        let mut rig = Rig::with(strategy, 3, &children);
        rig.begin();
        for child in ["a", "b", "c"] {
            rig.started(child, 1);
        }
        rig
    }

    fn said(&mut self) -> Vec<String> {
        let mut said = Vec::new();
        while let Some(action) = self.machine.poll_output() {
            said.push(match action {
                SupervisorAction::Start { child, incarnation } => {
                    format!("start {child} {incarnation}")
                }
                SupervisorAction::Stop { child, .. } => format!("stop {child}"),
                SupervisorAction::Abandon { child } => format!("abandon {child}"),
                SupervisorAction::Reset { child } => format!("reset {child}"),
                SupervisorAction::Isolate { child, isolated: true } => format!("isolate {child}"),
                SupervisorAction::Isolate { child, isolated: false } => format!("admit {child}"),
                SupervisorAction::StandingOrder { child, order: Some(order) } => {
                    format!("order {child} x{}", order.times)
                }
                SupervisorAction::StandingOrder { child, order: None } => {
                    format!("withdraw {child}")
                }
                SupervisorAction::Recovered { ticket, child, incarnation: Some(life) } => {
                    format!("{} recovered {child} {life}", ticket.0)
                }
                SupervisorAction::Recovered { ticket, child, incarnation: None } => {
                    format!("{} let {child} go", ticket.0)
                }
                SupervisorAction::GaveUp { ticket, child, why } => {
                    format!("{} gave {child} up: {why}", ticket.0)
                }
                SupervisorAction::Overdue { child, .. } => format!("overdue {child}"),
                SupervisorAction::Retire { child } => format!("retire {child}"),
                SupervisorAction::Left { child } => format!("left {child}"),
                SupervisorAction::GiveUp { reason } => format!("give up: {reason}"),
                SupervisorAction::Escalate { reason } => format!("escalate: {reason}"),
                SupervisorAction::AllStarted => "all started".into(),
                SupervisorAction::AllStopped => "all stopped".into(),
            });
        }
        said
    }

    fn ticket(&mut self) -> Ticket {
        self.tickets += 1;
        Ticket(self.tickets)
    }

    fn begin(&mut self) -> Vec<String> {
        self.machine.handle_begin(Incarnation::FIRST, self.now);
        self.said()
    }

    fn end(&mut self) -> Vec<String> {
        self.machine.handle_end(self.now);
        self.said()
    }

    fn restart(&mut self, child: &str, cause: Cause, life: u64) -> Vec<String> {
        let ticket = self.ticket();
        let struck = Some(Incarnation(life));
        self.machine.handle_restart(&name(child), ticket, cause, struck, self.now);
        self.said()
    }

    fn restart_by_hand(&mut self, child: &str) -> Vec<String> {
        let ticket = self.ticket();
        self.machine.handle_restart(&name(child), ticket, Cause::Asked, None, self.now);
        self.said()
    }

    fn reset(&mut self, child: &str) -> Vec<String> {
        let ticket = self.ticket();
        self.machine.handle_reset(&name(child), ticket, self.now);
        self.said()
    }

    fn reset_done(&mut self, child: &str, life: u64, outcome: Result<(), &str>) -> Vec<String> {
        let outcome = outcome.map_err(Into::into);
        self.machine.handle_reset_done(&name(child), Incarnation(life), outcome);
        self.said()
    }

    fn rest(&mut self, child: &str, cause: Cause) -> Vec<String> {
        let ticket = self.ticket();
        self.machine.handle_rest(&name(child), ticket, cause, self.now);
        self.said()
    }

    fn isolate(&mut self, child: &str, isolated: bool) -> Vec<String> {
        let ticket = self.ticket();
        self.machine.handle_isolate(&name(child), isolated, ticket, self.now);
        self.said()
    }

    fn remove(&mut self, child: &str) -> Vec<String> {
        let ticket = self.ticket();
        self.machine.handle_remove(&name(child), ticket, self.now);
        self.said()
    }

    fn started(&mut self, child: &str, life: u64) -> Vec<String> {
        self.machine.handle_started(&name(child), Incarnation(life), self.now);
        self.said()
    }

    fn start_failed(&mut self, child: &str, life: u64) -> Vec<String> {
        let reason = "no device".into();
        self.machine.handle_start_failed(&name(child), Incarnation(life), reason, self.now);
        self.said()
    }

    fn stopped(&mut self, child: &str, life: u64) -> Vec<String> {
        self.machine.handle_stopped(&name(child), Incarnation(life), self.now);
        self.said()
    }

    fn died(&mut self, child: &str, life: u64) -> Vec<String> {
        self.machine.handle_died(&name(child), Incarnation(life), false, None, self.now);
        self.said()
    }

    fn returned(&mut self, child: &str, life: u64) -> Vec<String> {
        self.machine.handle_died(&name(child), Incarnation(life), true, None, self.now);
        self.said()
    }

    fn died_on_the_spot(&mut self, child: &str, life: u64) -> Vec<String> {
        let next = Some(Incarnation(life + 1));
        self.machine.handle_died(&name(child), Incarnation(life), false, next, self.now);
        self.said()
    }

    fn escalated(&mut self, child: &str, life: u64) -> Vec<String> {
        let reason = "too much".into();
        self.machine.handle_escalated(&name(child), Incarnation(life), reason, self.now);
        self.said()
    }

    fn pass(&mut self, seconds: u64) -> Vec<String> {
        self.now = self.now + Duration::from_secs(seconds);
        self.machine.handle_timeout(self.now);
        self.said()
    }

    fn state(&self, child: &str) -> ChildState {
        let child = name(child);
        let status = self.machine.children().find(|status| status.name == child);
        status.expect("a child of this name").state
    }
}

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

    assert_eq!(rig.restart("b", Cause::Died, 1), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["1 recovered b #2"]);

    assert_eq!(rig.restart("b", Cause::Faulty, 2), ["stop b"]);
    assert_eq!(rig.stopped("b", 2), ["start b #3"]);
    assert_eq!(rig.started("b", 3), ["2 recovered b #3"]);

    assert_eq!(rig.restart("b", Cause::Stuck, 3), ["abandon b", "start b #4"]);
    assert_eq!(rig.started("b", 4), ["3 recovered b #4"]);
}

#[test]
fn a_life_that_stood_behind_anothers_hang_costs_no_restart() {
    let mut rig = Rig::with(Strategy::OneForOne, 1, &[("b", ChildRules::default())]);
    rig.begin();
    rig.started("b", 1);

    for life in 1..5 {
        let next = life + 1;
        let replaced = rig.restart("b", Cause::Behind, life);

        assert_eq!(replaced, ["abandon b".into(), format!("start b #{next}")]);
        rig.started("b", next);
    }
}

#[test]
fn independent_children_are_replaced_at_the_same_time() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    assert_eq!(rig.restart("c", Cause::Died, 1), ["start c #2"]);
    assert_eq!(rig.restart("a", Cause::Died, 1), ["start a #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered c #2"]);
    assert_eq!(rig.started("a", 2), ["2 recovered a #2"]);
}

#[test]
fn one_for_all_replaces_all_in_order_and_answers_when_all_are_at_work() {
    let mut rig = Rig::serving(Strategy::OneForAll);

    assert_eq!(rig.restart("b", Cause::Died, 1), ["stop c"]);
    assert_eq!(rig.stopped("c", 1), ["stop a"]);
    assert_eq!(rig.stopped("a", 1), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered b #2"]);
}

#[test]
fn rest_for_one_replaces_the_child_and_those_behind_it() {
    let mut rig = Rig::serving(Strategy::RestForOne);

    assert_eq!(rig.restart("b", Cause::Stuck, 1), ["abandon b", "stop c"]);
    assert_eq!(rig.stopped("c", 1), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered b #2"]);
    assert_eq!(rig.state("a"), ChildState::Running);
}

#[test]
fn a_failure_while_its_group_is_being_stopped_is_neither_lost_nor_doubled() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    rig.restart("b", Cause::Died, 1);

    assert_eq!(rig.restart("a", Cause::Died, 1), [""; 0]);
    assert_eq!(rig.stopped("c", 1), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered b #2", "2 recovered a #2"]);
    assert_eq!(rig.machine.restarts_left(rig.now), 2);
}

#[test]
fn a_child_that_hangs_while_it_should_stop_for_its_group_is_given_up() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    rig.restart("b", Cause::Died, 1);

    assert_eq!(rig.restart("c", Cause::Stuck, 1), ["abandon c", "stop a"]);
    assert_eq!(rig.stopped("c", 1), [""; 0]);
    assert_eq!(rig.stopped("a", 1), ["start a #2"]);
}

#[test]
fn a_failure_while_its_group_is_being_started_begins_the_group_again() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    rig.restart("c", Cause::Died, 1);
    rig.stopped("b", 1);
    rig.stopped("a", 1);
    assert_eq!(rig.started("a", 2), ["start b #2"]);

    assert_eq!(rig.restart("a", Cause::Died, 2), ["stop b"]);
    assert_eq!(rig.started("b", 2), [""; 0]);
    assert_eq!(rig.stopped("b", 2), ["start a #3"]);
    assert_eq!(rig.started("a", 3), ["start b #3"]);
    assert_eq!(rig.started("b", 3), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered c #2", "2 recovered a #3"]);
}

#[test]
fn a_start_that_fails_in_a_group_waits_for_a_decision_and_then_goes_on() {
    let mut rig = Rig::serving(Strategy::OneForAll);
    rig.restart("c", Cause::Died, 1);
    rig.stopped("b", 1);
    rig.stopped("a", 1);
    rig.started("a", 2);

    assert_eq!(rig.start_failed("b", 2), [""; 0]);
    assert_eq!(rig.state("b"), ChildState::Failed);
    assert_eq!(rig.state("c"), ChildState::Waiting);
    assert_eq!(rig.restart("b", Cause::Died, 2), ["stop a"]);
    assert_eq!(rig.stopped("a", 2), ["start a #3"]);
    assert_eq!(rig.started("a", 3), ["start b #3"]);
    assert_eq!(rig.started("b", 3), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["1 recovered c #2", "2 recovered b #3"]);
}

#[test]
fn a_start_that_fails_answers_its_own_request_and_may_be_tried_again() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Cause::Died, 1);

    assert_eq!(rig.start_failed("b", 2), ["1 gave b up: its next life did not start: no device"]);
    assert_eq!(rig.restart("b", Cause::Died, 1), ["start b #3"]);
    assert_eq!(rig.started("b", 3), ["2 recovered b #3"]);
}

#[test]
fn a_first_start_that_fails_holds_the_rest_back_until_it_is_decided() {
    let children = ["a", "b"].map(|child| (child, permanent()));
    let mut rig = Rig::with(Strategy::OneForOne, 3, &children);
    rig.begin();

    assert_eq!(rig.start_failed("a", 1), [""; 0]);
    assert_eq!(rig.restart("a", Cause::Died, 1), ["start a #2"]);
    assert_eq!(rig.start_failed("a", 2), ["1 gave a up: its next life did not start: no device"]);
    assert_eq!(rig.rest("a", Cause::Died), ["isolate a", "start b #1", "2 let a go"]);
    assert_eq!(rig.started("b", 1), ["all started"]);
    assert_eq!(rig.state("a"), ChildState::Resting);
}

#[test]
fn a_start_that_takes_too_long_is_given_up_and_declared() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Cause::Died, 1);
    assert_eq!(rig.machine.poll_timeout(), Some(rig.now + Duration::from_secs(5)));

    assert_eq!(rig.pass(4), [""; 0]);
    assert_eq!(
        rig.pass(1),
        [
            "abandon b",
            "overdue b",
            "1 gave b up: its next life did not start: not at work within 5s"
        ]
    );
    assert_eq!(rig.started("b", 2), [""; 0]);
    assert_eq!(rig.restart("b", Cause::Died, 2), ["start b #3"]);
}

#[test]
fn a_child_that_does_not_stop_in_time_is_given_up() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    assert_eq!(rig.end(), ["stop c"]);

    assert_eq!(rig.pass(5), ["abandon c", "stop b"]);
    assert_eq!(rig.died("b", 1), ["stop a"]);
    assert_eq!(rig.stopped("a", 1), ["all stopped"]);
    assert_eq!(rig.machine.poll_timeout(), None);
}

#[test]
fn a_fault_of_an_earlier_life_is_answered_by_the_present_one() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Cause::Died, 1);

    assert_eq!(rig.restart("b", Cause::Stuck, 1), [""; 0]);
    assert_eq!(rig.started("b", 2), ["1 recovered b #2", "2 recovered b #2"]);
    assert_eq!(rig.restart("b", Cause::Died, 1), ["3 recovered b #2"]);
    assert_eq!(rig.machine.restarts_left(rig.now), 2);
}

#[test]
fn reports_of_an_earlier_life_change_nothing() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Cause::Stuck, 1);

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
fn one_restart_too_many_ends_everything_and_escalates() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    for life in 1..=3 {
        rig.restart("b", Cause::Died, life);
        rig.started("b", life + 1);
    }

    assert_eq!(rig.restart("b", Cause::Died, 4), ["stop c"]);
    assert_eq!(rig.restart("a", Cause::Died, 1), [""; 0]);
    assert_eq!(rig.stopped("c", 1), ["stop a"]);
    assert_eq!(rig.stopped("a", 1), ["escalate: b needed more than 3 restarts in 60s"]);

    // What was asked of the old life is answered by the new one.
    assert_eq!(rig.begin(), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start b #5", "5 recovered a #2"]);
    assert_eq!(rig.started("b", 5), ["start c #2", "4 recovered b #5"]);
}

#[test]
fn the_end_of_the_root_is_the_end_of_hope() {
    let rules = SupervisorRules { root: true, intensity: 0, ..SupervisorRules::default() };
    let mut machine = Supervision::new(rules);
    let now = Instant::from_millis(1);
    machine.add_child(name("a"), permanent(), now).expect("a free name");
    let mut rig = Rig { machine, now, tickets: 0 };
    rig.begin();
    rig.started("a", 1);

    assert_eq!(
        rig.restart("a", Cause::Died, 1),
        [
            "give up: a needed more than 0 restarts in 10s",
            "escalate: a needed more than 0 restarts in 10s",
            "1 gave a up: given up: a needed more than 0 restarts in 10s"
        ]
    );
    assert!(rig.restart("a", Cause::Died, 1)[0].starts_with("2 gave a up"));
}

#[test]
fn old_restarts_are_forgotten() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    for life in 1..=20 {
        assert_eq!(rig.restart("b", Cause::Died, life), [format!("start b #{}", life + 1)]);
        rig.started("b", life + 1);
        rig.pass(21);
    }
}

#[test]
fn a_supervisor_below_that_escalates_is_restarted_without_being_asked() {
    let mut rig = Rig::serving(Strategy::RestForOne);

    assert_eq!(rig.escalated("b", 1), ["stop c"]);
    assert_eq!(rig.stopped("c", 1), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), [""; 0]);
    assert_eq!(rig.machine.restarts_left(rig.now), 2);
}

#[test]
fn a_death_is_noted_and_waits_for_the_recoverer() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    assert_eq!(rig.died("b", 1), [""; 0]);
    assert_eq!(rig.state("b"), ChildState::Failed);
    assert_eq!(rig.restart("b", Cause::Died, 1), ["start b #2"]);
}

#[test]
fn a_transient_child_may_return_and_a_temporary_one_may_also_die() {
    let children =
        [("t", kept(Restart::Transient)), ("u", kept(Restart::Temporary)), ("p", permanent())];
    let mut rig = Rig::with(Strategy::OneForOne, 3, &children);
    rig.begin();
    rig.started("t", 1);
    rig.started("u", 1);
    rig.started("p", 1);

    assert_eq!(rig.returned("t", 1), ["retire t"]);
    assert_eq!(rig.state("t"), ChildState::Finished);
    assert_eq!(rig.restart("t", Cause::Died, 1), ["retire t", "1 let t go"]);
    assert_eq!(rig.restart("u", Cause::Died, 1), ["retire u", "2 let u go"]);
    assert_eq!(rig.state("u"), ChildState::Finished);
    assert_eq!(rig.returned("p", 1), [""; 0]);
    assert_eq!(rig.restart("p", Cause::Died, 1), ["start p #2"]);
    assert_eq!(rig.restart_by_hand("t"), ["start t #2"]);
    assert_eq!(rig.died("t", 2), ["4 gave t up: its next life did not start: it died"]);
    assert_eq!(rig.restart("t", Cause::Died, 2), ["start t #3"]);
}

#[test]
fn a_transient_child_that_could_not_go_on_did_not_end_in_order() {
    let mut rig = Rig::with(Strategy::OneForOne, 3, &[("t", kept(Restart::Transient))]);
    rig.begin();
    rig.started("t", 1);
    rig.died("t", 1);

    assert_eq!(rig.restart("t", Cause::Faulty, 1), ["start t #2"]);
}

#[test]
fn a_temporary_child_that_is_stuck_or_faulty_is_ended_and_let_go() {
    let children = [("u", kept(Restart::Temporary)), ("v", kept(Restart::Temporary))];
    let mut rig = Rig::with(Strategy::OneForAll, 3, &children);
    rig.begin();
    rig.started("u", 1);
    rig.started("v", 1);

    assert_eq!(rig.restart("u", Cause::Stuck, 1), ["abandon u", "retire u", "1 let u go"]);
    assert_eq!(rig.restart("v", Cause::Faulty, 1), ["stop v"]);
    assert_eq!(rig.stopped("v", 1), ["retire v", "2 let v go"]);
}

#[test]
fn a_reset_is_passed_on_and_answered() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    assert_eq!(rig.reset("b"), ["reset b"]);
    assert_eq!(rig.reset("b"), ["2 gave b up: it has no life that could be reset"]);
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
        rig.restart("b", Cause::Died, 1),
        ["5 gave b up: it has no life that could be reset", "start b #2"]
    );
    assert_eq!(rig.reset("x"), ["7 gave x up: no such child"]);
}

#[test]
fn a_standing_order_draws_from_the_budget_and_returns_as_the_window_moves() {
    let children = ["a", "b"].map(|child| (child, on_the_spot()));
    let mut rig = Rig::with(Strategy::OneForOne, 2, &children);
    rig.begin();
    assert_eq!(rig.started("a", 1), ["order a x2", "start b #1"]);
    assert_eq!(rig.started("b", 1), ["order b x2", "all started"]);

    assert_eq!(rig.died_on_the_spot("a", 1), ["order a x2"]);
    assert_eq!(rig.died_on_the_spot("a", 1), [""; 0]);
    rig.pass(30);
    assert_eq!(rig.died_on_the_spot("b", 1), ["withdraw a", "withdraw b"]);
    assert_eq!(rig.pass(30), [""; 0]);
    rig.now = rig.machine.poll_timeout().expect("it waits for the window to move");
    assert_eq!(rig.pass(0), ["order a x1", "order b x2"]);
    assert_eq!(rig.machine.poll_timeout(), None);
}

#[test]
fn restarts_on_the_spot_beyond_the_budget_escalate() {
    let mut rig = Rig::with(Strategy::OneForOne, 1, &[("a", on_the_spot())]);
    rig.begin();
    rig.started("a", 1);

    assert_eq!(rig.died_on_the_spot("a", 1), ["withdraw a"]);
    assert_eq!(rig.died_on_the_spot("a", 2), ["stop a"]);
    assert_eq!(rig.stopped("a", 3), ["escalate: a needed more than 1 restarts in 60s"]);
}

#[test]
fn a_standing_order_is_given_only_where_the_rules_allow_it() {
    let given = |strategy, rules| {
        let mut rig = Rig::with(strategy, 3, &[("a", rules)]);
        rig.begin();
        rig.started("a", 1)
    };

    assert_eq!(given(Strategy::OneForOne, on_the_spot()), ["order a x3", "all started"]);
    assert_eq!(given(Strategy::OneForAll, on_the_spot()), ["all started"]);
    assert_eq!(given(Strategy::RestForOne, on_the_spot()), ["all started"]);
    assert_eq!(given(Strategy::OneForOne, permanent()), ["all started"]);
    let temporary = ChildRules { restart: Restart::Temporary, ..on_the_spot() };
    assert_eq!(given(Strategy::OneForOne, temporary), ["all started"]);
}

#[test]
fn a_standing_order_is_withdrawn_before_a_stop_and_while_isolated() {
    let mut rig = Rig::with(Strategy::OneForOne, 3, &[("a", on_the_spot())]);
    rig.begin();
    rig.started("a", 1);

    assert_eq!(rig.isolate("a", true), ["isolate a", "withdraw a", "1 recovered a #1"]);
    assert_eq!(rig.isolate("a", false), ["admit a", "order a x3", "2 recovered a #1"]);
    assert_eq!(rig.end(), ["withdraw a", "stop a"]);
}

#[test]
fn a_child_in_safe_rest_stays_there_until_a_person_brings_it_back() {
    let mut rig = Rig::serving(Strategy::OneForAll);

    assert_eq!(rig.rest("b", Cause::Faulty), ["isolate b", "stop b"]);
    assert_eq!(rig.stopped("b", 1), ["1 let b go"]);
    assert_eq!(rig.restart("b", Cause::Stuck, 1), ["2 gave b up: it is in safe rest"]);
    assert_eq!(rig.restart("a", Cause::Died, 1), ["stop c"]);
    assert_eq!(rig.stopped("c", 1), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start c #2"]);
    assert_eq!(rig.started("c", 2), ["3 recovered a #2"]);
    assert_eq!(rig.restart_by_hand("b"), ["admit b", "stop c"]);
    assert_eq!(rig.stopped("c", 2), ["stop a"]);
}

#[test]
fn what_a_person_wants_is_counted_by_no_budget_and_needs_a_supervisor_at_work() {
    let mut rig = Rig::with(Strategy::OneForOne, 1, &[("a", permanent())]);
    rig.begin();
    rig.started("a", 1);
    for life in 1..5 {
        assert_eq!(rig.restart_by_hand("a"), ["stop a"]);
        assert_eq!(rig.stopped("a", life), [format!("start a #{}", life + 1)]);
        assert_eq!(rig.started("a", life + 1), [format!("{life} recovered a #{}", life + 1)]);
    }
    assert_eq!(rig.machine.restarts_left(rig.now), 1);

    rig.end();
    rig.stopped("a", 5);
    assert_eq!(rig.restart_by_hand("a"), ["5 gave a up: its supervisor is not at work"]);
}

#[test]
fn a_stuck_child_is_put_to_rest_without_being_asked() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    assert_eq!(rig.rest("b", Cause::Stuck), ["isolate b", "abandon b", "1 let b go"]);
    assert_eq!(rig.state("b"), ChildState::Resting);
    assert_eq!(rig.isolate("x", true), ["2 gave x up: no such child"]);
}

#[test]
fn nobody_waits_for_an_isolated_child_without_a_life() {
    let children = ["a", "b"].map(|child| (child, permanent()));
    let mut rig = Rig::with(Strategy::OneForOne, 3, &children);
    rig.begin();
    rig.start_failed("a", 1);

    assert_eq!(rig.isolate("a", true), ["isolate a", "1 let a go", "start b #1"]);
}

#[test]
fn children_come_and_go_while_it_is_at_work() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    rig.machine.add_child(name("d"), permanent(), rig.now).expect("a free name");
    assert_eq!(rig.said(), ["start d #1"]);
    assert_eq!(rig.started("d", 1), [""; 0]);
    assert_eq!(
        rig.machine.add_child(name("d"), permanent(), rig.now),
        Err(GiveUpReason::NameTaken)
    );
    assert_eq!(rig.remove("b"), ["stop b"]);
    assert_eq!(rig.restart("b", Cause::Died, 1), ["2 gave b up: it is in safe rest"]);
    assert_eq!(rig.stopped("b", 1), ["left b", "1 let b go"]);
    assert_eq!(rig.remove("b"), ["3 gave b up: no such child"]);
    assert_eq!(rig.end(), ["stop d"]);
    assert_eq!(rig.stopped("d", 1), ["stop c"]);
}

#[test]
fn nothing_is_restarted_while_it_is_not_at_work() {
    let mut rig = Rig::with(Strategy::OneForOne, 3, &[("a", permanent())]);

    assert_eq!(rig.restart("a", Cause::Died, 0), ["1 gave a up: its supervisor is not at work"]);
    rig.begin();
    rig.started("a", 1);
    assert_eq!(rig.end(), ["stop a"]);
    assert_eq!(rig.restart("a", Cause::Died, 1), ["2 gave a up: its supervisor is not at work"]);
    assert_eq!(rig.stopped("a", 1), ["all stopped"]);
    assert_eq!(rig.remove("a"), ["left a", "3 let a go"]);
}

#[test]
fn being_forsaken_gives_every_life_up_and_a_new_beginning_starts_all() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Cause::Faulty, 1);
    rig.remove("c");

    rig.machine.handle_forsake(rig.now);
    assert_eq!(rig.said(), ["abandon c", "left c", "abandon b", "abandon a", "2 let c go"]);

    assert_eq!(rig.begin(), ["start a #2"]);
    assert_eq!(rig.started("a", 2), ["start b #2"]);
    assert_eq!(rig.started("b", 2), ["all started", "1 recovered b #2"]);
}

#[test]
fn a_second_beginning_without_an_end_leaves_no_life_twice() {
    let mut rig = Rig::serving(Strategy::OneForOne);

    assert_eq!(rig.begin(), ["abandon c", "abandon b", "abandon a", "start a #2"]);
}

#[test]
fn after_a_restart_of_its_own_children_at_work_stay_and_the_others_start_again() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.restart("b", Cause::Faulty, 1);
    rig.restart("c", Cause::Died, 1);

    rig.machine.handle_own_restart(rig.now);

    assert_eq!(rig.said(), ["abandon b", "abandon c", "start b #2"]);
    assert_eq!(rig.started("b", 2), ["start c #3"]);
    assert_eq!(rig.state("a"), ChildState::Running);
}

#[test]
fn isolating_all_reaches_every_child_once() {
    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.isolate("b", true);

    rig.machine.handle_isolate_all(true, rig.now);
    assert_eq!(rig.said(), ["isolate a", "isolate c"]);
    rig.machine.handle_isolate_all(false, rig.now);
    assert_eq!(rig.said(), ["admit a", "admit b", "admit c"]);
}

/// Puts child `b` of three into each state, throws each input at it, lets everything be answered, and
/// finds either a supervisor at work with all that it wants, or one that ended as it was told.
#[test]
fn every_state_takes_every_input_and_comes_to_an_end() {
    type Act = (&'static str, fn(&mut Rig));
    let states: [Act; 10] = [
        ("running", |_| {}),
        ("starting", |rig| drop(rig.restart("b", Cause::Died, 1))),
        ("stopping", |rig| drop(rig.restart("b", Cause::Faulty, 1))),
        ("resetting", |rig| drop(rig.reset("b"))),
        ("failed", |rig| drop(rig.died("b", 1))),
        ("resting", |rig| drop(rig.rest("b", Cause::Died))),
        ("leaving", |rig| drop(rig.remove("b"))),
        ("isolated", |rig| drop(rig.isolate("b", true))),
        ("ending", |rig| drop(rig.end())),
        ("forsaken", |rig| rig.machine.handle_forsake(rig.now)),
    ];
    let inputs: [Act; 22] = [
        ("nothing", |_| {}),
        ("restart, died", |rig| drop(rig.restart("b", Cause::Died, 1))),
        ("restart, stuck", |rig| drop(rig.restart("b", Cause::Stuck, 1))),
        ("restart, behind another", |rig| drop(rig.restart("b", Cause::Behind, 1))),
        ("restart, faulty", |rig| drop(rig.restart("b", Cause::Faulty, 1))),
        ("restart, next life", |rig| drop(rig.restart("b", Cause::Stuck, 2))),
        ("restart by hand", |rig| drop(rig.restart_by_hand("b"))),
        ("restart of a", |rig| drop(rig.restart("a", Cause::Stuck, 1))),
        ("reset", |rig| drop(rig.reset("b"))),
        ("rest", |rig| drop(rig.rest("b", Cause::Faulty))),
        ("rest, stuck", |rig| drop(rig.rest("b", Cause::Stuck))),
        ("isolate", |rig| drop(rig.isolate("b", true))),
        ("remove", |rig| drop(rig.remove("b"))),
        ("started", |rig| drop(rig.started("b", 2))),
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
        rig.said();
        let table: Vec<ChildStatus> = rig.machine.children().collect();
        let open = table.iter().find(|child| {
            !matches!(child.state, ChildState::Running | ChildState::Resting | ChildState::Finished)
        });
        let Some(child) = open else { break };
        let (name, life) = (child.name.as_str(), child.incarnation.0);
        match child.state {
            ChildState::Starting => drop(rig.started(name, life)),
            ChildState::Stopping => drop(rig.stopped(name, life)),
            ChildState::Resetting => drop(rig.reset_done(name, life, Ok(()))),
            ChildState::Failed => drop(rig.restart(name, Cause::Died, life)),
            // Either somebody else must move first, or the supervisor does not want to.
            _ if !rig.machine.at_work() => break,
            _ => {
                let moving = table.iter().find(|child| {
                    matches!(child.state, ChildState::Starting | ChildState::Stopping)
                });
                let child = moving.unwrap_or_else(|| panic!("{case}: {name} waits for nobody"));
                let (name, life) = (child.name.as_str(), child.incarnation.0);
                match child.state {
                    ChildState::Starting => drop(rig.started(name, life)),
                    _ => drop(rig.stopped(name, life)),
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
    assert!(rig.machine.poll_timeout().is_none(), "{case}: {:?}", rig.machine);
}

#[test]
fn who_is_at_work_does_not_wait_for_a_sibling_that_failed_in_turn() {
    let cases = [(Strategy::OneForAll, "stop a"), (Strategy::RestForOne, "start b #3")];
    for (strategy, next) in cases {
        let mut rig = Rig::serving(strategy);
        rig.restart("a", Cause::Died, 1);
        rig.stopped("c", 1);
        rig.stopped("b", 1);
        assert_eq!(rig.started("a", 2), ["start b #2"]);

        // What is done about b may wait for what is answered about a.
        assert_eq!(rig.start_failed("b", 2), ["1 recovered a #2"]);

        assert_eq!(rig.restart("b", Cause::Died, 2), [next]);
    }
}

#[test]
fn a_child_is_told_whether_another_life_follows() {
    let told = |rig: &mut Rig| {
        let mut told = Vec::new();
        while let Some(action) = rig.machine.poll_output() {
            if let SupervisorAction::Stop { child, again } = action {
                told.push((child.to_string(), again));
            }
        }
        told
    };
    let mut rig = Rig::serving(Strategy::OneForAll);
    let (now, tickets) = (rig.now, [Ticket(1), Ticket(2)]);

    rig.machine.handle_restart(&name("a"), tickets[0], Cause::Died, None, now);
    assert_eq!(told(&mut rig), [("c".into(), true)]);

    let mut rig = Rig::serving(Strategy::OneForOne);
    rig.machine.handle_rest(&name("b"), tickets[1], Cause::Faulty, now);
    assert_eq!(told(&mut rig), [("b".into(), false)]);
    rig.machine.handle_end(now);
    rig.machine.handle_stopped(&name("b"), Incarnation::FIRST, now);
    assert_eq!(told(&mut rig), [("c".into(), false)]);
}
