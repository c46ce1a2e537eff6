//! How long to wait before the next attempt.

use crate::random::Random;
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// Waiting times that grow from attempt to attempt and differ from case to case.
///
/// The first attempt is made at once; before the second it waits `first`, then each time `factor`
/// times as long, up to `limit`. Jitter keeps many who failed together from returning together.
///
/// ```
/// use blastema_core::recovery::Backoff;
/// use std::time::Duration;
///
/// let backoff = Backoff { jitter_percent: 0, ..Backoff::default() };
/// assert_eq!(backoff.delay(1, 7), Duration::ZERO);
/// assert_eq!(backoff.delay(2, 7), Duration::from_millis(10));
/// assert_eq!(backoff.delay(3, 7), Duration::from_millis(100));
/// assert_eq!(backoff.delay(90, 7), Duration::from_secs(5));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Backoff {
    /// Before the second attempt. Longer spares the robot's computer; shorter recovers sooner.
    pub first: Duration,
    /// How many times as long each further wait is; 1 keeps them equal.
    pub factor: u32,
    /// No wait is longer, jitter apart.
    pub limit: Duration,
    /// A wait is longer or shorter by up to this part of itself, at most 100.
    pub jitter_percent: u8,
}

impl Default for Backoff {
    /// 10 ms, 100 ms, 1 s, 5 s, give or take a tenth.
    fn default() -> Self {
        Backoff {
            first: Duration::from_millis(10),
            factor: 10,
            limit: Duration::from_secs(5),
            jitter_percent: 10,
        }
    }
}

impl Backoff {
    /// Every attempt is made at once.
    pub const NONE: Backoff =
        Backoff { first: Duration::ZERO, factor: 1, limit: Duration::ZERO, jitter_percent: 0 };

    /// How long to wait before attempt number `attempt`, which is counted from 1. The same `seed`
    /// gives the same jitter.
    pub fn delay(&self, attempt: u32, seed: u64) -> Duration {
        let Some(doublings) = attempt.checked_sub(2) else { return Duration::ZERO };
        let times = self.factor.saturating_pow(doublings);
        let base = self.first.saturating_mul(times).min(self.limit);
        let nanos = u64::try_from(base.as_nanos()).unwrap_or(u64::MAX / 4).min(u64::MAX / 4);
        let span = nanos / 100 * u64::from(self.jitter_percent.min(100));
        let shift = if span == 0 { 0 } else { Random::new(seed).nth(attempt) % (2 * span + 1) };
        Duration::from_nanos(nanos - span + shift)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_grow_up_to_the_limit_and_never_leave_the_jitter() {
        let backoff = Backoff::default();
        for seed in 0..1000 {
            let mut previous = Duration::ZERO;
            for attempt in 1..10 {
                let wait = backoff.delay(attempt, seed);
                let plain = Backoff { jitter_percent: 0, ..backoff }.delay(attempt, seed);
                assert!(wait >= plain * 9 / 10 && wait <= plain * 11 / 10, "{attempt}: {wait:?}");
                assert!(wait >= previous * 8 / 10);
                previous = wait;
            }
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_wait_and_another_seed_another() {
        let backoff = Backoff::default();

        assert_eq!(backoff.delay(3, 7), backoff.delay(3, 7));
        assert_ne!(backoff.delay(3, 7), backoff.delay(3, 8));
    }

    #[test]
    fn extreme_settings_do_not_overflow() {
        let backoff = Backoff {
            first: Duration::MAX,
            factor: u32::MAX,
            limit: Duration::MAX,
            jitter_percent: u8::MAX,
        };

        assert!(backoff.delay(u32::MAX, u64::MAX) > Duration::from_secs(1));
        assert_eq!(Backoff::NONE.delay(u32::MAX, 1), Duration::ZERO);
    }
}
