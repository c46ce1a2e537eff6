//! What takes encoded messages for a component of this node, and encodes its replies.

use crate::component::Handle;
use crate::component::cell::ComponentCell;
use crate::component::envelope::arrived_posting_time;
use crate::messaging::error::SendError;
use crate::messaging::reply::Responder;
use crate::messaging::sender::Sender;
use crate::registry::encoding::encoded_reply;
use crate::registry::{CapacityFuture, ContractPort, MessageMetadata, ReplyTo, Skeleton};
use blastema_core::contract::codec;
use blastema_core::{Contract, DeliveryError, FaultKind, Lifecycle, PeerIdentity, PreviousVersion};
use bytes::Bytes;
use std::sync::Arc;

impl ContractPort {
    /// The port of a component for one contract.
    pub(crate) fn open<C: Handle<M>, M: Contract>(cell: &Arc<ComponentCell<C>>) -> Self {
        let skeleton = LocalSkeleton::<C, M> { cell: cell.clone(), former: None };
        ContractPort::new::<M>(Sender(cell.clone()), Arc::new(skeleton))
    }
}

/// The skeleton of one contract of a component of this node.
struct LocalSkeleton<C: Handle<M>, M: Contract> {
    cell: Arc<ComponentCell<C>>,
    /// The version that the sender holds, where it is an earlier one.
    former: Option<Arc<PreviousVersion<M>>>,
}

impl<C: Handle<M>, M: Contract> LocalSkeleton<C, M> {
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
                        let encoded = cell.record.guard(what, encode);
                        encoded.unwrap_or_else(|reason| Err(DeliveryError::Undecodable { reason }))
                    };
                    reply_to(result.and_then(converted));
                };
                let answer = Responder::called_back(Box::new(callback), until);
                if is_first {
                    self.cell.post_first(message, answer);
                    return Ok(());
                }
                self.cell
                    .post(message, answer, id, arrived_posting_time::<M>(age))
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
        // To read it runs what is the user's, on the network's thread.
        let what = || format!("to read a message of {}", M::NAME);
        let read = || match &self.former {
            None => codec::decode_shared::<M>(message),
            Some(former) => former.read(message),
        };
        let read = self.cell.record.guard(what, read);
        match read.and_then(|read| read.map_err(|error| error.to_string())) {
            Ok(message) => self.hand_over(message, metadata, reply_to),
            Err(reason) => {
                let why = DeliveryError::Undecodable { reason };
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
        placement.map_or(0, |placement| placement.slot.activity.read().turn)
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
