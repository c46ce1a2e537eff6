//! Which hook comes next, whatever was ordered and however the last one ended.

use super::*;
use Lifecycle::{Active, Created, Error, Fatal, Finalized, Initialized};

fn failed(reason: &str) -> Result<(), Failure> {
    Err(reason.into())
}

/// Runs all hooks that are due; each succeeds.
fn run(course: &mut IncarnationLifecycle) -> Vec<Hook> {
    let mut ran = Vec::new();
    while let LifecycleStep::Run(hook) = course.next() {
        ran.push(hook);
        course.handle_done(hook, Ok(()));
    }
    ran
}

/// An incarnation that has come as far as `state`, its news told.
fn incarnation(state: Lifecycle) -> IncarnationLifecycle {
    let mut course = IncarnationLifecycle::new(true);
    match state {
        Created => {}
        Initialized => {
            run(&mut course);
            course.handle_activate(false);
            run(&mut course);
        }
        Active => {
            run(&mut course);
        }
        Error => {
            run(&mut course);
            course.handle_failure("broken".into());
            run(&mut course);
        }
        Fatal => {
            run(&mut course);
            course.handle_failure(Failure::fatal("broken"));
        }
        Finalized => {
            run(&mut course);
            course.handle_stop(EndReason::Stopped);
            run(&mut course);
        }
    }
    course.poll_news();
    assert_eq!(course.state, state);
    course
}

fn states(news: &[LifecycleReport]) -> Vec<Lifecycle> {
    let state = |news: &LifecycleReport| match news {
        LifecycleReport::State(state, _) => Some(*state),
        LifecycleReport::Child(_) | LifecycleReport::Unavailable { .. } => None,
    };
    news.iter().filter_map(state).collect()
}

fn answers(news: Vec<LifecycleReport>) -> Vec<ChildEvent> {
    let answer = |news| match news {
        LifecycleReport::Child(event) => Some(event),
        LifecycleReport::State(..) | LifecycleReport::Unavailable { .. } => None,
    };
    news.into_iter().filter_map(answer).collect()
}

#[test]
fn an_incarnation_is_initialised_started_and_activated() {
    let mut course = IncarnationLifecycle::new(true);

    assert_eq!(run(&mut course), [Hook::Initialize, Hook::Startup, Hook::Activated]);

    let news = course.poll_news();
    assert_eq!(states(&news), [Created, Initialized, Active]);
    assert_eq!(answers(news), [ChildEvent::Started]);
    assert_eq!(course.next(), LifecycleStep::Serve);
    assert!(course.is_serving());
}

#[test]
fn an_incarnation_that_nobody_waits_for_tells_no_supervisor() {
    let mut course = IncarnationLifecycle::new(false);
    run(&mut course);
    assert_eq!(answers(course.poll_news()), []);
}

#[test]
fn a_failed_initialisation_is_fatal() {
    let mut course = IncarnationLifecycle::new(true);
    assert_eq!(course.next(), LifecycleStep::Run(Hook::Initialize));

    course.handle_done(Hook::Initialize, failed("no device"));

    assert_eq!(run(&mut course), [Hook::Finalize]);
    assert_eq!(course.next(), LifecycleStep::End(EndReason::Fatal));
    let news = course.poll_news();
    assert_eq!(states(&news), [Created, Fatal, Finalized]);
    assert_eq!(answers(news), [ChildEvent::StartFailed { reason: "no device".into() }]);
}

#[test]
fn a_hook_that_fails_leads_to_error_and_a_reset_back_to_work() {
    for hook in [Hook::Execute, Hook::RateChanged] {
        let mut course = incarnation(Active);
        course.handle_done(hook, failed("out of range"));
        assert_eq!(run(&mut course), [Hook::Aborting, Hook::Error]);
        assert_eq!(course.next(), LifecycleStep::Rest);
        let news = course.poll_news();
        assert_eq!(news, [LifecycleReport::State(Error, Some("out of range".into()))]);

        course.handle_reset();
        course.handle_reset();
        assert_eq!(run(&mut course), [Hook::Reset, Hook::Activated]);
        let news = course.poll_news();
        assert_eq!(states(&news), [Initialized, Active]);
        assert_eq!(answers(news), [ChildEvent::Reset]);
    }
}

#[test]
fn a_failed_activation_at_the_start_is_an_error_that_the_supervisor_hears_of() {
    for hook in [Hook::Startup, Hook::Activated] {
        let mut course = IncarnationLifecycle::new(true);
        while let LifecycleStep::Run(next) = course.next() {
            if next == hook {
                course.handle_done(next, failed("jammed"));
                break;
            }
            course.handle_done(next, Ok(()));
        }
        assert_eq!(course.state, Error);
        let failed = ChildEvent::StartFailed { reason: "jammed".into() };
        assert_eq!(answers(course.poll_news()), [failed]);
    }
}

#[test]
fn a_failed_reset_is_fatal() {
    let mut course = incarnation(Error);
    course.handle_reset();
    assert_eq!(course.next(), LifecycleStep::Run(Hook::Reset));

    course.handle_done(Hook::Reset, failed("still broken"));

    assert_eq!(run(&mut course), [Hook::Finalize]);
    assert_eq!(course.next(), LifecycleStep::End(EndReason::Fatal));
    let reason = "still broken".into();
    assert_eq!(answers(course.poll_news()), [ChildEvent::ResetFailed { reason }]);
}

#[test]
fn a_failure_while_aborting_counts_only_when_it_is_fatal() {
    let mut course = incarnation(Active);
    course.handle_failure("one".into());
    assert_eq!(course.next(), LifecycleStep::Run(Hook::Aborting));
    course.handle_done(Hook::Aborting, failed("two"));
    assert_eq!(course.next(), LifecycleStep::Run(Hook::Error));

    course.handle_done(Hook::Error, Err(Failure::fatal("three")));

    assert_eq!(course.state, Fatal);
    assert_eq!(run(&mut course), [Hook::Finalize]);
}

#[test]
fn stop_ends_every_state_in_its_own_way() {
    let check = |state, expected: &[Hook]| {
        let mut course = incarnation(state);
        course.handle_stop(EndReason::Stopped);
        assert_eq!(run(&mut course), expected, "{state}");
        assert_eq!(course.next(), LifecycleStep::End(EndReason::Stopped), "{state}");
        assert_eq!(course.state, Finalized);
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
    let mut course = IncarnationLifecycle::new(true);
    for hook in [Hook::Initialize, Hook::Startup] {
        assert_eq!(course.next(), LifecycleStep::Run(hook));
        course.handle_done(hook, Ok(()));
    }
    assert_eq!(course.next(), LifecycleStep::Run(Hook::Activated));
    course.handle_stop(EndReason::Stopped);

    course.handle_done(Hook::Activated, Ok(()));

    assert_eq!(run(&mut course), [Hook::Deactivated, Hook::Shutdown, Hook::Finalize]);
    assert_eq!(answers(course.poll_news()), []);
}

#[test]
fn reset_is_answered_in_every_state() {
    for state in [Created, Initialized, Fatal, Finalized] {
        let mut course = incarnation(state);
        course.handle_reset();
        let news = answers(course.poll_news());
        assert!(matches!(news[..], [ChildEvent::ResetFailed { .. }]), "{state}");
    }
    let mut course = incarnation(Active);
    course.handle_reset();
    assert_eq!(answers(course.poll_news()), [ChildEvent::Reset]);
}

#[test]
fn activation_orders_act_only_between_initialized_and_active() {
    for state in [Created, Error, Fatal, Finalized] {
        for active in [true, false] {
            let mut course = incarnation(state);
            let before = course.hooks.clone();
            course.handle_activate(active);
            assert_eq!(course.hooks, before);
        }
    }
    let mut course = incarnation(Initialized);
    course.handle_activate(true);
    assert_eq!(run(&mut course), [Hook::Activated]);
    course.handle_activate(false);
    assert_eq!(run(&mut course), [Hook::Deactivated]);
    assert_eq!(course.state, Initialized);
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
        let mut course = incarnation(state);
        course.handle_failure("declared".into());
        assert_eq!(course.state, expected, "{state}");
    }
    for state in [Created, Initialized, Active, Error] {
        let mut course = incarnation(state);
        course.handle_failure(Failure::fatal("declared"));
        assert_eq!(course.state, Fatal, "{state}");
    }
}

#[test]
fn a_changed_rate_is_told_only_at_work() {
    for state in [Created, Initialized, Error, Fatal, Finalized] {
        let mut course = incarnation(state);
        let before = course.hooks.clone();
        course.handle_rate_changed();
        assert_eq!(course.hooks, before, "{state}");
    }
    let mut course = incarnation(Active);
    course.handle_rate_changed();
    assert_eq!(run(&mut course), [Hook::RateChanged]);
}

fn missing() -> Result<(), Failure> {
    Err(Failure::unavailable("no device"))
}

/// The waits that were asked for.
fn waits(course: &mut IncarnationLifecycle) -> Vec<Duration> {
    let wait = |news| match news {
        LifecycleReport::Unavailable { retry_in, .. } => Some(retry_in),
        LifecycleReport::State(..) | LifecycleReport::Child(_) => None,
    };
    course.poll_news().into_iter().filter_map(wait).collect()
}

#[test]
fn a_hook_whose_device_is_missing_is_called_again_ever_later_in_the_same_incarnation() {
    let mut course = IncarnationLifecycle::new(true);
    let mut waited = Vec::new();
    for _ in 0..10 {
        assert_eq!(course.next(), LifecycleStep::Run(Hook::Initialize));
        course.handle_done(Hook::Initialize, missing());
        assert_eq!(course.next(), LifecycleStep::Rest, "it is not its time");
        waited.extend(waits(&mut course));
        assert!(course.handle_retry());
    }

    let tenths = |wait: &Duration| (wait.as_millis() + 50) / 100;
    assert_eq!(waited.iter().map(tenths).take(3).collect::<Vec<_>>(), [1, 2, 4]);
    assert!(waited.iter().all(|wait| *wait <= Duration::from_millis(5500)), "{waited:?}");
    assert_eq!(run(&mut course), [Hook::Initialize, Hook::Startup, Hook::Activated]);
    assert_eq!(answers(course.poll_news()), [ChildEvent::Started]);
    assert_eq!(course.next(), LifecycleStep::Serve);
}

#[test]
fn a_reset_whose_device_is_missing_goes_on_by_itself() {
    let mut course = incarnation(Error);
    course.handle_reset();
    assert_eq!(course.next(), LifecycleStep::Run(Hook::Reset));
    course.handle_done(Hook::Reset, missing());
    let unavailable = ChildEvent::Unavailable { reason: "no device".into() };
    assert_eq!(answers(course.poll_news()), [unavailable]);

    assert!(course.handle_retry());
    assert_eq!(run(&mut course), [Hook::Reset, Hook::Activated]);

    assert_eq!(answers(course.poll_news()), [ChildEvent::Started]);
}

#[test]
fn an_incarnation_that_waits_is_stopped_fails_and_is_not_activated_twice() {
    let waiting = |hook| {
        let mut course = IncarnationLifecycle::new(true);
        while let LifecycleStep::Run(next) = course.next() {
            course.handle_done(next, if next == hook { missing() } else { Ok(()) });
        }
        course
    };
    let mut stopped = waiting(Hook::Initialize);
    stopped.handle_stop(EndReason::Stopped);
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
    let mut course = incarnation(Active);

    course.handle_done(Hook::Execute, missing());

    assert_eq!(run(&mut course), [Hook::Aborting, Hook::Error]);
}
