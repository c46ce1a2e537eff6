//! Why a message was not taken, or a request not answered, and the message itself where it is given
//! back.

use blastema_core::{DeliveryError, NodeName, ObjectName, Outcome};
use std::fmt;
use std::time::Duration;

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
    /// The deadline of the request, if it had one.
    pub deadline: Option<Duration>,
}

/// The resource that a receiver waits for.
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

/// A message that was not handed over.
#[derive(PartialEq, Eq)]
pub struct SendError<M> {
    /// Why the message was not handed over.
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
}

/// Gives an error its receiver.
macro_rules! name_receiver_in {
    ($error:ident) => {
        impl<M> $error<M> {
            /// Names the receiver.
            #[cold]
            pub(crate) fn at(mut self, receiver: impl FnOnce() -> Option<Receiver>) -> Self {
                self.receiver = receiver().map(Box::new);
                self
            }

            /// The receiver of the message, where that is known.
            pub fn receiver(&self) -> Option<&Receiver> {
                self.receiver.as_deref()
            }
        }
    };
}

name_receiver_in!(SendError);
name_receiver_in!(RequestError);

/// A request without a reply.
#[derive(PartialEq, Eq)]
pub struct RequestError<M> {
    /// Why there is no reply.
    pub kind: DeliveryError,
    /// The message as it was, where the receiver did not take it up.
    pub message: Option<M>,
    receiver: Option<Box<Receiver>>,
}

impl<M> RequestError<M> {
    pub(crate) fn new(kind: DeliveryError, message: Option<M>) -> Self {
        RequestError { kind, message, receiver: None }
    }

    /// Returns whether the request took effect, did not, or may have.
    pub fn outcome(&self) -> Outcome {
        match self.message {
            Some(_) => Outcome::NotTaken,
            None => self.kind.outcome(),
        }
    }
}

/// Prints the text of `Display`: a `main` that returns this error, and `unwrap`, print by `Debug`.
impl<M> fmt::Debug for SendError<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Prints the text of `Display`: a `main` that returns this error, and `unwrap`, print by `Debug`.
impl<M> fmt::Debug for RequestError<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
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

/// Writes which message to which receiver failed and how, with the limit that the receiver alone
/// does not know.
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
            match (why, to.queue, to.deadline) {
                (DeliveryError::Full, Some(limit), _) => write!(f, "its queue of {limit} is full")?,
                (DeliveryError::DeadlinePassed, _, Some(deadline)) => {
                    write!(f, "no reply within {deadline:?}")?;
                }
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
