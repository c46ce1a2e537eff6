//! What stands behind a sender.

use crate::messaging::error::{Receiver, RequestError, SendError};
use crate::messaging::reply::ReplyFuture;
use blastema_core::{Contract, MessageId};
use std::future::Future;
use std::pin::Pin;
use std::time::Duration;

/// What stands behind a [`Sender`]: a component here, or one on another node.
pub(crate) trait MessageSink<M: Contract>: Send + Sync {
    /// Hands the message over, or lets the receiver's policy decide. Never waits.
    fn tell(&self, message: M) -> Result<(), SendError<M>>;

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
