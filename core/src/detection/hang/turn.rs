//! What is on the thread of an arbiter.

use super::{ArbiterSample, SlotId};
use crate::{Instant, ObjectName};
use std::time::Duration;

/// What is on the thread of an arbiter, since when, and how much of that time is charged to it.
#[derive(Debug)]
pub(super) struct ThreadTurn {
    pub(super) running: Option<SlotId>,
    turn: Option<u64>,
    pub(super) allowance: Duration,
    /// At which look these were first seen.
    pub(super) since: Instant,
    pub(super) charged: Duration,
    /// What the thread had used of the processor at the last look, if it was ready to run.
    used: Option<Duration>,
    /// The component that was abandoned while it was on the thread.
    pub(super) left: Option<ObjectName>,
}

fn allowance(sample: &ArbiterSample) -> Duration {
    sample.activity.map_or(Duration::ZERO, |activity| activity.allowance)
}

impl ThreadTurn {
    /// The turn that the first sample of an arbiter shows.
    pub(super) fn new(sample: &ArbiterSample, at: Instant) -> Self {
        ThreadTurn {
            running: sample.running,
            turn: sample.activity.map(|activity| activity.turn),
            allowance: allowance(sample),
            since: at,
            charged: Duration::ZERO,
            used: None,
            left: None,
        }
    }

    /// Returns whether the thread has moved on since the last sample.
    pub(super) fn handle_sample(
        &mut self,
        sample: &ArbiterSample,
        at: Instant,
        beats: bool,
        hangs: bool,
    ) -> bool {
        let turn = sample.activity.map(|activity| activity.turn);
        // A culprit that was abandoned meanwhile has not thereby moved on.
        let turned = turn.is_some() && self.turn != turn;
        let changed = beats || self.running != sample.running || turned;
        if changed {
            (self.running, self.turn) = (sample.running, turn);
            (self.since, self.left) = (at, None);
        } else if self.allowance != allowance(sample) && !hangs {
            // A declared operation begins or ends within the turn: each part has its own time.
            self.since = at;
        }
        self.allowance = allowance(sample);
        changed
    }

    /// Charges the turn with the time since the last look, and returns that. A thread that was
    /// ready to run did what it used of the processor, however late this look is. One that waits
    /// for something does so by the detector's clock, which went on by `step`.
    pub(super) fn charge(
        &mut self,
        used: Option<Duration>,
        step: Duration,
        at: Instant,
    ) -> Duration {
        let charged = match (std::mem::replace(&mut self.used, used), used) {
            (Some(before), Some(used)) => used.saturating_sub(before),
            _ => step,
        };
        self.charged = (self.charged + charged).min(at - self.since);
        charged
    }
}
