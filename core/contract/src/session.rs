//! What the rest of the node asks of its sessions, and is told of them.

use actix::Message;
use blastema_core::net::ByteRate;
use blastema_core::net::session::SessionStatus;
use blastema_core::net::trust::access::AccessPolicy;
use blastema_core::{Incarnation, NodeName};
use bytes::Bytes;

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

/// What the network tells the directory of this node of the other nodes and their directories.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub enum DirectoryReport {
    /// A session with the node has begun.
    Opened {
        /// The node at the other end.
        node: NodeName,
        /// The incarnation of that node.
        incarnation: Incarnation,
    },
    /// A path leads to the node. A session that waited for one goes on.
    Reachable {
        /// The node at the other end.
        node: NodeName,
    },
    /// No path leads to the node. The session waits for one.
    Unreachable {
        /// The node at the other end.
        node: NodeName,
    },
    /// The session has ended, or nothing that the node says counts.
    Ended {
        /// The node at the other end.
        node: NodeName,
    },
    /// The node says that it ends in order.
    Left {
        /// The node that ends.
        node: NodeName,
    },
    /// The directory of the node says this.
    Said {
        /// The node that says it.
        node: NodeName,
        /// The encoded message.
        message: Bytes,
    },
    /// This policy counts from now on.
    Policy(Box<AccessPolicy>),
}

/// The directory of this node says this to that of another one. While a session with that node is
/// open it is delivered once, and in order.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct SendToDirectory {
    /// The node of the other directory.
    pub node: NodeName,
    /// The encoded message.
    pub message: Bytes,
}
