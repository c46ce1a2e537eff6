//! A message on its way, type-erased towards its receiver.
//!
//! An envelope is plain data and crosses threads sealed. Its handler's future is built on the
//! receiving thread, in a future slot: a pinned place that is kept per component and contract and
//! filled again and again, so that a message costs one allocation, the envelope; an event that a
//! hub hands to an idle listener needs no envelope, and costs none. The future owns a
//! share of the component's slot and borrows the component for as long as it runs. The guard owns
//! the other share, so that an unwinding handler never drops the component.

use crate::arbiter::deadline::Cancel;
use crate::arbiter::heartbeat;
use crate::component::slot::ComponentSlot;
use crate::component::{Component, Handle};
use crate::messaging::reply::Responder;
use crate::platform;
use blastema_core::{Contract, DeliveryError, Instant, MessageId};
use std::any::{Any, TypeId};
use std::cell::Cell;
use std::pin::Pin;
use std::rc::Rc;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

pub(crate) type BoxedEnvelope<C> = Box<dyn Envelope<C> + Send>;

/// What the executor needs of an envelope before it opens it.
pub(crate) struct EnvelopeHeader {
    pub(crate) contract: TypeId,
    pub(crate) name: &'static str,
    pub(crate) posted_at: Instant,
    /// By which its age is judged.
    pub(crate) captured_at: Instant,
    pub(crate) max_age: Option<Duration>,
    /// A death of the receiver by this message is to be reported to its sender.
    pub(crate) is_followed: bool,
}

impl EnvelopeHeader {
    /// Whether the message is older than its contract allows.
    #[inline]
    pub(crate) fn is_expired(&self) -> bool {
        self.max_age.is_some_and(|limit| platform::now() - self.captured_at > limit)
    }
}

/// When a message was posted, and when the data in it was captured, where the sender has said so.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Times {
    pub(crate) posted_at: Instant,
    pub(crate) captured_at: Option<Instant>,
}

impl Times {
    /// By which the age of the message is judged.
    #[inline]
    pub(crate) fn captured_at(self) -> Instant {
        self.captured_at.unwrap_or(self.posted_at)
    }
}

impl From<Instant> for Times {
    #[inline]
    fn from(posted_at: Instant) -> Self {
        Times { posted_at, captured_at: None }
    }
}

pub(crate) trait Envelope<C: Component> {
    fn header(&self) -> EnvelopeHeader;
    /// Whether the caller has stopped waiting for the reply.
    fn is_void(&self) -> bool;
    fn id(&self) -> Option<MessageId>;
    /// The request, for the code that resolves it when the receiver dies or hangs.
    fn revocable(&self) -> Option<Arc<dyn Cancel>>;
    /// Reports to the caller that the message was not accepted, and returns it.
    fn give_back(&mut self, why: DeliveryError);
    /// A slot for the futures of this contract.
    fn future_slot(&self) -> Box<dyn FutureSlot<C>>;
    /// Where such a slot finds the message.
    fn contents(&mut self) -> &mut dyn Any;
}

/// A pinned place, on the arbiter only, in which one contract's handler futures run one after
/// another.
pub(crate) trait FutureSlot<C: Component>: Any {
    fn refill(&mut self, contents: &mut dyn Any, slot: &Rc<ComponentSlot<C>>) -> bool;
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<()>;
}

/// The same to a caller that knows the contract, and has its message at hand.
pub(crate) trait EventFutureSlot<C: Component, M: Contract> {
    /// Begins the handler of an event.
    fn begin(&mut self, event: M, slot: &Rc<ComponentSlot<C>>, cx: &mut Context<'_>) -> Poll<()>;
}

struct Contents<M: Contract> {
    message: Option<M>,
    responder: Option<Responder<M>>,
}

/// An envelope that stays what it is: plain data, and `Send` by itself.
struct Sealed<M: Contract, G> {
    make: G,
    contents: Contents<M>,
    posted_at: Instant,
    /// Boxed, since few messages have it.
    rare: Option<Box<Rare>>,
}

/// What few messages have.
struct Rare {
    id: Option<MessageId>,
    captured_at: Option<Instant>,
}

struct HandlerFuture<M: Contract, G, F> {
    make: G,
    responder: Option<Responder<M>>,
    future: Pin<Box<Option<F>>>,
}

impl<M: Contract, G, F> HandlerFuture<M, G, F> {
    fn new(make: G) -> Self {
        HandlerFuture { make, responder: None, future: Box::pin(None) }
    }
}

impl<C, M, G, F> Envelope<C> for Sealed<M, G>
where
    C: Component,
    M: Contract,
    G: Fn(Rc<ComponentSlot<C>>, M) -> F + Copy + Send + 'static,
    F: Future<Output = M::Reply> + 'static,
{
    #[inline]
    fn header(&self) -> EnvelopeHeader {
        EnvelopeHeader {
            contract: TypeId::of::<M>(),
            name: M::NAME,
            posted_at: self.posted_at,
            captured_at: self
                .rare
                .as_ref()
                .and_then(|rare| rare.captured_at)
                .unwrap_or(self.posted_at),
            max_age: M::MAX_AGE,
            is_followed: self.contents.responder.is_some()
                || self.rare.as_ref().is_some_and(|rare| rare.id.is_some()),
        }
    }

    fn is_void(&self) -> bool {
        self.contents.responder.as_ref().is_some_and(|responder| !responder.is_wanted())
    }

    fn id(&self) -> Option<MessageId> {
        self.rare.as_ref().and_then(|rare| rare.id)
    }

    fn revocable(&self) -> Option<Arc<dyn Cancel>> {
        self.contents.responder.as_ref()?.revocable()
    }

    fn give_back(&mut self, why: DeliveryError) {
        let message = self.contents.message.take();
        if let Some(responder) = self.contents.responder.take() {
            responder.refuse(why, message);
        }
    }

    fn future_slot(&self) -> Box<dyn FutureSlot<C>> {
        Box::new(HandlerFuture::<M, G, F>::new(self.make))
    }

    fn contents(&mut self) -> &mut dyn Any {
        &mut self.contents
    }
}

impl<C, M, G, F> FutureSlot<C> for HandlerFuture<M, G, F>
where
    C: Component,
    M: Contract,
    G: Fn(Rc<ComponentSlot<C>>, M) -> F + Copy + 'static,
    F: Future<Output = M::Reply> + 'static,
{
    #[inline]
    fn refill(&mut self, contents: &mut dyn Any, slot: &Rc<ComponentSlot<C>>) -> bool {
        let Some(contents) = contents.downcast_mut::<Contents<M>>() else { return false };
        let Some(message) = contents.message.take() else { return false };
        self.responder = contents.responder.take();
        self.future.set(Some((self.make)(slot.clone(), message)));
        true
    }

    #[inline]
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        let Some(future) = self.future.as_mut().as_pin_mut() else { return Poll::Ready(()) };
        let Poll::Ready(reply) = future.poll(cx) else {
            let Some(why) = REFUSED.take() else { return Poll::Pending };
            if let Some(responder) = self.responder.take() {
                responder.refuse(why, None);
            }
            self.future.set(None);
            return Poll::Ready(());
        };
        if let Some(responder) = self.responder.take() {
            match heartbeat::send_refusal() {
                None => responder.give(reply),
                Some(why) => responder.refuse(why, None),
            }
        }
        self.future.set(None);
        Poll::Ready(())
    }
}

impl<C, M, G, F> EventFutureSlot<C, M> for HandlerFuture<M, G, F>
where
    C: Component,
    M: Contract,
    G: Fn(Rc<ComponentSlot<C>>, M) -> F + Copy + 'static,
    F: Future<Output = M::Reply> + 'static,
{
    #[inline]
    fn begin(&mut self, event: M, slot: &Rc<ComponentSlot<C>>, cx: &mut Context<'_>) -> Poll<()> {
        self.future.set(Some((self.make)(slot.clone(), event)));
        let Some(future) = self.future.as_mut().as_pin_mut() else { return Poll::Ready(()) };
        if future.poll(cx).is_pending() && REFUSED.take().is_none() {
            return Poll::Pending;
        }
        self.future.set(None);
        Poll::Ready(())
    }
}

thread_local! {
    /// Why the handler that was just polled refuses its message.
    static REFUSED: Cell<Option<DeliveryError>> = const { Cell::new(None) };
}

/// Ends the handler that awaits this: the asker gets the error in place of a reply.
#[cfg(feature = "device")]
pub(crate) async fn refuse<R>(why: DeliveryError) -> R {
    REFUSED.set(Some(why));
    std::future::pending().await
}

/// When the message was posted: exactly where its contract limits its age, else to the beat.
#[inline]
pub(crate) fn enqueue_time<M: Contract>() -> Instant {
    match M::MAX_AGE {
        Some(_) => platform::now(),
        None => heartbeat::coarse_now(),
    }
}

/// When a message was posted that took so long to arrive from another node.
pub(crate) fn arrived_posting_time<M: Contract>(age: Duration) -> Instant {
    match M::MAX_AGE {
        Some(_) => Instant::ORIGIN + (platform::now() - Instant::ORIGIN).saturating_sub(age),
        None => heartbeat::coarse_now(),
    }
}

/// Packs a message for the queue of a component.
#[inline]
pub(crate) fn seal_message<C: Handle<M>, M: Contract>(
    message: M,
    responder: Option<Responder<M>>,
    id: Option<MessageId>,
    times: impl Into<Times>,
) -> BoxedEnvelope<C> {
    let Times { posted_at, captured_at } = times.into();
    let contents = Contents { message: Some(message), responder };
    let is_rare = id.is_some() || captured_at.is_some();
    let rare = is_rare.then(|| Box::new(Rare { id, captured_at }));
    Box::new(Sealed { make: handle::<C, M>, contents, posted_at, rare })
}

/// A slot for the futures of this contract.
pub(crate) fn future_slot<C: Handle<M>, M: Contract>() -> Box<dyn FutureSlot<C>> {
    slot_of(handle::<C, M>)
}

/// The slot, if it is for the futures of this contract.
#[inline]
pub(crate) fn event_future_slot<C: Handle<M>, M: Contract>(
    slot: &mut dyn FutureSlot<C>,
) -> Option<&mut (impl EventFutureSlot<C, M> + use<C, M>)> {
    typed(handle::<C, M>, slot)
}

#[expect(clippy::manual_async_fn, reason = "an `async fn` keeps a second copy of its arguments")]
#[expect(
    clippy::await_holding_refcell_ref,
    reason = "messages wait while one is served; the control queue does not borrow"
)]
fn handle<C: Handle<M>, M: Contract>(
    slot: Rc<ComponentSlot<C>>,
    message: M,
) -> impl Future<Output = M::Reply> + use<C, M> {
    async move {
        let mut contents = slot.contents.borrow_mut();
        let (component, cx) = contents.both();
        if let Some(injected) = cx.before() {
            injected.await;
        }
        component.handle(message, cx).await
    }
}

/// Names the future's type by inference; it cannot be written down.
fn slot_of<C, M, G, F>(make: G) -> Box<dyn FutureSlot<C>>
where
    C: Component,
    M: Contract,
    G: Fn(Rc<ComponentSlot<C>>, M) -> F + Copy + 'static,
    F: Future<Output = M::Reply> + 'static,
{
    Box::new(HandlerFuture::<M, G, F>::new(make))
}

/// The same for the slot of this contract's futures.
#[inline]
fn typed<C, M, G, F>(_: G, slot: &mut dyn FutureSlot<C>) -> Option<&mut HandlerFuture<M, G, F>>
where
    C: Component,
    M: Contract,
    G: Fn(Rc<ComponentSlot<C>>, M) -> F + Copy + 'static,
    F: Future<Output = M::Reply> + 'static,
{
    (slot as &mut dyn Any).downcast_mut()
}
