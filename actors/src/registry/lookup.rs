//! What stands behind a `Sender` whose receiver may change: sends to the present one.

use crate::messaging::error::{RequestError, SendError};
use crate::messaging::reply::ReplyFuture;
use crate::messaging::sender::Sender;
use crate::messaging::sink::MessageSink;
use crate::registry::Registry;
use blastema_core::{Contract, DeliveryError, MessageId};
use std::future::Future;
use std::pin::Pin;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::watch;

/// Finds the present receiver: the holder of a name of the whole robot, or what a port is connected
/// to.
pub(crate) trait CurrentReceiver: Send + Sync {
    /// Its name or address, and a number that changes where it is another one of the same name.
    fn current(&self) -> Result<(String, u64), DeliveryError>;
    /// Changes whenever it may be another one.
    fn changes(&self) -> watch::Receiver<u64>;
}

/// A sender, with what it was found for.
type FoundSender<M> = ((String, u64), Sender<M>);

/// Messages of one contract to the present receiver.
pub(crate) struct CurrentSender<M: Contract, R> {
    receiver: R,
    registry: Registry,
    /// Who was sent to last, and how.
    last: Mutex<Option<FoundSender<M>>>,
}

impl<M: Contract, R: CurrentReceiver> CurrentSender<M, R> {
    pub(crate) fn new(receiver: R, registry: Registry) -> Self {
        CurrentSender { receiver, registry, last: Mutex::default() }
    }

    fn present(&self) -> Result<Sender<M>, DeliveryError> {
        let current = self.receiver.current()?;
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((known, sender)) = last.as_ref()
            && *known == current
        {
            return Ok(sender.clone());
        }
        let sender = self.registry.sender::<M>(&current.0)?;
        *last = Some((current, sender.clone()));
        Ok(sender)
    }
}

impl<M: Contract, R: CurrentReceiver> MessageSink<M> for CurrentSender<M, R> {
    fn tell(&self, message: M) -> Result<(), SendError<M>> {
        match self.present() {
            Ok(sender) => sender.0.tell(message),
            Err(why) => Err(SendError::new(why, message)),
        }
    }

    fn offer(&self, message: M) -> Result<(), SendError<M>> {
        match self.present() {
            Ok(sender) => sender.0.offer(message),
            Err(why) => Err(SendError::new(why, message)),
        }
    }

    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        Box::pin(async move {
            let mut changes = self.receiver.changes();
            // The next message may go to another receiver than the one that is full now.
            if let Ok(sender) = self.present() {
                tokio::select! {
                    () = sender.0.space() => {}
                    _ = changes.changed() => {}
                }
            }
        })
    }

    fn overdue(&self) {
        if let Ok(sender) = self.present() {
            sender.0.overdue();
        }
    }

    fn ask(
        &self,
        message: M,
        id: Option<MessageId>,
        within: Option<Duration>,
    ) -> Result<ReplyFuture<M>, RequestError<M>> {
        match self.present() {
            Ok(sender) => sender.0.ask(message, id, within),
            Err(why) => Err(RequestError::new(why, Some(message))),
        }
    }
}
