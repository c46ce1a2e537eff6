//! How late the rounds of a component begin.

use blastema_core::detection::RoundLateness;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// Powers of two from a nanosecond to nine minutes; the last one has what is later.
const BUCKETS: usize = 40;

/// Counts rounds by the power of two of the nanoseconds by which they began late. Its thread writes
/// it, and others read it without a lock.
#[derive(Debug)]
pub(crate) struct LatenessHistogram {
    /// Bucket `n` has what is below `1 << n` nanoseconds, and is not in the one before.
    rounds: [AtomicU64; BUCKETS],
    max: AtomicU64,
}

impl Default for LatenessHistogram {
    fn default() -> Self {
        LatenessHistogram { rounds: [const { AtomicU64::new(0) }; BUCKETS], max: AtomicU64::new(0) }
    }
}

impl LatenessHistogram {
    /// A round has begun so late.
    pub(crate) fn add(&self, late: Duration) {
        let nanos = u64::try_from(late.as_nanos()).unwrap_or(u64::MAX);
        let bucket = (u64::BITS - nanos.leading_zeros()) as usize;
        self.rounds[bucket.min(BUCKETS - 1)].fetch_add(1, Relaxed);
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
        let max = self.max.load(Relaxed);
        let percentile = |percent: u64| {
            let mut below = 0;
            let holds = |(_, count): &(usize, &u64)| {
                below += **count;
                below * 100 >= all * percent
            };
            let (bucket, _) = rounds.iter().enumerate().find(holds)?;
            // The last bucket has no upper bound but the maximum.
            let bound = if bucket == BUCKETS - 1 { max } else { (1 << bucket) - 1 };
            Some(Duration::from_nanos(bound.min(max)))
        };
        let max = Duration::from_nanos(max);
        (all > 0).then_some(RoundLateness { p50: percentile(50)?, p99: percentile(99)?, max })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_upper_bounds_within_a_factor_of_two_and_the_maximum_is_exact() {
        let nanos = Duration::from_nanos;
        let histogram = LatenessHistogram::default();
        assert_eq!(histogram.read(), None);

        (0..98).for_each(|_| histogram.add(nanos(50_000)));
        histogram.add(nanos(300_000));
        histogram.add(Duration::from_secs(3600));

        let read = histogram.read().expect("a hundred rounds");
        assert_eq!((read.p50, read.p99), (nanos((1 << 16) - 1), nanos((1 << 19) - 1)));
        assert_eq!(read.max, Duration::from_secs(3600));

        histogram.clear();
        histogram.add(Duration::ZERO);
        let zero = Duration::ZERO;
        assert_eq!(histogram.read(), Some(RoundLateness { p50: zero, p99: zero, max: zero }));
        histogram.add(Duration::from_secs(3600));
        assert_eq!(histogram.read().map(|read| read.p99), Some(Duration::from_secs(3600)));
    }
}
