//! The timers of a machine, in one list, as in quinn-proto's `connection/timer.rs`.

use crate::Instant;

/// A machine that names its timers, so that no deadline exists beside them.
///
/// [`poll_timeout`](crate::Machine::poll_timeout) is the earliest of them, and
/// [`handle_timeout`](crate::Machine::handle_timeout) lets those fire that are due. An instant that
/// is only compared when an input comes is no timer; its name ends in `_until` or `_at`.
pub(crate) trait Timers {
    /// The enumeration of the timers.
    type Timer: Copy + 'static;

    /// All of them. Of those that are due at once, the earlier in this list fires first.
    const TIMERS: &'static [Self::Timer];

    /// When this one is due; `None` while it does not run.
    fn due(&self, timer: Self::Timer) -> Option<Instant>;

    /// Lets this one fire. When the outputs have been drained, it is not due at `now` any more.
    fn fire(&mut self, timer: Self::Timer, now: Instant);

    /// When the next one is due.
    fn next_due(&self) -> Option<Instant> {
        Self::TIMERS.iter().filter_map(|timer| self.due(*timer)).min()
    }

    /// Lets each fire that is due by now, once.
    fn fire_due(&mut self, now: Instant) {
        for timer in Self::TIMERS {
            if self.due(*timer).is_some_and(|due| due <= now) {
                self.fire(*timer, now);
            }
        }
    }
}
