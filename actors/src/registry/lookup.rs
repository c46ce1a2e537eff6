//! What stands behind a `Sender` whose receiver may change: sends to the present one.

use crate::messaging::sender::Sender;
use crate::messaging::sink::{MessageSink, Redirect, Redirected};
use crate::platform::lock;
use crate::registry::Registry;
use blastema_core::{Contract, DeliveryError};
use std::sync::{Arc, Mutex};
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
    pub(crate) fn to(receiver: R, registry: Registry) -> Sender<M>
    where
        R: 'static,
    {
        let current = CurrentSender { receiver, registry, last: Mutex::default() };
        Sender(Arc::new(Redirected(current)))
    }
}

impl<M: Contract, R: CurrentReceiver> Redirect<M> for CurrentSender<M, R> {
    fn present(&self) -> Result<Arc<dyn MessageSink<M>>, DeliveryError> {
        let current = self.receiver.current()?;
        let mut last = lock(&self.last);
        if let Some((known, sender)) = last.as_ref()
            && *known == current
        {
            return Ok(sender.0.clone());
        }
        let sender = self.registry.sender::<M>(&current.0)?;
        *last = Some((current, sender.clone()));
        Ok(sender.0)
    }

    fn changed(&self) -> impl Future<Output = ()> + Send {
        let mut changes = self.receiver.changes();
        async move { drop(changes.changed().await) }
    }
}
