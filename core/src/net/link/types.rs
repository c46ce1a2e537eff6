//! What a link is configured with, is known for, and wants done.

use super::quality::Quality;
use crate::net::wire::frame::NameHolder;
use crate::net::wire::node_id::NodeId;
use crate::{GatherBuffer, Incarnation, NodeName};
use bytes::Bytes;
use std::fmt;
use std::ops::RangeInclusive;
use std::time::Duration;

/// The default hello interval of a link. A link whose hellos stop is down after three and a half of
/// them, 175 ms. A process that shares its cores stands still for some 100 ms when they are
/// overloaded; its links are then suspect, and not yet down.
pub const HELLO_INTERVAL: Duration = Duration::from_millis(50);
/// The intervals that a link may have, and a neighbour may announce: shorter ones are an attack or
/// an error, and a link must be known to be down within a minute.
pub const HELLO_INTERVAL_RANGE: RangeInclusive<Duration> =
    Duration::from_millis(1)..=Duration::from_secs(15);
/// When a neighbour that has not come is reported. A process begins within a second, and a computer
/// that is switched on with it takes longer and is found later.
pub const PEER_TIMEOUT: Duration = Duration::from_secs(5);

/// How a link behaves.
#[derive(Clone, Debug)]
pub struct LinkConfig {
    /// Our own name.
    pub node: NodeName,
    /// Our own incarnation.
    pub incarnation: Incarnation,
    /// Which node must be at the other end; `None` takes the first that sends.
    pub expected: Option<NodeName>,
    /// How long after the start, and five hello intervals, a neighbour may take to prove that it is
    /// there before it is reported as missing.
    pub peer_timeout: Duration,
    /// How often a hello is sent, unless the medium is too slow for it. Shorter finds a dead link
    /// sooner and costs more.
    pub hello_interval: Duration,
    /// So many hellos bring a new link up, where each that is missing takes back two; a link that
    /// was down needs twice as many, and again twice as many for each further failure.
    pub up_after_hellos: u32,
}

impl LinkConfig {
    /// The usual behaviour for this node.
    pub fn new(node: NodeName, incarnation: Incarnation) -> Self {
        LinkConfig {
            node,
            incarnation,
            expected: None,
            peer_timeout: PEER_TIMEOUT,
            hello_interval: HELLO_INTERVAL,
            up_after_hellos: 3,
        }
    }
}

/// What is known of a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum LinkState {
    /// No node has proved yet to be at the other end.
    Connecting,
    /// Hellos are received in both directions.
    Up,
    /// A hello is late. Traffic goes elsewhere where it can; nothing is torn down.
    Suspect,
    /// Hellos are not received in one direction or both; the neighbour must prove itself again.
    Down,
}

impl fmt::Display for LinkState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            LinkState::Connecting => "connecting",
            LinkState::Up => "up",
            LinkState::Suspect => "suspect",
            LinkState::Down => "down",
        })
    }
}

/// The node at the other end of a link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Neighbour {
    /// The name of the node at the other end.
    pub node: NodeName,
    /// The incarnation of the node at the other end.
    pub incarnation: Incarnation,
}

/// Why a link refuses the node at its other end.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PeerRefusal {
    /// Two nodes have one name. Give one of them another.
    #[error("another node is also called {node}")]
    NameTaken {
        /// The name that both nodes have.
        node: NodeName,
    },
    /// Two names give one number. Give one of the nodes another name.
    #[error("the names {node} and {other} give the same node number {}", NodeId::of(.node))]
    NumberTaken {
        /// The name of this node.
        node: NodeName,
        /// The name of the node at the other end.
        other: NodeName,
    },
    /// The cable is plugged in elsewhere, or the configured address is another node's.
    #[error("{found} is at the other end, {expected} is expected")]
    WrongNeighbour {
        /// The node that should be there.
        expected: NodeName,
        /// The node that is.
        found: NodeName,
    },
}

/// What a link wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkOutput {
    /// Give this frame to the transport.
    Transmit(GatherBuffer),
    /// The link is now in another state.
    Changed {
        /// The state from now on.
        state: LinkState,
        /// The node that is, or was, at the other end.
        neighbour: Option<Neighbour>,
        /// Why, for display.
        reason: &'static str,
    },
    /// No node has proved to be at the other end since the start. When one does, `Changed` follows.
    Missing {
        /// A node sends there, and does not receive us.
        hello_received: bool,
    },
    /// The link became degraded, or good again, or dearer or cheaper to use.
    Quality(Quality),
    /// Its frames are larger or smaller from now on, or it is known now what the path drops.
    FrameLimit,
    /// The node at the other end is refused.
    Refused(PeerRefusal),
    /// For the router: a message of the neighbour's router.
    Routing(Bytes),
    /// For the router: a packet.
    Packet(Bytes),
    /// The neighbour reaches another node of this one's name, which has answered a challenge.
    Taken(NameHolder),
}
