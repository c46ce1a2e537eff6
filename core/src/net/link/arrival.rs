//! When the next hello should be here: the estimator of Chen's failure detector NFD-E.

use crate::Instant;
use std::collections::VecDeque;
use std::time::Duration;

/// Estimates when the next of a series of numbered signs of life arrives.
///
/// The series is sent once per interval; nothing is known of the sender's clock. The estimate is
/// the mean of `arrival - interval * number` over the last arrivals, plus the next number's
/// interval (Chen, Toueg, Aguilera, IEEE ToC 51(5), 2002, section 5.3). Unlike a timer that every
/// arrival restarts, it does not carry the delay of the last message into the next deadline.
#[derive(Clone, Debug)]
pub(crate) struct ArrivalEstimator {
    interval: Duration,
    /// `arrival - interval * number`, in nanoseconds.
    offsets: VecDeque<i128>,
    sum: i128,
    /// The highest number so far, counted on past its wire format's overflow.
    highest: u64,
    /// A bit for each of the last 64 numbers, the highest number's at bit 0: it arrived.
    seen: u64,
    /// How many of those bits mean anything.
    span: u32,
}

/// What an arrival was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum HelloArrival {
    /// The newest so far; so many before it have not come.
    New { missed: u32 },
    /// Late or doubled: it says nothing about now.
    Old,
}

impl ArrivalEstimator {
    /// Chen et al. find 30 arrivals enough; more only makes it slower to follow a drifting clock.
    const WINDOW: usize = 32;

    /// So many missing in a row are an outage, and say nothing about the loss before and after.
    const OUTAGE: u32 = 8;

    pub(crate) fn new(interval: Duration, number: u32, now: Instant) -> Self {
        let mut arrivals = ArrivalEstimator {
            interval,
            offsets: VecDeque::with_capacity(Self::WINDOW),
            sum: 0,
            highest: u64::from(number),
            seen: 1,
            span: 1,
        };
        arrivals.learn(now);
        arrivals
    }

    pub(crate) fn interval(&self) -> Duration {
        self.interval
    }

    /// The highest number so far, as on the wire.
    pub(crate) fn highest(&self) -> u32 {
        self.highest as u32
    }

    /// The one with this number; so many directly before it were not sent.
    pub(crate) fn handle(&mut self, number: u32, skipped: u8, now: Instant) -> HelloArrival {
        // Serial-number arithmetic (RFC 1982): the nearer way round decides.
        let step = number.wrapping_sub(self.highest()).cast_signed();
        if step <= 0 {
            let back = step.unsigned_abs();
            if back < 64 {
                self.seen |= 1 << back;
            }
            return HelloArrival::Old;
        }
        let step = step.unsigned_abs();
        let skipped = u32::from(skipped).min(step - 1);
        if step > Self::OUTAGE {
            self.forget_loss();
        } else {
            self.seen = self.seen << step | ((2 << skipped) - 1);
            self.span = (self.span + step).min(64);
        }
        self.highest += u64::from(step);
        self.learn(now);
        HelloArrival::New { missed: step - 1 - skipped }
    }

    /// What was missing so far belongs to an outage, and says nothing of what is to come.
    pub(crate) fn forget_loss(&mut self) {
        (self.seen, self.span) = (1, 1);
    }

    fn learn(&mut self, now: Instant) {
        if self.offsets.len() == Self::WINDOW {
            self.sum -= self.offsets.pop_front().unwrap_or(0);
        }
        let offset = i128::from(now.as_nanos()) - self.nanos(self.highest);
        self.offsets.push_back(offset);
        self.sum += offset;
    }

    fn nanos(&self, number: u64) -> i128 {
        i128::from(number) * self.interval.as_nanos().cast_signed()
    }

    /// When the next one should be here.
    pub(crate) fn expected(&self) -> Instant {
        let mean = self.sum / self.offsets.len().max(1) as i128;
        let nanos = (mean + self.nanos(self.highest + 1)).max(0);
        Instant::from_nanos(u64::try_from(nanos).unwrap_or(u64::MAX))
    }

    /// How many of a thousand did not arrive, over the last 64; `None` while too few are known.
    pub(crate) fn loss_permille(&self) -> Option<u16> {
        // With fewer than 16, one loss would already look like a bad link.
        (self.span >= 16).then(|| {
            let lost = self.span.saturating_sub(self.seen.count_ones());
            (lost * 1000 / self.span) as u16
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const INTERVAL: Duration = Duration::from_millis(10);

    #[test]
    fn the_next_arrival_is_expected_one_interval_after_the_mean() {
        let mut arrivals = ArrivalEstimator::new(INTERVAL, 100, Instant::from_millis(1000));
        assert_eq!(arrivals.expected(), Instant::from_millis(1010));

        arrivals.handle(101, 0, Instant::from_millis(1014));

        assert_eq!(arrivals.expected(), Instant::from_millis(1022));
    }

    #[test]
    fn what_was_not_sent_is_not_lost() {
        let mut arrivals = ArrivalEstimator::new(INTERVAL, 0, Instant::ORIGIN);
        let mut arrive = |number: u32, skipped| {
            let now = Instant::from_millis(10 * u64::from(number));
            (arrivals.handle(number, skipped, now), arrivals.loss_permille())
        };
        (1..=20).for_each(|number| _ = arrive(number * 4, 3));
        assert_eq!(arrive(84, 3), (HelloArrival::New { missed: 0 }, Some(0)));
        assert_eq!(arrive(88, 2), (HelloArrival::New { missed: 1 }, Some(15)));
        assert_eq!(arrive(90, 63).0, HelloArrival::New { missed: 0 });
    }

    #[test]
    fn an_outage_is_no_loss() {
        let mut arrivals = ArrivalEstimator::new(INTERVAL, 0, Instant::ORIGIN);
        for number in (1..=20).chain(60..=80) {
            arrivals.handle(number, 0, Instant::from_millis(10 * u64::from(number)));
        }
        assert_eq!(arrivals.loss_permille(), Some(0));
    }

    #[test]
    fn a_late_or_doubled_one_changes_no_estimate_but_counts_as_arrived() {
        let mut arrivals = ArrivalEstimator::new(INTERVAL, u32::MAX, Instant::from_millis(1000));
        for number in 1..40u32 {
            arrivals.handle(number, 0, Instant::from_millis(1010 + 10 * u64::from(number)));
        }
        let expected = arrivals.expected();
        assert_eq!(arrivals.loss_permille(), Some(24), "number 0, after the overflow, is missing");

        assert_eq!(arrivals.handle(0, 0, Instant::from_millis(1500)), HelloArrival::Old);

        assert_eq!(arrivals.expected(), expected);
        assert_eq!(arrivals.loss_permille(), Some(0));
    }
}
