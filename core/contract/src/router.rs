//! Between the router and the sessions.
//!
//! ```text
//! sessions ──SendSegment──► router ──PathReported, SegmentArrived──► sessions
//! ```

use actix::{Message, Recipient};
use blastema_core::net::wire::packet::UndeliveredReason;
use blastema_core::net::{NodeId, PacketPriority, Route};
use blastema_core::{GatherBuffer, Incarnation, NodeName};
use bytes::Bytes;

/// A session wants this brought to its peer.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct SendSegment {
    /// The node that it is for.
    pub peer: NodeId,
    /// How urgent it is.
    pub class: PacketPriority,
    /// The encoded segment.
    pub segment: GatherBuffer,
    /// A copy is to go over every direct link and over the alternate path.
    pub everywhere: bool,
}

/// Another node's session has sent this.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct SegmentArrived {
    /// The node that sent it.
    pub source: NodeId,
    /// The encoded segment.
    pub segment: Bytes,
    /// No other node can have made it: it came over a link with that node itself, or that node has
    /// sealed it.
    pub authentic: bool,
}

/// A node is isolated: nothing is passed on from it, to it, or over it. Or it is let in again.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct SetIsolation {
    /// The node that is isolated or admitted.
    pub node: NodeName,
    /// Whether it is isolated.
    pub isolated: bool,
}

/// The way to a node has changed.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub enum PathReported {
    /// It can be reached, or has a new incarnation.
    Reachable {
        /// The node that can be reached.
        node: NodeName,
        /// The node's incarnation.
        incarnation: Incarnation,
        /// The largest segment on the way, in bytes.
        mtu: usize,
    },
    /// What is sent to it takes another way: repeat what is not acknowledged.
    Changed {
        /// The node that is reached over another path.
        node: NodeId,
        /// The largest segment on the way, in bytes.
        mtu: usize,
    },
    /// Something that was sent to it went no further, somewhere on its way.
    Undelivered {
        /// The node for which it was meant.
        node: NodeId,
        /// Why it went no further.
        reason: UndeliveredReason,
    },
    /// No path leads there any more.
    Lost {
        /// The node that no path leads to.
        node: NodeName,
    },
}

/// The sessions present themselves to the router.
#[derive(Clone, Debug, Message)]
#[rtype(result = "()")]
pub struct AddSessions {
    /// Takes what arrives.
    pub segments: Recipient<SegmentArrived>,
    /// Takes news of paths.
    pub paths: Recipient<PathReported>,
}

/// Asks for every node that can be reached, and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Routes")]
pub struct ReadRoutes;

/// The answer to [`ReadRoutes`].
#[derive(Clone, Debug, PartialEq, Eq, actix::MessageResponse)]
pub struct Routes {
    /// In the order of the nodes' names.
    pub routes: Vec<Route>,
}

/// The receiver panics. For demonstrations and tests of what becomes of that.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct InjectPanic;
