//! How many events there were lately.

use crate::Instant;
use std::collections::VecDeque;
use std::time::Duration;

/// The events of the last period, at most `limit`. Counting one costs the same however many there
/// are.
///
/// [`add`](Self::add) is `add_restart/3` of Erlang's `supervisor`, except that an event that is
/// refused is not counted.
///
/// ```
/// use blastema_core::{Instant, SlidingWindow};
/// use std::time::Duration;
///
/// let mut restarts = SlidingWindow::new(1, Duration::from_secs(10));
/// assert!(restarts.add((), Instant::from_millis(0)));
/// assert!(!restarts.add((), Instant::from_millis(10_000)));
/// assert!(restarts.add((), Instant::from_millis(10_001)));
/// ```
#[derive(Clone, Debug)]
pub struct SlidingWindow<T = ()> {
    limit: usize,
    period: Duration,
    events: VecDeque<(Instant, T)>,
}

impl<T> SlidingWindow<T> {
    /// An empty window.
    pub fn new(limit: u32, period: Duration) -> Self {
        SlidingWindow { limit: limit as usize, period, events: VecDeque::new() }
    }

    /// Counts one event. False: it would exceed the limit, and is not counted.
    pub fn add(&mut self, event: T, now: Instant) -> bool {
        self.forget(now);
        let within = self.events.len() < self.limit;
        if within {
            self.events.push_back((now, event));
        }
        within
    }

    /// Counts one event in any case; beyond the limit, the oldest is forgotten. Returns whether the
    /// limit is reached.
    pub fn push(&mut self, event: T, now: Instant) -> bool {
        self.events.push_back((now, event));
        self.forget(now);
        while self.events.len() > self.limit {
            self.events.pop_front();
        }
        self.events.len() == self.limit
    }

    /// The events that are counted, the oldest first.
    pub fn events(&self) -> impl Iterator<Item = &T> {
        self.events.iter().map(|(_, event)| event)
    }

    /// When the latest event was counted.
    pub fn last(&self) -> Option<Instant> {
        self.events.back().map(|&(at, _)| at)
    }

    /// How many have not left the window.
    pub fn recent(&self, now: Instant) -> u32 {
        let gone = self.events.partition_point(|&(at, _)| now - at > self.period);
        u32::try_from(self.events.len() - gone).unwrap_or(u32::MAX)
    }

    /// How many more would be within the limit at `now`.
    pub fn left(&self, now: Instant) -> u32 {
        u32::try_from(self.limit).unwrap_or(u32::MAX).saturating_sub(self.recent(now))
    }

    /// When the oldest event leaves the window; `None` if there is none.
    pub fn next_release(&self) -> Option<Instant> {
        // An event still counts when it is exactly one period old, and no longer just after.
        self.events.front().map(|&(at, _)| at + self.period + Duration::from_nanos(1))
    }

    /// Forgets what has left the window.
    pub fn forget(&mut self, now: Instant) {
        while self.events.front().is_some_and(|&(at, _)| now - at > self.period) {
            self.events.pop_front();
        }
    }

    /// Removes all events of the window.
    pub fn clear(&mut self) {
        self.events.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::at;

    #[test]
    fn the_event_beyond_the_limit_is_refused_and_old_ones_are_forgotten() {
        let mut window = SlidingWindow::new(2, Duration::from_secs(1));

        assert!(window.add((), at(0)));
        assert!(window.add((), at(500)));
        assert_eq!(window.left(at(1000)), 0);
        assert!(window.add((), at(1001)));
        assert!(!window.add((), at(1002)));
        assert_eq!(window.next_release(), Some(at(1500) + Duration::from_nanos(1)));
        assert_eq!(window.left(at(5000)), 2);
    }

    #[test]
    fn a_pushed_event_takes_the_place_of_the_oldest() {
        let mut window = SlidingWindow::new(2, Duration::from_secs(1));

        let full = [('a', 0), ('b', 500), ('c', 600), ('d', 1601)];
        let full = full.map(|(event, millis)| window.push(event, at(millis)));

        assert_eq!(full, [false, true, true, false]);
        assert!(window.events().eq(&['d']));
    }

    #[test]
    fn a_large_limit_is_counted_in_constant_time() {
        const LIMIT: u32 = 200_000;
        let mut window = SlidingWindow::new(LIMIT, Duration::from_secs(1));
        for n in 0..LIMIT {
            assert!(window.add((), at(u64::from(n / 1000))));
            assert_eq!(window.left(at(u64::from(n / 1000))), LIMIT - n - 1);
        }
        assert!(!window.add((), at(1000)));
        assert_eq!((window.left(at(1001)), window.recent(at(1001))), (1000, LIMIT - 1000));
        assert!(window.add((), at(1001)));
        assert_eq!(window.events.len(), LIMIT as usize - 999, "the others are forgotten");
    }

    #[test]
    fn a_limit_of_zero_allows_nothing() {
        assert!(!SlidingWindow::new(0, Duration::from_secs(1)).add((), at(0)));
    }
}
