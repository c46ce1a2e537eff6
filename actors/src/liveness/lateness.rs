//! How late the rounds of a component begin.

use blastema_core::detection::RoundLateness;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// Four for each power of two, in nanoseconds: a percentile is at most a quarter above the true one.
const BUCKETS: usize = 252;

/// Counts rounds by how late they began. Its thread writes it, and others read it without a lock.
#[derive(Debug)]
pub(crate) struct LatenessHistogram {
    rounds: [AtomicU64; BUCKETS],
    max: AtomicU64,
}

impl Default for LatenessHistogram {
    fn default() -> Self {
        LatenessHistogram { rounds: [const { AtomicU64::new(0) }; BUCKETS], max: AtomicU64::new(0) }
    }
}

/// The bucket of so many nanoseconds.
fn bucket_of(nanos: u64) -> usize {
    let power = nanos.max(4).ilog2() - 2;
    power as usize * 4 + (nanos >> power) as usize
}

/// The most nanoseconds that a bucket has.
fn largest_of(bucket: usize) -> u64 {
    let power = (bucket / 4).saturating_sub(1);
    ((bucket - power * 4) as u64) << power | ((1 << power) - 1)
}

impl LatenessHistogram {
    /// A round has begun so late.
    pub(crate) fn add(&self, late: Duration) {
        let nanos = u64::try_from(late.as_nanos()).unwrap_or(u64::MAX);
        self.rounds[bucket_of(nanos)].fetch_add(1, Relaxed);
        self.max.fetch_max(nanos, Relaxed);
    }

    /// Another incarnation begins.
    pub(crate) fn clear(&self) {
        self.rounds.iter().chain([&self.max]).for_each(|count| count.store(0, Relaxed));
    }

    /// `None` before the first round.
    pub(crate) fn read(&self) -> Option<RoundLateness> {
        let rounds = self.rounds.each_ref().map(|count| count.load(Relaxed));
        let all: u64 = rounds.iter().sum();
        let max = Duration::from_nanos(self.max.load(Relaxed));
        let percentile = |percent: u64| {
            let mut below = 0;
            let bucket = rounds.iter().position(|count| {
                below += count;
                below * 100 >= all * percent
            });
            Some(Duration::from_nanos(largest_of(bucket?)).min(max))
        };
        (all > 0).then_some(RoundLateness { p50: percentile(50)?, p99: percentile(99)?, max })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_has_a_bucket_whose_largest_is_at_most_a_quarter_above_it() {
        let powers = (0..64).map(|power| 1 << power);
        for nanos in
            powers.flat_map(|power: u64| [power - 1, power, power + power / 3, power + power / 2])
        {
            let bucket = bucket_of(nanos);
            let largest = largest_of(bucket);
            assert!(largest >= nanos && largest - nanos <= nanos / 4, "{nanos} in {bucket}");
            assert!(bucket == 0 || largest_of(bucket - 1) < nanos, "{nanos} in {bucket}");
        }
        assert_eq!(bucket_of(u64::MAX), BUCKETS - 1);
        assert_eq!(largest_of(BUCKETS - 1), u64::MAX);
    }

    #[test]
    fn percentiles_are_those_of_the_rounds_since_it_was_cleared_and_the_maximum_is_exact() {
        let nanos = Duration::from_nanos;
        let histogram = LatenessHistogram::default();
        assert_eq!(histogram.read(), None);

        (0..98).for_each(|_| histogram.add(nanos(50_000)));
        histogram.add(nanos(300_000));
        histogram.add(Duration::from_secs(3600));

        let read = histogram.read().expect("a hundred rounds");
        assert_eq!((read.p50, read.p99), (nanos((7 << 13) - 1), nanos((5 << 16) - 1)));
        assert_eq!(read.max, Duration::from_secs(3600));

        histogram.clear();
        histogram.add(Duration::ZERO);
        let zero = Duration::ZERO;
        assert_eq!(histogram.read(), Some(RoundLateness { p50: zero, p99: zero, max: zero }));
    }
}
