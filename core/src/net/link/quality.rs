//! How good a link is, and what that makes it cost.

use crate::Instant;
use crate::net::smooth;
use std::time::Duration;

/// How good a link is, as measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quality {
    /// The smoothed round trip; `None` before the first.
    pub round_trip: Option<Duration>,
    /// Its smoothed deviation.
    pub jitter: Duration,
    /// How many of a thousand hellos were lost, over the last 64: the neighbour's on their way
    /// here, or ours on their way there, whichever is more.
    pub loss_permille: u16,
    /// Loss or round trip is beyond its limit.
    pub degraded: bool,
    /// How many percent of its usual cost the link is worth at present.
    pub cost_percent: u16,
}

/// Measures a link, and judges it with reserve: what depends on the judgement must not swing.
#[derive(Debug, Default)]
pub(super) struct QualityEstimator {
    quality: Quality,
    /// When the cost was changed last.
    settled: Option<Instant>,
}

impl Default for Quality {
    fn default() -> Self {
        Quality {
            round_trip: None,
            jitter: Duration::ZERO,
            loss_permille: 0,
            degraded: false,
            cost_percent: 100,
        }
    }
}

/// A link that loses more than this of a thousand hellos is degraded.
const LOSS_LIMIT_PERMILLE: u16 = 100;
/// A link whose round trip takes longer than this, and than a hello interval, is degraded.
const ROUND_TRIP_LIMIT: Duration = Duration::from_millis(250);
/// A degraded link costs this many times as much: any other way is taken first.
const DEGRADED: u32 = 8;
/// A link becomes dearer at once, and cheaper only when it has been dear for so long: traffic that
/// is moved by a bad spell moves back once in this time at most.
const SETTLING: Duration = Duration::from_secs(5);

impl QualityEstimator {
    pub(super) fn quality(&self) -> Quality {
        self.quality
    }

    /// A round trip was measured.
    pub(super) fn handle_round_trip(&mut self, sample: Duration) {
        smooth(&mut self.quality.round_trip, &mut self.quality.jitter, sample);
    }

    /// Judges again; returns whether that must be reported. On a slow medium a round trip takes two
    /// frames and two hellos, when it is full.
    pub(super) fn judge(
        &mut self,
        loss_permille: u16,
        hello_interval: Duration,
        now: Instant,
    ) -> bool {
        let quality = &mut self.quality;
        quality.loss_permille = loss_permille.min(1000);
        let (loss, round_trip) = (quality.loss_permille, quality.round_trip.unwrap_or_default());
        let round_trip_limit = ROUND_TRIP_LIMIT.max(hello_interval);
        // Half the limit clears it, so that a link at its limit does not report all day.
        let degraded = if quality.degraded {
            loss > LOSS_LIMIT_PERMILLE / 2 || round_trip > round_trip_limit / 2
        } else {
            loss > LOSS_LIMIT_PERMILLE || round_trip > round_trip_limit
        };
        let turned = std::mem::replace(&mut quality.degraded, degraded) != degraded;
        // What crosses it costs as many transmissions as it takes until one and its acknowledgement
        // come through (ETX; De Couto et al., MobiCom 2003).
        let through = u32::from(1000 - loss.min(900));
        let expected = 100_000_000 / (through * through);
        let worth = if degraded { expected.max(100 * DEGRADED) } else { expected };
        let present = u32::from(quality.cost_percent);
        let settled = self.settled.is_none_or(|settled| now - settled >= SETTLING);
        let dearer = worth * 4 >= present * 5;
        let cheaper = settled && worth * 5 <= present * 4;
        if dearer || cheaper {
            quality.cost_percent = u16::try_from(worth).unwrap_or(u16::MAX);
            self.settled = Some(now);
        }
        turned || dearer || cheaper
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HELLO: Duration = Duration::from_millis(50);

    fn at(seconds: u64) -> Instant {
        Instant::from_millis(seconds * 1000)
    }

    #[test]
    fn a_link_becomes_dearer_at_once_and_cheaper_only_after_a_while() {
        let mut gauge = QualityEstimator::default();

        assert!(!gauge.judge(50, HELLO, at(10)), "a twentieth is within the reserve");
        assert!(gauge.judge(150, HELLO, at(11)));
        assert_eq!((gauge.quality().cost_percent, gauge.quality().degraded), (800, true));
        assert!(gauge.judge(0, HELLO, at(12)), "no longer degraded");
        assert_eq!(gauge.quality().cost_percent, 800, "but dear for a while");
        assert!(!gauge.judge(0, HELLO, at(15)));
        assert!(gauge.judge(0, HELLO, at(16)));
        assert_eq!(gauge.quality().cost_percent, 100);
    }

    #[test]
    fn a_link_that_swings_changes_its_cost_twice_in_five_seconds_at_most() {
        let mut gauge = QualityEstimator::default();
        let mut changes = 0;
        for tenth in 0..1000 {
            let before = gauge.quality().cost_percent;
            let loss = if tenth % 2 == 0 { 0 } else { 400 };
            gauge.judge(loss, HELLO, Instant::from_millis(1000 + tenth * 100));
            changes += usize::from(gauge.quality().cost_percent != before);
        }
        assert!((2..=40).contains(&changes), "{changes} in 100 s");
    }

    #[test]
    fn the_first_round_trip_counts_whole_and_the_next_an_eighth() {
        let mut gauge = QualityEstimator::default();
        let millis = Duration::from_millis;

        gauge.handle_round_trip(millis(8));
        gauge.handle_round_trip(millis(16));

        assert_eq!(gauge.quality().round_trip, Some(millis(9)));
        assert_eq!(gauge.quality().jitter, millis(5));
    }
}
