//! What the rest of the node asks of its sessions, and is told of them.

use actix::Message;
use blastema_core::net::ByteRate;
use blastema_core::net::session::SessionStatus;
use blastema_core::{Incarnation, NodeName};

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
