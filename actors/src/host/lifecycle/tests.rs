//! Which hook comes next, whatever was ordered and however the last one ended.

use super::*;
use Lifecycle::{Active, Created, Error, Fatal, Finalized, Initialized};

fn failed(reason: &str) -> Result<(), Failure> {
    Err(reason.into())
}

/// What is to be done next, once the actuators are at rest where that is waited for.
fn next(lifecycle: &mut IncarnationLifecycle) -> LifecycleStep {
    match lifecycle.next() {
        LifecycleStep::Settle => {
            lifecycle.handle_settled();
            lifecycle.next()
        }
        step => step,
    }
}

/// Runs all hooks that are due; each succeeds.
fn run(lifecycle: &mut IncarnationLifecycle) -> Vec<Hook> {
    let mut ran = Vec::new();
    while let LifecycleStep::Run(hook) = next(lifecycle) {
        ran.push(hook);
        lifecycle.handle_done(hook, Ok(()));
    }
    ran
}

/// An incarnation that has come as far as `state`, its reports told.
fn incarnation(state: Lifecycle) -> IncarnationLifecycle {
    let mut lifecycle = IncarnationLifecycle::new();
    match state {
        Created => {}
        Initialized => {
            run(&mut lifecycle);
            lifecycle.handle_activate(false);
            run(&mut lifecycle);
        }
        Active => {
            run(&mut lifecycle);
        }
        Error => {
            run(&mut lifecycle);
            lifecycle.handle_failure("broken".into());
            run(&mut lifecycle);
        }
        Fatal => {
            run(&mut lifecycle);
            lifecycle.handle_failure(Failure::fatal("broken"));
        }
        Finalized => {
            run(&mut lifecycle);
            lifecycle.handle_stop(StopOrder::Stop);
            run(&mut lifecycle);
        }
    }
    reports(&mut lifecycle);
    assert_eq!(lifecycle.state, state);
    lifecycle
}

/// All that is to be told.
fn reports(lifecycle: &mut IncarnationLifecycle) -> Vec<LifecycleReport> {
    std::iter::from_fn(|| lifecycle.poll_report()).collect()
}

fn states(reports: &[LifecycleReport]) -> Vec<Lifecycle> {
    let state = |reports: &LifecycleReport| match reports {
        LifecycleReport::State(state, _) => Some(*state),
        LifecycleReport::Child(_) | LifecycleReport::Unavailable { .. } => None,
    };
    reports.iter().filter_map(state).collect()
}

fn answers(reports: Vec<LifecycleReport>) -> Vec<ChildEvent> {
    let answer = |reports| match reports {
        LifecycleReport::Child(event) => Some(event),
        LifecycleReport::State(..) | LifecycleReport::Unavailable { .. } => None,
    };
    reports.into_iter().filter_map(answer).collect()
}

#[test]
fn an_incarnation_is_initialised_started_and_activated() {
    let mut lifecycle = IncarnationLifecycle::new();

    assert_eq!(run(&mut lifecycle), [Hook::Initialize, Hook::Startup, Hook::Activated]);

    let reported = reports(&mut lifecycle);
    assert_eq!(states(&reported), [Created, Initialized, Active]);
    assert_eq!(answers(reported), [ChildEvent::Started]);
    assert_eq!(next(&mut lifecycle), LifecycleStep::Serve);
    assert!(lifecycle.is_serving());
}

#[test]
fn a_failed_initialisation_is_fatal() {
    let mut lifecycle = IncarnationLifecycle::new();
    assert_eq!(next(&mut lifecycle), LifecycleStep::Run(Hook::Initialize));

    lifecycle.handle_done(Hook::Initialize, failed("no device"));

    assert_eq!(run(&mut lifecycle), [Hook::Finalize]);
    assert_eq!(next(&mut lifecycle), LifecycleStep::End(EndReason::Fatal));
    let reported = reports(&mut lifecycle);
    assert_eq!(states(&reported), [Created, Fatal, Finalized]);
    assert_eq!(answers(reported), [ChildEvent::FailsToStart], "the next one may not begin yet");
    assert_eq!(lifecycle.take_start_failure().as_deref(), Some("no device"));
}

#[test]
fn a_hook_that_fails_leads_to_error_and_a_reset_back_to_work() {
    let mut lifecycle = incarnation(Active);
    lifecycle.handle_done(Hook::Execute, failed("out of range"));
    assert_eq!(run(&mut lifecycle), [Hook::Aborting, Hook::Error]);
    assert_eq!(next(&mut lifecycle), LifecycleStep::Rest);
    let reported = reports(&mut lifecycle);
    assert_eq!(reported, [LifecycleReport::State(Error, Some("out of range".into()))]);

    lifecycle.handle_reset();
    lifecycle.handle_reset();
    assert_eq!(run(&mut lifecycle), [Hook::Reset, Hook::Activated]);
    let reported = reports(&mut lifecycle);
    assert_eq!(states(&reported), [Initialized, Active]);
    assert_eq!(answers(reported), [ChildEvent::Reset]);
}

#[test]
fn a_failed_activation_at_the_start_is_reported_at_the_end() {
    for hook in [Hook::Startup, Hook::Activated] {
        let mut lifecycle = IncarnationLifecycle::new();
        while let LifecycleStep::Run(next) = next(&mut lifecycle) {
            if next == hook {
                lifecycle.handle_done(next, failed("jammed"));
                break;
            }
            lifecycle.handle_done(next, Ok(()));
        }
        assert_eq!(lifecycle.state, Error);
        let last = [Hook::Aborting, Hook::Error, Hook::Shutdown, Hook::Finalize];
        assert_eq!(run(&mut lifecycle), last);
        assert_eq!(next(&mut lifecycle), LifecycleStep::End(EndReason::Fatal));
        assert_eq!(answers(reports(&mut lifecycle)), [ChildEvent::FailsToStart]);
        assert_eq!(lifecycle.take_start_failure().as_deref(), Some("jammed"));
    }
}

#[test]
fn a_failed_start_that_is_stopped_reports_only_the_stop() {
    let mut lifecycle = IncarnationLifecycle::new();
    assert_eq!(next(&mut lifecycle), LifecycleStep::Run(Hook::Initialize));
    lifecycle.handle_done(Hook::Initialize, failed("no device"));

    lifecycle.handle_stop(StopOrder::MakeWay);

    assert_eq!(run(&mut lifecycle), [Hook::Finalize]);
    assert_eq!(next(&mut lifecycle), LifecycleStep::End(EndReason::Fatal), "it has failed");
    assert_eq!(lifecycle.take_start_failure(), None);
    assert_eq!(lifecycle.stop_order(), Some(StopOrder::MakeWay));
}

#[test]
fn a_failed_reset_is_fatal() {
    let mut lifecycle = incarnation(Error);
    lifecycle.handle_reset();
    assert_eq!(next(&mut lifecycle), LifecycleStep::Run(Hook::Reset));

    lifecycle.handle_done(Hook::Reset, failed("still broken"));

    assert_eq!(run(&mut lifecycle), [Hook::Finalize]);
    assert_eq!(next(&mut lifecycle), LifecycleStep::End(EndReason::Fatal));
    let reason = "still broken".into();
    assert_eq!(answers(reports(&mut lifecycle)), [ChildEvent::ResetFailed { reason }]);
}

#[test]
fn a_failure_while_aborting_counts_only_when_it_is_fatal() {
    let mut lifecycle = incarnation(Active);
    lifecycle.handle_failure("one".into());
    assert_eq!(next(&mut lifecycle), LifecycleStep::Run(Hook::Aborting));
    lifecycle.handle_done(Hook::Aborting, failed("two"));
    assert_eq!(next(&mut lifecycle), LifecycleStep::Run(Hook::Error));

    lifecycle.handle_done(Hook::Error, Err(Failure::fatal("three")));

    assert_eq!(lifecycle.state, Fatal);
    assert_eq!(run(&mut lifecycle), [Hook::Finalize]);
}

#[test]
fn stop_ends_every_state_in_its_own_way() {
    let check = |state, expected: &[Hook]| {
        let mut lifecycle = incarnation(state);
        lifecycle.handle_stop(StopOrder::Stop);
        assert_eq!(run(&mut lifecycle), expected, "{state}");
        let failed = state == Fatal;
        let end = if failed { EndReason::Fatal } else { EndReason::Stopped };
        assert_eq!(next(&mut lifecycle), LifecycleStep::End(end), "{state}");
        assert_eq!(lifecycle.stop_order(), Some(StopOrder::Stop));
        assert_eq!(lifecycle.state, Finalized);
    };
    check(Created, &[Hook::Finalize]);
    check(Initialized, &[Hook::Shutdown, Hook::Finalize]);
    check(Active, &[Hook::Deactivated, Hook::Shutdown, Hook::Finalize]);
    check(Error, &[Hook::Shutdown, Hook::Finalize]);
    check(Fatal, &[Hook::Aborting, Hook::Finalize]);
    check(Finalized, &[]);
}

#[test]
fn a_stop_that_overtakes_the_activation_deactivates_again() {
    let mut lifecycle = IncarnationLifecycle::new();
    for hook in [Hook::Initialize, Hook::Startup] {
        assert_eq!(next(&mut lifecycle), LifecycleStep::Run(hook));
        lifecycle.handle_done(hook, Ok(()));
    }
    assert_eq!(next(&mut lifecycle), LifecycleStep::Run(Hook::Activated));
    lifecycle.handle_stop(StopOrder::Stop);

    lifecycle.handle_done(Hook::Activated, Ok(()));

    assert_eq!(run(&mut lifecycle), [Hook::Deactivated, Hook::Shutdown, Hook::Finalize]);
    assert_eq!(answers(reports(&mut lifecycle)), []);
}

#[test]
fn reset_is_answered_in_every_state() {
    for state in [Created, Initialized, Fatal, Finalized] {
        let mut lifecycle = incarnation(state);
        lifecycle.handle_reset();
        let answers = answers(reports(&mut lifecycle));
        assert!(matches!(answers[..], [ChildEvent::ResetFailed { .. }]), "{state}");
    }
    let mut lifecycle = incarnation(Active);
    lifecycle.handle_reset();
    assert_eq!(answers(reports(&mut lifecycle)), [ChildEvent::Reset]);
}

#[test]
fn activation_orders_act_only_between_initialized_and_active() {
    for state in [Created, Error, Fatal, Finalized] {
        for active in [true, false] {
            let mut lifecycle = incarnation(state);
            let before = lifecycle.hooks.clone();
            lifecycle.handle_activate(active);
            assert_eq!(lifecycle.hooks, before);
        }
    }
    let mut lifecycle = incarnation(Initialized);
    lifecycle.handle_activate(true);
    assert_eq!(run(&mut lifecycle), [Hook::Activated]);
    lifecycle.handle_activate(false);
    assert_eq!(run(&mut lifecycle), [Hook::Deactivated]);
    assert_eq!(lifecycle.state, Initialized);
}

#[test]
fn a_declared_failure_acts_in_every_state_that_can_still_fail() {
    for (state, expected) in [
        (Created, Error),
        (Initialized, Error),
        (Active, Error),
        (Error, Error),
        (Fatal, Fatal),
        (Finalized, Finalized),
    ] {
        let mut lifecycle = incarnation(state);
        lifecycle.handle_failure("declared".into());
        assert_eq!(lifecycle.state, expected, "{state}");
    }
    for state in [Created, Initialized, Active, Error] {
        let mut lifecycle = incarnation(state);
        lifecycle.handle_failure(Failure::fatal("declared"));
        assert_eq!(lifecycle.state, Fatal, "{state}");
    }
}

fn missing() -> Result<(), Failure> {
    Err(Failure::unavailable("no device"))
}

/// The waits that were asked for.
fn waits(lifecycle: &mut IncarnationLifecycle) -> Vec<Duration> {
    let wait = |reports| match reports {
        LifecycleReport::Unavailable { retry_in, .. } => Some(retry_in),
        LifecycleReport::State(..) | LifecycleReport::Child(_) => None,
    };
    reports(lifecycle).into_iter().filter_map(wait).collect()
}

#[test]
fn a_hook_without_its_device_is_called_again_with_back_off() {
    let mut lifecycle = IncarnationLifecycle::new();
    let mut waited = Vec::new();
    for _ in 0..10 {
        assert_eq!(next(&mut lifecycle), LifecycleStep::Run(Hook::Initialize));
        lifecycle.handle_done(Hook::Initialize, missing());
        assert_eq!(next(&mut lifecycle), LifecycleStep::Rest, "it is not its time");
        waited.extend(waits(&mut lifecycle));
        assert!(lifecycle.handle_retry());
    }

    let tenths = |wait: &Duration| (wait.as_millis() + 50) / 100;
    assert_eq!(waited.iter().map(tenths).take(3).collect::<Vec<_>>(), [1, 2, 4]);
    assert!(waited.iter().all(|wait| *wait <= Duration::from_millis(5500)), "{waited:?}");
    assert_eq!(run(&mut lifecycle), [Hook::Initialize, Hook::Startup, Hook::Activated]);
    assert_eq!(answers(reports(&mut lifecycle)), [ChildEvent::Started]);
    assert_eq!(next(&mut lifecycle), LifecycleStep::Serve);
}

#[test]
fn a_reset_whose_device_is_missing_goes_on_by_itself() {
    let mut lifecycle = incarnation(Error);
    lifecycle.handle_reset();
    assert_eq!(next(&mut lifecycle), LifecycleStep::Run(Hook::Reset));
    lifecycle.handle_done(Hook::Reset, missing());
    let unavailable = ChildEvent::Unavailable { reason: "no device".into() };
    assert_eq!(answers(reports(&mut lifecycle)), [unavailable]);

    assert!(lifecycle.handle_retry());
    assert_eq!(run(&mut lifecycle), [Hook::Reset, Hook::Activated]);

    assert_eq!(answers(reports(&mut lifecycle)), [ChildEvent::Started]);
}

#[test]
fn an_incarnation_that_waits_is_stopped_fails_and_is_not_activated_twice() {
    let waiting = |hook| {
        let mut lifecycle = IncarnationLifecycle::new();
        while let LifecycleStep::Run(next) = next(&mut lifecycle) {
            lifecycle.handle_done(next, if next == hook { missing() } else { Ok(()) });
        }
        lifecycle
    };
    let mut stopped = waiting(Hook::Initialize);
    stopped.handle_stop(StopOrder::Stop);
    assert!(!stopped.handle_retry());
    assert_eq!(run(&mut stopped), [Hook::Finalize]);

    let mut failed = waiting(Hook::Activated);
    failed.handle_fatal("broken".into());
    assert!(!failed.handle_retry());
    assert_eq!(run(&mut failed), [Hook::Finalize]);

    let mut asked = waiting(Hook::Activated);
    asked.handle_activate(true);
    assert!(asked.handle_retry());
    assert_eq!(run(&mut asked), [Hook::Activated]);
}

#[test]
fn a_device_that_is_missing_at_work_is_a_failure_like_any_other() {
    let mut lifecycle = incarnation(Active);

    lifecycle.handle_done(Hook::Execute, missing());

    assert_eq!(run(&mut lifecycle), [Hook::Aborting, Hook::Error]);
}

#[test]
fn a_hook_that_runs_is_not_ordered_a_second_time() {
    for (state, active, hook) in
        [(Initialized, true, Hook::Activated), (Active, false, Hook::Deactivated)]
    {
        let mut lifecycle = incarnation(state);
        lifecycle.handle_activate(active);
        assert_eq!(next(&mut lifecycle), LifecycleStep::Run(hook));

        lifecycle.handle_activate(active);
        lifecycle.handle_done(hook, Ok(()));

        assert_eq!(run(&mut lifecycle), [], "{state}");
    }
    let mut starting = IncarnationLifecycle::new();
    for hook in [Hook::Initialize, Hook::Startup] {
        assert_eq!(next(&mut starting), LifecycleStep::Run(hook));
        starting.handle_done(hook, Ok(()));
    }
    assert_eq!(next(&mut starting), LifecycleStep::Run(Hook::Activated));
    starting.handle_activate(true);
    starting.handle_done(Hook::Activated, Ok(()));
    assert_eq!(run(&mut starting), []);
}

#[test]
fn a_failure_that_a_hook_declares_counts_though_the_hook_succeeds() {
    let outcomes = || [Ok(()), missing(), failed("returned")];
    for (state, active) in [(Initialized, true), (Active, false)] {
        for outcome in outcomes() {
            let mut lifecycle = incarnation(state);
            lifecycle.handle_activate(active);
            let LifecycleStep::Run(hook) = next(&mut lifecycle) else { panic!("a hook is due") };
            lifecycle.handle_failure("declared".into());
            lifecycle.handle_done(hook, outcome);

            assert_eq!(run(&mut lifecycle), [Hook::Aborting, Hook::Error], "{hook:?}");
            let reported = reports(&mut lifecycle);
            assert_eq!(reported, [LifecycleReport::State(Error, Some("declared".into()))]);
        }
    }
    for outcome in outcomes() {
        let mut lifecycle = IncarnationLifecycle::new();
        assert_eq!(next(&mut lifecycle), LifecycleStep::Run(Hook::Initialize));
        lifecycle.handle_failure(Failure::fatal("declared"));
        lifecycle.handle_done(Hook::Initialize, outcome);

        assert_eq!(run(&mut lifecycle), [Hook::Finalize]);
        assert_eq!(states(&reports(&mut lifecycle)), [Created, Fatal, Finalized]);
    }
}

#[test]
fn a_component_settles_before_each_deactivation_and_not_once_it_has_failed() {
    let mut lifecycle = incarnation(Active);
    for _ in 0..2 {
        lifecycle.handle_activate(false);
        assert_eq!(lifecycle.next(), LifecycleStep::Settle);
        assert_eq!(lifecycle.next(), LifecycleStep::Settle, "it has not settled");
        assert!(!lifecycle.is_serving());
        assert_eq!(run(&mut lifecycle), [Hook::Deactivated]);
        lifecycle.handle_activate(true);
        run(&mut lifecycle);
    }

    lifecycle.handle_stop(StopOrder::Stop);
    assert_eq!(lifecycle.next(), LifecycleStep::Settle);

    let mut lifecycle = incarnation(Active);
    lifecycle.handle_activate(false);
    lifecycle.handle_failure("broken".into());
    assert_eq!(lifecycle.next(), LifecycleStep::Run(Hook::Aborting));
}
