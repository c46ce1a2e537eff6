//! What stands behind a `Sender` of a global name: sends to the holder at the time of sending.

use crate::messaging::error::{RequestError, SendError};
use crate::messaging::reply::ReplyFuture;
use crate::messaging::sender::Sender;
use crate::messaging::sink::MessageSink;
use crate::registry::Registry;
use blastema_core::directory::Holder;
use blastema_core::{Contract, DeliveryError, MessageId, ObjectName};
use std::future::Future;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::watch;

/// Finds who holds a name of the whole robot.
pub(crate) trait NameResolver: Send + Sync {
    /// Who holds the name now.
    fn holder(&self, name: &ObjectName) -> Option<Holder>;
    /// Changes whenever another object holds some name.
    fn revision(&self) -> watch::Receiver<u64>;
}

/// Messages of one contract to the holder of a name.
pub(crate) struct GlobalNameSender<M: Contract> {
    name: ObjectName,
    registry: Registry,
    names: Arc<dyn NameResolver>,
    /// Who was sent to last, and how.
    last: Mutex<Option<(Holder, Sender<M>)>>,
}

impl<M: Contract> GlobalNameSender<M> {
    pub(crate) fn new(name: ObjectName, registry: Registry, names: Arc<dyn NameResolver>) -> Self {
        GlobalNameSender { name, registry, names, last: Mutex::default() }
    }

    /// The sender to the present holder of the name.
    fn present(&self) -> Result<Sender<M>, DeliveryError> {
        let holder = self.names.holder(&self.name);
        let holder =
            holder.ok_or_else(|| DeliveryError::Unclaimed { name: self.name.to_string() })?;
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((known, sender)) = last.as_ref()
            && *known == holder
        {
            return Ok(sender.clone());
        }
        let sender = self.registry.sender::<M>(&format!("{}:{}", holder.node, holder.object))?;
        *last = Some((holder, sender.clone()));
        Ok(sender)
    }
}

impl<M: Contract> MessageSink<M> for GlobalNameSender<M> {
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
            let mut revision = self.names.revision();
            // The next message may go to another holder than the one that is full now.
            if let Ok(sender) = self.present() {
                tokio::select! {
                    () = sender.0.space() => {}
                    _ = revision.changed() => {}
                }
            }
        })
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
