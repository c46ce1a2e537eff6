//! The round trips to another node, as they are measured now and then.

use crate::Instant;
use std::time::Duration;

/// The round trips to one node.
#[derive(Clone, Copy, Debug, Default)]
pub struct RoundTripEstimator {
    last: Option<Duration>,
    /// The fastest of the present window, and of the one before.
    fastest: Option<Duration>,
    before: Option<Duration>,
    window_from: Instant,
    asked_at: Option<Instant>,
}

impl RoundTripEstimator {
    /// As long as the fastest passage of messages is remembered, to which it is added.
    const WINDOW: Duration = Duration::from_secs(10);

    /// The node is asked now. What was asked before, and was not answered, counts no more.
    pub fn handle_asked(&mut self, now: Instant) {
        self.asked_at = Some(now);
    }

    /// It has answered.
    pub fn handle_answer(&mut self, now: Instant) {
        let Some(asked_at) = self.asked_at.take() else { return };
        let trip = now - asked_at;
        if now - self.window_from > Self::WINDOW {
            (self.before, self.fastest, self.window_from) = (self.fastest, None, now);
        }
        self.fastest = Some(self.fastest.map_or(trip, |fastest| fastest.min(trip)));
        self.last = Some(trip);
    }

    /// It did not answer: what waits for it is not counted.
    pub fn handle_failed(&mut self) {
        self.asked_at = None;
    }

    /// The last round trip, or the time for which an answer is missing, where that is longer: a
    /// path that has become slow is so at once. What judges it does so with hysteresis.
    pub fn last(&self, now: Instant) -> Option<Duration> {
        let waited = self.asked_at.map_or(Duration::ZERO, |at| now - at);
        self.last.map(|last| last.max(waited))
    }

    /// The fastest round trip of the last ten to twenty seconds.
    pub fn fastest(&self) -> Option<Duration> {
        [self.fastest, self.before].into_iter().flatten().min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::at;

    #[test]
    fn an_answer_that_is_missing_counts_while_it_is_and_the_fastest_is_forgotten() {
        let mut trips = RoundTripEstimator::default();
        let ask = |trips: &mut RoundTripEstimator, asked: u64, trip: u64| {
            trips.handle_asked(at(asked));
            trips.handle_answer(at(asked + trip));
        };
        assert_eq!((trips.last(at(0)), trips.fastest()), (None, None));
        ask(&mut trips, 0, 8);
        ask(&mut trips, 1000, 16);
        assert_eq!(trips.last(at(2000)), Some(Duration::from_millis(16)));
        trips.handle_asked(at(2000));
        assert_eq!(trips.last(at(2500)), Some(Duration::from_millis(500)));
        trips.handle_failed();
        ask(&mut trips, 2600, 1);
        assert_eq!(trips.last(at(2700)), Some(Duration::from_millis(1)));
        (3..40).for_each(|second| ask(&mut trips, second * 1000, 300));
        assert_eq!(trips.fastest(), Some(Duration::from_millis(300)));
    }
}
