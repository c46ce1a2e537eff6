//! The network below the objects, as pure machines: what travels from node to node, and how.
//!
//! ```text
//! message              what objects say to each other across nodes
//!       session        end to end with one peer node: exactly once, in order, over any path
//!       router         which neighbour is next; which one if that fails
//!       link           one use of one transport towards one neighbour: is it alive, how good
//! ═══ transport ═══    (not here: it owns a medium and knows only frames)
//! ```
//!
//! Each layer has one wire format of its own, written by hand; what nodes say to each other about
//! bindings and subscriptions, the codec of contracts writes. A layer never looks into the payload
//! of the one above. Nothing that arrives can panic: what is not understood is refused as a
//! [`WireError`] and counted in [`Refusals`].
//!
//! The bytes before a small reliable message, from the first of the frame:
//!
//! ```text
//! frame 2 │ packet 9 │ segment 6..8, 4..6 more with an acknowledgement │ length 1 │ message …
//! ```
//!
//! | | at first | after an hour and a million messages | with an acknowledgement on board |
//! | --- | --- | --- | --- |
//! | message without an answer | 23 | 28 | 6, then 8 more |
//! | event | 22 | 27 | 6, then 8 more |
//! | event of which the newest counts | 23 | 30 | never |
//! | request | 25 | 32 | 6, then 8 more |
//! | its answer | 20 | 24 | 6, then 8 more |
//!
//! What a node in between has passed on is five bytes longer, and four for each further one.
//! `core/tests/virtual/net_header.rs` holds these numbers. Small messages that wait together share
//! a part, and all of it but the length and their own fields.
//!
//! Where nodes have keys, [`link_layer`] seals all of it for the neighbour ([`seal`]): 24 bytes
//! more on the wire, 12 on CAN. A node that passes a packet on opens it, and seals it for the next
//! one. What is in a packet that goes over a relay, [`routing`] has sealed for its destination
//! before: 24 bytes more.
//!
//! What this module does not do: multicast, congestion control towards strangers.

pub mod byte_rate;
pub mod discovery;
pub mod link;
pub mod link_layer;
pub mod link_traffic;
pub mod peer_protocol;
pub mod refusal_alarms;
pub mod routing;
pub mod seal;
pub mod session;
pub mod trust;
pub mod wire;

pub use byte_rate::{ByteRate, ByteRates};
pub use link::link_set::{LinkSet, LinkSetOutput};
pub use link::{
    HELLO_INTERVAL, HELLO_INTERVAL_RANGE, Link, LinkConfig, LinkOutput, LinkState, Neighbour,
    PEER_TIMEOUT, Quality,
};
pub use link_layer::{AddLinkError, LinkAddress, LinkLayer, LinkLayerOutput, NeighbourKey};
pub use link_traffic::LinkTraffic;
pub use peer_protocol::receive_backlog::ReceiveBacklog;
pub use peer_protocol::{Peer, PeerProtocol, PeerProtocolOutput, Peers};
pub use routing::topology::Route;
pub use routing::{Router, RouterConfig, RouterOutput};
pub use session::ordering_key::OrderingKey;
pub use session::{Session, SessionConfig, SessionOutput};
pub use wire::link_id::LinkId;
pub use wire::node_id::NodeId;
pub use wire::packet::PacketPriority;
pub use wire::{Refusals, WireError};

use std::time::Duration;

/// A fault of the network that is not declared again for so long has ended: longer than an
/// advertisement lives that is not repeated.
pub const QUIET: Duration = Duration::from_secs(60);
/// A fault that lasts is declared again at this interval: two of three may be lost.
const REPORT_INTERVAL: Duration = Duration::from_secs(20);

/// Smaller segments are those of a medium that is taken for slow until it is measured: a serial
/// line, or CAN, whose frames have 1,024 bytes. Larger ones fit into frames of 1,200 bytes,
/// whichever node passes them on.
const NARROW: usize = 1050;

/// Whether a path leads over such a medium, by the largest segment that it carries. Router and
/// session ask here, so that they do not wait differently long for what goes the same way.
pub(crate) fn is_narrow(segment: usize) -> bool {
    segment < NARROW
}

/// Takes one more round trip into the mean and its deviation: an eighth of the round trip, a
/// quarter of the deviation (RFC 6298).
pub(crate) fn smooth(mean: &mut Option<Duration>, deviation: &mut Duration, sample: Duration) {
    match *mean {
        None => (*mean, *deviation) = (Some(sample), sample / 2),
        Some(before) => {
            *deviation = (*deviation * 3 + before.abs_diff(sample)) / 4;
            *mean = Some((before * 7 + sample) / 8);
        }
    }
}
