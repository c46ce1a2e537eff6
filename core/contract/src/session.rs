//! Between the sessions and the gateway, which speaks for the objects of the node.
//!
//! ```text
//! gateway ──Say, SayNewest──► sessions ──SessionReported──► gateway
//! ```

use actix::{Message, Recipient};
use blastema_core::net::ByteRate;
use blastema_core::net::session::SessionStatus;
use blastema_core::net::{NodeId, OrderingKey};
use blastema_core::{Credit, DeliveryError, GatherBuffer, Incarnation, NodeName, TrafficClass};
use bytes::Bytes;
use std::collections::BTreeMap;

/// Sends a message, exactly once and in the order of its stream. If it cannot be, it comes back as
/// [`SessionReported::Returned`].
#[derive(Debug, Message)]
#[rtype(result = "()")]
pub struct SendReliable {
    /// The node that it is for.
    pub peer: NodeId,
    /// In which session: what was meant for one is never said in the next.
    pub session: u32,
    /// The ordered stream that carries it.
    pub stream: TrafficClass,
    /// With what it stays in order there.
    pub strand: OrderingKey,
    /// The encoded message.
    pub message: GatherBuffer,
    /// The credit that it holds until the peer has acknowledged it.
    pub credit: Option<Credit>,
}

/// Sends a message once, if at all: of one channel the newest that arrives counts.
#[derive(Debug, Message)]
#[rtype(result = "()")]
pub struct SendLatest {
    /// The node that it is for.
    pub peer: NodeId,
    /// The number of the session on this node.
    pub session: u32,
    /// The channel on which the newest message counts.
    pub channel: u32,
    /// The encoded message.
    pub message: GatherBuffer,
    /// The credit that it holds until the session has it.
    pub credit: Option<Credit>,
}

/// What a session has to tell.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub enum SessionReported {
    /// A node can be reached; a session will begin.
    Reachable {
        /// The node that can be reached.
        node: NodeName,
        /// The node's incarnation.
        incarnation: Incarnation,
    },
    /// No path leads to it any more; its session waits for one for a while.
    Unreachable {
        /// The node that no path leads to.
        node: NodeName,
    },
    /// A session has begun.
    Opened {
        /// The node at the other end.
        node: NodeName,
        /// The incarnation of that node.
        incarnation: Incarnation,
        /// The session's number on this node.
        session: u32,
    },
    /// A message has arrived.
    Message {
        /// The node that sent it.
        peer: NodeId,
        /// The encoded message.
        message: Bytes,
    },
    /// A message was not delivered, or perhaps not.
    Returned {
        /// The node that it was for.
        peer: NodeId,
        /// The encoded message.
        message: Bytes,
        /// Why it was not delivered.
        why: DeliveryError,
        /// Some of it was sent, so that it may have arrived; otherwise it has not.
        sent: bool,
    },
    /// A session is over; what was unacknowledged has been returned.
    Ended {
        /// The node at the other end.
        peer: NodeId,
        /// Why the session ended.
        why: DeliveryError,
    },
}

/// The gateway presents itself to the sessions.
#[derive(Clone, Debug, Message)]
#[rtype(result = "()")]
pub struct AddGateway(pub Recipient<SessionReported>);

/// The gateway restarts, with all peers or with one: the session is to end and begin again,
/// so that both ends agree.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct ResetSession {
    /// The node at the other end; `None` for all sessions.
    pub peer: Option<NodeId>,
}

/// This node ends in order: what was sent is to be delivered, then every session ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct CloseSessions;

/// Asks for all sessions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Vec<SessionRow>")]
pub struct ReadSessions;

/// One session, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SessionRow {
    /// The node at the other end.
    pub node: NodeName,
    /// How it stands.
    pub status: SessionStatus,
    /// How many of the bytes that its counters count went each way in the last second.
    pub rate: ByteRate,
    /// Contracts that the two nodes do not mean alike: which, and what differs. Those found since
    /// the session began, sixteen at most.
    pub differences: Vec<String>,
}

/// How another node stands, for those of the middleware that talk to each other across nodes.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub enum PeerStatusChanged {
    /// A session with it has begun: it can be talked to.
    Opened {
        /// The node at the other end.
        node: NodeName,
        /// The incarnation of that node.
        incarnation: Incarnation,
    },
    /// The session has ended, or nothing that it says counts.
    Ended {
        /// The node at the other end.
        node: NodeName,
    },
    /// It says that it ends in order.
    Left {
        /// The node that ends.
        node: NodeName,
    },
}

/// Which contracts do nodes not mean alike?
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "BTreeMap<NodeName, Vec<String>>")]
pub struct ReadDifferences;
