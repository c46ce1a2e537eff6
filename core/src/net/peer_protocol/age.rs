//! How old a message is that comes from a node with a clock of its own.

use crate::Instant;
use std::time::Duration;

/// Tells a message's age from the sender's timestamp, without comparing clocks.
///
/// `arrival - timestamp` is the age plus an unknown constant. The least that was seen lately
/// belongs to a message that came as fast as the network allows; what another took more than that,
/// it waited on the way: in a buffer, for a path, for a repetition. The age is therefore short by
/// the fastest passage, less than a round trip.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AgeEstimator {
    /// The least of the present window, and of the one before, in microseconds.
    least: i64,
    before: i64,
    window_from: Instant,
}

impl AgeEstimator {
    /// Two clocks that drift apart by 100 ppm, which is bad, differ by 1 ms after this.
    const WINDOW: Duration = Duration::from_secs(10);

    /// Begins with a message that was sent just now.
    pub(crate) fn new(timestamp_us: u64, now: Instant) -> Self {
        let offset = offset(timestamp_us, now);
        AgeEstimator { least: offset, before: offset, window_from: now }
    }

    /// The age of a message that arrives now.
    pub(crate) fn handle(&mut self, timestamp_us: u64, now: Instant) -> Duration {
        let offset = offset(timestamp_us, now);
        if now - self.window_from > Self::WINDOW {
            // Where all that came since was late, the last window's word stands.
            self.before = self.least;
            self.least = offset;
            self.window_from = now;
        }
        self.least = self.least.min(offset);
        let fastest = self.least.min(self.before);
        Duration::from_micros(offset.saturating_sub(fastest).unsigned_abs())
    }
}

fn offset(timestamp_us: u64, now: Instant) -> i64 {
    // Both are far below 2^62 microseconds, which is 146,000 years; what is not is an attack.
    let bounded = |us: u64| i64::try_from(us).unwrap_or(i64::MAX / 2).min(i64::MAX / 2);
    bounded(now.as_nanos() / 1000) - bounded(timestamp_us)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::at;

    const MS: u64 = 1000;

    #[test]
    fn what_waited_on_the_way_is_that_much_older() {
        let mut ages = AgeEstimator::new(0, at(70_005));
        assert_eq!(ages.handle(10 * MS, at(70_015)), Duration::ZERO);
        assert_eq!(ages.handle(20 * MS, at(70_325)), Duration::from_millis(300));
        assert_eq!(ages.handle(400 * MS, at(70_403)), Duration::ZERO, "faster than all before");
        assert_eq!(ages.handle(410 * MS, at(70_415)), Duration::from_millis(2));
    }

    #[test]
    fn clocks_that_drift_apart_make_nothing_old() {
        let mut ages = AgeEstimator::new(0, at(1000));
        let mut oldest = Duration::ZERO;
        for second in 1..10_000u64 {
            // The receiver's clock is fast by 100 ppm.
            let now = Instant::from_nanos(1_000_000_000 + second * 1_000_100_000);
            oldest = oldest.max(ages.handle(second * 1000 * MS, now));
        }
        assert!(oldest < Duration::from_millis(4), "{oldest:?}");
    }

    #[test]
    fn absurd_timestamps_are_no_more_than_wrong() {
        let mut ages = AgeEstimator::new(u64::MAX, at(0));
        ages.handle(0, Instant::from_nanos(u64::MAX));
        ages.handle(u64::MAX, at(0));
    }
}
