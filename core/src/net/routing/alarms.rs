//! Alarms that were reported as faults, until they clear.
//!
//! A condition that lasts is reported again and again: announcements are repeated every ten
//! seconds. A condition that is not reported for a minute has ended.

use super::{Router, RouterAlarm, RouterOutput};
use crate::net::active_alarms::QUIET;

impl Router {
    /// It is told of now.
    pub(super) fn begin_trouble(&mut self, trouble: RouterAlarm) {
        self.troubles.raise(trouble, self.now);
        self.wake_at = self.wake_at.min(self.now + QUIET);
    }

    /// It goes on, if it was told of.
    pub(super) fn go_on(&mut self, trouble: RouterAlarm) {
        self.troubles.go_on(&trouble, self.now);
    }

    pub(super) fn end_troubles(&mut self) {
        for trouble in self.troubles.take_over(self.now) {
            // When it begins again, it is told of again.
            self.reported_conflict = None;
            self.forget_namesakes();
            self.outputs.push_back(RouterOutput::Over(trouble));
        }
    }
}
