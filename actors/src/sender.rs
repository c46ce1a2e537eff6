//! Where messages of one contract can be sent, whoever is behind it and wherever it lives.

use crate::asking;
use crate::host::life::IncarnationToken;
use crate::reply::ReplyFuture;
use blastema_core::{
    Contract, DeliveryError, MessageId, NodeName, ObjectName, Outcome, RetryPolicy,
};
use std::fmt;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// How long [`Sender::ask`] waits for a reply.
pub const DEFAULT_DEADLINE: Duration = Duration::from_secs(1);

/// What stands behind a [`Sender`]: a component here, or one on another node.
pub(crate) trait MessageSink<M: Contract>: Send + Sync {
    /// Hands the message over, or lets the receiver's policy decide. Never waits.
    fn tell(&self, message: M) -> Result<(), SendError<M>>;

    /// Hands the message over, or gives it back where there is no room.
    fn offer(&self, message: M) -> Result<(), SendError<M>>;

    /// Completes when there may be room for what was refused so.
    fn room<'a>(&'a self, refused: &DeliveryError)
    -> Pin<Box<dyn Future<Output = ()> + Send + 'a>>;

    /// Hands a request over. It is not begun when `within` has passed; who waits minds it as well.
    fn ask(
        &self,
        message: M,
        id: Option<MessageId>,
        within: Option<Duration>,
    ) -> Result<ReplyFuture<M>, RequestError<M>>;

    /// Whom its errors name.
    fn receiver(&self) -> Option<Receiver> {
        None
    }
}

/// The receiver that a failed message was for.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Receiver {
    /// Its node, where that is known.
    pub node: Option<NodeName>,
    /// Its name there.
    pub object: ObjectName,
    /// The contract of the message.
    pub contract: &'static str,
    /// How many messages its queue holds; `None` for a receiver on another node.
    pub queue: Option<usize>,
    /// The receiver serves nothing, because a hook of it waits for what is
    /// [not there yet](crate::Failure::unavailable); `None` for a receiver on another node.
    pub unavailable: Option<Unavailable>,
}

/// What a receiver waits for.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Unavailable {
    /// The reason that its hook gave last.
    pub reason: String,
    /// For how long it has waited.
    pub lasts: Duration,
}

impl fmt::Display for Unavailable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Unavailable { reason, lasts } = self;
        write!(f, "the receiver has been unavailable for {:.1} s: {reason}", lasts.as_secs_f64())
    }
}

impl fmt::Display for Receiver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.node {
            Some(node) => write!(f, "{node}:{}", self.object),
            None => write!(f, "{}", self.object),
        }
    }
}

/// Where messages of contract `M` can be sent. It outlives the receiver's restarts; local and
/// remote receivers are alike.
///
/// Messages from one sender to one receiver arrive in order. What was accepted is served unless the
/// receiver dies while it serves it, is stopped, or its queue's policy drops it; all of these are
/// counted among the dead letters.
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

    /// Hands the message to the receiver's queue, and waits while it has no room. What goes to
    /// another node waits there, once it has been accepted here, until the receiver has room.
    ///
    /// # Errors
    /// The reason, and the message as it was; never [`DeliveryError::Full`],
    /// [`DeliveryError::WayFull`] or [`DeliveryError::Restarting`].
    pub async fn deliver(&self, message: M) -> Result<(), SendError<M>> {
        deliver(&*self.0, message).await.map_err(|error| error.at(|| self.0.receiver()))
    }

    /// Asks, and waits for the reply for one second at most.
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
        let asked = async {
            if M::IDEMPOTENT {
                return asking::ask_idempotent(&*self.0, message, deadline).await;
            }
            self.0.ask(message, None, Some(deadline))?.within(deadline).await
        };
        asked.await.map_err(|error| error.at(|| self.0.receiver()))
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
        let asked = asking::ask_by(&*self.0, message, rule).await;
        asked.map_err(|error| error.at(|| self.0.receiver()))
    }

    /// Prepares a request that may be sent more than once and stays the same message: if it has
    /// killed three lives of the receiver, it is quarantined. A receiver on another node serves it
    /// once, and answers with the same reply for a minute, as long as its node lives; a request
    /// that failed is not remembered.
    pub fn repeatable(&self, message: M) -> Repeatable<M>
    where
        M: Clone,
    {
        Repeatable { sender: self.clone(), message, id: next_id() }
    }
}

/// One request that may be sent more than once, under one identity.
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
        asked.await.map_err(|error| error.at(|| inlet.receiver()))
    }

    /// Its identity.
    pub fn id(&self) -> MessageId {
        self.id
    }
}

/// A fresh identity for a message of this process.
pub(crate) fn next_id() -> MessageId {
    static NEXT: AtomicU64 = AtomicU64::new(1);
    static SENDER: std::sync::OnceLock<u64> = std::sync::OnceLock::new();
    let sender = *SENDER.get_or_init(crate::platform::random_seed);
    MessageId { sender, sequence: NEXT.fetch_add(1, Relaxed) }
}

pub(crate) async fn deliver<M: Contract>(
    inlet: &(impl MessageSink<M> + ?Sized),
    message: M,
) -> Result<(), SendError<M>> {
    let mut message = message;
    loop {
        let refused = match inlet.offer(message) {
            Err(SendError {
                kind:
                    why @ (DeliveryError::Full
                    | DeliveryError::WayFull { .. }
                    | DeliveryError::Restarting),
                message: back,
                ..
            }) => {
                message = back;
                why
            }
            other => return other,
        };
        inlet.room(&refused).await;
    }
}

/// A sender for a thread of the component's own: it is refused once the life that made it has
/// ended.
pub(crate) struct DetachedSender<M: Contract> {
    pub(crate) inner: Sender<M>,
    pub(crate) life: Arc<IncarnationToken>,
}

impl<M: Contract> MessageSink<M> for DetachedSender<M> {
    fn tell(&self, message: M) -> Result<(), SendError<M>> {
        match self.life.forbidden() {
            Some(why) => Err(SendError::new(why, message)),
            None => self.inner.0.tell(message),
        }
    }

    fn offer(&self, message: M) -> Result<(), SendError<M>> {
        match self.life.forbidden() {
            Some(why) => Err(SendError::new(why, message)),
            None => self.inner.0.offer(message),
        }
    }

    fn room<'a>(
        &'a self,
        refused: &DeliveryError,
    ) -> Pin<Box<dyn Future<Output = ()> + Send + 'a>> {
        self.inner.0.room(refused)
    }

    fn ask(
        &self,
        message: M,
        id: Option<MessageId>,
        within: Option<Duration>,
    ) -> Result<ReplyFuture<M>, RequestError<M>> {
        match self.life.forbidden() {
            Some(why) => Err(RequestError::new(why, Some(message))),
            None => self.inner.0.ask(message, id, within),
        }
    }

    fn receiver(&self) -> Option<Receiver> {
        self.inner.0.receiver()
    }
}

/// A message that was not handed over.
#[derive(PartialEq, Eq)]
pub struct SendError<M> {
    /// Why.
    pub kind: DeliveryError,
    /// The message as it was.
    pub message: M,
    // An error that is passed on through every call is better small.
    receiver: Option<Box<Receiver>>,
}

impl<M> SendError<M> {
    pub(crate) fn new(kind: DeliveryError, message: M) -> Self {
        SendError { kind, message, receiver: None }
    }

    /// Names the receiver.
    #[cold]
    pub(crate) fn at(mut self, receiver: impl FnOnce() -> Option<Receiver>) -> Self {
        self.receiver = receiver().map(Box::new);
        self
    }

    /// Whom the message was for, where that is known.
    pub fn receiver(&self) -> Option<&Receiver> {
        self.receiver.as_deref()
    }
}

/// A request without a reply.
#[derive(PartialEq, Eq)]
pub struct RequestError<M> {
    /// Why.
    pub kind: DeliveryError,
    /// The message as it was, where the receiver did not take it up.
    pub message: Option<M>,
    receiver: Option<Box<Receiver>>,
}

impl<M> RequestError<M> {
    pub(crate) fn new(kind: DeliveryError, message: Option<M>) -> Self {
        RequestError { kind, message, receiver: None }
    }

    /// Names the receiver.
    #[cold]
    pub(crate) fn at(mut self, receiver: impl FnOnce() -> Option<Receiver>) -> Self {
        self.receiver = receiver().map(Box::new);
        self
    }

    /// Whom the request was for, where that is known.
    pub fn receiver(&self) -> Option<&Receiver> {
        self.receiver.as_deref()
    }

    /// What is known of the request: whether it took effect, did not, or may have.
    pub fn outcome(&self) -> Outcome {
        match self.message {
            Some(_) => Outcome::NotTaken,
            None => self.kind.outcome(),
        }
    }
}

// By hand, so that nobody asks the user's message for `Debug`.
impl<M> fmt::Debug for SendError<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SendError").field("why", &self.kind).finish_non_exhaustive()
    }
}

impl<M> fmt::Debug for RequestError<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let returned = self.message.is_some();
        f.debug_struct("RequestError")
            .field("why", &self.kind)
            .field("message_returned", &returned)
            .finish()
    }
}

impl<M> fmt::Display for SendError<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        describe(f, self.receiver(), "was not sent", &self.kind)
    }
}

impl<M> fmt::Display for RequestError<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        describe(f, self.receiver(), "failed", &self.kind)
    }
}

/// Says which message to whom met with what, with the limit that the receiver alone does not know.
fn describe(
    f: &mut fmt::Formatter<'_>,
    receiver: Option<&Receiver>,
    what: &str,
    why: &DeliveryError,
) -> fmt::Result {
    match receiver {
        None => write!(f, "the message {what}: {why}"),
        Some(to) => {
            write!(f, "`{}` to {to} {what}: ", to.contract)?;
            match (why, to.queue) {
                (DeliveryError::Full, Some(limit)) => write!(f, "its queue of {limit} is full")?,
                _ => write!(f, "{why}")?,
            }
            to.unavailable.as_ref().map_or(Ok(()), |unavailable| write!(f, "; {unavailable}"))
        }
    }
}

impl<M> std::error::Error for SendError<M> {}
impl<M> std::error::Error for RequestError<M> {}

impl<M> From<SendError<M>> for RequestError<M> {
    fn from(error: SendError<M>) -> Self {
        RequestError::new(error.kind, Some(error.message))
    }
}
