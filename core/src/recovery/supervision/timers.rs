//! When a supervisor acts by itself.

use super::{ChildKey, Supervisor};
use crate::Instant;
use crate::timer::Timers;

/// The timers of a supervisor.
#[derive(Clone, Copy, Debug)]
pub(crate) enum SupervisorTimer {
    /// Gives up what a child was asked to do and has not done in its time: to start, to end, to be
    /// reset.
    ChildDeadline,
    /// Grants restarts that the restart intensity did not allow before.
    RestartRelease,
}

impl Timers for Supervisor {
    type Timer = SupervisorTimer;

    const TIMERS: &'static [SupervisorTimer] = {
        use SupervisorTimer::*;
        &[ChildDeadline, RestartRelease]
    };

    fn due(&self, timer: SupervisorTimer) -> Option<Instant> {
        match timer {
            SupervisorTimer::ChildDeadline => {
                self.timed.iter().filter_map(|key| self.children[key].due()).min()
            }
            SupervisorTimer::RestartRelease => self.budget.next_release(),
        }
    }

    fn fire(&mut self, timer: SupervisorTimer, now: Instant) {
        match timer {
            SupervisorTimer::ChildDeadline => {
                let is_due =
                    |key: &&ChildKey| self.children[*key].due().is_some_and(|due| due <= now);
                let overdue: Vec<ChildKey> = self.timed.iter().filter(is_due).copied().collect();
                overdue.into_iter().for_each(|key| self.handle_overdue(key, now));
            }
            SupervisorTimer::RestartRelease => {
                let released = self.budget.release(now);
                if self.budget.is_shared() && !released.is_empty() {
                    self.for_each(|supervisor, key| supervisor.grant(key, now));
                } else {
                    released.into_iter().for_each(|key| self.grant(key, now));
                }
            }
        }
    }
}
