//! How fast a line may be written to.

use blastema_core::Instant;
use std::time::Duration;

/// So much time of the line is written at once. Shorter wakes us more often, longer lets more wait
/// in the system's buffer.
pub(super) const PIECE: Duration = Duration::from_millis(5);
/// One part in so many more time is taken than the line's speed asks for: the clocks of serial
/// ports are off by some percent, and what is written too fast stays in the system's buffer.
const SLACK: u32 = 32;
/// How soon it is looked again whether a device has taken what was written.
const LOOK: Duration = Duration::from_millis(1);

/// Keeps a writer at the speed of its line.
#[derive(Debug, Default)]
pub(super) struct LinePacer {
    /// When all that was written has gone out.
    free: Option<Instant>,
    /// A sender waits for that, and so is owed some of the time by which it is woken too late.
    waited: bool,
    /// A device without a line of its own is written to as fast as it takes.
    is_device: bool,
}

/// What the system still has of what was written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum DriverBacklog {
    Nothing,
    /// No more than a piece.
    Little,
    /// More: the line is slower than was said, or was stopped.
    Much,
}

impl LinePacer {
    /// For a device to which the speed means nothing: it is written to as fast as it takes.
    pub(super) fn of_device() -> Self {
        LinePacer { is_device: true, ..LinePacer::default() }
    }

    /// Whether the speed means nothing.
    pub(super) fn is_free(&self) -> bool {
        self.is_device
    }

    /// When the next piece may be written; `None` for now.
    pub(super) fn due(&mut self, held: DriverBacklog, now: Instant) -> Option<Instant> {
        if self.is_device {
            return (held != DriverBacklog::Nothing).then_some(now + LOOK);
        }
        if held == DriverBacklog::Much {
            // What the line could have carried meanwhile is gone.
            (self.free, self.waited) = (None, false);
            return Some(now + PIECE);
        }
        let due = self.free.filter(|free| *free > now);
        self.waited |= due.is_some();
        due
    }

    /// Something was written that takes the line so long.
    pub(super) fn spend(&mut self, span: Duration, now: Instant) {
        // A sender that is woken very late finds the line idle, and may not fill the system's
        // buffer for that.
        let owed = if self.waited { PIECE } else { Duration::ZERO };
        let from = self.free.filter(|free| *free + owed >= now).unwrap_or(now);
        (self.free, self.waited) = (Some(from + span + span / SLACK), false);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    fn at(millis: u64) -> Instant {
        Instant::from_millis(10_000 + millis)
    }

    /// How much time of the line is written within a second by a sender that is woken so late each
    /// time.
    fn written(late: Duration) -> Duration {
        let (mut pace, mut now, mut sum) = (LinePacer::default(), at(0), Duration::ZERO);
        while now < at(1_000) {
            match pace.due(DriverBacklog::Nothing, now) {
                Some(due) => now = due + late,
                None => {
                    pace.spend(PIECE, now);
                    sum += PIECE;
                }
            }
        }
        sum
    }

    #[test]
    fn a_line_is_given_a_little_less_than_it_carries_also_by_who_is_woken_late() {
        for late in [0, 1, 3] {
            let sum = written(late * MS);
            assert!((965 * MS..=980 * MS).contains(&sum), "{sum:?} in a second");
        }
    }

    #[test]
    fn who_was_idle_or_slept_for_long_is_owed_nothing() {
        let mut pace = LinePacer::default();
        pace.spend(PIECE, at(0));
        assert!(pace.due(DriverBacklog::Nothing, at(0)).is_some(), "a sender waits");
        assert_eq!(pace.due(DriverBacklog::Nothing, at(9_000)), None);
        pace.spend(PIECE, at(9_000));
        assert!(pace.due(DriverBacklog::Nothing, at(9_000)).is_some());

        let mut idle = LinePacer::default();
        idle.spend(PIECE, at(0));
        idle.spend(PIECE, at(9_000));
        assert!(idle.due(DriverBacklog::Nothing, at(9_005)).is_some());
    }

    #[test]
    fn what_waits_in_the_system_is_waited_for_and_nothing_is_owed_for_it() {
        let mut pace = LinePacer::default();
        pace.spend(PIECE, at(0));

        for millis in [10, 15, 20] {
            assert_eq!(pace.due(DriverBacklog::Much, at(millis)), Some(at(millis) + PIECE));
        }
        assert_eq!(pace.due(DriverBacklog::Little, at(25)), None);
        pace.spend(PIECE, at(25));
        assert!(pace.due(DriverBacklog::Nothing, at(30)).is_some());
    }

    #[test]
    fn a_device_without_a_line_waits_only_for_what_it_has_not_taken() {
        let mut pace = LinePacer::of_device();
        for _ in 0..100 {
            assert_eq!(pace.due(DriverBacklog::Nothing, at(0)), None);
            pace.spend(PIECE, at(0));
        }
        assert_eq!(pace.due(DriverBacklog::Little, at(0)), Some(at(0) + LOOK));
    }
}
