use super::*;
use crate::testing::at;

const SPAN: Duration = Duration::from_millis(100);

fn who(name: &str, incarnation: u64) -> CommanderId {
    CommanderId { name: name.into(), incarnation: Incarnation(incarnation) }
}

fn held() -> (Lease, u64) {
    held_by_planner(StopBy::SafeCommand)
}

fn held_by_planner(stop_by: StopBy) -> (Lease, u64) {
    held_under(LeaseRules { span: SPAN, command_timeout: None, max_wait: SPAN, stop_by })
}

fn held_under(rules: LeaseRules) -> (Lease, u64) {
    let mut lease = Lease::new(ObjectName::new("wheel").unwrap(), rules, 7);
    lease.handle_at_work();
    let grant = lease.handle_claim(who("planner", 1), at(0)).unwrap();
    assert_eq!(grant, LeaseGrant { epoch: 8, span: SPAN });
    (lease, grant.epoch)
}

fn ended() -> Result<(), DeliveryError> {
    Err(DeliveryError::LeaseEnded { actuator: "wheel".into() })
}

fn held_by(commander: &str) -> Result<LeaseGrant, DeliveryError> {
    Err(DeliveryError::Held { actuator: "wheel".into(), by: commander.into() })
}

/// What is given next, after the cut-off where that is called as well.
fn applied(lease: &mut Lease) -> Option<(RestCause, bool)> {
    match lease.poll_output()? {
        LeaseOutput::Apply { cause, again, .. } => Some((cause, again)),
        LeaseOutput::CutOff { .. } | LeaseOutput::CheckTaken { .. } => applied(lease),
    }
}

/// What is to be done, in order.
fn outputs(lease: &mut Lease) -> Vec<&'static str> {
    let name = |output| match output {
        LeaseOutput::CutOff { .. } => "cut-off",
        LeaseOutput::CheckTaken { is_late: false } => "check",
        LeaseOutput::CheckTaken { is_late: true } => "late",
        LeaseOutput::Apply { cause: RestCause::Stopped, .. } => "stop",
        LeaseOutput::Apply { cause: RestCause::Rung(_), .. } => "rung",
        LeaseOutput::Apply { .. } => "safe",
    };
    std::iter::from_fn(|| lease.poll_output()).map(name).collect()
}

#[test]
fn every_state_is_shown() {
    let (mut lease, epoch) = held();
    let commander = who("planner", 1);
    let (now, left) = (at(40), SPAN - Duration::from_millis(40));
    let held = LeaseStatus::Held { commander: commander.clone(), epoch, left };
    assert_eq!(lease.status(now), held);
    lease.handle_timeout(at(100));
    assert_eq!(lease.status(at(100)), LeaseStatus::Settling { commander });
    lease.handle_applied(RestCause::Expired, true);
    lease.handle_cut_off_returned();
    assert_eq!(lease.status(at(102)), LeaseStatus::Free);
}

#[test]
fn safe_outputs_are_applied_when_the_lease_is_over_and_not_before() {
    let (mut lease, epoch) = held();
    lease.handle_renewal(epoch, at(60)).unwrap();

    lease.handle_timeout(at(159));
    assert_eq!(applied(&mut lease), None);
    assert_eq!(lease.poll_timeout(), Some(at(160)));
    lease.handle_timeout(at(160));

    assert_eq!(applied(&mut lease), Some((RestCause::Expired, false)));
    assert_eq!(lease.handle_renewal(epoch, at(161)), ended());
}

#[test]
fn a_late_command_ends_the_lease_itself_where_the_timer_was_later_still() {
    let (mut lease, epoch) = held();
    assert_eq!(lease.handle_renewal(epoch, at(100)), ended());
    assert_eq!(applied(&mut lease), Some((RestCause::Expired, false)));
}

#[test]
fn a_second_commander_is_refused_while_the_lease_holds_and_until_all_is_safe() {
    let (mut lease, epoch) = held();
    let held = held_by("planner#1");
    assert_eq!(lease.handle_claim(who("console", 1), at(99)), held);

    let settling = lease.handle_claim(who("console", 1), at(100));
    assert_eq!(settling, Err(DeliveryError::Restarting));
    assert_eq!(applied(&mut lease), Some((RestCause::Expired, false)));
    lease.handle_applied(RestCause::Expired, true);
    lease.handle_cut_off_returned();
    let grant = lease.handle_claim(who("console", 1), at(102)).unwrap();

    assert!(grant.epoch > epoch);
    assert_eq!(
        lease.handle_renewal(epoch, at(103)),
        Err(DeliveryError::Superseded { epoch: grant.epoch })
    );
    lease.handle_release(epoch);
    assert_eq!(lease.handle_renewal(grant.epoch, at(104)), Ok(()), "it is not the holder's");
}

#[test]
fn no_commander_is_granted_the_lease_before_the_cut_off_has_returned() {
    let (mut lease, epoch) = held();
    lease.handle_release(epoch);
    let claim = |lease: &mut Lease| lease.handle_claim(who("console", 1), at(12));

    lease.handle_applied(RestCause::Released, true);
    assert_eq!(claim(&mut lease), Err(DeliveryError::Restarting));
    lease.handle_cut_off_returned();
    let epoch = claim(&mut lease).unwrap().epoch;

    lease.handle_release(epoch);
    lease.handle_cut_off_returned();
    assert_eq!(claim(&mut lease), Err(DeliveryError::Restarting));
    lease.handle_applied(RestCause::Released, true);
    assert!(claim(&mut lease).is_ok());
}

#[test]
fn the_next_incarnation_of_a_commander_takes_over_and_fences_the_one_before() {
    let (mut lease, old) = held();
    let grant = lease.handle_claim(who("planner", 2), at(10)).unwrap();
    assert_eq!(
        lease.handle_renewal(old, at(11)),
        Err(DeliveryError::Superseded { epoch: grant.epoch })
    );
    let late = lease.handle_claim(who("planner", 1), at(12));
    assert_eq!(late, held_by("planner#2"));
    assert_eq!(applied(&mut lease), None);
}

#[test]
fn a_safe_command_that_did_not_get_through_is_given_whenever_the_component_is_at_work_again() {
    let (mut lease, epoch) = held();
    lease.handle_release(epoch);
    assert_eq!(applied(&mut lease), Some((RestCause::Released, false)));
    for _ in 1..100 {
        lease.handle_applied(RestCause::Released, false);
        assert_eq!(applied(&mut lease), None);
        lease.handle_at_work();
        assert_eq!(applied(&mut lease), Some((RestCause::Released, true)));
    }
    lease.handle_applied(RestCause::Released, true);
    lease.handle_at_work();
    assert_eq!(applied(&mut lease), None);
}

#[test]
fn a_component_that_leaves_work_stops_what_moves_and_nothing_else() {
    let (mut lease, epoch) = held();
    lease.handle_leaving();
    assert_eq!((outputs(&mut lease), lease.is_stopping()), (vec![], false));
    assert_eq!(lease.handle_renewal(epoch, at(1)), ended());
    let refused = lease.handle_claim(who("planner", 1), at(1));
    assert_eq!(refused, Err(DeliveryError::Restarting));
    lease.handle_left(true);
    lease.handle_at_work();

    lease.handle_claim(who("planner", 1), at(2)).unwrap();
    lease.handle_command(at(1));
    lease.handle_leaving();
    lease.handle_leaving();
    assert_eq!((outputs(&mut lease), lease.is_stopping()), (vec!["stop"], true));
    lease.handle_applied(RestCause::Stopped, true);
    assert_eq!(lease.status(at(3)), LeaseStatus::Free);
    assert!(lease.is_stopping(), "its work goes on until it has settled");
    lease.handle_settled();
    lease.handle_left(false);

    assert_eq!(outputs(&mut lease), [""; 0], "it was stopped, whatever became of the hook");
    assert!(lease.handle_claim(who("planner", 1), at(4)).is_err(), "it is not at work");
}

#[test]
fn the_cut_off_is_called_once_where_the_stop_command_fails_or_comes_too_late() {
    type Step = fn(&mut Lease);
    let refused: Step = |lease| lease.handle_applied(RestCause::Stopped, false);
    let too_late: Step = |lease| lease.handle_left(false);
    let fails: Step = |lease| {
        lease.handle_applied(RestCause::Stopped, true);
        lease.handle_left(false);
    };
    let never_begun: Step = |lease| {
        lease.handle_settled();
        lease.handle_left(true);
    };
    for step in [refused, too_late, fails, never_begun] {
        let (mut lease, _) = held();
        lease.handle_command(at(1));
        lease.handle_leaving();
        assert_eq!(outputs(&mut lease), ["stop"]);
        step(&mut lease);
        assert_eq!(outputs(&mut lease), ["cut-off"]);
        too_late(&mut lease);
        refused(&mut lease);
        assert_eq!(outputs(&mut lease), [""; 0]);
        lease.handle_at_work();
        assert!(lease.handle_claim(who("planner", 1), at(3)).is_err(), "it is being cut off");
        lease.handle_cut_off_returned();
        assert!(lease.handle_claim(who("planner", 1), at(3)).is_ok());
    }
}

#[test]
fn a_hook_that_stops_the_actuator_is_waited_for_and_cut_off_where_it_fails() {
    for (hook_done, then) in [(true, vec![]), (false, vec!["cut-off"])] {
        let (mut lease, _) = held_by_planner(StopBy::Hook);
        lease.handle_command(at(1));
        lease.handle_leaving();
        outputs(&mut lease);
        lease.handle_left(hook_done);
        assert_eq!(outputs(&mut lease), then);
    }
}

#[test]
fn a_stop_command_of_its_own_follows_the_safe_command_too() {
    let (mut lease, epoch) = held_by_planner(StopBy::StopCommand);
    lease.handle_command(at(1));
    lease.handle_release(epoch);
    assert_eq!(outputs(&mut lease), ["cut-off", "safe"]);

    lease.handle_leaving();
    assert_eq!(outputs(&mut lease), ["stop"], "before the safe command was carried out");
    let settling = LeaseStatus::Settling { commander: who("planner", 1) };
    lease.handle_applied(RestCause::Released, true);
    assert_eq!(lease.status(at(1)), settling, "that one was replaced");
    lease.handle_applied(RestCause::Stopped, true);
    lease.handle_cut_off_returned();
    assert_eq!(lease.status(at(2)), LeaseStatus::Free);
}

/// Commanded at 10 ms and renewed since, under a command timeout of 40 ms.
fn overdue() -> (Lease, u64) {
    let command_timeout = Some(Duration::from_millis(40));
    let (stop_by, max_wait) = (StopBy::SafeCommand, Duration::from_millis(40));
    let rules = LeaseRules { span: SPAN, command_timeout, max_wait, stop_by };
    let (mut lease, epoch) = held_under(rules);
    lease.handle_command(at(10));
    lease.handle_renewal(epoch, at(49)).unwrap();
    lease.handle_timeout(at(49));
    assert_eq!((outputs(&mut lease), lease.poll_timeout()), (vec![], Some(at(50))));
    lease.handle_timeout(at(50));
    assert_eq!(outputs(&mut lease), ["safe"]);
    (lease, epoch)
}

#[test]
fn a_command_counts_for_its_timeout_and_the_safe_command_is_given_once_within_the_lease() {
    let (mut lease, epoch) = overdue();
    lease.handle_applied(RestCause::CommandTimeout, true);
    for now in 52..200 {
        lease.handle_renewal(epoch, at(now)).unwrap();
        lease.handle_timeout(at(now));
    }
    lease.handle_left(false);
    assert_eq!(outputs(&mut lease), [""; 0]);

    lease.handle_command(at(200));
    lease.handle_command(at(220));
    lease.handle_renewal(epoch, at(260)).unwrap();
    assert_eq!(outputs(&mut lease), [""; 0], "a command that came now would count");
    lease.handle_timeout(at(260));
    assert_eq!(outputs(&mut lease), ["safe"]);
}

#[test]
fn a_safe_command_that_the_component_does_not_begin_or_end_is_followed_by_the_cut_off_once() {
    type Step = fn(&mut Lease);
    let not_begun: Step = |lease| lease.handle_check(false);
    let dies: Step = |lease| lease.handle_applied(RestCause::CommandTimeout, false);
    let fails: Step = |lease| lease.handle_left(false);
    let fails_after_its_reply: Step = |lease| {
        lease.handle_applied(RestCause::CommandTimeout, true);
        lease.handle_left(false);
    };
    for step in [not_begun, dies, fails, fails_after_its_reply] {
        let (mut lease, epoch) = overdue();
        lease.handle_timeout(at(59));
        assert_eq!(outputs(&mut lease), [""; 0]);
        for now in [60, 70] {
            lease.handle_timeout(at(now));
            assert_eq!(outputs(&mut lease), ["check"]);
            lease.handle_check(true);
        }
        step(&mut lease);
        assert_eq!(outputs(&mut lease), ["cut-off"]);
        [not_begun, dies, fails].iter().for_each(|step| step(&mut lease));
        lease.handle_timeout(at(90));
        lease.handle_ended();
        assert_eq!(outputs(&mut lease), [""; 0]);

        lease.handle_command(at(91));
        lease.handle_applied(RestCause::CommandTimeout, true);
        lease.handle_renewal(epoch, at(131)).unwrap();
        lease.handle_timeout(at(131));
        assert_eq!(outputs(&mut lease), ["safe"], "the command of 91 counted to 131");
    }
}

#[test]
fn a_commander_that_sends_on_does_not_have_it_cut_off_again_before_the_component_takes_any() {
    let (mut lease, epoch) = overdue();
    lease.handle_check(false);
    assert_eq!(outputs(&mut lease), ["cut-off"]);
    for now in [60, 110, 160] {
        lease.handle_command(at(now));
        lease.handle_renewal(epoch, at(now + 40)).unwrap();
        lease.handle_timeout(at(now + 40));
        lease.handle_check(false);
        assert_eq!(outputs(&mut lease), ["safe"]);
    }

    lease.handle_applied(RestCause::CommandTimeout, true);
    lease.handle_command(at(201));
    lease.handle_renewal(epoch, at(241)).unwrap();
    lease.handle_timeout(at(241));
    lease.handle_check(false);
    assert_eq!(outputs(&mut lease), ["safe", "cut-off"]);
}

#[test]
fn a_component_that_could_begin_its_safe_command_and_does_not_is_late_after_max_wait() {
    let (mut lease, epoch) = overdue();
    for (now, then) in [(60, "check"), (89, "check"), (99, "late")] {
        lease.handle_renewal(epoch, at(now)).unwrap();
        lease.handle_timeout(at(now));
        assert_eq!(outputs(&mut lease), [then]);
        lease.handle_check(true);
    }
}

#[test]
fn what_is_commanded_ends_with_its_incarnation_and_is_cut_off_where_none_follows_at_once() {
    for (follows, then) in [(true, vec![]), (false, vec!["cut-off"])] {
        let (mut lease, epoch) = held();
        lease.handle_left(false);
        lease.handle_ended();
        lease.handle_at_work();
        assert_eq!(outputs(&mut lease), [""; 0], "it has not moved");

        lease.handle_command(at(1));
        lease.handle_left(false);
        if !follows {
            lease.handle_ended();
            lease.handle_ended();
        }
        assert_eq!(outputs(&mut lease), then);
        lease.handle_at_work();
        assert_eq!(outputs(&mut lease), ["safe"]);
        lease.handle_applied(RestCause::CommandTimeout, true);
        lease.handle_renewal(epoch, at(2)).unwrap();
        lease.handle_ended();
        assert_eq!(outputs(&mut lease), [""; 0], "it is at rest");

        lease.handle_command(at(3));
        lease.handle_left(false);
        lease.handle_command(at(4));
        lease.handle_at_work();
        assert_eq!(outputs(&mut lease), [""; 0], "a command that came since counts");
    }
}

#[test]
fn a_safe_command_that_is_refused_cuts_off_and_is_given_when_the_component_is_at_work_again() {
    let (mut lease, _) = overdue();
    lease.handle_applied(RestCause::CommandTimeout, false);
    assert_eq!(outputs(&mut lease), ["cut-off"]);
    lease.handle_at_work();
    assert_eq!(outputs(&mut lease), ["safe"]);
}

/// A policy takes the lease of a commander at 10 ms.
fn taken(command_timeout: Option<Duration>) -> Lease {
    let (stop_by, max_wait) = (StopBy::SafeCommand, Duration::from_millis(40));
    let (mut lease, _) = held_under(LeaseRules { span: SPAN, command_timeout, max_wait, stop_by });
    lease.handle_command(at(1));
    lease.handle_rung(who("policy", 1), None, at(10));
    assert_eq!(outputs(&mut lease), ["rung"]);
    lease
}

#[test]
fn a_policy_holds_the_lease_over_all_its_rungs_and_no_change_cuts_the_actuator_off() {
    let mut lease = taken(None);
    assert_eq!(lease.handle_claim(who("console", 1), at(11)), held_by("policy#1"));
    lease.handle_applied(RestCause::Rung(1), true);

    let homing = Some("homing".to_owned());
    lease.handle_rung(who("policy", 1), homing, at(15));
    assert_eq!(lease.handle_claim(who("console", 1), at(16)), held_by("policy#1"));
    let homing = lease.handle_claim(who("homing", 1), at(20)).unwrap();
    lease.handle_command(at(21));
    lease.handle_release(homing.epoch);
    assert_eq!(outputs(&mut lease), ["rung"], "the policy has it back");
    lease.handle_timeout(at(22));
    assert!(lease.handle_claim(who("homing", 2), at(23)).is_err(), "it is being served");
    lease.handle_applied(RestCause::Rung(1), true);
    lease.handle_claim(who("homing", 2), at(30)).unwrap();
    lease.handle_command(at(31));
    lease.handle_rung(who("policy", 1), None, at(40));
    lease.handle_applied(RestCause::Rung(1), true);
    assert_eq!(lease.handle_claim(who("homing", 3), at(41)), held_by("policy#1"));
    lease.handle_applied(RestCause::Rung(2), true);
    lease.handle_timeout(at(9_000));
    assert_eq!((outputs(&mut lease), lease.commander()), (vec!["rung"], None));

    lease.handle_rungs_over(at(9_100));
    assert_eq!(outputs(&mut lease), ["safe"]);
    lease.handle_applied(RestCause::Released, true);
    lease.handle_timeout(at(99_000));
    assert!(lease.handle_claim(who("console", 1), at(99_000)).is_ok());
    assert_eq!(outputs(&mut lease), [""; 0]);
}

#[test]
fn a_rung_waits_for_a_component_that_was_never_at_work_and_does_not_cut_it_off() {
    let (stop_by, command_timeout) = (StopBy::SafeCommand, Some(SPAN));
    let rules = LeaseRules { span: SPAN, command_timeout, max_wait: SPAN, stop_by };
    let mut lease = Lease::new(ObjectName::new("wheel").unwrap(), rules, 7);
    lease.handle_rung(who("policy", 1), None, at(0));
    for now in 0..100 {
        lease.handle_timeout(at(100 * now));
    }
    lease.handle_ended();
    assert_eq!(outputs(&mut lease), [""; 0]);
    lease.handle_at_work();
    assert_eq!(outputs(&mut lease), ["rung"]);
    lease.handle_timeout(at(10_000));
    lease.handle_timeout(at(12_000));
    assert_eq!(outputs(&mut lease), ["cut-off"], "it does not take it");
}

#[test]
fn a_lease_that_a_policy_ends_or_that_is_over_before_its_rungs_is_cut_off_only_if_need_be() {
    let expires: fn(&mut Lease) = |lease| {
        lease.handle_policy();
        lease.handle_timeout(at(100));
    };
    let suspended: fn(&mut Lease) = |lease| lease.handle_suspended(|_| true, at(100));
    for end in [expires, suspended] {
        let (mut lease, _) = held();
        end(&mut lease);
        // A handler that is busy meanwhile is not looked at before it is late.
        assert_eq!((outputs(&mut lease), lease.poll_timeout()), (vec!["safe"], Some(at(200))));
        lease.handle_applied(RestCause::Expired, true);
        lease.handle_applied(RestCause::Released, true);
        lease.handle_timeout(at(200));
        assert_eq!((outputs(&mut lease), lease.status(at(200))), (vec![], LeaseStatus::Free));

        for fails in [true, false] {
            let (mut lease, _) = held();
            end(&mut lease);
            lease.handle_timeout(at(199));
            lease.handle_timeout(at(200));
            assert_eq!(outputs(&mut lease), ["safe", "late"]);
            match fails {
                true => lease.handle_left(false),
                false => lease.handle_check(false),
            }
            assert_eq!(outputs(&mut lease), ["cut-off"]);
        }
    }
}

#[test]
fn a_rungs_command_is_given_until_it_is_carried_out_and_again_in_each_third_of_its_timeout() {
    let mut lease = taken(Some(Duration::from_millis(300)));
    lease.handle_timeout(at(110));
    lease.handle_applied(RestCause::Rung(1), false);
    lease.handle_timeout(at(210));
    assert_eq!(outputs(&mut lease), [""; 0]);
    lease.handle_at_work();
    for now in [310, 410] {
        assert_eq!(outputs(&mut lease), ["rung"]);
        lease.handle_timeout(at(now));
        assert_eq!(outputs(&mut lease), [""; 0], "it is being served");
        lease.handle_applied(RestCause::Rung(1), true);
        lease.handle_timeout(at(now + 99));
        lease.handle_timeout(at(now + 100));
    }
    assert_eq!(outputs(&mut lease), ["rung"]);
    lease.handle_applied(RestCause::Rung(1), true);
    lease.handle_leaving();
    assert_eq!(outputs(&mut lease), ["stop"]);
    lease.handle_applied(RestCause::Stopped, true);
    lease.handle_settled();
    lease.handle_timeout(at(5_000));
    assert_eq!(outputs(&mut lease), [""; 0], "it was stopped in order");
    lease.handle_at_work();
    assert_eq!(outputs(&mut lease), ["rung"]);
}

#[test]
fn an_actuator_whose_rung_fails_is_late_or_is_never_finished_is_cut_off_once() {
    type Step = fn(&mut Lease);
    let never_begun: Step = |_| {};
    let fails: Step = |lease| lease.handle_applied(RestCause::Rung(1), false);
    let dies: Step = |lease| lease.handle_left(false);
    let ends: Step = |lease| lease.handle_rungs_over(at(10));
    let dies_later: Step = |lease| {
        lease.handle_applied(RestCause::Rung(1), true);
        lease.handle_left(false);
        lease.handle_timeout(at(10));
    };
    for step in [never_begun, fails, dies, ends, dies_later] {
        let mut lease = taken(None);
        step(&mut lease);
        lease.handle_timeout(at(1009));
        assert!(!outputs(&mut lease).contains(&"cut-off"));
        lease.handle_timeout(at(1010));
        assert_eq!(outputs(&mut lease), ["cut-off"]);
        lease.handle_timeout(at(9_000));
        assert!(!outputs(&mut lease).contains(&"cut-off"));
    }
}

#[test]
fn a_node_in_the_safe_state_ends_the_hold_of_a_policy() {
    let mut lease = taken(None);
    lease.handle_rest();
    assert_eq!(outputs(&mut lease), ["cut-off", "safe"]);
    lease.handle_applied(RestCause::Released, true);
    lease.handle_cut_off_returned();
    assert_eq!((lease.status(at(20)), outputs(&mut lease)), (LeaseStatus::Free, vec![]));
}

#[test]
fn a_lease_that_ends_while_the_safe_command_is_carried_out_ends_as_any() {
    let (mut lease, epoch) = overdue();
    lease.handle_release(epoch);
    assert_eq!(outputs(&mut lease), ["cut-off", "safe"]);
    lease.handle_applied(RestCause::CommandTimeout, true);
    lease.handle_cut_off_returned();
    assert!(lease.handle_claim(who("console", 1), at(53)).is_err(), "its own is awaited");
    lease.handle_applied(RestCause::Released, true);
    assert!(lease.handle_claim(who("console", 1), at(55)).is_ok());
}

#[test]
fn an_owed_command_is_not_forgiven_by_what_comes_after_it() {
    // The next rung has no limit of its own while the one before is owed.
    let mut lease = taken(None);
    lease.handle_rung(who("policy", 1), None, at(900));
    lease.handle_timeout(at(1010));
    assert!(outputs(&mut lease).contains(&"cut-off"));

    // A lease that ends in order, with the safe command of a command timeout owed.
    let hold = Duration::from_secs(10);
    let rules = |command_timeout, max_wait| LeaseRules {
        span: SPAN,
        command_timeout,
        max_wait,
        stop_by: StopBy::SafeCommand,
    };
    let (mut lease, _) = held_under(rules(None, hold));
    lease.handle_suspended(|_| true, at(50));
    lease.handle_timeout(at(1050));
    assert_eq!(outputs(&mut lease), ["safe", "late"], "its max_wait is for commands that hold");
    let (mut lease, _) = held_under(rules(Some(Duration::from_millis(20)), 3 * SPAN));
    lease.handle_command(at(0));
    lease.handle_timeout(at(20));
    lease.handle_suspended(|_| true, at(90));
    assert_eq!(outputs(&mut lease), ["safe", "safe"]);
    lease.handle_timeout(at(320));
    assert_eq!(outputs(&mut lease), ["late"]);

    // The safe state waits for no safe command.
    let (mut lease, _) = held();
    lease.handle_suspended(|_| true, at(50));
    lease.handle_rest();
    assert_eq!(outputs(&mut lease), ["safe", "cut-off", "safe"]);
}
