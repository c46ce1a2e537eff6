//! What an incarnation has to do beside messages: its rounds, its timers, its tasks, and two
//! limits.
//!
//! All of it is polled by the executor, under the guard, and ends with the incarnation. Everything
//! that has a time stands in one schedule, of which one alarm waits for the earliest entry: a timer
//! costs its closure, which it frees as soon as it is cancelled, and an entry.
//!
//! Rounds and timers become due here and take their turn between messages; one that is due already
//! is not made due again, so that nothing stale piles up while the component is busy. Rounds are due
//! at whole intervals after the first: each of these instants is that of a round which takes its
//! turn, or is counted as missed.

use crate::arbiter::turn_budget::TurnBudget;
use crate::component::Component;
use crate::component::incarnation::{
    ComponentFuture, ScheduleEntry, TimerAction, TimerId, TimerMode, TimerTable,
};
use crate::platform;
use crate::platform::alarm::ScheduleAlarm;
use blastema_core::Instant;
use blastema_core::sorted::SortedMap;
use futures_util::stream::{FuturesUnordered, Stream};
use std::collections::VecDeque;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll};
use std::time::Duration;

/// Tasks of one component at one time. A component with more has lost count of them.
const TASKS: usize = 1024;
/// Tasks that may end in one poll; then the rest of the arbiter has its turn.
const BUDGET: usize = 64;
/// Ticks that are no later than this are made up for, so that the runtime's clock, which rounds up
/// to whole milliseconds, costs a fast rhythm none of them.
const LATE: Duration = Duration::from_millis(5);
/// The runtime's clock is no finer. Ticks of a faster rhythm are never made up for.
const FINEST: Duration = Duration::from_millis(1);
/// A timer of no interval would keep the arbiter for itself.
const SHORTEST: Duration = Duration::from_micros(1);

/// Something that is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DueWork {
    /// A round, which is due since then.
    Execute(Instant),
    Timer(TimerId),
    /// The incarnation should have begun by now.
    ReadyLimit,
    /// It should have ended by now.
    StopLimit,
    /// It should have settled by now.
    SettleLimit,
    /// What was not there yet may be there now.
    Retry,
}

/// A task of the component's own; it waits while the turn is over.
struct Spawned {
    task: ComponentFuture,
    budget: Rc<TurnBudget>,
}

impl Future for Spawned {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        if self.budget.is_spent() {
            cx.waker().wake_by_ref();
            return Poll::Pending;
        }
        let polled = self.task.as_mut().poll(cx);
        self.budget.lasts();
        polled
    }
}

pub(crate) struct ScheduledWork<C: Component> {
    interval: Option<Duration>,
    /// The component has its thread to itself, where its alarm may be exact.
    is_precise: bool,
    active: bool,
    /// Something was started and has not been polled yet.
    fresh: bool,
    /// The last step went to a round or a timer, and the next one goes to a message.
    message_next: bool,
    /// The last turn went to the tasks, and the next one goes to the next step.
    step_first: bool,
    /// There only while it holds something: most components wait for messages and nothing else.
    work: Option<Box<Work>>,
    /// Shared with the code that sets them, once it has set one.
    timers: Option<Rc<TimerTable<C>>>,
}

/// What is planned, due and under way.
#[derive(Default)]
struct Work {
    /// There only where the component has started a task.
    tasks: Option<FuturesUnordered<Spawned>>,
    schedule: SortedMap<ScheduleEntry, DueWork>,
    /// Numbers the entries.
    next_entry: u64,
    /// Waits for the earliest entry.
    alarm: Option<ScheduleAlarm>,
    /// At most one entry per timer, and one for the round.
    due: VecDeque<DueWork>,
    /// Limits that were reached and have not been asked for yet.
    reached: Vec<DueWork>,
    /// The entry of the next round.
    round: Option<ScheduleEntry>,
    /// When the last round was to be, since the component is active.
    last_round: Option<Instant>,
    /// Rounds that were missed, and have not been asked for yet.
    missed: u64,
}

impl<C: Component> Default for ScheduledWork<C> {
    fn default() -> Self {
        ScheduledWork {
            interval: None,
            is_precise: false,
            active: false,
            fresh: false,
            message_next: false,
            step_first: false,
            work: None,
            timers: None,
        }
    }
}

/// The latest of the ticks that are due now, beginning with `due`, and how many are before it.
fn latest_tick(due: Instant, every: Duration, now: Instant) -> (Instant, u32) {
    let ticks = (now - due).as_nanos() / every.as_nanos();
    let ticks = u32::try_from(ticks).unwrap_or(u32::MAX);
    (due + every * ticks, ticks)
}

/// The tick of a timer after the one of `due`, which is run now, and how many are missed between.
fn next_tick(due: Instant, every: Duration, now: Instant) -> (Instant, u32) {
    let every = every.max(SHORTEST);
    if now - due <= LATE && every >= FINEST {
        return (due + every, 0);
    }
    let (latest, missed) = latest_tick(due, every, now);
    (latest + every, missed)
}

impl<C: Component> ScheduledWork<C> {
    /// For an incarnation that begins, with rounds at this interval, perhaps on a thread of its own.
    pub(crate) fn begin(&mut self, interval: Option<Duration>, is_precise: bool) {
        *self = ScheduledWork { interval, is_precise, ..ScheduledWork::default() };
    }

    #[inline]
    pub(crate) fn is_empty(&self) -> bool {
        self.work.as_ref().is_none_or(|work| !work.has_tasks() && work.schedule.is_empty())
    }

    /// Something was started and has not been polled yet.
    #[inline]
    pub(crate) fn is_fresh(&self) -> bool {
        self.fresh
    }

    pub(crate) fn set_active(&mut self, active: bool) {
        if self.active == active {
            return;
        }
        self.active = active;
        if let Some(work) = &mut self.work {
            work.last_round = None;
            work.due.retain(|work| !matches!(work, DueWork::Execute(_)));
        }
        self.plan_round();
    }

    /// The next round comes so long after the last one, or at once.
    pub(crate) fn set_interval(&mut self, interval: Option<Duration>) {
        if self.interval != interval {
            self.interval = interval;
            self.plan_round();
        }
    }

    fn plan_round(&mut self) {
        if let Some(work) = &mut self.work
            && let Some(entry) = work.round.take()
        {
            work.schedule.remove(&entry);
        }
        if let (true, Some(interval)) = (self.active, self.interval) {
            let now = platform::now();
            let work = self.planned();
            let at = work.last_round.map_or(now, |last| (last + interval).max(now));
            work.round = Some(work.enter(at, DueWork::Execute(at)));
        }
        self.tidy();
    }

    /// To have something entered.
    fn planned(&mut self) -> &mut Work {
        self.fresh = true;
        self.work.get_or_insert_default()
    }

    /// Gives back what is not needed while nothing is planned.
    fn tidy(&mut self) {
        let Some(work) = &mut self.work else { return };
        if !work.schedule.is_empty() {
            return;
        }
        work.alarm = None;
        let is_idle = work.due.is_empty() && work.reached.is_empty();
        if is_idle && !work.has_tasks() && self.interval.is_none() {
            self.work = None;
        }
    }

    /// Takes on what the component has started, and ends what it has cancelled.
    pub(crate) fn take_on(
        &mut self,
        tasks: Vec<ComponentFuture>,
        cancelled: &[Option<ScheduleEntry>],
        timers: Option<&Rc<TimerTable<C>>>,
        budget: &Rc<TurnBudget>,
    ) {
        for task in tasks {
            let tasks = self.planned().tasks.get_or_insert_default();
            let held = tasks.len();
            assert!(held < TASKS, "the component holds {TASKS} tasks and starts yet another");
            tasks.push(Spawned { task, budget: budget.clone() });
        }
        if let Some(timers) = timers {
            self.timers = Some(timers.clone());
            self.take_on_timers(cancelled, timers);
        }
        self.tidy();
    }

    fn take_on_timers(&mut self, cancelled: &[Option<ScheduleEntry>], timers: &TimerTable<C>) {
        if let Some(work) = &mut self.work {
            work.forget_cancelled(cancelled, timers);
        }
        let now = platform::now();
        for id in timers.take_new() {
            let mode = timers.active.borrow().get(&id.0).map(|timer| timer.mode);
            let Some(TimerMode::Once(delay) | TimerMode::Every(delay)) = mode else { continue };
            let entry = self.planned().enter(now + delay, DueWork::Timer(id));
            if let Some(timer) = timers.active.borrow_mut().get_mut(&id.0) {
                timer.entry = Some(entry);
            }
        }
    }

    /// Sets one of the limits. One that is set already stays as it is.
    pub(crate) fn limit(&mut self, limit: DueWork, within: Duration) {
        let work = self.planned();
        if work.schedule.values().all(|set| *set != limit) {
            work.enter(platform::now() + within, limit);
        }
    }

    pub(crate) fn cancel_limit(&mut self, limit: DueWork) {
        if let Some(work) = &mut self.work {
            work.schedule.retain(|_, set| *set != limit);
            work.reached.retain(|reached| *reached != limit);
        }
        self.tidy();
    }

    /// Says whether this limit has been reached, once.
    pub(crate) fn take_limit(&mut self, limit: DueWork) -> bool {
        let Some(work) = &mut self.work else { return false };
        let before = work.reached.len();
        work.reached.retain(|reached| *reached != limit);
        work.reached.len() < before
    }

    /// Polls what was started. A panic in it is the component's.
    pub(crate) fn poll(&mut self, cx: &mut Context<'_>) {
        self.fresh = false;
        let Some(work) = &mut self.work else { return };
        work.poll_schedule(self.interval, self.is_precise, self.timers.as_deref(), cx);
        work.poll_tasks(cx);
    }

    /// How many rounds have been missed since this was asked last.
    pub(crate) fn take_missed(&mut self) -> u64 {
        self.work.as_mut().map_or(0, |work| std::mem::take(&mut work.missed))
    }

    /// What is due first, unless it is a message's turn: one follows each round and timer, so that
    /// those which are late all the time leave capacity.
    #[inline]
    pub(crate) fn next_in_turn(&mut self) -> Option<DueWork> {
        if std::mem::take(&mut self.message_next) {
            return None;
        }
        let due = self.next_due();
        self.message_next = due.is_some();
        due
    }

    /// Whether the turn that begins now begins with the tasks.
    pub(crate) fn has_tasks_first(&mut self) -> bool {
        !std::mem::take(&mut self.step_first)
    }

    /// The tasks were polled. If that has used the turn up, the next one does not begin with them.
    pub(crate) fn end_poll(&mut self, is_spent: bool) {
        self.step_first = is_spent;
    }

    /// What is due first.
    #[inline]
    pub(crate) fn next_due(&mut self) -> Option<DueWork> {
        self.work.as_mut()?.due.pop_front()
    }

    /// The timer's action, to be run now, and how many of its ticks have been missed since the last
    /// one. One that is repeated is entered again here, and not when it falls due: what cannot be
    /// kept costs nothing but the calls that are made.
    pub(crate) fn lift(&mut self, id: TimerId) -> Option<(TimerAction<C>, u32)> {
        let mut active = self.timers.as_ref()?.active.borrow_mut();
        let timer = active.get_mut(&id.0)?;
        let mut missed = 0;
        if let (TimerMode::Every(every), Some(at)) = (timer.mode, timer.due.take()) {
            let next;
            (next, missed) = next_tick(at, every, platform::now());
            let entry = self.work.as_mut()?.enter(next, DueWork::Timer(id));
            timer.entry = Some(entry);
            self.fresh = true;
        }
        Some((timer.action.take()?, missed))
    }

    /// After it was run. What was cancelled meanwhile, or is not to run again, ends.
    pub(crate) fn put_back(&mut self, id: TimerId, action: TimerAction<C>) {
        let Some(timers) = &self.timers else { return };
        let mut active = timers.active.borrow_mut();
        match active.get_mut(&id.0) {
            Some(timer) if matches!(timer.mode, TimerMode::Every(_)) => {
                timer.action = Some(action);
                return;
            }
            _ => drop(active.remove(&id.0)),
        }
        drop(active);
        self.tidy();
    }

    /// Ends everything, and hands out what is the user's, to be dropped one by one under a guard.
    pub(crate) fn clear(&mut self) -> (Vec<ComponentFuture>, Vec<TimerAction<C>>) {
        let ScheduledWork { work, timers, .. } = std::mem::take(self);
        let tasks = work.and_then(|work| work.tasks).into_iter().flatten();
        let tasks = tasks.map(|spawned| spawned.task);
        let timers = timers.into_iter().flat_map(|timers| timers.active.take().into_values());
        let actions = timers.filter_map(|timer| timer.action);
        (tasks.collect(), actions.collect())
    }
}

impl Work {
    fn has_tasks(&self) -> bool {
        self.tasks.as_ref().is_some_and(|tasks| !tasks.is_empty())
    }

    fn enter(&mut self, at: Instant, work: DueWork) -> ScheduleEntry {
        self.next_entry += 1;
        let entry = (at, self.next_entry);
        self.schedule.insert(entry, work);
        entry
    }

    fn forget_cancelled<C: Component>(
        &mut self,
        cancelled: &[Option<ScheduleEntry>],
        timers: &TimerTable<C>,
    ) {
        if cancelled.is_empty() {
            return;
        }
        for entry in cancelled.iter().flatten() {
            self.schedule.remove(entry);
        }
        let active = timers.active.borrow();
        let is_over = |id: &TimerId| !active.contains_key(&id.0);
        self.due.retain(|work| !matches!(work, DueWork::Timer(id) if is_over(id)));
    }

    fn poll_tasks(&mut self, cx: &mut Context<'_>) {
        let Some(tasks) = &mut self.tasks else { return };
        for _ in 0..BUDGET {
            if !matches!(Pin::new(&mut *tasks).poll_next(cx), Poll::Ready(Some(()))) {
                return;
            }
        }
        cx.waker().wake_by_ref();
    }

    /// Makes due what is, until everything lies ahead.
    fn poll_schedule<C: Component>(
        &mut self,
        interval: Option<Duration>,
        is_precise: bool,
        timers: Option<&TimerTable<C>>,
        cx: &mut Context<'_>,
    ) {
        while let Some((&(earliest, _), _)) = self.schedule.first_key_value() {
            let alarm = self.alarm.get_or_insert_with(|| ScheduleAlarm::new(is_precise));
            if alarm.poll_until(earliest, cx).is_pending() {
                return;
            }
            let now = platform::now().max(earliest);
            while let Some(((at, _), work)) = self.schedule.pop_first_if(|(at, _)| *at <= now) {
                self.fall_due(work, at, now, interval, timers);
            }
        }
        self.alarm = None;
    }

    fn fall_due<C: Component>(
        &mut self,
        mut work: DueWork,
        at: Instant,
        now: Instant,
        interval: Option<Duration>,
        timers: Option<&TimerTable<C>>,
    ) {
        match work {
            DueWork::Execute(_) => {
                let Some(interval) = interval.map(|interval| interval.max(SHORTEST)) else {
                    return;
                };
                let (latest, missed) = latest_tick(at, interval, now);
                self.last_round = Some(latest);
                let next = latest + interval;
                self.round = Some(self.enter(next, DueWork::Execute(next)));
                self.missed += u64::from(missed);
                let mut due = self.due.iter_mut();
                if let Some(waits) = due.find(|due| matches!(due, DueWork::Execute(_))) {
                    *waits = DueWork::Execute(latest);
                    self.missed += 1;
                    return;
                }
                work = DueWork::Execute(latest);
            }
            DueWork::Timer(id) => {
                let Some(timers) = timers else { return };
                let mut active = timers.active.borrow_mut();
                let Some(timer) = active.get_mut(&id.0) else { return };
                (timer.entry, timer.due) = (None, Some(at));
            }
            DueWork::ReadyLimit | DueWork::StopLimit | DueWork::SettleLimit | DueWork::Retry => {
                return self.reached.push(work);
            }
        }
        self.due.push_back(work);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(micros: u64) -> Instant {
        Instant::from_nanos(micros * 1000)
    }

    #[test]
    fn a_tick_follows_the_one_before_it_and_those_that_were_missed_are_skipped() {
        let ms = Duration::from_millis;
        for (every, now, next) in [
            (ms(10), 0, (10_000, 0)),
            (ms(10), 3_000, (10_000, 0)),
            // Late, but not by more than is made up for.
            (ms(1), 1_500, (1_000, 0)),
            (ms(10), 10_000, (20_000, 1)),
            (ms(10), 25_000, (30_000, 2)),
            (ms(10), 30_000, (40_000, 3)),
            // Faster than the clock.
            (Duration::from_micros(100), 1_050, (1_100, 10)),
            (Duration::ZERO, 1_000, (1_001, 1000)),
        ] {
            let next = (at(next.0), next.1);
            assert_eq!(next_tick(at(0), every, at(now)), next, "{every:?} seen at {now}");
        }
    }

    #[test]
    fn each_period_is_that_of_a_round_which_takes_its_turn_or_is_counted_as_missed() {
        let (period, mut work) = (Duration::from_micros(100), Work::default());
        work.round = Some(work.enter(at(0), DueWork::Execute(at(0))));
        let (mut rounds, mut missed) = (0, 0);
        // When the schedule is polled, and whether the round that is due then takes its turn.
        for (now, runs, due) in [
            (0, true, Some(0)),
            (100, true, Some(100)),
            (199, true, None),
            // Late by less than a period, and by more.
            (299, true, Some(200)),
            (555, true, Some(500)),
            // It waits behind another handler: the one after it takes its turn.
            (610, false, None),
            (700, true, Some(700)),
            (1_000_000, false, None),
            (1_000_350, true, Some(1_000_300)),
        ] {
            while let Some(((due, _), round)) =
                work.schedule.pop_first_if(|(due, _)| *due <= at(now))
            {
                work.fall_due::<NoTimers>(round, due, at(now), Some(period), None);
            }
            missed += std::mem::take(&mut work.missed);
            let round = if runs { work.due.pop_front() } else { None };
            assert_eq!(round, due.map(|due| DueWork::Execute(at(due))), "at {now}");
            if let Some(DueWork::Execute(due)) = round {
                let periods = due.as_nanos() / 100_000;
                assert_eq!(rounds + missed, periods, "at {now}");
                rounds += 1;
            }
        }
    }

    struct NoTimers;
    impl Component for NoTimers {}
}
