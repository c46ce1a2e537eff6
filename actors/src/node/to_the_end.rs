//! Work that is done to its end, also where its caller waits for it no more.

use actix::ArbiterHandle;
use std::pin::Pin;
use std::task::{Context, Poll};
use tokio::runtime::Handle;

/// Does the work where it is polled. If it is dropped before that is done, the work goes on at the
/// given place, or else on the thread that drops it.
pub(super) struct ToTheEnd<T: 'static> {
    arbiter: Option<ArbiterHandle>,
    work: Option<Pin<Box<dyn Future<Output = T> + Send>>>,
}

impl<T: 'static> ToTheEnd<T> {
    pub(super) fn of(
        arbiter: Option<ArbiterHandle>,
        work: impl Future<Output = T> + Send + 'static,
    ) -> Self {
        ToTheEnd { arbiter, work: Some(Box::pin(work)) }
    }
}

impl<T: 'static> Future for ToTheEnd<T> {
    type Output = T;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<T> {
        let work = self.work.as_mut().expect("what has ended is not polled again");
        let polled = work.as_mut().poll(cx);
        if polled.is_ready() {
            self.work = None;
        }
        polled
    }
}

impl<T: 'static> Drop for ToTheEnd<T> {
    fn drop(&mut self) {
        let Some(work) = self.work.take() else { return };
        let work = async { drop(work.await) };
        if let Some(arbiter) = &self.arbiter {
            // A place that has ended takes no work: then the work is done by others, or was.
            arbiter.spawn(work);
        } else if let Ok(runtime) = Handle::try_current() {
            drop(runtime.spawn(work));
        }
    }
}
