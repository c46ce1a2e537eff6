//! Work that is done to its end, also where its caller waits for it no more.

use actix::ArbiterHandle;
use std::pin::Pin;
use std::task::{Context, Poll};
use tokio::runtime::Handle;

type Work = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Does the work where it is polled. If it is dropped before that is done, the work goes on at the
/// given place, or else on the thread that drops it.
pub(super) struct ToTheEnd {
    arbiter: Option<ArbiterHandle>,
    work: Option<Work>,
}

impl ToTheEnd {
    pub(super) fn of(
        arbiter: Option<ArbiterHandle>,
        work: impl Future<Output = ()> + Send + 'static,
    ) -> Self {
        ToTheEnd { arbiter, work: Some(Box::pin(work)) }
    }
}

impl Future for ToTheEnd {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        let Some(work) = &mut self.work else { return Poll::Ready(()) };
        let polled = work.as_mut().poll(cx);
        if polled.is_ready() {
            self.work = None;
        }
        polled
    }
}

impl Drop for ToTheEnd {
    fn drop(&mut self) {
        let Some(work) = self.work.take() else { return };
        if let Some(arbiter) = &self.arbiter {
            // A place that has ended takes no work: then the work is done by others, or was.
            arbiter.spawn(work);
        } else if let Ok(runtime) = Handle::try_current() {
            drop(runtime.spawn(work));
        }
    }
}
