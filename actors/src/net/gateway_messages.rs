//! What objects of this node send to those of other nodes.

use crate::registry::ReplyTo;
use actix::Message;
use blastema_core::{ContractIdentity, Credit, GatherBuffer, Instant, MessageId, ObjectAddress};

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
