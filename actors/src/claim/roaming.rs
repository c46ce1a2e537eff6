//! What stands behind a `Sender` of a claimed name: whoever holds it when something is sent.

use super::Names;
use crate::registry::Registry;
use crate::reply::Reply;
use crate::sender::{Inlet, RequestError, SendError, Sender};
use blastema_core::global_name::Holder;
use blastema_core::{Contract, MessageId, ObjectName, Why};
use std::future::Future;
use std::pin::Pin;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Messages of one contract to the holder of a name.
pub(crate) struct Roaming<M: Contract> {
    name: ObjectName,
    registry: Registry,
    names: Names,
    /// Who was sent to last, and how.
    last: Mutex<Option<(Holder, Sender<M>)>>,
}

impl<M: Contract> Roaming<M> {
    pub(crate) fn new(name: ObjectName, registry: Registry, names: Names) -> Self {
        Roaming { name, registry, names, last: Mutex::default() }
    }

    /// The way to whoever holds the name now.
    fn present(&self) -> Result<Sender<M>, Why> {
        let holder = self.names.holder(&self.name);
        let holder = holder.ok_or_else(|| Why::Unclaimed { name: self.name.to_string() })?;
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

impl<M: Contract> Inlet<M> for Roaming<M> {
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

    fn room<'a>(&'a self, refused: &Why) -> Pin<Box<dyn Future<Output = ()> + Send + 'a>> {
        let refused = refused.clone();
        Box::pin(async move {
            let mut revision = self.names.revision();
            // Whoever has no room now need not be the one who is sent to next.
            if let Ok(sender) = self.present() {
                tokio::select! {
                    () = sender.0.room(&refused) => {}
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
    ) -> Result<Reply<M>, RequestError<M>> {
        match self.present() {
            Ok(sender) => sender.0.ask(message, id, within),
            Err(why) => Err(RequestError::new(why, Some(message))),
        }
    }
}
