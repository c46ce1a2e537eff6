//! What a life has to do beside messages: its rounds, its timers, its tasks, and two limits.
//!
//! All of it is polled by the pump, under the guard, and ends with the life. Rounds and timers become
//! due here and take their turn between messages; one that is due already is not made due again, so
//! that nothing stale piles up while the component is busy.

use super::life::{Action, Rhythm, Task, TimerId};
use crate::component::Component;
use crate::platform;
use futures_util::stream::{FuturesUnordered, Stream};
use std::collections::VecDeque;
use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::time::{Instant, Interval, MissedTickBehavior, Sleep};

/// Tasks of one component at one time. Who has more has lost count of them.
const TASKS: usize = 1024;
/// Wake-ups handled in one poll; then the rest of the arbiter has its turn.
const BUDGET: usize = 64;

/// Something that is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Chore {
    Execute,
    Timer(TimerId),
    /// The life should have begun by now.
    ReadyLimit,
    /// It should have ended by now.
    StopLimit,
    /// What was not there yet may be there now.
    Retry,
}

/// What a future of this list came to.
enum Woken {
    Task,
    Due(Chore),
    /// And it will be again.
    Tick(Chore, Interval),
}

struct Timer<C: Component> {
    id: TimerId,
    repeats: bool,
    /// Lifted out while it runs.
    action: Option<Action<C>>,
}

pub(crate) struct Chores<C: Component> {
    futures: FuturesUnordered<Pin<Box<dyn Future<Output = Woken>>>>,
    tasks: usize,
    timers: Vec<Timer<C>>,
    /// At most one entry per timer, and one for the round.
    due: VecDeque<Chore>,
    /// Limits that count now; each at most once.
    limits: Vec<(Chore, Pin<Box<Sleep>>)>,
    /// Limits that were reached and have not been asked for yet.
    reached: Vec<Chore>,
    interval: Option<Duration>,
    active: bool,
    /// A ticker for rounds is on its way.
    ticking: bool,
    /// Something was started and has not been polled yet.
    fresh: bool,
}

impl<C: Component> Default for Chores<C> {
    fn default() -> Self {
        Chores {
            futures: FuturesUnordered::new(),
            tasks: 0,
            timers: Vec::new(),
            due: VecDeque::new(),
            limits: Vec::new(),
            reached: Vec::new(),
            interval: None,
            active: false,
            ticking: false,
            fresh: false,
        }
    }
}

/// The instant that lies so far ahead.
fn after(span: Duration) -> Instant {
    platform::timer_at(platform::now() + span)
}

fn ticker(first: Instant, interval: Duration) -> Interval {
    // A timer of no interval would keep the arbiter for itself.
    let mut ticker = tokio::time::interval_at(first, interval.max(Duration::from_micros(1)));
    ticker.set_missed_tick_behavior(MissedTickBehavior::Skip);
    ticker
}

async fn tick(chore: Chore, mut ticker: Interval) -> Woken {
    ticker.tick().await;
    Woken::Tick(chore, ticker)
}

impl<C: Component> Chores<C> {
    /// For a life that begins, with rounds at this interval.
    pub(crate) fn begin(&mut self, interval: Option<Duration>) {
        *self = Chores { interval, ..Chores::default() };
    }

    #[inline]
    pub(crate) fn is_empty(&self) -> bool {
        self.futures.is_empty() && self.limits.is_empty()
    }

    /// Something was started and has not been polled yet.
    #[inline]
    pub(crate) fn is_fresh(&self) -> bool {
        self.fresh
    }

    pub(crate) fn set_active(&mut self, active: bool) {
        self.active = active;
        self.start_rounds();
    }

    pub(crate) fn set_interval(&mut self, interval: Option<Duration>) {
        self.interval = interval;
        // The old ticker, if any, sees at its next tick that it has been replaced.
        self.ticking = false;
        self.start_rounds();
    }

    fn start_rounds(&mut self) {
        if let (true, false, Some(interval)) = (self.active, self.ticking, self.interval) {
            self.ticking = true;
            self.push(tick(Chore::Execute, ticker(after(Duration::ZERO), interval)));
        }
    }

    fn push(&mut self, future: impl Future<Output = Woken> + 'static) {
        self.fresh = true;
        self.futures.push(Box::pin(future));
    }

    /// Takes on what the component has started.
    pub(crate) fn take_on(
        &mut self,
        tasks: Vec<Task>,
        timers: Vec<(TimerId, Rhythm, Action<C>)>,
        cancelled: &[TimerId],
    ) {
        for task in tasks {
            assert!(self.tasks < TASKS, "the component holds {TASKS} tasks and starts yet another");
            self.tasks += 1;
            self.push(async move {
                task.await;
                Woken::Task
            });
        }
        for (id, rhythm, action) in timers {
            let repeats = match rhythm {
                Rhythm::Once(delay) => {
                    let until = after(delay);
                    self.push(async move {
                        tokio::time::sleep_until(until).await;
                        Woken::Due(Chore::Timer(id))
                    });
                    false
                }
                Rhythm::Every(interval) => {
                    self.push(tick(Chore::Timer(id), ticker(after(interval), interval)));
                    true
                }
            };
            self.timers.push(Timer { id, repeats, action: Some(action) });
        }
        self.timers.retain(|timer| !cancelled.contains(&timer.id));
    }

    /// Sets one of the limits. One that is set already stays as it is.
    pub(crate) fn limit(&mut self, limit: Chore, within: Duration) {
        if self.limits.iter().all(|(set, _)| *set != limit) {
            self.fresh = true;
            self.limits.push((limit, Box::pin(tokio::time::sleep_until(after(within)))));
        }
    }

    pub(crate) fn cancel_limit(&mut self, limit: Chore) {
        self.limits.retain(|(set, _)| *set != limit);
        self.reached.retain(|reached| *reached != limit);
    }

    /// Says whether this limit has been reached, once.
    pub(crate) fn take_limit(&mut self, limit: Chore) -> bool {
        let before = self.reached.len();
        self.reached.retain(|reached| *reached != limit);
        self.reached.len() < before
    }

    /// Polls what was started. A panic in it is the component's.
    pub(crate) fn poll(&mut self, cx: &mut Context<'_>) {
        let reached = self.limits.extract_if(.., |(_, sleep)| sleep.as_mut().poll(cx).is_ready());
        self.reached.extend(reached.map(|(limit, _)| limit));
        for _ in 0..BUDGET {
            match Pin::new(&mut self.futures).poll_next(cx) {
                Poll::Ready(Some(woken)) => self.handle(woken),
                Poll::Ready(None) | Poll::Pending => {
                    self.fresh = false;
                    return;
                }
            }
        }
        self.fresh = false;
        cx.waker().wake_by_ref();
    }

    fn handle(&mut self, woken: Woken) {
        match woken {
            Woken::Task => self.tasks -= 1,
            Woken::Due(chore) => self.make_due(chore),
            Woken::Tick(Chore::Execute, ticker) => {
                if !self.active || self.interval != Some(ticker.period()) {
                    self.ticking &= self.active;
                    return;
                }
                self.make_due(Chore::Execute);
                self.push(tick(Chore::Execute, ticker));
            }
            Woken::Tick(chore @ Chore::Timer(id), ticker) => {
                if self.timers.iter().any(|timer| timer.id == id) {
                    self.make_due(chore);
                    self.push(tick(chore, ticker));
                }
            }
            Woken::Tick(..) => {}
        }
    }

    fn make_due(&mut self, chore: Chore) {
        if !self.due.contains(&chore) {
            self.due.push_back(chore);
        }
    }

    /// What is due first.
    #[inline]
    pub(crate) fn next_due(&mut self) -> Option<Chore> {
        self.due.pop_front()
    }

    /// The timer's action, to be run, unless it was cancelled.
    pub(crate) fn lift(&mut self, id: TimerId) -> Option<Action<C>> {
        self.timers.iter_mut().find(|timer| timer.id == id)?.action.take()
    }

    /// After it was run.
    pub(crate) fn put_back(&mut self, id: TimerId, action: Action<C>) {
        let Some(at) = self.timers.iter().position(|timer| timer.id == id) else { return };
        if self.timers[at].repeats {
            self.timers[at].action = Some(action);
        } else {
            self.timers.swap_remove(at);
        }
    }

    /// Ends everything, and hands it out to be dropped under a guard.
    pub(crate) fn clear(&mut self) -> Self {
        std::mem::take(self)
    }
}
