//! Where messages of one contract can be sent, to a local or a remote receiver alike.

use crate::messaging::error::{Receiver, RequestError, SendError};
use crate::messaging::incarnation::IncarnationToken;
use crate::messaging::message_id::next_id;
use crate::messaging::retry;
use crate::messaging::sink::{MessageSink, Redirect};
use crate::settings::DEFAULT_DEADLINE;
use blastema_core::{Contract, DeliveryError, MessageId, RetryPolicy};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

/// Sends messages of contract `M` to one receiver, local or remote. It stays valid across the
/// receiver's restarts; one that was found by name reaches the component that has the name now.
///
/// Messages from one sender to one receiver arrive in order. An accepted message is served unless
/// the receiver dies while it serves it, is stopped, or its queue's policy drops it; all of these
/// are counted among the dead letters.
pub struct Sender<M: Contract>(pub(crate) Arc<dyn MessageSink<M>>);

impl<M: Contract> Clone for Sender<M> {
    fn clone(&self) -> Self {
        Sender(self.0.clone())
    }
}

impl<M: Contract> fmt::Debug for Sender<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Sender of {}", M::NAME)
    }
}

impl<M: Contract> Sender<M> {
    /// Hands the message to the receiver's queue. Never waits; a reply, if the contract has one, is
    /// dropped.
    ///
    /// # Errors
    /// The reason, and the message as it was.
    pub fn tell(&self, message: M) -> Result<(), SendError<M>> {
        self.0.tell(message).map_err(|error| error.at(|| self.0.receiver()))
    }

    /// Sends the message, and waits while the receiver's queue is full. A message to another node,
    /// once accepted here, waits there until the receiver's queue has space.
    ///
    /// # Errors
    /// The reason, and the message as it was; never [`DeliveryError::Full`],
    /// [`DeliveryError::WayFull`] or [`DeliveryError::Restarting`].
    pub async fn deliver(&self, message: M) -> Result<(), SendError<M>> {
        deliver(&*self.0, message).await.map_err(|error| error.at(|| self.0.receiver()))
    }

    /// Sends a request and waits up to one second for the reply.
    ///
    /// # Errors
    /// The request always resolves: with the reply, when the deadline passes, or when the receiver
    /// dies, whichever is first. The message comes back where it was not taken up.
    ///
    /// A receiver on another node does not begin a request whose deadline has passed. Where the way
    /// to it was lost after the request had been sent, the outcome is not known, which is said by
    /// [`DeliveryError::OutcomeUnknown`]; a contract that is declared `idempotent` is then asked
    /// again by itself as soon as there is a way, and where the receiver died while it served it,
    /// within the deadline.
    pub async fn ask(&self, message: M) -> Result<M::Reply, RequestError<M>> {
        self.ask_within(message, DEFAULT_DEADLINE).await
    }

    /// Asks, and waits for the reply until the deadline.
    ///
    /// # Errors
    /// As [`ask`](Self::ask).
    pub async fn ask_within(
        &self,
        message: M,
        deadline: Duration,
    ) -> Result<M::Reply, RequestError<M>> {
        ask_within(&*self.0, message, deadline).await
    }

    /// Asks, and asks again by this rule where the request was not taken up, or, if its contract is
    /// declared `idempotent`, where it may have taken effect.
    ///
    /// ```
    /// use blastema::RetryPolicy;
    /// # use blastema::prelude::*;
    /// # #[derive(Debug, Request)] #[contract(reply = u32)] struct Count;
    /// # async fn f(counter: Sender<Count>) -> Result<(), Box<dyn std::error::Error>> {
    /// let rule = RetryPolicy { attempts: 3, ..RetryPolicy::default() };
    /// let count = counter.ask_by(Count, &rule).await?;
    /// # let _ = count; Ok(()) }
    /// ```
    ///
    /// # Errors
    /// What stood in the way of the last attempt.
    pub async fn ask_by(
        &self,
        message: M,
        rule: &RetryPolicy,
    ) -> Result<M::Reply, RequestError<M>> {
        let asked = retry::ask_by(&*self.0, message, rule).await;
        asked.map_err(|error| error.at(|| self.0.receiver()))
    }

    /// Prepares a request that may be sent more than once and stays the same message: if it has
    /// killed three incarnations of the receiver, it is quarantined. A receiver on another node
    /// serves it once, and answers with the same reply for a minute, as long as its node lives; a
    /// request that failed is not remembered.
    pub fn repeatable(&self, message: M) -> Repeatable<M>
    where
        M: Clone,
    {
        Repeatable { sender: self.clone(), message, id: next_id() }
    }
}

/// A request that may be sent more than once, under one identity.
#[derive(Debug)]
pub struct Repeatable<M: Contract> {
    sender: Sender<M>,
    message: M,
    id: MessageId,
}

impl<M: Contract + Clone> Repeatable<M> {
    /// Sends it, or sends it again, and waits for one second at most.
    ///
    /// # Errors
    /// As [`Sender::ask`].
    pub async fn ask(&self) -> Result<M::Reply, RequestError<M>> {
        self.ask_within(DEFAULT_DEADLINE).await
    }

    /// Sends it, or sends it again, and waits until the deadline.
    ///
    /// # Errors
    /// As [`Sender::ask`].
    pub async fn ask_within(&self, deadline: Duration) -> Result<M::Reply, RequestError<M>> {
        let (inlet, message) = (&self.sender.0, self.message.clone());
        let asked =
            async { inlet.ask(message, Some(self.id), Some(deadline))?.within(deadline).await };
        asked.await.map_err(|error| not_answered(&**inlet, error, deadline))
    }

    /// The identity of the message, the same each time that it is sent.
    pub fn id(&self) -> MessageId {
        self.id
    }
}

/// Asks, and again where an idempotent request may have met the end of an incarnation.
#[inline]
pub(crate) async fn ask_within<M: Contract>(
    inlet: &(impl MessageSink<M> + ?Sized),
    message: M,
    deadline: Duration,
) -> Result<M::Reply, RequestError<M>> {
    let asked = async {
        if M::IDEMPOTENT {
            return retry::ask_idempotent(inlet, message, deadline).await;
        }
        inlet.ask(message, None, Some(deadline))?.within(deadline).await
    };
    asked.await.map_err(|error| not_answered(inlet, error, deadline))
}

/// Names the receiver and the deadline of a request.
#[cold]
fn not_answered<M: Contract>(
    inlet: &(impl MessageSink<M> + ?Sized),
    error: RequestError<M>,
    deadline: Duration,
) -> RequestError<M> {
    if error.kind == DeliveryError::DeadlinePassed {
        inlet.overdue();
    }
    error.at(|| Some(Receiver { deadline: Some(deadline), ..inlet.receiver()? }))
}

pub(crate) async fn deliver<M: Contract>(
    inlet: &(impl MessageSink<M> + ?Sized),
    message: M,
) -> Result<(), SendError<M>> {
    let mut message = message;
    loop {
        match inlet.offer(message) {
            Err(SendError {
                kind:
                    DeliveryError::Full | DeliveryError::WayFull { .. } | DeliveryError::Restarting,
                message: back,
                ..
            }) => message = back,
            other => return other,
        }
        inlet.space().await;
    }
}

/// A sender for a thread of the component's own: it is refused once the incarnation that made it
/// has ended.
pub(crate) struct DetachedSender<M: Contract> {
    pub(crate) inner: Sender<M>,
    pub(crate) incarnation: Arc<IncarnationToken>,
}

impl<M: Contract> Redirect<M> for DetachedSender<M> {
    fn present(&self) -> Result<Arc<dyn MessageSink<M>>, DeliveryError> {
        self.incarnation.forbidden().map_or_else(|| Ok(self.inner.0.clone()), Err)
    }

    fn receiver(&self) -> Option<Receiver> {
        self.inner.0.receiver()
    }
}
