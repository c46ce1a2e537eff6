//! How long a component or a hub may keep its arbiter's thread before the others have their turn.
//!
//! A task of tokio's `LocalSet` that wakes itself is polled up to 61 times before the runtime looks
//! at timers, sockets and other threads. A turn that took too long therefore ends with a rest: the
//! task is woken through the scheduler, as [`tokio::task::yield_now`] does it, after every ready
//! neighbour and the driver; what else wakes it before that does not end the rest. Between two
//! handlers that take long, each neighbour, due timer and control message has its turn.
//!
//! Batches of quick messages must not pay for that. Two clocks tell the one from the other: after
//! each handler the kernel's coarse clock is read, which costs a few nanoseconds and ticks every 1
//! to 10 ms. Once it has ticked within a turn, turns are measured by the exact clock until one of
//! them is short. No handler takes any time on a clock that a test has paused.

use crate::platform;
use blastema_core::Instant;
use std::cell::{Cell, RefCell};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::task::{Context, Wake, Waker};
use std::time::Duration;

/// A turn that is measured ends when it took longer than this: a hundred times what the switch to
/// another task costs.
const TURN_SPAN: Duration = Duration::from_micros(200);

/// The time that one task of an arbiter has taken, and may take, in one turn.
pub(crate) struct TurnBudget {
    /// What the coarse clock said when the turn began.
    tick: Cell<u64>,
    /// When the turn began, where it is measured.
    began: Cell<Instant>,
    /// A turn took long; the next ones are measured.
    measured: Cell<bool>,
    /// This turn took long.
    spent: Cell<bool>,
    /// The next turn goes on where this one ended.
    continued: Cell<bool>,
    rest: RefCell<Option<Arc<Rest>>>,
}

/// The time between two turns. Over when the scheduler says so.
struct Rest {
    over: AtomicBool,
    waker: Waker,
}

impl Wake for Rest {
    fn wake(self: Arc<Self>) {
        self.over.store(true, Relaxed);
        self.waker.wake_by_ref();
    }
}

impl Default for TurnBudget {
    fn default() -> Self {
        TurnBudget {
            tick: Cell::new(0),
            began: Cell::new(Instant::ORIGIN),
            measured: Cell::new(false),
            spent: Cell::new(false),
            continued: Cell::new(false),
            rest: RefCell::new(None),
        }
    }
}

impl TurnBudget {
    /// A turn begins.
    #[inline]
    pub(crate) fn begin(&self) {
        self.spent.set(false);
        if self.measured.get() {
            self.began.set(platform::now());
        } else if !self.continued.replace(false) {
            self.tick.set(platform::tick());
        }
    }

    /// A handler has returned. Says whether another one may follow in this turn.
    #[inline]
    pub(crate) fn lasts(&self) -> bool {
        if self.measured.get() {
            let spent = self.spent.get() || platform::now() - self.began.get() > TURN_SPAN;
            self.spent.set(spent);
            return !spent;
        }
        let tick = platform::tick();
        tick == self.tick.get() || self.lasts_beyond(tick)
    }

    #[cold]
    fn lasts_beyond(&self, tick: u64) -> bool {
        if platform::clock_stands() {
            self.tick.set(tick);
            return true;
        }
        self.distrust();
        false
    }

    /// This turn took long.
    fn distrust(&self) {
        self.spent.set(true);
        self.measured.set(true);
    }

    #[inline]
    pub(crate) fn is_spent(&self) -> bool {
        self.spent.get()
    }

    /// The turn ends. Where it took long, a rest follows.
    #[inline]
    pub(crate) fn end(&self, waker: &Waker) {
        if self.spent.get() {
            self.rest(waker);
        } else if self.measured.replace(false) {
            // It was short. The coarse clock counts from the next turn on.
            self.continued.set(false);
        }
    }

    /// The turn ends though there is more to do, because it took many messages, but not long.
    /// Others that are ready have their turn.
    pub(crate) fn pause(&self, waker: &Waker) {
        self.continued.set(true);
        waker.wake_by_ref();
    }

    /// A handler took long, as its caller has measured.
    pub(crate) fn overdraw(&self, waker: &Waker) {
        self.distrust();
        self.rest(waker);
    }

    #[cold]
    fn rest(&self, waker: &Waker) {
        if self.is_resting() {
            return;
        }
        let rest = Arc::new(Rest { over: AtomicBool::new(false), waker: waker.clone() });
        self.rest.replace(Some(rest.clone()));
        self.continued.set(false);
        // Its first poll leaves the waker with the scheduler; there is no second.
        let after = Waker::from(rest);
        let _ = pin!(tokio::task::yield_now()).poll(&mut Context::from_waker(&after));
    }

    /// The others have not had their turn yet.
    #[inline]
    pub(crate) fn is_resting(&self) -> bool {
        self.rest.borrow().as_ref().is_some_and(|rest| !rest.over.load(Relaxed))
    }

    /// No handler took long of late.
    #[inline]
    pub(crate) fn is_trusted(&self) -> bool {
        !self.measured.get()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;
    use std::future::poll_fn;
    use std::rc::Rc;
    use std::task::Poll;

    /// Keeps the thread busy for so long.
    fn burn(span: Duration) {
        let start = std::time::Instant::now();
        while start.elapsed() < span {
            std::hint::spin_loop();
        }
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn no_handler_takes_long_on_a_paused_clock() {
        let budget = TurnBudget::default();
        budget.begin();
        burn(Duration::from_millis(30));
        assert!(budget.lasts() && budget.is_trusted());
    }

    /// On real threads.
    mod real {
        use super::*;

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn quick_messages_after_a_long_handler_are_trusted_again_in_turns_that_go_on() {
            let budget = TurnBudget::default();
            budget.begin();
            burn(Duration::from_millis(30));
            assert!(!budget.lasts());
            budget.end(Waker::noop());
            tokio::task::yield_now().await;

            budget.begin();
            assert!(budget.lasts(), "it is measured, and short");
            budget.pause(Waker::noop());
            budget.end(Waker::noop());
            assert!(budget.is_trusted());

            budget.begin();
            assert!(budget.lasts(), "the coarse clock counts from here on");
        }

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn one_long_handler_ends_the_turn_and_the_following_turns_are_measured() {
            let budget = TurnBudget::default();
            budget.begin();
            burn(Duration::from_millis(30));
            assert!(!budget.lasts(), "after one handler of 30 ms");
            budget.end(Waker::noop());
            assert!(budget.is_resting() && !budget.is_trusted());

            tokio::task::yield_now().await;
            assert!(!budget.is_resting());
            budget.begin();
            burn(Duration::from_millis(1));
            assert!(!budget.lasts(), "after one handler of 1 ms");
        }

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn a_measured_turn_that_is_short_is_trusted_again() {
            let budget = TurnBudget::default();
            budget.overdraw(Waker::noop());
            tokio::task::yield_now().await;
            // A busy machine may stretch any turn.
            for _ in 0..10_000 {
                budget.begin();
                budget.lasts();
                budget.end(Waker::noop());
                if budget.is_trusted() {
                    return;
                }
                tokio::task::yield_now().await;
            }
            panic!("never short");
        }

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn a_rest_ends_after_due_timers_and_not_by_another_wake() {
            let budget = Rc::new(TurnBudget::default());
            let turns = Rc::new(Cell::new(0));
            let (rested, counted) = (budget.clone(), turns.clone());
            let busy = actix_rt::spawn(poll_fn(move |cx| {
                if rested.is_resting() {
                    cx.waker().wake_by_ref(); // As a neighbour would that sends to it all the time.
                    return Poll::<()>::Pending;
                }
                rested.begin();
                burn(Duration::from_millis(12));
                rested.lasts();
                rested.end(cx.waker());
                cx.waker().wake_by_ref();
                counted.set(counted.get() + 1);
                Poll::Pending
            }));
            tokio::task::yield_now().await;
            for _ in 0..5 {
                let before = turns.get();
                tokio::time::sleep(Duration::from_millis(1)).await;
                assert!(turns.get() - before <= 2, "one that was under way, and one more");
            }
            busy.abort();
        }
    }
}
