//! Opening a medium again when it could not be opened or was lost.

use crate::medium_timer::MediumTimer;
use blastema_core::recovery::Backoff;
use std::task::{self, Poll};
use std::time::Duration;

/// What a dying process still holds is free after some milliseconds; how late a freed port may be
/// noticed is the limit. One process tries one address, so that jitter is not needed.
const BACKOFF: Backoff = Backoff {
    first: Duration::from_millis(20),
    factor: 2,
    limit: Duration::from_secs(1),
    jitter_percent: 0,
};

/// Counts failed attempts and waits between them.
#[derive(Default)]
pub(crate) struct ReopenBackoff {
    failures: u32,
    pause: MediumTimer,
}

impl ReopenBackoff {
    /// Begins the pause after a failed attempt.
    pub(crate) fn failed(&mut self) {
        self.failures = self.failures.saturating_add(1);
        let pause = BACKOFF.delay(self.failures.saturating_add(1), 0);
        self.pause = MediumTimer::after(pause);
    }

    /// Forgets the failures: it is open now, or a new incarnation begins.
    pub(crate) fn reset(&mut self) {
        *self = ReopenBackoff::default();
    }

    /// Ready when the next attempt is due.
    pub(crate) fn poll_due(&mut self, task: &mut task::Context<'_>) -> Poll<()> {
        self.pause.poll(task)
    }
}
