//! The slot for the reply to one request.
//!
//! A slot belongs to the caller's side. The callee holds a [`Responder`] that fills it, and the
//! callee's cell and deadline hold a [`Cancel`] that resolves it without the callee. So a callee
//! that hangs does not keep its callers waiting, and a reply of an abandoned one is refused. A slot
//! takes the first result only.

use crate::arbiter::deadline::{Cancel, Deadline};
use crate::arbiter::heartbeat::{self, ArbiterHeartbeat};
use crate::messaging::error::RequestError;
use crate::platform;
use crate::sync::atomic::AtomicBool;
use crate::sync::atomic::Ordering::Relaxed;
use crate::sync::{Mutex, MutexGuard};
use blastema_core::{Contract, DeliveryError, Instant};
use std::pin::Pin;
use std::sync::{Arc, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

/// Gets a reply that leaves this process, or the reason why there is none.
pub(crate) type ReplyCallback<M> =
    Box<dyn FnOnce(Result<<M as Contract>::Reply, DeliveryError>) + Send>;

pub(crate) struct ReplySlot<M: Contract> {
    state: Mutex<State<M>>,
    /// No result has come yet, and the caller waits; readable without the lock.
    open: AtomicBool,
    /// The caller's deadline, which is known of requests from other nodes.
    until: Option<Instant>,
    /// The slot of the component of this process that asks.
    asker: Option<u32>,
}

enum State<M: Contract> {
    /// Nothing has come yet.
    Open(Listener<M>),
    /// This has come, and waits to be fetched.
    Resolved(Result<M::Reply, RequestError<M>>),
    /// The caller does not wait any more.
    Closed,
}

enum Listener<M: Contract> {
    None,
    Task(Waker),
    Callback(ReplyCallback<M>),
}

impl<M: Contract> ReplySlot<M> {
    fn lock(&self) -> MutexGuard<'_, State<M>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn resolve(&self, result: Result<M::Reply, RequestError<M>>) {
        let mut state = self.lock();
        let State::Open(listener) = &mut *state else { return };
        self.open.store(false, Relaxed);
        match std::mem::replace(listener, Listener::None) {
            Listener::None => *state = State::Resolved(result),
            Listener::Task(waker) => {
                *state = State::Resolved(result);
                drop(state);
                waker.wake();
            }
            Listener::Callback(callback) => {
                *state = State::Closed;
                drop(state);
                callback(result.map_err(|error| error.kind));
            }
        }
    }
}

impl<M: Contract> Cancel for ReplySlot<M> {
    fn cancel(&self, why: DeliveryError) {
        self.resolve(Err(RequestError::new(why, None)));
    }

    fn asker(&self) -> Option<u32> {
        self.asker
    }
}

/// The callee's end of a slot. Dropped without an answer, it says that the callee was stopped.
pub(crate) struct Responder<M: Contract>(Option<Arc<ReplySlot<M>>>);

impl<M: Contract> Responder<M> {
    /// A slot whose result is awaited.
    #[inline]
    pub(crate) fn awaited() -> (Responder<M>, ReplyFuture<M>) {
        Responder::awaited_until(None)
    }

    /// A slot whose result is awaited until then.
    pub(crate) fn awaited_until(until: Option<Instant>) -> (Responder<M>, ReplyFuture<M>) {
        let state = Mutex::new(State::Open(Listener::None));
        let asker = heartbeat::running_here();
        let slot = Arc::new(ReplySlot { state, open: AtomicBool::new(true), until, asker });
        (Responder(Some(slot.clone())), ReplyFuture { slot, limit: Limit::None, done: false })
    }

    /// A slot whose result goes to a callback, and is wanted until then.
    pub(crate) fn called_back(callback: ReplyCallback<M>, until: Option<Instant>) -> Responder<M> {
        let state = Mutex::new(State::Open(Listener::Callback(callback)));
        let open = AtomicBool::new(true);
        Responder(Some(Arc::new(ReplySlot { state, open, until, asker: None })))
    }

    /// Puts the reply in, unless the slot was revoked.
    #[inline]
    pub(crate) fn give(mut self, reply: M::Reply) {
        if let Some(slot) = self.0.take() {
            slot.resolve(Ok(reply));
        }
    }

    /// Says that there will be no reply, and gives the message back where it was not taken up.
    pub(crate) fn refuse(mut self, why: DeliveryError, message: Option<M>) {
        if let Some(slot) = self.0.take() {
            slot.resolve(Err(RequestError::new(why, message)));
        }
    }

    /// The end of the slot that resolves it without the callee.
    #[inline]
    pub(crate) fn revocable(&self) -> Option<Arc<dyn Cancel>> {
        self.0.clone().map(|slot| slot as Arc<dyn Cancel>)
    }

    /// The caller's deadline, if it is known.
    pub(crate) fn until(&self) -> Option<Instant> {
        self.0.as_ref().and_then(|slot| slot.until)
    }

    /// The asker still waits, as far as is known.
    #[inline]
    pub(crate) fn is_wanted(&self) -> bool {
        let waits = |slot: &Arc<ReplySlot<M>>| {
            slot.open.load(Relaxed) && slot.until.is_none_or(|until| platform::now() < until)
        };
        self.0.as_ref().is_some_and(waits)
    }
}

impl<M: Contract> Drop for Responder<M> {
    fn drop(&mut self) {
        if let Some(slot) = self.0.take() {
            slot.cancel(DeliveryError::Stopped);
        }
    }
}

/// The caller's end of a slot: resolves to the reply, or to the reason why there is none. Dropping
/// it shows the callee that the caller does not wait any more.
pub(crate) struct ReplyFuture<M: Contract> {
    slot: Arc<ReplySlot<M>>,
    limit: Limit,
    /// The result has been fetched.
    done: bool,
}

enum Limit {
    /// No time is set.
    None,
    /// To be set at the first poll.
    Within(Duration),
    /// Swept by the beat of the arbiter on which the wait began.
    Swept { _deadline: Deadline },
    /// This thread has no beat.
    Timed(Pin<Box<tokio::time::Sleep>>),
}

impl<M: Contract> ReplyFuture<M> {
    /// The same, and it resolves with [`DeliveryError::DeadlinePassed`] when nothing came in time.
    #[inline]
    pub(crate) fn within(mut self, deadline: Duration) -> Self {
        self.limit = Limit::Within(deadline);
        self
    }
}

impl<M: Contract> Future for ReplyFuture<M> {
    type Output = Result<M::Reply, RequestError<M>>;

    fn poll(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let this = self.get_mut();
        if let Limit::Timed(sleep) = &mut this.limit
            && sleep.as_mut().poll(cx).is_ready()
        {
            this.slot.cancel(DeliveryError::DeadlinePassed);
        }
        let mut state = this.slot.lock();
        match &mut *state {
            State::Open(Listener::Task(waker)) => waker.clone_from(cx.waker()),
            State::Open(listener) => *listener = Listener::Task(cx.waker().clone()),
            State::Resolved(_) => {
                let State::Resolved(result) = std::mem::replace(&mut *state, State::Closed) else {
                    return Poll::Pending;
                };
                drop(state);
                this.done = true;
                return Poll::Ready(result);
            }
            State::Closed => return Poll::Pending,
        }
        drop(state);
        if let Limit::Within(deadline) = this.limit {
            if ArbiterHeartbeat::beats_here() {
                this.limit = Limit::Swept { _deadline: Deadline::set(deadline, this.slot.clone()) };
            } else {
                this.limit = Limit::Timed(Box::pin(tokio::time::sleep(deadline)));
                cx.waker().wake_by_ref();
            }
        }
        Poll::Pending
    }
}

impl<M: Contract> Drop for ReplyFuture<M> {
    fn drop(&mut self) {
        if self.done {
            return;
        }
        self.slot.open.store(false, Relaxed);
        // The reply, if it is there, is the user's: it is dropped outside of the lock.
        let _left = std::mem::replace(&mut *self.slot.lock(), State::Closed);
    }
}
