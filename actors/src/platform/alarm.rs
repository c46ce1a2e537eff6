//! Wakes a task at an instant.

use super::timer_at;
use blastema_core::Instant;
use rustix::time::{self, Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec};
use std::os::fd::OwnedFd;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::unix::AsyncFd;
use tokio::time::Sleep;

/// Waits until an instant, which may differ from poll to poll.
#[derive(Debug)]
pub(crate) struct ScheduleAlarm {
    timer: AlarmTimer,
    /// What the timer is set for, unless that has come.
    set_for: Option<Instant>,
}

#[derive(Debug)]
enum AlarmTimer {
    /// The runtime's: whole milliseconds, by the clock that a test may have paused.
    Runtime(Pin<Box<Sleep>>),
    /// The kernel's (timerfd_create(2)): nanoseconds, by the system's clock.
    Kernel(AsyncFd<OwnedFd>),
}

impl ScheduleAlarm {
    /// A precise one has a timer of the kernel, where the system offers that: a file descriptor, and
    /// two system calls each time.
    pub(crate) fn new(is_precise: bool) -> Self {
        let timer = if is_precise { AlarmTimer::precise() } else { AlarmTimer::of_the_runtime() };
        ScheduleAlarm { timer, set_for: None }
    }

    /// Ready when this instant has come.
    pub(crate) fn poll_until(&mut self, at: Instant, cx: &mut Context<'_>) -> Poll<()> {
        if self.set_for != Some(at) {
            self.timer.set(at);
            self.set_for = Some(at);
        }
        let polled = self.timer.poll(cx);
        if polled.is_ready() {
            self.set_for = None;
        }
        polled
    }
}

impl AlarmTimer {
    fn of_the_runtime() -> Self {
        AlarmTimer::Runtime(Box::pin(tokio::time::sleep(Duration::ZERO)))
    }

    fn precise() -> Self {
        kernel_timer().map(AlarmTimer::Kernel).unwrap_or_else(|error| {
            tracing::warn!("rounds and timers are kept to the millisecond only: {error}");
            AlarmTimer::of_the_runtime()
        })
    }

    fn set(&mut self, at: Instant) {
        match self {
            AlarmTimer::Runtime(sleep) => sleep.as_mut().reset(timer_at(at)),
            AlarmTimer::Kernel(timer) => {
                const SECOND: u64 = 1_000_000_000;
                // Zero would disarm it.
                let nanos = at.as_nanos().max(1);
                let it_value = Timespec {
                    tv_sec: (nanos / SECOND).cast_signed(),
                    tv_nsec: (nanos % SECOND).cast_signed(),
                };
                let it_interval = Timespec { tv_sec: 0, tv_nsec: 0 };
                let once = Itimerspec { it_interval, it_value };
                time::timerfd_settime(timer.get_ref(), TimerfdTimerFlags::ABSTIME, &once)
                    .expect("the kernel takes every instant of its clock");
            }
        }
    }

    /// Ready once for each time that it is set.
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        match self {
            AlarmTimer::Runtime(sleep) => sleep.as_mut().poll(cx),
            AlarmTimer::Kernel(timer) => loop {
                // An error means that the runtime ends.
                let Poll::Ready(Ok(mut ready)) = timer.poll_read_ready(cx) else {
                    return Poll::Pending;
                };
                // There is nothing to read where the timer was set again after it had expired.
                let expirations = ready.try_io(|timer| Ok(rustix::io::read(timer, &mut [0; 8])?));
                if expirations.is_ok() {
                    ready.clear_ready();
                    return Poll::Ready(());
                }
            },
        }
    }
}

#[expect(
    deprecated,
    reason = "its successor is unsafe for files that are closed early; an OwnedFd is not"
)]
fn kernel_timer() -> std::io::Result<AsyncFd<OwnedFd>> {
    let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
    let timer = time::timerfd_create(TimerfdClockId::Monotonic, flags)?;
    AsyncFd::with_interest(timer, tokio::io::Interest::READABLE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::platform::now;
    use std::future::poll_fn;

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn an_alarm_of_the_runtime_goes_by_the_clock_that_a_test_has_paused() {
        let hour = now() + Duration::from_secs(3600);
        let mut alarm = ScheduleAlarm::new(false);
        poll_fn(|cx| alarm.poll_until(hour, cx)).await;
        assert_eq!(now(), hour);
    }

    /// On real threads.
    mod real {
        use super::*;
        use std::task::Waker;

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn an_alarm_of_the_kernel_is_due_at_each_instant_that_it_is_set_to_and_never_before()
        {
            let period = Duration::from_micros(100);
            let start = now();
            let mut alarm = ScheduleAlarm::new(true);
            assert!(matches!(alarm.timer, AlarmTimer::Kernel(_)));
            for due in (0..1000).map(|k| start + period * k) {
                poll_fn(|cx| alarm.poll_until(due, cx)).await;
                // The two clocks were read within a few microseconds.
                assert!(now() + Duration::from_micros(10) >= due);
            }
        }

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn an_alarm_waits_for_the_instant_of_the_latest_poll_and_for_one_that_has_passed_again()
         {
            let soon = now() + Duration::from_millis(1);
            let mut alarm = ScheduleAlarm::new(true);
            let mut cx = Context::from_waker(Waker::noop());
            assert!(alarm.poll_until(soon, &mut cx).is_pending());
            // It expires, and the runtime learns that, before it is set again.
            tokio::time::sleep(Duration::from_millis(5)).await;

            let hour = soon + Duration::from_secs(3600);
            for _ in 0..10 {
                assert!(alarm.poll_until(hour, &mut cx).is_pending());
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            poll_fn(|cx| alarm.poll_until(soon, cx)).await;
            poll_fn(|cx| alarm.poll_until(soon, cx)).await;
        }
    }
}
