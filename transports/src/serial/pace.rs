//! How fast a line may be written to.

use std::time::Duration;
use tokio::time::Instant;

/// So much time of the line is written at once. Shorter wakes us more often, longer lets more wait in the
/// system's buffer.
pub(super) const PIECE: Duration = Duration::from_millis(5);
/// One part in so many more time is taken than the line's speed asks for: the clocks of serial ports are off
/// by some percent, and what is written too fast stays in the system's buffer.
const SLACK: u32 = 32;

/// Keeps a writer at the speed of its line.
#[derive(Debug, Default)]
pub(super) struct Pace {
    /// When all that was written has gone out.
    free: Option<Instant>,
    /// Somebody waits for that, and so is owed some of the time by which he is woken too late.
    waited: bool,
}

impl Pace {
    /// When the next piece may be written; `None` for now. Nor may it while the line is `late`: more of
    /// what was written before waits in the system than should.
    pub(super) fn due(&mut self, late: bool, now: Instant) -> Option<Instant> {
        if late {
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
        // Whoever is woken very late finds the line idle, and may not fill the system's buffer for that.
        let owed = if self.waited { PIECE } else { Duration::ZERO };
        let from = self.free.map_or(now, |free| (free + owed).max(now) - owed);
        (self.free, self.waited) = (Some(from + span + span / SLACK), false);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    /// How much time of the line is written within a second by somebody who is woken so late each time.
    fn written(late: Duration) -> Duration {
        let start = Instant::now();
        let (mut pace, mut now, mut sum) = (Pace::default(), start, Duration::ZERO);
        while now < start + 1_000 * MS {
            match pace.due(false, now) {
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
    fn who_was_idle_or_slept_for_long_is_owed_no_more_than_a_piece() {
        let start = Instant::now();
        let mut pace = Pace::default();
        pace.spend(PIECE, start);
        assert!(pace.due(false, start).is_some());

        let late = start + 10_000 * MS;
        let pieces = (0..1_000).take_while(|_| {
            let may = pace.due(false, late).is_none();
            pace.spend(PIECE, late);
            may
        });
        assert_eq!(pieces.count(), 1);

        let mut idle = Pace::default();
        idle.spend(PIECE, start);
        idle.spend(PIECE, late);
        assert!(idle.due(false, late + PIECE).is_some());
    }

    #[test]
    fn what_waits_in_the_system_is_waited_for_and_nothing_is_owed_for_it() {
        let start = Instant::now();
        let mut pace = Pace::default();
        pace.spend(PIECE, start);

        for millis in [10, 15, 20] {
            let now = start + millis * MS;
            assert_eq!(pace.due(true, now), Some(now + PIECE));
        }
        let now = start + 25 * MS;
        assert_eq!(pace.due(false, now), None);
        pace.spend(PIECE, now);
        assert!(pace.due(false, now + PIECE).is_some());
    }
}
