//! What this node's own side tells the gateway.

use super::undelivered::UndeliveredEvents;
use crate::topic::TopicKey;
use actix::Message;
use blastema_core::net::NodeId;
use blastema_core::net::peer_protocol::SessionEpoch;
use blastema_core::{Credit, DeliveryError, GatherBuffer, Instant, ObjectName};
use std::sync::Arc;

/// Told by objects, topics and the node, on whichever thread.
#[derive(Message)]
#[rtype(result = "()")]
pub(in crate::net) enum LocalInput {
    /// The start of this node is over: its objects answer.
    Started,
    /// This node ends in order: what was sent is to be delivered, then every session ends.
    Ending,
    /// An object here has answered another node's request.
    Reply {
        peer: NodeId,
        epoch: SessionEpoch,
        call: u64,
        result: Result<GatherBuffer, DeliveryError>,
    },
    /// An object may have room for what waits.
    Capacity { peer: NodeId, object: ObjectName },
    /// A topic got its first listener here, or lost its last, or its contract is known now. Reports
    /// of several threads come in any order: the topic is asked what is so now.
    Interest(TopicKey),
    /// An event was published here that a peer listens to.
    Event {
        peer: NodeId,
        subscription: u32,
        /// Counts it where the subscription has ended meanwhile.
        losses: Arc<UndeliveredEvents>,
        event: GatherBuffer,
        sent: Instant,
        credit: Credit,
    },
}
