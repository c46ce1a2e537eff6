//! How fast a line may be written to.

use blastema_core::Instant;
use std::time::Duration;

/// So much time of the line is written at once. Shorter wakes us more often, longer lets more wait
/// in the system's buffer.
pub(super) const PIECE: Duration = Duration::from_millis(5);
/// One part in so many more time is taken than the line's speed asks for: the clocks of serial
/// ports are off by some percent, and what is written too fast stays in the system's buffer.
const SLACK: u32 = 32;
/// How soon it is looked again at a device that may be faster than its line's speed says.
const LOOK: Duration = Duration::from_millis(1);
/// A device that let us wait for so long in all is judged.
const JUDGED_AFTER: Duration = Duration::from_millis(500);
/// And again so much later: it may only have stood still.
const JUDGED_FOR: Duration = Duration::from_secs(60);

/// Keeps a writer at the speed of its line.
#[derive(Debug, Default)]
pub(super) struct LinePacer {
    /// When all that was written has gone out.
    free: Option<Instant>,
    /// A sender waits for that, and so is owed some of the time by which it is woken too late.
    waited: bool,
    /// Of a device without a line of its own.
    trial: Option<Trial>,
}

/// Whether a device takes more than the speed that was set says, which may mean nothing to it.
#[derive(Debug, Default)]
struct Trial {
    /// How long it has let us wait, and how much time of the line was written meanwhile.
    waiting: Duration,
    taken: Duration,
    /// There is a line behind it, for all that we know until then.
    slow_until: Option<Instant>,
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
    /// For a device to which the speed may mean nothing: it is written to as fast as it takes,
    /// unless it turns out that there is a line behind it.
    pub(super) fn of_device() -> Self {
        LinePacer { trial: Some(Trial::default()), ..LinePacer::default() }
    }

    /// Whether the speed means nothing, as far as is known.
    pub(super) fn is_free(&self) -> bool {
        self.trial.as_ref().is_some_and(|trial| trial.slow_until.is_none())
    }

    /// When the next piece may be written; `None` for now.
    pub(super) fn due(&mut self, held: DriverBacklog, now: Instant) -> Option<Instant> {
        if let Some(trial) = &mut self.trial {
            trial.slow_until.take_if(|until| *until <= now);
            if trial.slow_until.is_none() {
                if held == DriverBacklog::Nothing {
                    return None;
                }
                if !trial.is_slow(now) {
                    return Some(now + LOOK);
                }
                (self.free, self.waited) = (None, false);
            }
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
        if let Some(trial) = self.trial.as_mut().filter(|trial| trial.slow_until.is_none()) {
            trial.taken += span;
            return;
        }
        // A sender that is woken very late finds the line idle, and may not fill the system's
        // buffer for that.
        let owed = if self.waited { PIECE } else { Duration::ZERO };
        let from = self.free.filter(|free| *free + owed >= now).unwrap_or(now);
        (self.free, self.waited) = (Some(from + span + span / SLACK), false);
    }
}

impl Trial {
    /// The device lets us wait once more.
    fn is_slow(&mut self, now: Instant) -> bool {
        self.waiting += LOOK;
        if self.waiting < JUDGED_AFTER {
            return false;
        }
        // A line's adapter has some memory of its own.
        let slow = self.taken < self.waiting * 2;
        (self.waiting, self.taken) = (Duration::ZERO, Duration::ZERO);
        self.slow_until = slow.then(|| now + JUDGED_FOR);
        slow
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

    /// How much time of the line a device takes within some seconds that holds so much at most, and
    /// gives out so many times as much as its line would carry.
    fn taken_by(seconds: u64, memory: Duration, times: u32) -> Duration {
        let (mut pace, mut now) = (LinePacer::of_device(), at(0));
        let (mut sum, mut inside, mut outside) = (Duration::ZERO, Duration::ZERO, Duration::ZERO);
        while now < at(seconds * 1_000) {
            let moved = outside.min(memory.saturating_sub(inside));
            (inside, outside) = (inside + moved, outside - moved);
            let held =
                if outside.is_zero() { DriverBacklog::Nothing } else { DriverBacklog::Little };
            let next = match pace.due(held, now) {
                Some(due) => due,
                None => {
                    pace.spend(PIECE, now);
                    (sum, outside) = (sum + PIECE, outside + PIECE);
                    now
                }
            };
            inside = inside.saturating_sub((next - now) * times);
            now = next;
        }
        sum
    }

    #[test]
    fn a_device_without_a_line_is_not_held_back_by_the_speed_that_was_set() {
        let sum = taken_by(10, 20 * MS, 50);
        assert!(sum > 150_000 * MS, "{sum:?} of the line in ten seconds");
    }

    #[test]
    fn a_device_with_a_line_behind_it_is_found_out_and_its_memory_left_empty() {
        let sum = taken_by(10, 200 * MS, 1);
        assert!((9_500 * MS..9_990 * MS).contains(&sum), "{sum:?} in ten seconds");
    }

    #[test]
    fn at_each_trial_a_device_with_a_line_is_found_out_as_soon_as_at_the_first() {
        let (mut pace, mut now, mut tried) = (LinePacer::of_device(), at(0), Duration::ZERO);
        while now < at(130_000) {
            let held = if pace.is_free() { DriverBacklog::Little } else { DriverBacklog::Nothing };
            match pace.due(held, now) {
                Some(due) => {
                    tried += if pace.is_free() { due - now } else { Duration::ZERO };
                    now = due;
                }
                None => pace.spend(PIECE, now),
            }
        }
        assert!((2 * JUDGED_AFTER..3 * JUDGED_AFTER).contains(&tried), "{tried:?} in three trials");
    }
}
