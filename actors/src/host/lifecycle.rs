//! The lifecycle of one incarnation: the next hook, and the reports about it.
//!
//! A pure machine. The executor runs the hooks that it names and says how they ended; orders come
//! in between.

use crate::component::Failure;
use crate::liveness::label::{CONDITION, FACTORY, Label, TIMER};
use blastema_contract::child::ChildEvent;
use blastema_core::Lifecycle;
use blastema_core::recovery::Backoff;
use smallvec::{SmallVec, smallvec};
use std::collections::VecDeque;
use std::time::Duration;

/// How long a hook waits that found what it needs not there yet: 100 ms, then twice as long each
/// time, up to five seconds, so that a device is used soon after it was plugged in, and a missing
/// one costs nothing.
const UNAVAILABLE: Backoff = Backoff {
    first: Duration::from_millis(100),
    factor: 2,
    limit: Duration::from_secs(5),
    jitter_percent: 10,
};

/// One of a component's hooks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Hook {
    Initialize,
    Startup,
    Activated,
    Execute,
    Deactivated,
    Aborting,
    Error,
    Reset,
    Shutdown,
    Finalize,
}

const HOOK_COUNT: usize = 10;

/// The names of the hooks, in the order of [`Hook`].
static HOOKS: [Label; HOOK_COUNT] = [
    Label::new("on_initialize"),
    Label::new("on_startup"),
    Label::new("on_activated"),
    Label::new("on_execute"),
    Label::new("on_deactivated"),
    Label::new("on_aborting"),
    Label::new("on_error"),
    Label::new("on_reset"),
    Label::new("on_shutdown"),
    Label::new("on_finalize"),
];

impl Hook {
    pub(crate) fn label(self) -> &'static Label {
        &HOOKS[self as usize]
    }

    pub(crate) fn name(self) -> &'static str {
        self.label().name
    }
}

/// Whether what runs under this name serves a message.
pub(crate) fn is_message(during: &str) -> bool {
    HOOKS.iter().chain([&CONDITION, &FACTORY, &TIMER]).all(|known| known.name != during)
}

/// Whether what runs under this name is a part of the start.
pub(crate) fn is_start(during: &str) -> bool {
    let hooks = [Hook::Initialize, Hook::Startup, Hook::Activated].map(Hook::label);
    hooks.into_iter().chain([&FACTORY]).any(|known| known.name == during)
}

/// How an incarnation ends that does not panic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum EndReason {
    /// It was ordered to.
    Stopped,
    /// It ended itself.
    Returned,
    /// It did not come to work, or could not go on.
    Fatal,
}

/// An order to end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StopOrder {
    Stop,
    /// Another incarnation follows.
    MakeWay,
}

/// What the executor is to do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LifecycleStep {
    Run(Hook),
    /// Bring the actuators to rest, and serve timers, rounds and messages meanwhile; then tell
    /// [`IncarnationLifecycle::handle_settled`].
    Settle,
    /// Serve timers, rounds and messages.
    Serve,
    /// Wait for an order.
    Rest,
    End(EndReason),
}

/// What is to be reported.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum LifecycleReport {
    /// The state that was reached, and why.
    State(Lifecycle, Option<String>),
    /// What the supervisor is to know.
    Child(ChildEvent),
    /// Something is not there yet; [`IncarnationLifecycle::handle_retry`] is to be called when this
    /// has passed.
    Unavailable { reason: String, retry_in: Duration },
}

/// A hook that is to be called again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Retried {
    hook: Hook,
    /// How many times it has failed.
    attempts: u32,
    /// It is not its time yet.
    waits: bool,
}

/// What the supervisor waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Awaited {
    Start,
    Reset,
}

#[derive(Debug)]
pub(crate) struct IncarnationLifecycle {
    state: Lifecycle,
    /// At most one per hook, the next one first.
    hooks: SmallVec<[Hook; HOOK_COUNT]>,
    /// The hook that has begun and not ended.
    running: Option<Hook>,
    awaited: Option<Awaited>,
    /// The actuators are at rest, so that the component may be deactivated.
    settled: bool,
    /// Why it did not come to work. The supervisor, which waits for the start, hears of it when the
    /// incarnation has ended: only then may the next one begin.
    start_failure: Option<String>,
    /// A hook found that something is not there yet.
    retried: Option<Retried>,
    end: Option<EndReason>,
    /// Its supervisor waits for its end.
    ordered: Option<StopOrder>,
    reports: VecDeque<LifecycleReport>,
}

impl IncarnationLifecycle {
    /// An incarnation that is about to be initialised and activated. Its supervisor waits for a
    /// report of that.
    pub(crate) fn new() -> Self {
        IncarnationLifecycle {
            state: Lifecycle::Created,
            hooks: smallvec![Hook::Initialize, Hook::Startup, Hook::Activated],
            running: None,
            awaited: Some(Awaited::Start),
            settled: false,
            start_failure: None,
            retried: None,
            end: None,
            ordered: None,
            reports: VecDeque::from([LifecycleReport::State(Lifecycle::Created, None)]),
        }
    }

    /// The supervisor still waits to hear that the incarnation has begun.
    pub(crate) fn is_starting(&self) -> bool {
        self.awaited == Some(Awaited::Start)
    }

    /// What the supervisor is to be told of an incarnation that has ended before it came to work.
    pub(crate) fn take_start_failure(&mut self) -> Option<String> {
        self.start_failure.take()
    }

    /// Nothing but messages, timers and rounds.
    #[inline]
    pub(crate) fn is_serving(&self) -> bool {
        self.state == Lifecycle::Active && self.hooks.is_empty() && self.end.is_none()
    }

    /// How it ends, where it does.
    pub(crate) fn end_reason(&self) -> Option<EndReason> {
        self.end
    }

    /// What its supervisor has ordered, which waits for its end, whatever it ends of.
    pub(crate) fn stop_order(&self) -> Option<StopOrder> {
        self.ordered
    }

    pub(crate) fn is_ending(&self) -> bool {
        self.end.is_some()
    }

    pub(crate) fn poll_report(&mut self) -> Option<LifecycleReport> {
        let report = self.reports.pop_front();
        if report.is_none() && self.is_serving() {
            // A component at work has nothing to report for long.
            self.reports = VecDeque::new();
        }
        report
    }

    /// What is to be done next. A hook that is named here counts as begun.
    pub(crate) fn next(&mut self) -> LifecycleStep {
        if self.retried.is_some_and(|retried| retried.waits) {
            return LifecycleStep::Rest;
        }
        if self.hooks.first() == Some(&Hook::Deactivated) && !self.settled {
            return LifecycleStep::Settle;
        }
        if !self.hooks.is_empty() {
            let hook = self.hooks.remove(0);
            self.running = Some(hook);
            return LifecycleStep::Run(hook);
        }
        match self.end {
            Some(end) => LifecycleStep::End(end),
            None if self.state == Lifecycle::Active => LifecycleStep::Serve,
            None => LifecycleStep::Rest,
        }
    }

    /// A hook has ended.
    pub(crate) fn handle_done(&mut self, hook: Hook, result: Result<(), Failure>) {
        self.running = None;
        let has_failed = match hook {
            Hook::Initialize | Hook::Startup | Hook::Activated | Hook::Deactivated => {
                matches!(self.state, Lifecycle::Error | Lifecycle::Fatal)
            }
            Hook::Reset => self.state == Lifecycle::Fatal,
            _ => false,
        };
        // A failure that was declared while the hook ran counts, unless the hook fails for good.
        if has_failed && result.as_ref().err().is_none_or(|failure| !failure.fatal) {
            return;
        }
        match (hook, result) {
            (
                Hook::Initialize | Hook::Startup | Hook::Activated | Hook::Reset,
                Err(Failure { reason, unavailable: true, .. }),
            ) if self.end.is_none() => self.handle_unavailable(hook, reason),
            (Hook::Initialize, Ok(())) => self.enter(Lifecycle::Initialized, None),
            (Hook::Activated, Ok(())) => self.handle_activated(),
            (Hook::Reset, Ok(())) => {
                self.enter(Lifecycle::Initialized, None);
                if self.end.is_none() {
                    self.hooks.push(Hook::Activated);
                }
            }
            (Hook::Initialize | Hook::Reset, Err(failure)) => self.handle_fatal(failure.reason),
            (Hook::Deactivated, Err(failure)) if self.end.is_none() => {
                self.enter(Lifecycle::Initialized, None);
                self.handle_failure(failure);
            }
            (Hook::Deactivated, result) => {
                self.enter(Lifecycle::Initialized, reason_of(hook, result));
            }
            (Hook::Aborting | Hook::Error, Err(failure)) if failure.fatal && self.end.is_none() => {
                self.handle_fatal(failure.reason);
            }
            (Hook::Finalize, result) => self.enter(Lifecycle::Finalized, reason_of(hook, result)),
            (_, Ok(())) => {}
            (Hook::Aborting | Hook::Error | Hook::Shutdown, result) => {
                self.enter(self.state, reason_of(hook, result));
            }
            (_, Err(failure)) => self.handle_failure(failure),
        }
    }

    /// The actuators are at rest.
    pub(crate) fn handle_settled(&mut self) {
        self.settled = true;
    }

    /// What runs was cut off: the incarnation ends here.
    pub(crate) fn handle_cut_off(&mut self, during: &str, within: Duration) {
        let reason = format!("{during} was cut off: it had not stopped within {within:?}");
        let is_at_work = self.state == Lifecycle::Active;
        let state = if is_at_work { Lifecycle::Initialized } else { self.state };
        self.enter(state, Some(reason));
    }

    /// Something that the hook needs is not there yet.
    fn handle_unavailable(&mut self, hook: Hook, reason: String) {
        let before = self.retried.filter(|retried| retried.hook == hook);
        let attempts = before.map_or(0, |retried| retried.attempts).saturating_add(1);
        self.retried = Some(Retried { hook, attempts, waits: true });
        // A caller that waited for the start, or the reset, waits for the start from now on.
        self.awaited = Some(Awaited::Start);
        self.reports
            .push_back(LifecycleReport::Child(ChildEvent::Unavailable { reason: reason.clone() }));
        // The first attempt was made at once; what it waits before the second is the first wait.
        let retry_in = UNAVAILABLE.delay(attempts.saturating_add(1), u64::from(attempts));
        self.reports.push_back(LifecycleReport::Unavailable { reason, retry_in });
    }

    /// The time has come to call the hook again; says whether that is still so.
    pub(crate) fn handle_retry(&mut self) -> bool {
        let waiting = self.retried.as_mut().filter(|retried| retried.waits);
        let Some(retried) = waiting else { return false };
        retried.waits = false;
        self.hooks.insert(0, retried.hook);
        true
    }

    fn handle_activated(&mut self) {
        self.retried = None;
        self.enter(Lifecycle::Active, None);
        if self.end.is_some() {
            self.hooks.insert(0, Hook::Deactivated);
            return;
        }
        match self.awaited.take() {
            Some(Awaited::Start) => {
                self.reports.push_back(LifecycleReport::Child(ChildEvent::Started))
            }
            Some(Awaited::Reset) => {
                self.reports.push_back(LifecycleReport::Child(ChildEvent::Reset))
            }
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
        let starts = self.is_starting();
        self.answer_failed(&failure.reason);
        self.retried = None;
        self.enter(Lifecycle::Error, Some(failure.reason));
        self.hooks = smallvec![Hook::Aborting, Hook::Error];
        if starts {
            // Its supervisor does not reset what did not come to work: another incarnation follows,
            // or none.
            self.hooks.extend([Hook::Shutdown, Hook::Finalize]);
            self.end = Some(EndReason::Fatal);
        }
    }

    /// This incarnation cannot go on.
    pub(crate) fn handle_fatal(&mut self, reason: String) {
        if self.end.is_some() {
            return;
        }
        self.answer_failed(&reason);
        self.retried = None;
        let aborting = self.state == Lifecycle::Active || self.hooks.contains(&Hook::Aborting);
        self.enter(Lifecycle::Fatal, Some(reason));
        self.hooks.clear();
        if aborting {
            self.hooks.push(Hook::Aborting);
        }
        self.hooks.push(Hook::Finalize);
        self.end = Some(EndReason::Fatal);
    }

    fn answer_failed(&mut self, reason: &str) {
        let reason = reason.to_owned();
        match self.awaited.take() {
            Some(Awaited::Start) => {
                self.start_failure = Some(reason);
                self.reports.push_back(LifecycleReport::Child(ChildEvent::FailsToStart));
            }
            Some(Awaited::Reset) => {
                self.reports.push_back(LifecycleReport::Child(ChildEvent::ResetFailed { reason }));
            }
            None => {}
        }
    }

    /// The incarnation is ordered to end.
    pub(crate) fn handle_stop(&mut self, order: StopOrder) {
        if self.ordered != Some(StopOrder::Stop) {
            self.ordered = Some(order);
        }
        self.start_failure = None;
        match self.end {
            Some(EndReason::Returned) => self.end = Some(EndReason::Stopped),
            // What has failed before it was stopped has failed.
            Some(EndReason::Stopped | EndReason::Fatal) => {}
            None => self.begin_end(EndReason::Stopped),
        }
    }

    /// The incarnation ends itself.
    pub(crate) fn handle_return(&mut self) {
        if self.end.is_none() {
            self.begin_end(EndReason::Returned);
        }
    }

    /// The incarnation is to end in order.
    fn begin_end(&mut self, end: EndReason) {
        self.end = Some(end);
        self.awaited = None;
        self.retried = None;
        self.hooks.retain(|hook| *hook == Hook::Aborting);
        match self.state {
            Lifecycle::Active => {
                self.hooks.extend([Hook::Deactivated, Hook::Shutdown, Hook::Finalize]);
            }
            Lifecycle::Initialized | Lifecycle::Error => {
                self.hooks.extend([Hook::Shutdown, Hook::Finalize]);
            }
            Lifecycle::Created | Lifecycle::Fatal => self.hooks.push(Hook::Finalize),
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
                self.hooks.push(Hook::Reset);
                self.awaited = Some(Awaited::Reset);
            }
            (Lifecycle::Active, None) => {
                self.reports.push_back(LifecycleReport::Child(ChildEvent::Reset))
            }
            (state, _) => {
                let reason = format!("it is {state}; only a component in error can be reset");
                self.reports.push_back(LifecycleReport::Child(ChildEvent::ResetFailed { reason }));
            }
        }
    }

    /// Leave work, or return to it. Without effect where the state does not allow it.
    pub(crate) fn handle_activate(&mut self, active: bool) {
        match (self.state, active, self.end) {
            (Lifecycle::Active, false, None) if !self.is_due(Hook::Deactivated) => {
                self.hooks.push(Hook::Deactivated);
            }
            (Lifecycle::Initialized, true, None)
                if self.hooks.is_empty()
                    && self.running != Some(Hook::Activated)
                    && self.retried.is_none() =>
            {
                self.hooks.push(Hook::Activated);
            }
            _ => {}
        }
    }

    /// The hook runs, or is to run.
    fn is_due(&self, hook: Hook) -> bool {
        self.running == Some(hook) || self.hooks.contains(&hook)
    }

    fn enter(&mut self, state: Lifecycle, reason: Option<String>) {
        self.state = state;
        self.settled = false;
        self.reports.push_back(LifecycleReport::State(state, reason));
    }
}

/// Why a hook that brings the component to rest has failed.
fn reason_of(hook: Hook, result: Result<(), Failure>) -> Option<String> {
    result.err().map(|failure| format!("{} failed: {}", hook.name(), failure.reason))
}

#[cfg(test)]
mod tests;
