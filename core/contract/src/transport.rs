//! Between a transport, which owns a medium, and the links that use it.
//!
//! A transport moves frames: whole, in any order, perhaps lost, perhaps twice. It knows neither nodes
//! nor messages. It never blocks: when its own queue is full it drops the frame and counts it.

use actix::{Message, Recipient};
use bytes::Bytes;
use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;

/// An address as one medium writes it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum MediumAddress {
    /// UDP and TCP.
    Ip(SocketAddr),
    /// Memory: the name under which the other end opened.
    Memory(Arc<str>),
}

impl fmt::Display for MediumAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            MediumAddress::Ip(address) => write!(f, "{address}"),
            MediumAddress::Memory(name) => write!(f, "{name}"),
        }
    }
}

/// Sends one frame. No answer: a medium that knows of a failure says so by [`TransportReport`].
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct Transmit {
    /// To whom, on this medium.
    pub to: MediumAddress,
    /// The frame, whole.
    pub frame: Bytes,
}

/// One frame arrived.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct Received {
    /// From whom, on this medium.
    pub from: MediumAddress,
    /// The frame, whole.
    pub frame: Bytes,
}

/// What a transport has to say about its medium.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub enum TransportReport {
    /// The medium is open.
    Opened {
        /// Our own address on it, with the port that was really taken.
        local: MediumAddress,
        /// The largest frame it carries, in bytes.
        mtu: usize,
    },
    /// The medium cannot be opened, or is gone. The transport tries again by itself where that can
    /// help; the text says what the user may do.
    Closed {
        /// What happened, and what helps.
        reason: String,
    },
    /// A connection to this peer is gone (media with connections only).
    PeerLost {
        /// Who.
        peer: MediumAddress,
    },
}

/// Who gets what a transport receives and reports. Sent anew, it replaces what was before.
#[derive(Clone, Debug, Message)]
#[rtype(result = "()")]
pub struct Attach {
    /// Gets every frame.
    pub frames: Recipient<Received>,
    /// Gets every report; the present state is reported at once.
    pub reports: Recipient<TransportReport>,
}

/// Closes the medium for good; the transport stops.
#[derive(Clone, Copy, Debug, Message)]
#[rtype(result = "()")]
pub struct Close;

/// Asks for the counters.
#[derive(Clone, Copy, Debug, Message)]
#[rtype(result = "TransportCounters")]
pub struct ReadCounters;

/// What a transport did so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, actix::MessageResponse)]
pub struct TransportCounters {
    /// Frames given to the medium.
    pub sent: u64,
    /// Frames taken from it.
    pub received: u64,
    /// Frames not sent because the queue was full or no peer was connected.
    pub dropped: u64,
    /// Frames refused because they were too large, truncated or otherwise no frames.
    pub refused: u64,
}
