//! Between the links of a network and the router.
//!
//! ```text
//! transport ── Received, TransportReport ──► links ── LinkChanged, ReceivedOnLink ──► router
//!           ◄─ Transmit ────────────────────       ◄─ TransmitOnLink ────────────────
//! ```

use actix::{Message, Recipient};
use blastema_core::GatherBuffer;
use blastema_core::net::routing::LinkStatus;
use blastema_core::net::wire::frame::NameHolder;
use blastema_core::net::{ByteRate, LinkId, LinkState, LinkTraffic, Neighbour, Quality, Refusals};
use bytes::Bytes;
use std::sync::Arc;
use std::time::Duration;

/// What a link carries.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkPayload {
    /// From router to router, no further.
    Routing(Bytes),
    /// A packet on its way.
    Packet(GatherBuffer),
    /// Another node has the neighbour's name. The neighbour's links act on it.
    Taken(NameHolder),
}

/// The router wants a link to carry this. Dropped and counted where the link is not up.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct TransmitOnLink {
    /// The link to send it on.
    pub link: LinkId,
    /// The payload to send.
    pub load: LinkPayload,
}

/// A link's neighbour has sent this.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct ReceivedOnLink {
    /// The link on which it arrived.
    pub link: LinkId,
    /// The payload as received.
    pub load: LinkPayload,
}

/// A link is now as follows.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct LinkChanged {
    /// The link that has changed.
    pub link: LinkId,
    /// The link's present status.
    pub status: LinkStatus,
    /// Where it leads, for display.
    pub remote: Arc<str>,
}

/// The interface that a network uses has lost its carrier, or has it again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct CarrierChanged {
    /// Whether it is there now.
    pub present: bool,
}

/// The links of a network present themselves to the router.
#[derive(Clone, Debug, Message)]
#[rtype(result = "()")]
pub struct AddLinks {
    /// The links, each by its number on this node.
    pub links: Vec<LinkId>,
    /// Takes what they are to carry.
    pub carry: Recipient<TransmitOnLink>,
}

/// Asks a network for all its links.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Vec<LinkRow>")]
pub struct ReadLinks;

/// One link, for display.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkRow {
    /// Its number on this node, by which routes name it.
    pub number: LinkId,
    /// The network's name in the configuration.
    pub network: Arc<str>,
    /// The link's name there.
    pub link: Arc<str>,
    /// The link's present state.
    pub state: LinkState,
    /// Who is, or was last, at its other end.
    pub neighbour: Option<Neighbour>,
    /// How long ago its neighbour's last hello came; `None` for never.
    pub last_sign: Option<Duration>,
    /// How good it is.
    pub quality: Quality,
    /// How often hellos are said on it: as configured, or as often as the medium can bear.
    pub hello_interval: Duration,
    /// What it costs at present: its own cost, and more while its quality is poor.
    pub cost: u16,
    /// What it has carried since its network's links were built last.
    pub traffic: LinkTraffic,
    /// How many bytes of that went each way in the last second.
    pub rate: ByteRate,
    /// What was refused on it.
    pub refusals: Refusals,
    /// How its frames are sealed; `None` where they are not, or not yet.
    pub seal: Option<LinkSeal>,
}

/// How the frames of a link are sealed, for display.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LinkSeal {
    /// The cipher, or the message authentication code where nothing is encrypted.
    pub cipher: &'static str,
    /// For how long these keys are used.
    pub key_age: Duration,
}
