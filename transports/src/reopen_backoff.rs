//! Opening a medium again when it could not be opened or was lost.

use blastema_core::recovery::Backoff;
use std::future::Future;
use std::pin::Pin;
use std::task::{self, Poll};
use std::time::Duration;
use tokio::time::Sleep;

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
    pause: Option<Pin<Box<Sleep>>>,
}

impl ReopenBackoff {
    /// Begins the pause after a failed attempt.
    pub(crate) fn failed(&mut self) {
        self.failures = self.failures.saturating_add(1);
        let pause = BACKOFF.delay(self.failures.saturating_add(1), 0);
        self.pause = Some(Box::pin(tokio::time::sleep(pause)));
    }

    /// Forgets the failures: it is open now, or a new incarnation begins.
    pub(crate) fn reset(&mut self) {
        *self = ReopenBackoff::default();
    }

    /// Ready when the next attempt is due.
    pub(crate) fn poll_due(&mut self, task: &mut task::Context<'_>) -> Poll<()> {
        match &mut self.pause {
            Some(pause) => pause.as_mut().poll(task),
            None => Poll::Ready(()),
        }
    }
}
