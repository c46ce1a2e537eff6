//! What a session wants done, and what it did.

use crate::net::wire::packet::{PacketPriority, UndeliveredReason};
use crate::{DeliveryError, GatherBuffer, Incarnation, TrafficClass};
use bytes::Bytes;

/// What a session wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SessionOutput {
    /// Give this segment to the router for the peer.
    Transmit {
        /// How urgent it is.
        class: PacketPriority,
        /// The encoded segment.
        segment: GatherBuffer,
        /// A copy is to go over every way that there is.
        everywhere: bool,
    },
    /// A session has begun.
    Opened {
        /// With this incarnation of the peer.
        incarnation: Incarnation,
        /// This end's number of it. A later output may already be of the next session.
        number: u32,
    },
    /// A message has arrived, once and in its order.
    Message {
        /// On which stream.
        stream: TrafficClass,
        /// The message as the peer sent it.
        message: Bytes,
    },
    /// A best-effort message has arrived, newer than all before it on its channel.
    Newest {
        /// On which channel.
        channel: u32,
        /// The message as the peer sent it.
        message: Bytes,
    },
    /// A message was not acknowledged before its session ended. Those in flight to a silent peer
    /// are returned up to four idle timeouts after the end, those that had arrived are not.
    Returned {
        /// The stream that it was for.
        stream: TrafficClass,
        /// The message as it was given to the session.
        message: Bytes,
        /// Why the message is returned.
        why: DeliveryError,
        /// Some of it was sent, so that it may have arrived; otherwise it has not.
        sent: bool,
    },
    /// The session is over. What had not been sent has been returned before this.
    Ended {
        /// Which incarnation of the peer it was with.
        incarnation: Incarnation,
        /// Why the session is over.
        why: DeliveryError,
    },
    /// The peer speaks another version; the two cannot talk until one is updated.
    Incompatible {
        /// The peer's version.
        theirs: u8,
    },
}

/// A refused message, and why.
pub type Refused = (DeliveryError, Bytes);

/// What a session did so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionCounters {
    /// Chunks sent, retransmissions included.
    pub sent: u64,
    /// Bytes of chunks and best-effort messages sent, retransmissions included.
    pub bytes_sent: u64,
    /// Bytes of chunks and best-effort messages received, duplicates included.
    pub bytes_received: u64,
    /// Chunks sent again.
    pub retransmitted: u64,
    /// Chunks and best-effort messages that had been received before.
    pub duplicates: u64,
    /// Best-effort messages that were received after a newer one of their channel.
    pub superseded: u64,
    /// Best-effort messages that gave way to a newer one of their channel before they were sent.
    pub replaced: u64,
    /// Fragmented messages that were given up before all of their chunks were received.
    pub incomplete: u64,
    /// Packets that came back undelivered; what is reliable of them was sent again.
    pub returned: u64,
    /// Why the last of them did.
    pub last_return: Option<UndeliveredReason>,
    /// Copies on the redundant stream that were dropped, for the first had arrived.
    pub replicas: u64,
}
