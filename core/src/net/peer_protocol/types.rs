//! Inputs and outputs of the peer protocol.

use crate::net::session::ordering_key::OrderingKey;
use crate::net::trust::access::AccessDenied;
use crate::net::wire::node_id::NodeId;
use crate::{
    ContractIdentity, Credit, DeliveryError, GatherBuffer, Instant, MessageId, NodeName,
    ObjectName, PeerIdentity, TrafficClass,
};
use bytes::Bytes;
use std::time::Duration;

/// Which topic, and the contract of its events.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TopicContract {
    /// The name of the topic.
    pub topic: String,
    /// The contract's name.
    pub contract: String,
}

/// One session's number on this node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SessionEpoch(pub u32);

/// What an object wants sent to one of another node.
#[derive(Debug)]
pub struct Call {
    /// The node of the receiver.
    pub node: NodeName,
    /// The object that receives it there.
    pub object: ObjectName,
    /// The contract of the message.
    pub contract: ContractIdentity,
    /// By which identity a repeated message is known.
    pub id: Option<MessageId>,
    /// When the object sent it.
    pub sent: Instant,
    /// When the answer is no use any more.
    pub until: Option<Instant>,
    /// The encoded message.
    pub payload: GatherBuffer,
    /// The number by which the caller knows the request; `None` if it wants no reply.
    pub reply_as: Option<u64>,
    /// The credit that the message holds until the peer's session has acknowledged it.
    pub credit: Option<Credit>,
}

impl Call {
    /// The same, to be sent again in another session.
    pub(super) fn without_credit(&self) -> Call {
        Call {
            node: self.node.clone(),
            object: self.object.clone(),
            contract: self.contract.clone(),
            id: self.id,
            sent: self.sent,
            until: self.until,
            payload: self.payload.clone(),
            reply_as: self.reply_as,
            credit: None,
        }
    }
}

/// How much of a message that came back was on its way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TransmitState {
    /// Nothing: it has certainly not arrived.
    Nothing,
    /// Some of it, or all: it may have arrived.
    Perhaps,
}

/// Whom a message was for that was lost.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MessageTarget {
    /// This object, by the contract of this name.
    Object(ObjectName, &'static str),
    /// Those who listen by the subscription of this number.
    Subscription(u32),
    /// It is not known any more: its session is long over.
    Forgotten,
}

/// What a peer protocol wants done.
#[derive(Debug, PartialEq, Eq)]
pub enum PeerProtocolOutput {
    /// Give this to the session with the peer.
    Send {
        /// The node that it is for.
        peer: NodeId,
        /// The ordered stream that carries it.
        stream: TrafficClass,
        /// With what it stays in order there.
        key: OrderingKey,
        /// The encoded message.
        message: GatherBuffer,
        /// The credit that it holds until the peer's session has acknowledged it.
        credit: Option<Credit>,
    },
    /// Give this to the session with the peer, to be sent once: of the channel the newest counts.
    SendNewest {
        /// The node that it is for.
        peer: NodeId,
        /// The channel on which the newest message counts.
        channel: u32,
        /// The encoded message.
        message: GatherBuffer,
        /// The credit that it holds until the session has it.
        credit: Option<Credit>,
    },
    /// Does this object take this contract? Answer with
    /// [`PeerProtocol::handle_bound`](super::PeerProtocol::handle_bound).
    Bind {
        /// The node that asks.
        peer: NodeId,
        /// The session in which it asks.
        epoch: SessionEpoch,
        /// The number of the binding, chosen by the peer.
        binding: u32,
        /// The object that is asked for.
        object: ObjectName,
        /// The contract as the peer knows it.
        identity: Box<PeerIdentity>,
    },
    /// Give this message to the object that is bound; answer a request with
    /// [`PeerProtocol::handle_answer`](super::PeerProtocol::handle_answer).
    Serve {
        /// The node that sent it.
        peer: NodeId,
        /// The session in which it was sent.
        epoch: SessionEpoch,
        /// Through which binding.
        binding: u32,
        /// By which number to answer; `None` if no reply is wanted.
        call: Option<u64>,
        /// By which identity a repeated message is known.
        id: Option<MessageId>,
        /// How long it has been on its way.
        age: Duration,
        /// A request is not to be begun after this.
        until: Option<Instant>,
        /// The encoded message.
        payload: Bytes,
    },
    /// A request of ours is resolved.
    Resolve {
        /// The caller's number for it.
        reply_as: u64,
        /// The encoded reply, or why there is none.
        result: Result<Bytes, DeliveryError>,
    },
    /// A message that wanted no reply did not arrive, or perhaps not.
    Lost {
        /// The node that it was for.
        peer: NodeId,
        /// The receiver at that node.
        to: MessageTarget,
        /// Why it was not delivered.
        why: DeliveryError,
    },
    /// The peer's object has no room: senders should stop, for this object.
    ObjectFull {
        /// The node of the object.
        peer: NodeId,
        /// The object that has no room.
        object: ObjectName,
    },
    /// It has room again.
    ObjectReady {
        /// The node of the object.
        peer: NodeId,
        /// The object that has room again.
        object: ObjectName,
    },
    /// Our contract differs from the peer's.
    Differs {
        /// The node of the peer.
        peer: NodeId,
        /// The contract, and what differs.
        difference: String,
    },
    /// Send what is published here to this peer, unless the contract differs; then tell with
    /// [`PeerProtocol::handle_subscribe_refused`](super::PeerProtocol::handle_subscribe_refused).
    Subscribe {
        /// The node that listens.
        peer: NodeId,
        /// The number of the subscription, chosen by the peer.
        subscription: u32,
        /// The topic that the peer listens to.
        topic: TopicContract,
        /// The contract as the peer knows it, and then the earlier versions that it understands.
        /// What is sent by the n-th of them goes under the number and n.
        identities: Vec<PeerIdentity>,
    },
    /// A peer was refused what it may not do, and told so where it waits for an answer.
    AccessDenied {
        /// The peer, and the right that it lacks.
        denied: Box<AccessDenied>,
    },
    /// A peer refuses a subscription of this node, by its policy.
    SubscriptionForbidden {
        /// The reason that the peer gives; it names the peer.
        why: DeliveryError,
    },
    /// Send no more of this.
    Unsubscribe {
        /// Who does not want it any more.
        peer: NodeId,
        /// The number of the subscription, chosen by the peer.
        subscription: u32,
    },
    /// An event arrived for those who listen here.
    Event {
        /// The node that published it.
        peer: NodeId,
        /// The topic of the event.
        topic: TopicContract,
        /// By which of our versions of the contract it is read: 0 is the present one.
        form: usize,
        /// How long it has been on its way.
        age: Duration,
        /// The encoded event.
        payload: Bytes,
    },
    /// A peer has told all that it listens to, and its objects answer.
    Announced {
        /// The node that has told it.
        peer: NodeId,
    },
    /// The peer is in the safe state, or no more.
    SafeState {
        /// The node that says so of itself.
        peer: NodeId,
        /// Why it is; `None` if it is at work.
        reason: Option<String>,
    },
    /// A peer has a newer roster. It counts if the robot has signed it.
    Roster {
        /// The node that has it.
        peer: NodeId,
        /// The signed text.
        text: Bytes,
    },
    /// The directory of a peer says this to that of this node.
    Directory {
        /// The node of the peer.
        peer: NodeId,
        /// The encoded message.
        message: Bytes,
    },
    /// The peer ends in order.
    Bye {
        /// The node that ends.
        peer: NodeId,
    },
    /// The session is over: drop what the peer had here, its bindings and subscriptions, and what
    /// it has said of its objects' room.
    Forget {
        /// The node at the session's other end.
        peer: NodeId,
        /// Why it is over.
        why: DeliveryError,
    },
}
