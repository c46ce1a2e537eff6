//! What takes encoded messages for a component of this node, and encodes its replies.

use crate::component::cell::{CellCore, ComponentCell};
use crate::component::envelope::arrived_posting_time;
use crate::component::{Component, Handle};
use crate::messaging::error::{Receiver, RequestError, SendError};
use crate::messaging::reply::{ReplyFuture, Responder};
use crate::messaging::sender::Sender;
use crate::messaging::sink::MessageSink;
use crate::registry::encoding::{encoded_reply, read_result};
use crate::registry::{CapacityFuture, ContractPort, MessageMetadata, ReplyTo, Skeleton};
use blastema_core::contract::codec;
use blastema_core::{
    Contract, ContractIdentity, DeliveryError, FaultKind, Lifecycle, MessageId, PeerIdentity,
    PreviousVersion,
};
use bytes::Bytes;
use std::any::Any;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

impl ContractPort {
    /// The port of a component for one contract.
    pub(crate) fn open<C: Handle<M>, M: Contract>(cell: &Arc<ComponentCell<C>>) -> Self {
        let skeleton = LocalSkeleton::<C, M> { cell: cell.clone(), former: None };
        ContractPort::new::<M>(Sender(Arc::new(NamedSink(cell.clone()))), Arc::new(skeleton))
    }
}

/// Whether another component has the name of this one now.
fn has_successor<C: Component>(cell: &Arc<ComponentCell<C>>) -> bool {
    let CellCore { name, environment, .. } = &cell.record;
    let present = environment.registry.cell(name);
    let own = |present: Arc<dyn Any + Send + Sync>| {
        present.downcast::<ComponentCell<C>>().is_ok_and(|present| Arc::ptr_eq(&present, cell))
    };
    present.is_some_and(|present| !own(present))
}

/// What stands behind a sender by name: this component, and once it has been removed the one that
/// has its name.
struct NamedSink<C: Component>(Arc<ComponentCell<C>>);

impl<C: Component> NamedSink<C> {
    /// The way to another component that has the name now.
    fn successor<M: Contract>(&self) -> Result<Sender<M>, DeliveryError> {
        match has_successor(&self.0) {
            true => self.0.record.environment.registry.sender(self.0.record.name.as_str()),
            false => Err(DeliveryError::Stopped),
        }
    }

    #[inline]
    fn or_successor<M: Contract>(
        &self,
        sent: Result<(), SendError<M>>,
        again: impl FnOnce(&Sender<M>, M) -> Result<(), SendError<M>>,
    ) -> Result<(), SendError<M>> {
        match sent {
            Err(SendError { kind: DeliveryError::Stopped, message, .. }) => {
                match self.successor() {
                    Ok(successor) => again(&successor, message),
                    Err(why) => Err(SendError::new(why, message)),
                }
            }
            sent => sent,
        }
    }
}

impl<C: Handle<M>, M: Contract> MessageSink<M> for NamedSink<C> {
    #[inline]
    fn tell(&self, message: M) -> Result<(), SendError<M>> {
        self.or_successor(self.0.tell(message), |successor, message| successor.0.tell(message))
    }

    #[inline]
    fn offer(&self, message: M) -> Result<(), SendError<M>> {
        self.or_successor(self.0.offer(message), |successor, message| successor.0.offer(message))
    }

    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        Box::pin(async move {
            match self.successor::<M>() {
                Ok(successor) => successor.0.space().await,
                Err(_) => MessageSink::<M>::space(&*self.0).await,
            }
        })
    }

    fn overdue(&self) {
        MessageSink::<M>::overdue(&*self.0);
    }

    fn receiver(&self) -> Option<Receiver> {
        MessageSink::<M>::receiver(&*self.0)
    }

    #[inline]
    fn ask(
        &self,
        message: M,
        id: Option<MessageId>,
        within: Option<Duration>,
    ) -> Result<ReplyFuture<M>, RequestError<M>> {
        match self.0.ask(message, id, within) {
            Err(RequestError { kind: DeliveryError::Stopped, message: Some(message), .. }) => {
                match self.successor() {
                    Ok(successor) => successor.0.ask(message, id, within),
                    Err(why) => Err(RequestError::new(why, Some(message))),
                }
            }
            asked => asked,
        }
    }
}

/// The skeleton of one contract of a component of this node.
struct LocalSkeleton<C: Handle<M>, M: Contract> {
    cell: Arc<ComponentCell<C>>,
    /// The version that the sender holds, where it is an earlier one.
    former: Option<Arc<PreviousVersion<M>>>,
}

impl<C: Handle<M>, M: Contract> LocalSkeleton<C, M> {
    /// The way to the component that has the name after this one was removed, where it serves the
    /// same contract.
    fn successor(&self) -> Option<Arc<dyn Skeleton>> {
        if self.former.is_some() || !self.cell.queue.is_stopped() || !has_successor(&self.cell) {
            return None;
        }
        let CellCore { name, environment, .. } = &self.cell.record;
        let (identity, successor) = environment.registry.skeleton(name, M::NAME).ok()?;
        identity.check(&ContractIdentity::of::<M>().full()).is_ok().then_some(successor)
    }

    fn hand_over(
        &self,
        message: M,
        MessageMetadata { id, age, is_first, until, .. }: MessageMetadata,
        reply_to: Option<ReplyTo>,
    ) -> Result<(), DeliveryError> {
        match reply_to {
            // Its sender is elsewhere, and has been notified that it was sent.
            None => {
                let posted_at = arrived_posting_time::<M>(age);
                self.cell.tell_at(message, posted_at).map_err(|SendError { kind: why, .. }| {
                    // For want of room it may wait.
                    if !matches!(why, DeliveryError::Full | DeliveryError::Restarting) {
                        self.cell.record.record_dead_letter(M::NAME, &why);
                    }
                    why
                })
            }
            Some(reply_to) => {
                let (former, cell) = (self.former.clone(), self.cell.clone());
                let callback = move |result: Result<M::Reply, DeliveryError>| {
                    // The asker is not to wait for its deadline where the conversion panics.
                    let converted = |reply| {
                        let what = || format!("the conversion of a reply to {}", M::NAME);
                        let encode = || encoded_reply(reply, former.as_deref());
                        cell.record.guard(what, encode).unwrap_or_else(|panicked| {
                            Err(DeliveryError::ReplyUnsent { reason: panicked })
                        })
                    };
                    reply_to(result.and_then(converted));
                };
                let answer = Responder::called_back(Box::new(callback), until);
                if is_first {
                    self.cell.post_first(message, answer);
                    return Ok(());
                }
                self.cell
                    .post(message, Some(answer), id, arrived_posting_time::<M>(age))
                    .map_err(|error| error.kind)
            }
        }
    }
}

impl<C: Handle<M>, M: Contract> Skeleton for LocalSkeleton<C, M> {
    fn deliver(
        &self,
        message: &Bytes,
        metadata: MessageMetadata,
        reply_to: Option<ReplyTo>,
    ) -> Result<(), DeliveryError> {
        if let Some(successor) = self.successor() {
            return successor.deliver(message, metadata, reply_to);
        }
        // To read it runs what is the user's, on the network's thread.
        let what = || format!("to read a message of {}", M::NAME);
        let read = || match &self.former {
            None => codec::decode_shared::<M>(message),
            Some(former) => former.read(message),
        };
        match read_result(self.cell.record.guard(what, read)) {
            Ok(message) => self.hand_over(message, metadata, reply_to),
            Err(why) => {
                self.cell.record.record_dead_letter(M::NAME, &why);
                if let Some(reply_to) = reply_to {
                    reply_to(Err(why.clone()));
                }
                Err(why)
            }
        }
    }

    fn turn(&self) -> u64 {
        let placement = self.cell.record.arbiter();
        placement.map_or(0, |placement| placement.slot.activity.mark().turn)
    }

    fn space(&self) -> Option<CapacityFuture> {
        let cell = self.cell.clone();
        Some(Box::pin(async move { cell.queue.space(cell.port_of::<M>()).await }))
    }

    fn record_dead_letter(&self, why: &DeliveryError) {
        self.cell.record.record_dead_letter(M::NAME, why);
    }

    fn former(&self, theirs: &PeerIdentity) -> Option<Arc<dyn Skeleton>> {
        let mut former = M::previous_versions().into_iter();
        let former = former.find(|former| former.identity().check(theirs).is_ok())?;
        let (cell, former) = (self.cell.clone(), Some(Arc::new(former)));
        Some(Arc::new(LocalSkeleton::<C, M> { cell, former }))
    }

    fn is_at_work(&self) -> bool {
        self.cell.record.state() == Lifecycle::Active
    }

    fn declare(&self, kind: FaultKind, detail: String) {
        self.cell.record.declare(kind, detail);
    }

    fn clear_fault(&self, kind: FaultKind) {
        self.cell.record.clear(kind);
    }
}
