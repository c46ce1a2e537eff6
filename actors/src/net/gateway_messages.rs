//! What this node's own side asks of the gateway, or tells it.

use crate::registry::ReplyTo;
use crate::topic::TopicKey;
use actix::Message;
use blastema_core::net::NodeId;
use blastema_core::net::peer_protocol::SessionEpoch;
use blastema_core::{
    ContractIdentity, Credit, DeliveryError, GatherBuffer, Instant, MessageId, ObjectAddress,
};

/// An object here sends a message to one of another node.
#[derive(Message)]
#[rtype(result = "()")]
pub(in crate::net) struct SendToPeer {
    pub(in crate::net) to: ObjectAddress,
    pub(in crate::net) contract: ContractIdentity,
    pub(in crate::net) id: Option<MessageId>,
    /// When it was sent: its contract may bound its age.
    pub(in crate::net) sent: Instant,
    /// When its answer is no use any more.
    pub(in crate::net) until: Option<Instant>,
    pub(in crate::net) payload: GatherBuffer,
    pub(in crate::net) reply_to: Option<ReplyTo>,
    pub(in crate::net) credit: Credit,
}

/// The start of this node is over: its objects answer.
#[derive(Message)]
#[rtype(result = "()")]
pub(in crate::net) struct StartCompleted;

/// An object here has answered another node's request.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct LocalReply {
    pub(super) peer: NodeId,
    pub(super) epoch: SessionEpoch,
    pub(super) call: u64,
    pub(super) result: Result<GatherBuffer, DeliveryError>,
}

/// A topic got its first listener here, or lost its last, or its contract is known now. Reports
/// of several threads come in any order: the topic is asked what is so now.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct TopicInterestChanged {
    pub(super) key: TopicKey,
}
