//! What a session wants done, and what it did.

use crate::net::packet::{Class, Undelivered};
use crate::net::segment::Stream;
use crate::{Incarnation, Why};
use bytes::Bytes;

/// What a session wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SessionOutput {
    /// Give this segment to the router for the peer.
    Transmit {
        /// How urgent it is.
        class: Class,
        /// The segment.
        segment: Bytes,
    },
    /// A session has begun.
    Opened {
        /// With this life of the peer.
        incarnation: Incarnation,
    },
    /// A message has arrived, once and in its order.
    Message {
        /// On which stream.
        stream: Stream,
        /// The message.
        message: Bytes,
    },
    /// A best-effort message has arrived, newer than all before it on its channel.
    Newest {
        /// On which channel.
        channel: u32,
        /// The message.
        message: Bytes,
    },
    /// A message was not acknowledged before its session ended.
    Returned {
        /// The stream that it was for.
        stream: Stream,
        /// The message.
        message: Bytes,
        /// Why.
        why: Why,
    },
    /// The session is over. What was unacknowledged has been returned before this.
    Ended {
        /// Which life of the peer it was with.
        incarnation: Incarnation,
        /// Why.
        why: Why,
    },
    /// A stream holds all that it should: stop sending, or messages will soon be refused.
    Full {
        /// Which.
        stream: Stream,
    },
    /// A stream that was full takes messages again.
    Room {
        /// Which.
        stream: Stream,
    },
    /// The peer speaks another version; the two cannot talk until one is updated.
    Incompatible {
        /// The peer's version.
        theirs: u8,
    },
}

/// A refused message, and why.
pub type Refused = (Why, Bytes);

/// What a session did so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionCounters {
    /// Parts sent, repetitions included.
    pub sent: u64,
    /// Parts sent again.
    pub repeated: u64,
    /// Parts and best-effort messages that had arrived before.
    pub doubled: u64,
    /// Best-effort messages that came after a newer one of their channel.
    pub overtaken: u64,
    /// Messages that were never finished.
    pub unfinished: u64,
    /// Packets that came back undelivered; what is reliable of them was sent again.
    pub returned: u64,
    /// Why the last of them did.
    pub last_return: Option<Undelivered>,
}
