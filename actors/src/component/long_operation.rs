//! Long operations that a component announces, of which one may lie within another.

use crate::liveness::activity::ActivityRecord;
use crate::messaging::incarnation::IncarnationToken;
use std::sync::Arc;
use std::time::Duration;

/// Ends a long operation when dropped; see [`Context::long_operation`](crate::Context).
#[must_use = "the operation counts as long only while this guard lives"]
#[derive(Debug)]
pub struct LongOperation {
    activity: &'static ActivityRecord,
    token: Arc<IncarnationToken>,
    /// What is announced again when it ends.
    before: Duration,
}

impl LongOperation {
    pub(crate) fn begin(
        activity: &'static ActivityRecord,
        token: Arc<IncarnationToken>,
        span: Duration,
    ) -> Self {
        let before = activity.read().component.allowance;
        let operation = LongOperation { activity, token, before };
        operation.announce(span.max(before));
        operation
    }

    fn announce(&self, span: Duration) {
        // The activity record may belong to another incarnation by now.
        if !self.token.has_ended() {
            self.activity.allow(span);
        }
    }
}

impl Drop for LongOperation {
    fn drop(&mut self) {
        self.announce(self.before);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::liveness::activity::ActivitySlot;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn of_operations_within_one_another_the_longest_counts() {
        let slot = ActivitySlot::claim();
        let begin = |span| LongOperation::begin(slot.activity, Arc::default(), span);
        let allowance = || slot.activity.read().component.allowance;

        let outer = begin(800 * MS);
        let inner = begin(10 * MS);
        assert_eq!(allowance(), 800 * MS, "a shorter one does not shorten it");
        drop(inner);
        assert_eq!(allowance(), 800 * MS);
        let longer = begin(2000 * MS);
        assert_eq!(allowance(), 2000 * MS);
        drop(longer);
        assert_eq!(allowance(), 800 * MS);
        drop(outer);
        assert_eq!(allowance(), Duration::ZERO);
    }

    #[test]
    fn what_outlives_its_incarnation_changes_no_later_one() {
        let (slot, token) = (ActivitySlot::claim(), Arc::<IncarnationToken>::default());
        let late = LongOperation::begin(slot.activity, token.clone(), 800 * MS);
        token.end();
        slot.activity.allow(500 * MS);

        drop(late);

        assert_eq!(slot.activity.read().component.allowance, 500 * MS);
    }
}
