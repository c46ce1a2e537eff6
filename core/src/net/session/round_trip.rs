//! How long an answer takes, and how long to wait for one (RFC 6298).

use crate::net::smooth;
use std::time::Duration;

/// The estimator of one session.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RttEstimator {
    smoothed: Option<Duration>,
    deviation: Duration,
    /// Doublings since the last measurement: what a repetition brought may be the answer to the
    /// first sending (Karn's algorithm).
    backoff: u32,
    narrow: bool,
}

impl RttEstimator {
    /// Before the first measurement: several round trips of any medium aboard a robot.
    const INITIAL: Duration = Duration::from_millis(100);
    /// The same where the medium is probably slow (RFC 6298, 2.1).
    const INITIAL_NARROW: Duration = Duration::from_secs(1);
    /// The shortest there: a frame, its acknowledgement, which waits a little, and a frame and a
    /// hello before either, at 9,600 bits a second. What was measured with small messages says
    /// nothing of large ones.
    const SHORTEST_NARROW: Duration = Duration::from_millis(400);
    /// The longest there.
    const LONGEST_NARROW: Duration = Duration::from_secs(2);
    /// The shortest time after which silence is taken for loss: ten times the delay of
    /// acknowledgements.
    pub(crate) const SHORTEST: Duration = Duration::from_millis(20);
    /// The longest one.
    pub(crate) const LONGEST: Duration = Duration::from_millis(500);

    pub(crate) fn new() -> Self {
        RttEstimator { smoothed: None, deviation: Duration::ZERO, backoff: 0, narrow: false }
    }

    pub(crate) fn smoothed(&self) -> Option<Duration> {
        self.smoothed
    }

    /// An answer took so long.
    pub(crate) fn measure(&mut self, sample: Duration) {
        self.progress();
        smooth(&mut self.smoothed, &mut self.deviation, sample);
    }

    /// On a narrow one a single segment may take long.
    pub(crate) fn enter_path(&mut self, narrow: bool) {
        self.narrow = narrow;
        self.progress();
    }

    pub(crate) fn timeout(&self) -> Duration {
        let (initial, shortest, longest) = match self.narrow {
            true => (Self::INITIAL_NARROW, Self::SHORTEST_NARROW, Self::LONGEST_NARROW),
            false => (Self::INITIAL, Self::SHORTEST, Self::LONGEST),
        };
        // Steady round trips say nothing of the next one, which a busy computer or a radio delays:
        // the shortest timeout comes on top of them (TCP in Linux does the same with 200 ms).
        let least = if self.narrow { Duration::ZERO } else { shortest };
        let margin = (4 * self.deviation).max(least);
        let base = self.smoothed.map_or(initial, |smoothed| smoothed + margin).max(shortest);
        // A slow line's round trip may be longer than the longest that one waits elsewhere.
        base.saturating_mul(1 << self.backoff).min(longest.max(base))
    }

    pub(crate) fn back_off(&mut self) {
        // 1024 times the shortest timeout is beyond any longest.
        self.backoff = (self.backoff + 1).min(10);
    }

    /// There is a measurement, another path, or another session. An answer that measures nothing is
    /// no progress: it may have been on its way since the first sending.
    pub(crate) fn progress(&mut self) {
        self.backoff = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn the_timeout_follows_the_measured_round_trip_within_its_bounds() {
        let mut trip = RttEstimator::new();
        assert_eq!(trip.timeout(), 100 * MS);
        trip.measure(40 * MS);
        assert_eq!(trip.timeout(), 120 * MS, "40 + 4 * 20");
        for _ in 0..100 {
            trip.measure(MS);
        }
        let steady = trip.timeout();
        assert!((21 * MS..22 * MS).contains(&steady), "the shortest is a margin: {steady:?}");
        for _ in 0..40 {
            trip.back_off();
        }
        assert_eq!(trip.timeout(), 500 * MS, "never above the longest");
        trip.progress();
        assert_eq!(trip.timeout(), steady);
    }
    #[test]
    fn on_a_narrow_path_no_small_message_shortens_it_and_its_doublings_last_until_a_measurement() {
        let mut trip = RttEstimator::new();
        trip.enter_path(true);
        assert_eq!(trip.timeout(), 1000 * MS);
        for _ in 0..100 {
            trip.measure(30 * MS);
        }
        assert_eq!(trip.timeout(), 400 * MS);

        trip.back_off();
        trip.back_off();
        assert_eq!(trip.timeout(), 1600 * MS);
        trip.back_off();
        assert_eq!(trip.timeout(), 2000 * MS, "never above the longest");
        trip.measure(30 * MS);
        assert_eq!(trip.timeout(), 400 * MS);
    }
}
