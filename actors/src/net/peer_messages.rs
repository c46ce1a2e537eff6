//! What the middleware's own parts say to their like on other nodes: bytes of a machine's.
//!
//! They go as ordinary messages to a name that no object has, so that sessions bring them once and
//! in order. What cannot be sent, or comes too fast, is dropped and counted: machines that talk
//! like this find out by themselves what is missing.

use crate::messaging::sender::Sender;
use crate::registry::{ContractPort, MessageMetadata, Registry, ReplyTo, Skeleton};
use actix::prelude::*;
use blastema_core::contract::codec;
use blastema_core::net::NodeId;
use blastema_core::sorted::SortedMap;
use blastema_core::{DeliveryError, FaultKind, NodeName, ObjectName};
use blastema_macros::Event;
use bytes::Bytes;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicU64, AtomicUsize};

/// Letters that may wait until their reader has its turn: all that a large robot says at once.
const UNREAD_MAX: usize = 4096;
/// Whom a sender is kept for: as many nodes as there are sessions with.
const SENDERS_MAX: usize = 512;

/// One message.
#[derive(Clone, Debug, Event)]
#[contract(crate = "crate", name = "blastema/actor-message", version = 1, max_size = 128 * 1024)]
struct ActorMessage {
    bytes: Vec<u8>,
}

/// A message from another node.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) struct ActorMessageReceived {
    pub(crate) from: NodeId,
    pub(crate) bytes: Bytes,
}

/// Writes letters, and takes those of its like.
pub(crate) struct PeerChannel {
    registry: Registry,
    object: ObjectName,
    senders: SortedMap<NodeName, Sender<ActorMessage>>,
    slot: Arc<Slot>,
}

/// Where letters come in.
struct Slot {
    reader: Recipient<ActorMessageReceived>,
    unread: AtomicUsize,
    dropped: AtomicU64,
}

impl PeerChannel {
    /// Letters to and from this place, which is called the same on every node.
    pub(crate) fn at(
        object: ObjectName,
        registry: &Registry,
        reader: Recipient<ActorMessageReceived>,
    ) -> Self {
        let (unread, dropped) = (AtomicUsize::new(0), AtomicU64::new(0));
        let slot = Arc::new(Slot { reader, unread, dropped });
        let skeleton: Arc<dyn Skeleton> = slot.clone();
        registry
            .register_hidden(object.clone(), ContractPort::of_skeleton::<ActorMessage>(skeleton));
        PeerChannel { registry: registry.clone(), object, senders: SortedMap::new(), slot }
    }

    /// Sends one. It is dropped where the node takes none now.
    pub(crate) fn send(&mut self, to: &NodeName, bytes: &Bytes) {
        if !self.senders.contains_key(to) {
            let address = format!("{to}:{}", self.object);
            let Ok(sender) = self.registry.sender::<ActorMessage>(&address) else { return };
            if self.senders.len() >= SENDERS_MAX {
                self.senders.pop_first();
            }
            self.senders.insert(to.clone(), sender);
        }
        if let Some(sender) = self.senders.get(to)
            && sender.tell(ActorMessage { bytes: bytes.to_vec() }).is_err()
        {
            self.slot.dropped.fetch_add(1, Relaxed);
        }
    }

    /// The reader has begun to read one.
    pub(crate) fn read_one(&self) {
        self.slot.unread.fetch_sub(1, Relaxed);
    }
}

/// Drops messages that no actor of this node reads, so that their sender gets no error for an
/// unknown object.
pub(crate) fn register_sink(object: ObjectName, registry: &Registry) {
    registry.register_hidden(object, ContractPort::of_skeleton::<ActorMessage>(Arc::new(Discard)));
}

struct Discard;

impl Skeleton for Discard {
    fn deliver(
        &self,
        _: &Bytes,
        _: MessageMetadata,
        reply_to: Option<ReplyTo>,
    ) -> Result<(), DeliveryError> {
        if let Some(reply_to) = reply_to {
            reply_to(Err(DeliveryError::Stopped));
        }
        Ok(())
    }

    fn declare(&self, _: FaultKind, _: String) {
        // As for those who read them.
    }
}

impl Skeleton for Slot {
    fn deliver(
        &self,
        message: &Bytes,
        metadata: MessageMetadata,
        reply_to: Option<ReplyTo>,
    ) -> Result<(), DeliveryError> {
        let read = codec::decode::<ActorMessage>(message)
            .map_err(|error| DeliveryError::Undecodable { reason: error.to_string() });
        let delivered = read.and_then(|message| {
            let Some(from) = metadata.from else {
                return Err(DeliveryError::Unknown { name: "the node that writes".to_owned() });
            };
            if self.unread.fetch_add(1, Relaxed) >= UNREAD_MAX {
                self.unread.fetch_sub(1, Relaxed);
                return Err(DeliveryError::Full);
            }
            self.reader.do_send(ActorMessageReceived { from, bytes: message.bytes.into() });
            Ok(())
        });
        if delivered.is_err() {
            self.dropped.fetch_add(1, Relaxed);
        }
        if let (Err(why), Some(reply_to)) = (&delivered, reply_to) {
            reply_to(Err(why.clone()));
        }
        delivered
    }

    fn declare(&self, _: FaultKind, _: String) {
        // The contract differs only between nodes of different versions, which sessions tell.
    }
}
