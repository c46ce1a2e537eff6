//! Configuration, inputs and outputs of a router.

use crate::net::link::Neighbour;
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::net::wire::packet::UndeliveredReason;
use crate::{GatherBuffer, Incarnation, NodeName};
use bytes::Bytes;

/// How a router behaves.
#[derive(Clone, Debug)]
pub struct RouterConfig {
    /// Our own name.
    pub node: NodeName,
    /// Our own incarnation.
    pub incarnation: Incarnation,
    /// The most nodes that are remembered; more are refused and counted. Bounds memory and the time
    /// that a change takes.
    pub nodes_max: usize,
    /// How many nodes may pass a packet on, at most 31.
    pub hops: u8,
}

impl RouterConfig {
    /// The usual behaviour for this node.
    pub fn new(node: NodeName, incarnation: Incarnation) -> Self {
        RouterConfig { node, incarnation, nodes_max: 256, hops: 16 }
    }
}

/// What a router must know of a link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkStatus {
    /// Who is at its other end.
    pub neighbour: Neighbour,
    /// It carries, or it does not.
    pub health: LinkHealth,
    /// How dear it is to use; the cheaper of two paths is taken. 0 counts as 1.
    pub cost: u16,
    /// The largest frame that it carries, in bytes.
    pub mtu: usize,
}

/// Whether a link can be used, the best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum LinkHealth {
    /// The link carries traffic.
    Up,
    /// It carries again, and has failed too often lately to be taken where there is another way.
    Proving,
    /// It may have failed: taken only where there is no other way.
    Suspect,
    /// It does not carry.
    Down,
}

/// What a router wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RouterOutput {
    /// Give this to the link as the router's own.
    Routing {
        /// The link that sends it.
        link: LinkId,
        /// The encoded routing message.
        bytes: Bytes,
    },
    /// Give this packet to the link.
    Packet {
        /// The link that sends it.
        link: LinkId,
        /// The encoded packet.
        packet: GatherBuffer,
    },
    /// A segment arrived for our session with the source.
    Segment {
        /// Who sent it.
        source: NodeId,
        /// The segment, opened where it was sealed.
        segment: Bytes,
        /// No other node can have made it: it came over a link with the source itself, or the
        /// source has sealed it.
        authentic: bool,
    },
    /// A packet of ours could not be delivered.
    Undelivered {
        /// Where it should have gone.
        destination: NodeId,
        /// Why it did not.
        reason: UndeliveredReason,
    },
    /// A node can be reached, or has a new incarnation.
    Reachable {
        /// The node that can be reached.
        node: NodeName,
        /// In which incarnation.
        incarnation: Incarnation,
        /// The largest segment that can be sent to it, in bytes.
        mtu: usize,
    },
    /// What is sent to this node takes another way from now on. Repeat what is not acknowledged.
    PathChanged {
        /// The node whose path has changed.
        node: NodeId,
        /// The largest segment that can be sent to it, in bytes.
        mtu: usize,
    },
    /// No path leads to a node any more.
    Lost {
        /// The node that cannot be reached.
        node: NodeName,
        /// In which incarnation.
        incarnation: Incarnation,
    },
    /// Two names give one node number. The second is ignored; give it another name. This is
    /// repeated every 20 s while it lasts.
    NumberTaken {
        /// Who has it.
        node: NodeName,
        /// Who is ignored.
        refused: NodeName,
    },
    /// An earlier node of our name is there, and answers: this one must stop.
    NameTaken {
        /// The other's incarnation.
        by: Incarnation,
    },
    /// Tell the neighbour at the other end of a link that another node has its name, and has
    /// answered a challenge.
    Refuse {
        /// The link to the refused neighbour.
        link: LinkId,
        /// The other node's incarnation.
        by: Incarnation,
        /// The link with the other one; `None` where it is reached over other nodes.
        over: Option<LinkId>,
    },
    /// The neighbour signs what it advertises, and this node has no keys, or the other way round:
    /// what it says is not taken.
    KeysDiffer {
        /// The node at the other end of the link.
        neighbour: NodeName,
    },
    /// A link to this node is not used: another incarnation of it is reached by other ways, and has
    /// answered a challenge. This is repeated every 20 s while it lasts.
    KeptOut {
        /// The name of both nodes.
        node: NodeName,
        /// The incarnation that is kept out.
        incarnation: Incarnation,
        /// The incarnation that is reached.
        by: Incarnation,
        /// The link with the one that is kept out.
        link: LinkId,
        /// The link with the other one; `None` where it is reached over other nodes.
        over: Option<LinkId>,
    },
}
