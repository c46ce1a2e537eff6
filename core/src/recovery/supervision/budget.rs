//! How many restarts a supervisor still allows: one count for each child, or one for all of them.

use super::child::ChildKey;
use crate::recovery::SupervisorRules;
use crate::sorted::SortedMap;
use crate::{Instant, SlidingWindow};
use std::time::Duration;

/// The restarts that are counted at present. See the [module](self).
#[derive(Clone, Debug)]
pub(super) struct Budget {
    intensity: u32,
    period: Duration,
    shared: bool,
    /// By child; under a shared count, all under one key. A child that was never restarted has
    /// none.
    windows: SortedMap<ChildKey, SlidingWindow>,
}

impl Budget {
    pub(super) fn new(rules: &SupervisorRules) -> Self {
        let (intensity, period) = (rules.intensity, rules.period);
        let shared = rules.counts_together();
        Budget { intensity, period, shared, windows: SortedMap::new() }
    }

    /// Where a child's restarts are counted.
    fn of(&self, child: ChildKey) -> ChildKey {
        if self.shared { ChildKey::MAX } else { child }
    }

    /// All children draw from one count.
    pub(super) fn is_shared(&self) -> bool {
        self.shared
    }

    /// Counts one restart of a child. False: the intensity is exceeded, and nothing is counted.
    pub(super) fn add(&mut self, child: ChildKey, now: Instant) -> bool {
        let of = self.of(child);
        let window = self.windows.entry(of);
        window.or_insert_with(|| SlidingWindow::new(self.intensity, self.period)).add((), now)
    }

    /// How many more restarts of a child are within the intensity.
    pub(super) fn left(&self, child: ChildKey, now: Instant) -> u32 {
        self.windows.get(&self.of(child)).map_or(self.intensity, |window| window.left(now))
    }

    /// How many more restarts are within the intensity, whichever child they strike.
    pub(super) fn least(&self, now: Instant) -> u32 {
        let left = self.windows.values().map(|window| window.left(now));
        left.min().unwrap_or(self.intensity)
    }

    /// The child is no more.
    pub(super) fn forget(&mut self, child: ChildKey) {
        self.windows.remove(&child);
    }

    /// An incarnation of the supervisor begins, with everything allowed.
    pub(super) fn clear(&mut self) {
        self.windows.clear();
    }
}
