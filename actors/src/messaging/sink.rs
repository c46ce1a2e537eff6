//! What stands behind a sender.

use crate::messaging::error::{Receiver, RequestError, SendError};
use crate::messaging::reply::ReplyFuture;
use blastema_core::{Contract, DeliveryError, MessageId};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

/// What stands behind a [`Sender`](crate::Sender): a component here, or one on another node.
pub(crate) trait MessageSink<M: Contract>: Send + Sync {
    /// Hands the message over, or lets the receiver's policy decide. Never waits.
    fn tell(&self, message: M) -> Result<(), SendError<M>> {
        self.offer(message)
    }

    /// Hands the message over, or gives it back where there is no room.
    fn offer(&self, message: M) -> Result<(), SendError<M>>;

    /// Completes when there may be room for what was refused so.
    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>>;

    /// Hands a request over. It is not begun when `within` has passed; the caller observes it as
    /// well.
    fn ask(
        &self,
        message: M,
        id: Option<MessageId>,
        within: Option<Duration>,
    ) -> Result<ReplyFuture<M>, RequestError<M>>;

    /// A request of the component that runs on this thread has not been answered by its deadline.
    fn overdue(&self) {}

    /// The receiver that its errors name.
    fn receiver(&self) -> Option<Receiver> {
        None
    }
}

/// Finds where each message is sent.
pub(crate) trait Redirect<M: Contract>: Send + Sync {
    /// The present one.
    fn present(&self) -> Result<Arc<dyn MessageSink<M>>, DeliveryError>;

    /// Completes when it may be another one.
    fn changed(&self) -> impl Future<Output = ()> + Send {
        std::future::pending()
    }

    /// The receiver that errors name.
    fn receiver(&self) -> Option<Receiver> {
        None
    }
}

/// Sends to the present sink.
pub(crate) struct Redirected<R>(pub(crate) R);

impl<M: Contract, R: Redirect<M>> MessageSink<M> for Redirected<R> {
    fn tell(&self, message: M) -> Result<(), SendError<M>> {
        match self.0.present() {
            Ok(sink) => sink.tell(message),
            Err(why) => Err(SendError::new(why, message)),
        }
    }

    fn offer(&self, message: M) -> Result<(), SendError<M>> {
        match self.0.present() {
            Ok(sink) => sink.offer(message),
            Err(why) => Err(SendError::new(why, message)),
        }
    }

    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        Box::pin(async move {
            let changed = self.0.changed();
            // The next message may go to another receiver than the one that is full now.
            if let Ok(sink) = self.0.present() {
                tokio::select! {
                    () = sink.space() => {}
                    () = changed => {}
                }
            }
        })
    }

    fn overdue(&self) {
        if let Ok(sink) = self.0.present() {
            sink.overdue();
        }
    }

    fn receiver(&self) -> Option<Receiver> {
        self.0.receiver()
    }

    fn ask(
        &self,
        message: M,
        id: Option<MessageId>,
        within: Option<Duration>,
    ) -> Result<ReplyFuture<M>, RequestError<M>> {
        match self.0.present() {
            Ok(sink) => sink.ask(message, id, within),
            Err(why) => Err(RequestError::new(why, Some(message))),
        }
    }
}
