//! Whether one more restart is still worth it.

use crate::Instant;
use std::time::Duration;

/// Adds a restart at `now` to the earlier ones, and says whether that exceeds `intensity` restarts
/// in `period`. Restarts that have left the window are forgotten.
///
/// This is `add_restart/3` of Erlang's `supervisor`: pure, over instants.
///
/// # Errors
/// The restarts in the window are more than `intensity`.
pub fn add_restart(
    earlier: &[Instant],
    now: Instant,
    intensity: u32,
    period: Duration,
) -> Result<Vec<Instant>, Vec<Instant>> {
    let recent = |&&at: &&Instant| now - at <= period;
    let restarts: Vec<Instant> = earlier.iter().filter(recent).copied().chain([now]).collect();
    if restarts.len() > intensity as usize { Err(restarts) } else { Ok(restarts) }
}

/// The restarts of one child or one supervisor, as far back as they count. Holds at most
/// `intensity` + 1 instants.
#[derive(Clone, Debug)]
pub struct RestartWindow {
    intensity: u32,
    period: Duration,
    restarts: Vec<Instant>,
}

impl RestartWindow {
    /// An empty window.
    pub fn new(intensity: u32, period: Duration) -> Self {
        RestartWindow { intensity, period, restarts: Vec::new() }
    }

    /// Counts one restart. False: the intensity is exceeded.
    pub fn add(&mut self, now: Instant) -> bool {
        let counted = add_restart(&self.restarts, now, self.intensity, self.period);
        let within = counted.is_ok();
        self.restarts = counted.unwrap_or_else(|restarts| restarts);
        within
    }

    /// How many more would be within the intensity at `now`.
    pub fn left(&self, now: Instant) -> u32 {
        let recent = self.restarts.iter().filter(|&&at| now - at <= self.period).count();
        self.intensity.saturating_sub(u32::try_from(recent).unwrap_or(u32::MAX))
    }

    /// When the oldest restart leaves the window; `None` if there is none.
    pub fn next_release(&self) -> Option<Instant> {
        // The restart still counts when it is exactly one period old, and no longer just after.
        self.restarts.first().map(|&at| at + self.period + Duration::from_nanos(1))
    }

    /// Forgets what has left the window.
    pub fn forget(&mut self, now: Instant) {
        let period = self.period;
        self.restarts.retain(|&at| now - at <= period);
    }

    /// Forgets everything: a new incarnation of the supervisor begins.
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
    fn an_intensity_of_zero_allows_nothing() {
        assert!(add_restart(&[], at(0), 0, Duration::from_secs(1)).is_err());
    }
}
