//! A time that a medium waits for.

#[cfg(any(all(feature = "can", target_os = "linux"), feature = "slcan", feature = "fault"))]
use blastema_core::Instant;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::time::Sleep;

/// A time that is waited for, or none.
#[derive(Default)]
pub(crate) struct MediumTimer {
    #[cfg(any(all(feature = "can", target_os = "linux"), feature = "slcan", feature = "fault"))]
    due: Option<Instant>,
    sleep: Option<Pin<Box<Sleep>>>,
}

impl MediumTimer {
    /// Waits for so long from now on.
    pub(crate) fn after(span: Duration) -> Self {
        MediumTimer {
            #[cfg(any(
                all(feature = "can", target_os = "linux"),
                feature = "slcan",
                feature = "fault"
            ))]
            due: None,
            sleep: Some(Box::pin(tokio::time::sleep(span))),
        }
    }

    /// Ready when the time has come, and where none is waited for.
    pub(crate) fn poll(&mut self, task: &mut Context<'_>) -> Poll<()> {
        if let Some(sleep) = &mut self.sleep {
            ready!(sleep.as_mut().poll(task));
            *self = MediumTimer::default();
        }
        Poll::Ready(())
    }

    /// Ready at this time, which takes the place of the one before.
    #[cfg(any(all(feature = "can", target_os = "linux"), feature = "slcan", feature = "fault"))]
    pub(crate) fn poll_at(
        &mut self,
        due: Instant,
        now: Instant,
        task: &mut Context<'_>,
    ) -> Poll<()> {
        if self.due != Some(due) {
            *self = MediumTimer { due: Some(due), ..MediumTimer::after(due - now) };
        }
        self.poll(task)
    }
}
