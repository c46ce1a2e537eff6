//! Whether one more restart is still worth it.

use crate::Instant;
use std::collections::VecDeque;
use std::time::Duration;

/// The restarts of one child or one supervisor, as far back as they count: at most `intensity`
/// instants. Counting one costs the same however many there are.
///
/// This is `add_restart/3` of Erlang's `supervisor`, but that a restart that is refused is not
/// counted.
#[derive(Clone, Debug)]
pub struct RestartWindow {
    intensity: u32,
    period: Duration,
    restarts: VecDeque<Instant>,
}

impl RestartWindow {
    /// An empty window.
    pub fn new(intensity: u32, period: Duration) -> Self {
        RestartWindow { intensity, period, restarts: VecDeque::new() }
    }

    /// Counts one restart. False: it would exceed the intensity, and is not counted.
    pub fn add(&mut self, now: Instant) -> bool {
        self.forget(now);
        let within = self.restarts.len() < self.intensity as usize;
        if within {
            self.restarts.push_back(now);
        }
        within
    }

    /// How many have not left the window.
    pub fn recent(&self, now: Instant) -> u32 {
        let gone = self.restarts.partition_point(|&at| now - at > self.period);
        u32::try_from(self.restarts.len() - gone).unwrap_or(u32::MAX)
    }

    /// How many more would be within the intensity at `now`.
    pub fn left(&self, now: Instant) -> u32 {
        self.intensity.saturating_sub(self.recent(now))
    }

    /// When the oldest restart leaves the window; `None` if there is none.
    pub fn next_release(&self) -> Option<Instant> {
        // The restart still counts when it is exactly one period old, and no longer just after.
        self.restarts.front().map(|&at| at + self.period + Duration::from_nanos(1))
    }

    /// Forgets what has left the window.
    pub fn forget(&mut self, now: Instant) {
        while self.restarts.front().is_some_and(|&at| now - at > self.period) {
            self.restarts.pop_front();
        }
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.restarts.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    #[test]
    fn the_restart_beyond_the_intensity_is_refused_and_old_ones_are_forgotten() {
        let mut window = RestartWindow::new(2, Duration::from_secs(1));

        assert!(window.add(at(0)));
        assert!(window.add(at(500)));
        assert_eq!(window.left(at(1000)), 0);
        assert!(window.add(at(1001)));
        assert!(!window.add(at(1002)));
        assert_eq!(window.next_release(), Some(at(1500) + Duration::from_nanos(1)));
        assert_eq!(window.left(at(5000)), 2);
    }

    #[test]
    fn a_large_intensity_is_counted_in_constant_time() {
        const INTENSITY: u32 = 200_000;
        let mut window = RestartWindow::new(INTENSITY, Duration::from_secs(1));
        for n in 0..INTENSITY {
            assert!(window.add(at(u64::from(n / 1000))));
            assert_eq!(window.left(at(u64::from(n / 1000))), INTENSITY - n - 1);
        }
        assert!(!window.add(at(1000)));
        assert_eq!((window.left(at(1001)), window.recent(at(1001))), (1000, INTENSITY - 1000));
        assert!(window.add(at(1001)));
        assert_eq!(window.restarts.len(), INTENSITY as usize - 999, "the others are forgotten");
    }

    #[test]
    fn an_intensity_of_zero_allows_nothing() {
        assert!(!RestartWindow::new(0, Duration::from_secs(1)).add(at(0)));
    }
}
