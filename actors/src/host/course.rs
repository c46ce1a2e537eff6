//! The course of one life: which hook comes next, and what is told about it.
//!
//! A pure machine. The pump runs the hooks that it names and says how they ended; orders come in
//! between.

use crate::component::Failure;
use blastema_contract::child::ChildEvent;
use blastema_core::Lifecycle;
use std::collections::VecDeque;

/// One of a component's hooks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Hook {
    Initialize,
    Startup,
    Activated,
    Execute,
    RateChanged,
    Deactivated,
    Aborting,
    Error,
    Reset,
    Shutdown,
    Finalize,
}

impl Hook {
    const ALL: [Hook; 11] = [
        Hook::Initialize,
        Hook::Startup,
        Hook::Activated,
        Hook::Execute,
        Hook::RateChanged,
        Hook::Deactivated,
        Hook::Aborting,
        Hook::Error,
        Hook::Reset,
        Hook::Shutdown,
        Hook::Finalize,
    ];

    /// Whether this is the name of a hook.
    pub(crate) fn is_name(text: &str) -> bool {
        Hook::ALL.iter().any(|hook| hook.name() == text)
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            Hook::Initialize => "on_initialize",
            Hook::Startup => "on_startup",
            Hook::Activated => "on_activated",
            Hook::Execute => "on_execute",
            Hook::RateChanged => "on_rate_changed",
            Hook::Deactivated => "on_deactivated",
            Hook::Aborting => "on_aborting",
            Hook::Error => "on_error",
            Hook::Reset => "on_reset",
            Hook::Shutdown => "on_shutdown",
            Hook::Finalize => "on_finalize",
        }
    }
}

/// How a life ends that does not panic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum End {
    /// It was told to.
    Stopped,
    /// It was told to, and another life follows.
    Replaced,
    /// It ended itself.
    Returned,
    /// It could not go on.
    Fatal,
}

/// What the pump is to do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    Run(Hook),
    /// Serve timers, rounds and messages.
    Serve,
    /// Wait for an order.
    Rest,
    End(End),
}

/// What is to be told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum News {
    State(Lifecycle, Option<String>),
    Child(ChildEvent),
}

/// What the supervisor waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Awaited {
    Start,
    Reset,
}

#[derive(Debug)]
pub(crate) struct Course {
    state: Lifecycle,
    /// At most one per hook.
    hooks: VecDeque<Hook>,
    awaited: Option<Awaited>,
    end: Option<End>,
    news: Vec<News>,
}

impl Course {
    /// A life that is about to be initialised and activated. `announced`: its supervisor waits to
    /// hear of it.
    pub(crate) fn new(announced: bool) -> Self {
        Course {
            state: Lifecycle::Created,
            hooks: VecDeque::from([Hook::Initialize, Hook::Startup, Hook::Activated]),
            awaited: announced.then_some(Awaited::Start),
            end: None,
            news: vec![News::State(Lifecycle::Created, None)],
        }
    }

    /// The supervisor still waits to hear that the life has begun.
    pub(crate) fn is_starting(&self) -> bool {
        self.awaited == Some(Awaited::Start)
    }

    /// Nothing but messages, timers and rounds.
    #[inline]
    pub(crate) fn is_serving(&self) -> bool {
        self.state == Lifecycle::Active && self.hooks.is_empty() && self.end.is_none()
    }

    /// Another life follows this one.
    pub(crate) fn makes_way(&self) -> bool {
        self.end == Some(End::Replaced)
    }

    pub(crate) fn is_ending(&self) -> bool {
        self.end.is_some()
    }

    pub(crate) fn poll_news(&mut self) -> Vec<News> {
        std::mem::take(&mut self.news)
    }

    /// What is to be done next. A hook that is named here counts as begun.
    pub(crate) fn next(&mut self) -> Step {
        match (self.hooks.pop_front(), self.end) {
            (Some(hook), _) => Step::Run(hook),
            (None, Some(end)) => Step::End(end),
            (None, None) if self.state == Lifecycle::Active => Step::Serve,
            (None, None) => Step::Rest,
        }
    }

    /// A hook has ended.
    pub(crate) fn handle_done(&mut self, hook: Hook, result: Result<(), Failure>) {
        match (hook, result) {
            (Hook::Initialize, Ok(())) => self.enter(Lifecycle::Initialized, None),
            (Hook::Activated, Ok(())) => self.handle_activated(),
            (Hook::Reset, Ok(())) => {
                self.enter(Lifecycle::Initialized, None);
                if self.end.is_none() {
                    self.hooks.push_back(Hook::Activated);
                }
            }
            (Hook::Initialize | Hook::Reset, Err(failure)) => self.handle_fatal(failure.reason),
            (Hook::Deactivated, result) => {
                self.enter(Lifecycle::Initialized, None);
                if let (Err(failure), None) = (result, self.end) {
                    self.handle_failure(failure);
                }
            }
            (Hook::Aborting | Hook::Error, Err(failure)) if failure.fatal => {
                self.handle_fatal(failure.reason);
            }
            (Hook::Finalize, _) => self.enter(Lifecycle::Finalized, None),
            (Hook::Aborting | Hook::Error | Hook::Shutdown, _) => {}
            (_, Ok(())) => {}
            (_, Err(failure)) => self.handle_failure(failure),
        }
    }

    fn handle_activated(&mut self) {
        self.enter(Lifecycle::Active, None);
        if self.end.is_some() {
            self.hooks.push_front(Hook::Deactivated);
            return;
        }
        match self.awaited.take() {
            Some(Awaited::Start) => self.news.push(News::Child(ChildEvent::Started)),
            Some(Awaited::Reset) => self.news.push(News::Child(ChildEvent::Reset)),
            None => {}
        }
    }

    /// The component's work has failed.
    pub(crate) fn handle_failure(&mut self, failure: Failure) {
        if failure.fatal {
            return self.handle_fatal(failure.reason);
        }
        if self.end.is_some() || self.state == Lifecycle::Error {
            return;
        }
        self.answer_failed(&failure.reason);
        self.enter(Lifecycle::Error, Some(failure.reason));
        self.hooks = VecDeque::from([Hook::Aborting, Hook::Error]);
    }

    /// This life cannot go on.
    pub(crate) fn handle_fatal(&mut self, reason: String) {
        if self.end.is_some() {
            return;
        }
        self.answer_failed(&reason);
        let aborting = self.state == Lifecycle::Active || self.hooks.contains(&Hook::Aborting);
        self.enter(Lifecycle::Fatal, Some(reason));
        self.hooks.clear();
        if aborting {
            self.hooks.push_back(Hook::Aborting);
        }
        self.hooks.push_back(Hook::Finalize);
        self.end = Some(End::Fatal);
    }

    fn answer_failed(&mut self, reason: &str) {
        let reason = reason.to_owned();
        match self.awaited.take() {
            Some(Awaited::Start) => {
                self.news.push(News::Child(ChildEvent::StartFailed { reason }));
            }
            Some(Awaited::Reset) => {
                self.news.push(News::Child(ChildEvent::ResetFailed { reason }));
            }
            None => {}
        }
    }

    /// The life is to end in order.
    pub(crate) fn handle_stop(&mut self, end: End) {
        if self.end.is_some() {
            // Who asks to be told that it stopped is told so, whatever it ends of.
            if end == End::Stopped || (end == End::Replaced && self.end != Some(End::Stopped)) {
                self.end = Some(end);
            }
            return;
        }
        self.end = Some(end);
        self.awaited = None;
        self.hooks.retain(|hook| *hook == Hook::Aborting);
        match self.state {
            Lifecycle::Active => {
                self.hooks.extend([Hook::Deactivated, Hook::Shutdown, Hook::Finalize]);
            }
            Lifecycle::Initialized | Lifecycle::Error => {
                self.hooks.extend([Hook::Shutdown, Hook::Finalize]);
            }
            Lifecycle::Created | Lifecycle::Fatal => self.hooks.push_back(Hook::Finalize),
            Lifecycle::Finalized => {}
        }
    }

    /// A component in error is to recover by itself.
    pub(crate) fn handle_reset(&mut self) {
        if self.awaited == Some(Awaited::Reset) {
            return;
        }
        match (self.state, self.end) {
            (Lifecycle::Error, None) => {
                self.hooks.push_back(Hook::Reset);
                self.awaited = Some(Awaited::Reset);
            }
            (Lifecycle::Active, None) => self.news.push(News::Child(ChildEvent::Reset)),
            (state, _) => {
                let reason = format!("it is {state}; only a component in error can be reset");
                self.news.push(News::Child(ChildEvent::ResetFailed { reason }));
            }
        }
    }

    /// Leave work, or return to it. Without effect where the state does not allow it.
    pub(crate) fn handle_activate(&mut self, active: bool) {
        match (self.state, active, self.end) {
            (Lifecycle::Active, false, None) if self.hooks.is_empty() => {
                self.hooks.push_back(Hook::Deactivated);
            }
            (Lifecycle::Initialized, true, None) if self.hooks.is_empty() => {
                self.hooks.push_back(Hook::Activated);
            }
            _ => {}
        }
    }

    /// The rate of execution has changed.
    pub(crate) fn handle_rate_changed(&mut self) {
        if self.is_serving() {
            self.hooks.push_back(Hook::RateChanged);
        }
    }

    fn enter(&mut self, state: Lifecycle, reason: Option<String>) {
        self.state = state;
        self.news.push(News::State(state, reason));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Lifecycle::{Active, Created, Error, Fatal, Finalized, Initialized};

    fn failed(reason: &str) -> Result<(), Failure> {
        Err(reason.into())
    }

    /// Runs all hooks that are due; each succeeds.
    fn run(course: &mut Course) -> Vec<Hook> {
        let mut ran = Vec::new();
        while let Step::Run(hook) = course.next() {
            ran.push(hook);
            course.handle_done(hook, Ok(()));
        }
        ran
    }

    /// A life that has come as far as `state`, its news told.
    fn life(state: Lifecycle) -> Course {
        let mut course = Course::new(true);
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
                course.handle_stop(End::Stopped);
                run(&mut course);
            }
        }
        course.poll_news();
        assert_eq!(course.state, state);
        course
    }

    fn states(news: &[News]) -> Vec<Lifecycle> {
        let state = |news: &News| match news {
            News::State(state, _) => Some(*state),
            News::Child(_) => None,
        };
        news.iter().filter_map(state).collect()
    }

    fn answers(news: Vec<News>) -> Vec<ChildEvent> {
        let answer = |news| match news {
            News::Child(event) => Some(event),
            News::State(..) => None,
        };
        news.into_iter().filter_map(answer).collect()
    }

    #[test]
    fn a_life_is_initialised_started_and_activated() {
        let mut course = Course::new(true);

        assert_eq!(run(&mut course), [Hook::Initialize, Hook::Startup, Hook::Activated]);

        let news = course.poll_news();
        assert_eq!(states(&news), [Created, Initialized, Active]);
        assert_eq!(answers(news), [ChildEvent::Started]);
        assert_eq!(course.next(), Step::Serve);
        assert!(course.is_serving());
    }

    #[test]
    fn a_life_that_nobody_waits_for_tells_no_supervisor() {
        let mut course = Course::new(false);
        run(&mut course);
        assert_eq!(answers(course.poll_news()), []);
    }

    #[test]
    fn a_failed_initialisation_is_fatal() {
        let mut course = Course::new(true);
        assert_eq!(course.next(), Step::Run(Hook::Initialize));

        course.handle_done(Hook::Initialize, failed("no device"));

        assert_eq!(run(&mut course), [Hook::Finalize]);
        assert_eq!(course.next(), Step::End(End::Fatal));
        let news = course.poll_news();
        assert_eq!(states(&news), [Created, Fatal, Finalized]);
        assert_eq!(answers(news), [ChildEvent::StartFailed { reason: "no device".into() }]);
    }

    #[test]
    fn a_hook_that_fails_leads_to_error_and_a_reset_back_to_work() {
        for hook in [Hook::Execute, Hook::RateChanged] {
            let mut course = life(Active);
            course.handle_done(hook, failed("out of range"));
            assert_eq!(run(&mut course), [Hook::Aborting, Hook::Error]);
            assert_eq!(course.next(), Step::Rest);
            let news = course.poll_news();
            assert_eq!(news, [News::State(Error, Some("out of range".into()))]);

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
            let mut course = Course::new(true);
            while let Step::Run(next) = course.next() {
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
        let mut course = life(Error);
        course.handle_reset();
        assert_eq!(course.next(), Step::Run(Hook::Reset));

        course.handle_done(Hook::Reset, failed("still broken"));

        assert_eq!(run(&mut course), [Hook::Finalize]);
        assert_eq!(course.next(), Step::End(End::Fatal));
        let reason = "still broken".into();
        assert_eq!(answers(course.poll_news()), [ChildEvent::ResetFailed { reason }]);
    }

    #[test]
    fn a_failure_while_aborting_counts_only_when_it_is_fatal() {
        let mut course = life(Active);
        course.handle_failure("one".into());
        assert_eq!(course.next(), Step::Run(Hook::Aborting));
        course.handle_done(Hook::Aborting, failed("two"));
        assert_eq!(course.next(), Step::Run(Hook::Error));

        course.handle_done(Hook::Error, Err(Failure::fatal("three")));

        assert_eq!(course.state, Fatal);
        assert_eq!(run(&mut course), [Hook::Finalize]);
    }

    #[test]
    fn stop_ends_every_state_in_its_own_way() {
        let check = |state, expected: &[Hook]| {
            let mut course = life(state);
            course.handle_stop(End::Stopped);
            assert_eq!(run(&mut course), expected, "{state}");
            assert_eq!(course.next(), Step::End(End::Stopped), "{state}");
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
        let mut course = Course::new(true);
        for hook in [Hook::Initialize, Hook::Startup] {
            assert_eq!(course.next(), Step::Run(hook));
            course.handle_done(hook, Ok(()));
        }
        assert_eq!(course.next(), Step::Run(Hook::Activated));
        course.handle_stop(End::Stopped);

        course.handle_done(Hook::Activated, Ok(()));

        assert_eq!(run(&mut course), [Hook::Deactivated, Hook::Shutdown, Hook::Finalize]);
        assert_eq!(answers(course.poll_news()), []);
    }

    #[test]
    fn reset_is_answered_in_every_state() {
        for state in [Created, Initialized, Fatal, Finalized] {
            let mut course = life(state);
            course.handle_reset();
            let news = answers(course.poll_news());
            assert!(matches!(news[..], [ChildEvent::ResetFailed { .. }]), "{state}");
        }
        let mut course = life(Active);
        course.handle_reset();
        assert_eq!(answers(course.poll_news()), [ChildEvent::Reset]);
    }

    #[test]
    fn activation_orders_act_only_between_initialized_and_active() {
        for state in [Created, Error, Fatal, Finalized] {
            for active in [true, false] {
                let mut course = life(state);
                let before = course.hooks.clone();
                course.handle_activate(active);
                assert_eq!(course.hooks, before);
            }
        }
        let mut course = life(Initialized);
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
            let mut course = life(state);
            course.handle_failure("declared".into());
            assert_eq!(course.state, expected, "{state}");
        }
        for state in [Created, Initialized, Active, Error] {
            let mut course = life(state);
            course.handle_failure(Failure::fatal("declared"));
            assert_eq!(course.state, Fatal, "{state}");
        }
    }

    #[test]
    fn a_changed_rate_is_told_only_at_work() {
        for state in [Created, Initialized, Error, Fatal, Finalized] {
            let mut course = life(state);
            let before = course.hooks.clone();
            course.handle_rate_changed();
            assert_eq!(course.hooks, before, "{state}");
        }
        let mut course = life(Active);
        course.handle_rate_changed();
        assert_eq!(run(&mut course), [Hook::RateChanged]);
    }
}
