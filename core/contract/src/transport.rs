//! Between a transport, which owns a medium, and the links that use it.
//!
//! A transport moves frames: whole, in any order, perhaps lost, perhaps twice. It knows neither
//! nodes nor messages. It never blocks: when its own queue is full it drops the frame and counts
//! it.

use actix::dev::ToEnvelope;
use actix::{Actor, Addr, Handler, Message, Recipient};
use blastema_core::medium::impairment::{Impairable, Impairment, Injected};
use blastema_core::medium::lane::FrameLane;
use blastema_core::{GatherBuffer, Instant};
use bytes::Bytes;
use std::collections::BTreeSet;
use std::fmt;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

/// An address as one medium writes it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum MediumAddress {
    /// UDP and TCP.
    Ip(SocketAddr),
    /// Memory: the name under which the other end opened.
    Memory(Arc<str>),
    /// Unix-domain sockets: the path at which the other end listens.
    Unix(Arc<Path>),
    /// A line with two ends, such as a serial cable: the node at the other.
    Line,
    /// CAN: the node's number on the bus.
    Can(u8),
    /// A medium of the application's own: what that medium calls it.
    Own(Arc<str>),
    /// A connection that the other end has made, and on which it has not proven who it is. See
    /// [`Adopt`].
    Connection {
        /// Which one of its transport; the transport uses no number for two connections.
        number: u32,
        /// The address that the other end claims, which proves nothing.
        claimed: Arc<MediumAddress>,
    },
}

impl MediumAddress {
    /// The peer's address: that which the other end claims, where this is a connection.
    pub fn peer(&self) -> &MediumAddress {
        match self {
            MediumAddress::Connection { claimed, .. } => claimed.peer(),
            address => address,
        }
    }
}

impl blastema_core::net::LinkAddress for MediumAddress {
    fn is_connection(&self) -> bool {
        matches!(self, MediumAddress::Connection { .. })
    }

    fn peer(&self) -> &Self {
        self.peer()
    }
}

impl From<SocketAddr> for MediumAddress {
    fn from(address: SocketAddr) -> Self {
        MediumAddress::Ip(address)
    }
}

impl From<Arc<Path>> for MediumAddress {
    fn from(path: Arc<Path>) -> Self {
        MediumAddress::Unix(path)
    }
}

impl fmt::Display for MediumAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            MediumAddress::Ip(address) => write!(f, "{address}"),
            MediumAddress::Memory(name) | MediumAddress::Own(name) => f.write_str(name),
            MediumAddress::Unix(path) => write!(f, "{}", path.display()),
            MediumAddress::Line => f.write_str("line"),
            MediumAddress::Can(number) => write!(f, "{number}"),
            MediumAddress::Connection { number, claimed } => {
                write!(f, "connection {number} of {claimed}")
            }
        }
    }
}

/// Sends one frame. No answer: a medium that knows of a failure says so by [`TransportReport`].
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct Transmit {
    /// The receiver's address on this medium.
    pub to: MediumAddress,
    /// The frame, whole, in one piece or two.
    pub frame: GatherBuffer,
    /// What it may overtake.
    pub lane: FrameLane,
}

impl Transmit {
    /// The usual, which overtakes nothing.
    pub fn new(to: MediumAddress, frame: GatherBuffer) -> Self {
        Transmit { to, frame, lane: FrameLane::Usual }
    }
}

/// One frame arrived.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct Received {
    /// The sender's address on this medium.
    pub from: MediumAddress,
    /// The frame, whole.
    pub frame: Bytes,
}

impl Impairable for Transmit {
    type Peer = MediumAddress;

    fn peer(&self) -> &MediumAddress {
        self.to.peer()
    }

    fn length(&self) -> usize {
        self.frame.len()
    }

    fn bytes(&mut self) -> &mut Bytes {
        self.frame.make_whole()
    }
}

impl Impairable for Received {
    type Peer = MediumAddress;

    fn peer(&self) -> &MediumAddress {
        self.from.peer()
    }

    fn length(&self) -> usize {
        self.frame.len()
    }

    fn bytes(&mut self) -> &mut Bytes {
        &mut self.frame
    }
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
        /// A path over it, as through a VPN, may drop such frames and say nothing: each link finds
        /// by probes what passes.
        is_probed: bool,
    },
    /// The medium cannot be opened, or is gone. The transport tries again by itself where that can
    /// help; the text says what the user may do.
    Closed {
        /// What happened, and what helps.
        reason: String,
    },
    /// The medium is closed for good, as [`Close`] asked.
    Ended,
    /// How much the medium carries, where that is little: hellos are said less often on it, and it
    /// is dearer to use. Reported after each opening.
    Rate {
        /// Bytes of frames in a second, both ways together.
        bytes_per_second: u64,
    },
    /// Another node sends under this node's address on the medium.
    Clash {
        /// Which medium and address, and what helps.
        reason: String,
    },
    /// A connection to this peer is gone (media with connections only).
    PeerLost {
        /// The peer's address on the medium.
        peer: MediumAddress,
    },
}

/// Who gets what a transport receives and reports. Sent again, it replaces the one before.
#[derive(Clone, Debug, Message)]
#[rtype(result = "()")]
pub struct Attach {
    /// Gets every frame.
    pub frames: Recipient<Received>,
    /// Gets every report; the present state is reported at once. A transport reports its opening
    /// and closing, not each of its attempts.
    pub reports: Recipient<TransportReport>,
    /// What a connection that another node makes is worth. A change from `Claimed` to `Proven`
    /// closes all connections, for none of them is proven.
    pub connections: ConnectionTrust,
    /// The node's clock, by which the transport tells how long frames wait for the medium; without
    /// one it does not.
    pub clock: Option<fn() -> Instant>,
}

impl Attach {
    /// For a receiver that believes the addresses that connections claim.
    pub fn new(frames: Recipient<Received>, reports: Recipient<TransportReport>) -> Self {
        Attach { frames, reports, connections: ConnectionTrust::Claimed, clock: None }
    }
}

/// What a connection that another node makes is worth (media with connections only).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ConnectionTrust {
    /// The address that the other end claims is believed: its connection replaces an older one of
    /// that peer. For networks without keys.
    #[default]
    Claimed,
    /// The connection is no peer's until the receiver says whose it is, by [`Adopt`]. Until then
    /// its frames come from [`MediumAddress::Connection`], few and small, and not for long.
    Proven,
}

/// The connection is the peer's from now on: frames on it come from `peer`, frames to `peer` go out
/// on it, and an older connection of the peer is closed without a report. A connection that is gone
/// stays gone.
///
/// ```text
/// receiver                               transport
///   │◄─ Received { from: connection 7 } ───┤   at most 16 frames of 128 bytes
///   ├── Transmit { to: connection 7 } ────►│
///   │◄─ Received { from: connection 7 } ───┤
///   ├── Adopt { connection 7, peer } ─────►│   the receiver knows who it is
///   │◄─ Received { from: peer } ───────────┤
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct Adopt {
    /// The connection, a [`MediumAddress::Connection`].
    pub connection: MediumAddress,
    /// The address of the peer that it belongs to.
    pub peer: MediumAddress,
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
#[non_exhaustive]
pub struct TransportCounters {
    /// Frames given to the medium.
    pub sent: u64,
    /// Frames taken from it and handed on.
    pub received: u64,
    /// Frames that got lost here: a queue was full, no peer was connected, or no receiver is
    /// attached.
    pub dropped: u64,
    /// What was refused: frames that are too large, bytes that are no frames, peers that do not
    /// speak this protocol or are too many.
    pub refused: u64,
    /// Failures that the medium told of and that the transport survived, such as an ICMP "port
    /// unreachable" or a connection that broke.
    pub errors: u64,
    /// What waits for the medium now.
    pub backlog: TransmitBacklog,
}

/// The frames that wait for a medium at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TransmitBacklog {
    /// The number of frames that wait.
    pub frames: usize,
    /// How long the oldest of them has waited; zero if there is none, or if the receiver that is
    /// attached has no clock.
    pub oldest: Duration,
}

impl TransmitBacklog {
    /// So many frames, of which the oldest waits since then.
    pub fn since(frames: usize, oldest: Option<Instant>, now: Option<Instant>) -> TransmitBacklog {
        let age = now.zip(oldest).map(|(now, oldest)| now - oldest);
        TransmitBacklog { frames, oldest: age.unwrap_or_default() }
    }

    /// Adds the frames of both; the oldest is the older one of the two.
    pub fn and(self, other: TransmitBacklog) -> TransmitBacklog {
        let (frames, oldest) = (self.frames + other.frames, self.oldest.max(other.oldest));
        TransmitBacklog { frames, oldest }
    }
}

/// All that is known of a transport, whatever it is made of.
///
/// ```text
/// link ──Transmit──► transport ──► medium
///      ◄─Received──            ◄──
/// ```
#[derive(Clone, Debug)]
pub struct Transport {
    /// Takes the frames to send.
    pub transmit: Recipient<Transmit>,
    /// Takes who is to get frames and reports.
    pub attach: Recipient<Attach>,
    /// Takes whose a connection is; media without connections ignore it.
    pub adopt: Recipient<Adopt>,
    /// Takes the end.
    pub close: Recipient<Close>,
    /// Gives the counters.
    pub counters: Recipient<ReadCounters>,
}

impl<A> From<Addr<A>> for Transport
where
    A: Actor
        + Handler<Transmit>
        + Handler<Attach>
        + Handler<Adopt>
        + Handler<Close>
        + Handler<ReadCounters>,
    A::Context: ToEnvelope<A, Transmit>
        + ToEnvelope<A, Attach>
        + ToEnvelope<A, Adopt>
        + ToEnvelope<A, Close>
        + ToEnvelope<A, ReadCounters>,
{
    fn from(address: Addr<A>) -> Self {
        Transport {
            transmit: address.clone().recipient(),
            attach: address.clone().recipient(),
            adopt: address.clone().recipient(),
            close: address.clone().recipient(),
            counters: address.recipient(),
        }
    }
}

/// Which way frames go, seen from the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// From the link to the medium.
    Outgoing,
    /// From the medium to the link.
    Incoming,
    /// Both directions at once.
    Both,
}

impl Direction {
    /// Whether frames to the medium are meant.
    pub fn outgoing(self) -> bool {
        matches!(self, Direction::Outgoing | Direction::Both)
    }

    /// Whether frames from the medium are meant.
    pub fn incoming(self) -> bool {
        matches!(self, Direction::Incoming | Direction::Both)
    }
}

/// Makes a medium bad, in place of how bad it was. For what stands between link and transport.
#[derive(Clone, Copy, Debug, PartialEq, Message)]
#[rtype(result = "()")]
pub struct Impair {
    /// The direction that is impaired.
    pub direction: Direction,
    /// What the frames suffer from now on.
    pub impairment: Impairment,
}

/// Cuts the cable: nothing passes until [`Restore`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct Cut {
    /// The direction that is cut.
    pub direction: Direction,
    /// The medium notices, as Ethernet notices a pulled cable ([`TransportReport::Closed`]);
    /// otherwise it says nothing, as a switch that has lost its next hop.
    pub reported: bool,
}

/// Puts these peers, and no others, on the other side of a partition: nothing passes to and from
/// them, and does not report it. For what stands between link and transport.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct Partition {
    /// The direction that is blocked.
    pub direction: Direction,
    /// The addresses of the peers on the other side.
    pub peers: BTreeSet<MediumAddress>,
}

/// Restores everything: no cut, no partition and no impairment, in both directions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct Restore;

/// Asks what was done to frames on purpose.
#[derive(Clone, Copy, Debug, Message)]
#[rtype(result = "InjectedFaults")]
pub struct ReadInjectedFaults;

/// What was done to frames on purpose.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, actix::MessageResponse)]
pub struct InjectedFaults {
    /// To frames from the link to the medium.
    pub outgoing: Injected,
    /// To frames from the medium to the link.
    pub incoming: Injected,
}
