//! How long something took, over many times, in a bounded space.

use serde::{Deserialize, Serialize};
use std::time::Duration;

/// Buckets to each doubling: a quantile is at most an eighth too high.
const STEPS: u64 = 8;

/// Counts, sum, extremes and quantiles of durations. Two of them can be merged.
///
/// It holds at most 8 buckets for each of 64 doublings of a nanosecond.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Timings {
    count: u64,
    sum_ns: u64,
    least_ns: u64,
    worst_ns: u64,
    /// How many in each bucket that holds any, in order: JSON's maps have no numbers as keys.
    buckets: Vec<(u16, u64)>,
}

impl Timings {
    /// Adds one.
    pub(crate) fn record(&mut self, span: Duration) {
        let nanos = u64::try_from(span.as_nanos()).unwrap_or(u64::MAX);
        self.least_ns = if self.count == 0 { nanos } else { self.least_ns.min(nanos) };
        self.worst_ns = self.worst_ns.max(nanos);
        self.count += 1;
        self.sum_ns = self.sum_ns.saturating_add(nanos);
        self.add(bucket(nanos), 1);
    }

    /// Adds all of another.
    pub(crate) fn merge(&mut self, other: &Timings) {
        if other.count == 0 {
            return;
        }
        self.least_ns =
            if self.count == 0 { other.least_ns } else { self.least_ns.min(other.least_ns) };
        self.worst_ns = self.worst_ns.max(other.worst_ns);
        self.count += other.count;
        self.sum_ns = self.sum_ns.saturating_add(other.sum_ns);
        for &(bucket, count) in &other.buckets {
            self.add(bucket, count);
        }
    }

    /// How many.
    pub(crate) const fn count(&self) -> u64 {
        self.count
    }

    /// The mean of all.
    pub(crate) fn mean(&self) -> Option<Duration> {
        self.sum_ns.checked_div(self.count).map(Duration::from_nanos)
    }

    /// The shortest.
    pub(crate) fn least(&self) -> Option<Duration> {
        (self.count > 0).then(|| Duration::from_nanos(self.least_ns))
    }

    /// The longest.
    pub(crate) fn worst(&self) -> Option<Duration> {
        (self.count > 0).then(|| Duration::from_nanos(self.worst_ns))
    }

    /// The span that so many of a thousand did not exceed, at most an eighth too high.
    pub(crate) fn quantile(&self, per_mille: u64) -> Option<Duration> {
        let wanted = (self.count * per_mille).div_ceil(1_000).max(1);
        let mut seen = 0;
        for &(bucket, count) in &self.buckets {
            seen += count;
            if seen >= wanted {
                return Some(Duration::from_nanos(upper_edge(bucket).min(self.worst_ns)));
            }
        }
        None
    }

    fn add(&mut self, bucket: u16, count: u64) {
        match self.buckets.binary_search_by_key(&bucket, |entry| entry.0) {
            Ok(at) => self.buckets[at].1 += count,
            Err(at) => self.buckets.insert(at, (bucket, count)),
        }
    }
}

/// The doubling in the higher part, the step within it in the lower three bits.
fn bucket(nanos: u64) -> u16 {
    let nanos = nanos.max(STEPS);
    let doubling = u64::from(nanos.ilog2());
    let step = (nanos >> (doubling - 3)) & (STEPS - 1);
    u16::try_from(doubling * STEPS + step).expect("64 doublings of 8 steps fit")
}

/// The largest span of a bucket.
fn upper_edge(bucket: u16) -> u64 {
    let (doubling, step) = (u64::from(bucket) / STEPS, u64::from(bucket) % STEPS);
    let width = 1u64 << (doubling - 3);
    (1u64 << doubling).saturating_add((step + 1) * width - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quantile_is_at_most_an_eighth_too_high_and_never_too_low() {
        for nanos in [8, 9, 100, 12_345, 345_000, 11_100_000, 9_999_999_999] {
            let mut timings = Timings::default();
            timings.record(Duration::from_nanos(nanos));
            timings.record(Duration::from_secs(3_600));

            let median = timings.quantile(500).expect("two were recorded").as_nanos();
            assert!(median >= u128::from(nanos), "{nanos}: {median}");
            assert!(median <= u128::from(nanos + nanos / 8 + 1), "{nanos}: {median}");
        }
    }

    #[test]
    fn merging_is_the_same_as_recording_all_in_one() {
        let (mut left, mut right, mut all) =
            (Timings::default(), Timings::default(), Timings::default());
        for (at, nanos) in [5, 80, 900, 70_000, 1_000_000].into_iter().enumerate() {
            let part = if at % 2 == 0 { &mut left } else { &mut right };
            part.record(Duration::from_nanos(nanos));
            all.record(Duration::from_nanos(nanos));
        }

        left.merge(&right);
        left.merge(&Timings::default());

        assert_eq!(left, all);
        assert_eq!(all.count(), 5);
        assert_eq!(all.least(), Some(Duration::from_nanos(5)));
        assert_eq!(all.worst(), Some(Duration::from_millis(1)));
        assert_eq!(all.mean(), Some(Duration::from_nanos(214_197)));
    }

    #[test]
    fn nothing_recorded_has_no_figures() {
        let none = Timings::default();

        assert_eq!(
            (none.mean(), none.least(), none.worst(), none.quantile(990)),
            (None, None, None, None)
        );
    }

    #[test]
    fn the_longest_span_has_a_bucket() {
        let mut timings = Timings::default();
        timings.record(Duration::MAX);

        assert_eq!(timings.quantile(500), Some(Duration::from_nanos(u64::MAX)));
    }
}
