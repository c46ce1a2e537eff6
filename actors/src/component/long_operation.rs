//! Long operations that a component announces, of which one may lie within another.

use crate::liveness::activity::ActivityRecord;
use crate::messaging::incarnation::IncarnationToken;
use crate::platform;
use crate::platform::lock;
use blastema_core::Instant;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// The operations of one incarnation that are under way, each with the time when it is to be over.
pub(crate) struct LongOperations {
    activity: &'static ActivityRecord,
    token: Arc<IncarnationToken>,
    ends: Mutex<Vec<Instant>>,
}

impl LongOperations {
    pub(crate) fn new(activity: &'static ActivityRecord, token: Arc<IncarnationToken>) -> Self {
        LongOperations { activity, token, ends: Mutex::default() }
    }

    pub(crate) fn begin(self: &Arc<Self>, span: Duration) -> LongOperation {
        let end = platform::now() + span;
        let mut ends = lock(&self.ends);
        ends.push(end);
        self.allow_latest(&ends);
        LongOperation { operations: self.clone(), end }
    }

    /// Announces the time until the last of them is to be over.
    fn allow_latest(&self, ends: &[Instant]) {
        // The activity record may belong to another incarnation by now.
        if !self.token.has_ended() {
            let now = platform::now();
            self.activity.allow(ends.iter().max().map_or(Duration::ZERO, |end| *end - now));
        }
    }
}

/// Ends a long operation when dropped; see [`Context::long_operation`](crate::Context).
#[must_use = "the operation counts as long only while this guard lives"]
pub struct LongOperation {
    operations: Arc<LongOperations>,
    end: Instant,
}

impl std::fmt::Debug for LongOperation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LongOperation").field("end", &self.end).finish_non_exhaustive()
    }
}

impl Drop for LongOperation {
    fn drop(&mut self) {
        let mut ends = lock(&self.operations.ends);
        if let Some(at) = ends.iter().position(|end| *end == self.end) {
            ends.swap_remove(at);
        }
        self.operations.allow_latest(&ends);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::liveness::activity::ActivitySlot;
    use blastema_doubles::advance;

    const MS: Duration = Duration::from_millis(1);

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn the_latest_end_counts_in_whatever_order_operations_end() {
        let slot = ActivitySlot::claim();
        let operations = Arc::new(LongOperations::new(slot.activity, Arc::default()));
        let allowance = || slot.activity.read().component.allowance;

        let outer = operations.begin(800 * MS);
        let inner = operations.begin(10 * MS);
        assert_eq!(allowance(), 800 * MS, "a shorter one does not shorten it");
        advance(100 * MS).await;
        drop(inner);
        assert_eq!(allowance(), 700 * MS);

        let longer = operations.begin(2000 * MS);
        drop(outer);
        assert_eq!(allowance(), 2000 * MS);
        let last = operations.begin(100 * MS);
        drop(longer);
        assert_eq!(allowance(), 100 * MS);
        drop(last);
        assert_eq!(allowance(), Duration::ZERO);
    }

    #[test]
    fn what_outlives_its_incarnation_changes_no_later_one() {
        let (slot, token) = (ActivitySlot::claim(), Arc::<IncarnationToken>::default());
        let late = Arc::new(LongOperations::new(slot.activity, token.clone())).begin(800 * MS);
        token.end();
        slot.activity.allow(500 * MS);

        drop(late);

        assert_eq!(slot.activity.read().component.allowance, 500 * MS);
    }
}
