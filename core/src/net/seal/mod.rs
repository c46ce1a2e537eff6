//! Sealed frames: encrypted and authenticated for one peer, with keys that two nodes agree on.
//!
//! ```text
//!  initiator: the smaller node number            responder
//!      │ ◄───────────── knock ───────────────────────│   where only the responder knows the address
//!      │ ───────────── init (Noise KK) ─────────────►│
//!      │ ◄───────────── answer ──────────────────────│   offers a channel; the present one stays
//!      │ ── first sealed frame ─────────────────────►│   accepts it: PeerOpen
//!      │ ◄───────────── first sealed frame ──────────│
//!   PeerOpen
//! ```
//!
//! A [`Sealer`] has the channels of all peers on one network, or of all peers that are reached over
//! relays. Its caller gives it the peers' static public keys, says where they are, and gives it
//! what the medium received. It seals and opens frames at once. What it does by itself, it says as
//! [`SealerOutput`]s.
//!
//! | file | concept |
//! | --- | --- |
//! | `noise` | the only one that knows cryptographic libraries |
//! | `cipher` | what it implements, for doubles |
//! | `header`, `handshake_frame` | the bytes of sealed frames and of handshakes |
//! | `window` | which counters were received |
//! | `channel` | two keys and the counters under them; the present, offered and former one of a peer |
//! | `compact` | tags without encryption, for small media |
//! | `admission` | repeats, rates and cookies, before any arithmetic on curves |
//! | `sealed_peer`, `handshake` | what is known of a peer; the course of a handshake on both sides |
//!
//! **Handshakes.** The smaller node number is the initiator, so handshakes never cross; the other
//! end knocks. An init is repeated after 50 ms, 100 ms and so on up to a second, with a new
//! ephemeral key after half a second. One handshake's message costs some 0.2 ms of arithmetic: such
//! work waits until the caller gives it a turn ([`Sealer::handle_turn`]), one message each.
//!
//! **Before authentication.** A frame of a handshake passes, in this order: its form; `mac1`, which
//! needs a key of the pair; the memory of repeats; a budget of 64 within a second; beyond that, where
//! addresses can be forged, a cookie. All of it takes less than 64 KiB, and no address receives
//! more bytes than came from there.
//!
//! **Attribution.** What was not opened is counted in [`SealRefusals`] and is no peer's fault:
//! every node on the medium can send it. [`Sealer::refused_of`] counts what only a holder of the
//! pair's key can have sent.
//!
//! What this module does not do: it does not know names, rosters or policies, or who may open a
//! channel beyond the keys that it is given.

mod admission;
mod compact;
mod handshake;
mod handshake_frame;
mod header;
mod sealed_peer;
mod timers;

pub mod channel;
pub mod cipher;
pub mod noise;
pub mod window;

pub use crate::medium::lane::FrameLane;
pub use channel::{KeyLimits, OpenError};
pub use cipher::{CipherSuite, SealCrypto};
pub(crate) use handshake_frame::{INIT_LENGTH, is_handshake};
pub use header::SealProfile;
pub use noise::NoiseCrypto;

use self::admission::{BUDGET, BUDGET_PERIOD, CookieJar, RepeatMemory};
use self::channel::Opening;
use self::handshake::HandshakeStep;
use self::header::SealHeader;
use self::noise::SeedGenerator;
use self::sealed_peer::SealedPeer;
use super::wire::node_id::NodeId;
use super::wire::{Refusals, WireError};
use crate::recovery::Backoff;
use crate::sorted::SortedMap;
use crate::timer::Timers;
use crate::{Incarnation, Instant, Machine, SlidingWindow};
use bytes::{Bytes, BytesMut};
use std::collections::VecDeque;
use std::hash::Hash;
use std::time::Duration;

/// Whether this is a frame of a sealer's, sealed or of a handshake, by its first byte. What is sent
/// without a seal beside it begins with other bytes (RFC 7983 tells protocols apart so).
pub(crate) fn is_seal_frame(frame: &[u8]) -> bool {
    frame.first().is_some_and(|first| SealHeader::begins_with(*first)) || is_handshake(frame)
}

/// What channels are for. Keys of one use are never those of another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChannelPurpose {
    /// The frames between two neighbours.
    Link,
    /// What two nodes send each other over relays.
    Path,
}

/// An init, an answer, and what a medium adds to each.
const EXCHANGE_BYTES: u64 = 89 + 76 + 16;

/// How a sealer behaves.
#[derive(Clone, Debug)]
pub struct SealerConfig {
    /// The number of this node.
    pub node: NodeId,
    /// This node's incarnation.
    pub incarnation: Incarnation,
    /// The robot's name: nodes of another do not understand this one's handshakes.
    pub robot: String,
    /// What the channels are for.
    pub purpose: ChannelPurpose,
    /// How frames are protected. Both ends of a network say the same.
    pub profile: SealProfile,
    /// This processor has instructions for AES. Without them ChaCha20-Poly1305 is agreed on.
    pub fast_aes: bool,
    /// A sender on this medium can claim any address. Under load, handshakes then need a cookie.
    pub forgeable_addresses: bool,
    /// How long init and answer take on this medium. An init is repeated after three times as long,
    /// and after 50 ms at least.
    pub exchange_time: Duration,
    /// How long keys may be used.
    pub limits: KeyLimits,
}

impl SealerConfig {
    /// The usual behaviour on a fast medium with addresses.
    pub fn new(node: NodeId, incarnation: Incarnation, robot: impl Into<String>) -> Self {
        SealerConfig {
            node,
            incarnation,
            robot: robot.into(),
            purpose: ChannelPurpose::Link,
            profile: SealProfile::Full,
            fast_aes: true,
            forgeable_addresses: true,
            exchange_time: Duration::ZERO,
            limits: KeyLimits::default(),
        }
    }

    fn suite(&self) -> CipherSuite {
        if self.fast_aes { CipherSuite::AesGcm } else { CipherSuite::ChaChaPoly }
    }

    /// When a frame that begins something is repeated.
    fn backoff(&self) -> Backoff {
        let first = Duration::from_millis(50).max(self.exchange_time * 3);
        let limit = Duration::from_secs(1).max(first);
        Backoff { first, factor: 2, limit, jitter_percent: 10 }
    }

    /// What both ends of a handshake know beside their keys.
    fn prologue(&self, initiator: NodeId, responder: NodeId) -> Vec<u8> {
        let purpose: &[u8] = match (self.purpose, self.profile) {
            (ChannelPurpose::Link, SealProfile::Full) => b"link",
            (ChannelPurpose::Link, SealProfile::Compact) => b"compact link",
            (ChannelPurpose::Path, SealProfile::Full) => b"path",
            (ChannelPurpose::Path, SealProfile::Compact) => b"compact path",
        };
        let (initiator, responder) = (initiator.0.to_be_bytes(), responder.0.to_be_bytes());
        // The numbers have a fixed length: two lists of pieces never give the same bytes.
        [b"blastema 2 ", purpose, b"\0", self.robot.as_bytes(), &initiator, &responder].concat()
    }
}

/// A frame that was opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OpenedFrame {
    /// The node that has sealed it.
    pub peer: NodeId,
    /// In which of its incarnations.
    pub incarnation: Incarnation,
    /// The lane of the frame.
    pub lane: FrameLane,
    /// What was sealed.
    pub plain: Bytes,
}

/// What a sealer wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SealerOutput<A> {
    /// Give this frame to the transport.
    Transmit {
        /// The address of the receiver.
        to: A,
        /// The frame, sealed or of a handshake.
        frame: Bytes,
    },
    /// The peer has a channel with this node: it holds its key, and is there now. Frames of its
    /// earlier incarnations are not opened any more.
    PeerOpen {
        /// The peer that the channel is with.
        peer: NodeId,
        /// Where its first frame came from, which may be forged.
        address: A,
        /// The incarnation that the peer's key has proved.
        incarnation: Incarnation,
        /// It had a channel in the same incarnation: these are new keys.
        renewed: bool,
    },
    /// A node with the peer's key, in another incarnation, is there while the peer is heard: the
    /// peer was restarted within some tenths of a second, or two nodes have one key. The other one
    /// reads what is [sealed for it](Sealer::seal_for_other).
    KeyInUse {
        /// The peer whose key another node has.
        peer: NodeId,
        /// Where the other one is.
        address: A,
        /// The incarnation that is heard.
        open: Incarnation,
        /// The other one, which is refused.
        refused: Incarnation,
    },
    /// No new keys could be agreed on until the old ones must not be used any more. The channel is
    /// closed; the sealer goes on asking for another.
    KeyWornOut {
        /// The peer whose channel is closed.
        peer: NodeId,
    },
}

/// What was refused without proof of its sender, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SealRefusals {
    /// Not sealed, of another release, or cut.
    pub malformed: Refusals,
    /// For a channel, or from a node, that is not known.
    pub unknown: u64,
    /// Duplicates, and what is too old.
    pub stale: u64,
    /// Not sealed by the holder of the keys.
    pub forged: u64,
    /// Handshakes without the pair's key.
    pub filtered: u64,
    /// Handshakes that were seen before.
    pub repeated: u64,
    /// Handshakes beyond the budget.
    pub limited: u64,
}

impl SealRefusals {
    /// All of them, but duplicates, which every network makes.
    pub fn total(&self) -> u64 {
        let SealRefusals { malformed, unknown, stale: _, forged, filtered, repeated: _, limited } =
            self;
        malformed.total() + unknown + forged + filtered + limited
    }

    fn count(&mut self, error: &OpenError) {
        match error {
            OpenError::Malformed(error) => self.malformed.count(error),
            OpenError::Unknown => self.unknown += 1,
            OpenError::Stale => self.stale += 1,
            OpenError::Forged => self.forged += 1,
            OpenError::Filtered => self.filtered += 1,
            OpenError::Repeated => self.repeated += 1,
            OpenError::Limited => self.limited += 1,
        }
    }
}

/// Why a peer's public key is not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PeerKeyError {
    /// No secret belongs to it. The roster is wrong.
    #[error("the public key of node {0} is not a key of X25519")]
    LowOrder(NodeId),
    /// It is this node's own number.
    #[error("node {0} is this node itself")]
    Ourselves(NodeId),
}

/// The state of a peer's channel, for display.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChannelStatus {
    /// How frames are protected.
    pub profile: SealProfile,
    /// The AEAD of the full profile, and of the handshake.
    pub suite: CipherSuite,
    /// Since when these keys are used.
    pub since: Instant,
    /// The peer's incarnation, as the handshake says.
    pub incarnation: Incarnation,
}

/// The channels with all peers on one network. `A` are its addresses.
#[derive(Debug)]
pub struct Sealer<C: SealCrypto, A> {
    config: SealerConfig,
    crypto: C,
    seeds: SeedGenerator,
    peers: SortedMap<NodeId, SealedPeer<C, A>>,
    /// Whose channel, or handshake, a number in a frame to this node means.
    numbers: SortedMap<u32, NodeId>,
    repeats: RepeatMemory,
    budget: SlidingWindow,
    cookies: CookieJar,
    /// Messages of handshakes that wait for their turn.
    steps: VecDeque<HandshakeStep<A>>,
    refusals: SealRefusals,
    wake_at: Option<Instant>,
    outputs: VecDeque<SealerOutput<A>>,
}

impl<C: SealCrypto, A: Clone + Eq + Hash> Sealer<C, A> {
    /// A sealer without peers. The seed is of the system's random source, and used once.
    pub fn new(config: SealerConfig, crypto: C, seed: [u8; 32], now: Instant) -> Self {
        let mut seeds = SeedGenerator::new(seed);
        Sealer {
            config,
            crypto,
            peers: SortedMap::new(),
            numbers: SortedMap::new(),
            repeats: RepeatMemory::default(),
            budget: SlidingWindow::new(BUDGET, BUDGET_PERIOD),
            cookies: CookieJar::new(&mut seeds, now),
            seeds,
            steps: VecDeque::new(),
            refusals: SealRefusals::default(),
            wake_at: None,
            outputs: VecDeque::new(),
        }
    }

    /// Knows a peer by its static public key: a node of the roster. A peer that is known by another
    /// key is removed first. Costs one agreement on the curve, some 60 µs.
    ///
    /// # Errors
    /// [`PeerKeyError`]: the roster is wrong.
    pub fn add_peer(
        &mut self,
        peer: NodeId,
        public: &[u8; cipher::PUBLIC_KEY],
    ) -> Result<(), PeerKeyError> {
        if peer == self.config.node {
            return Err(PeerKeyError::Ourselves(peer));
        }
        if self.peers.get(&peer).is_some_and(|known| known.keys.public == *public) {
            return Ok(());
        }
        self.remove_peer(peer);
        let secret = self.crypto.pair_secret(public).ok_or(PeerKeyError::LowOrder(peer))?;
        let (suite, purpose) = (self.config.suite(), self.config.purpose);
        self.peers.insert(peer, SealedPeer::new(*public, secret, suite, purpose));
        Ok(())
    }

    /// Drops all keys of a peer, which is not in the roster any more.
    pub fn remove_peer(&mut self, peer: NodeId) {
        self.peers.remove(&peer);
        self.numbers.retain(|_, of| *of != peer);
        self.steps.retain(|step| step.peer() != peer);
        self.rearm();
    }

    /// Asks the peer, at this address, for a channel with new keys, until there is one. A channel
    /// that is open stays so meanwhile. Peers that are not known are not asked.
    pub fn connect(&mut self, peer: NodeId, address: A, now: Instant) {
        if let Some(known) = self.peers.get_mut(&peer) {
            known.address = Some(address);
            self.begin(peer, now);
            self.rearm();
        }
    }

    /// The peer is at this address now. Where a handshake is under way, it goes on where it began.
    pub fn set_address(&mut self, peer: NodeId, address: A) {
        if let Some(known) = self.peers.get_mut(&peer) {
            known.address = Some(address);
        }
    }

    /// How many bytes a seal adds to a frame.
    pub fn overhead(&self) -> usize {
        self.config.profile.overhead()
    }

    /// The medium carries so many bytes in a second, both ways together: an init is repeated only
    /// when an answer would be there.
    pub fn handle_rate(&mut self, bytes_per_second: u64) {
        let nanos = (EXCHANGE_BYTES * 1_000_000_000) / bytes_per_second.max(1);
        self.config.exchange_time = Duration::from_nanos(nanos);
    }

    /// Stops asking the peer for a channel. One that is open stays so.
    pub fn stop_asking(&mut self, peer: NodeId) {
        if let Some(known) = self.peers.get_mut(&peer) {
            known.attempt = None;
            self.index(peer);
            self.rearm();
        }
    }

    /// Seals a frame, given in pieces, for the peer; `None` while it has no channel.
    pub fn seal(
        &mut self,
        peer: NodeId,
        lane: FrameLane,
        pieces: &[&[u8]],
        now: Instant,
    ) -> Option<Bytes> {
        let known = self.peers.get_mut(&peer)?;
        let frame = known.channels.seal(lane, pieces, &self.config.limits);
        if frame.is_none() && known.channels.present.is_some() {
            self.drop_keys(peer, now);
            self.rearm();
        } else if known.attempt.is_none() && known.channels.is_worn(&self.config.limits) {
            self.begin(peer, now);
            self.rearm();
        }
        frame
    }

    /// Seals a frame for another node with the peer's key, of which
    /// [`KeyInUse`](SealerOutput::KeyInUse) was reported just now.
    pub fn seal_for_other(&mut self, peer: NodeId, frame: &[u8]) -> Option<Bytes> {
        let offered = self.peers.get_mut(&peer)?.channels.offered.as_mut()?;
        Some(offered.channel.seal(FrameLane::Hello, &[frame]))
    }

    /// The peer is the other node with its key, of which [`KeyInUse`](SealerOutput::KeyInUse) was
    /// reported just now; the one that it was until now is the other one.
    pub fn accept_other(&mut self, peer: NodeId, address: A, now: Instant) {
        let Some(known) = self.peers.get_mut(&peer) else { return };
        let Some(incarnation) = known.channels.exchange(now) else { return };
        let renewed = known.handle_open(incarnation, address.clone());
        self.outputs.push_back(SealerOutput::PeerOpen { peer, address, incarnation, renewed });
        self.rearm();
    }

    /// The medium has received a frame. Returns what was sealed in it, or `None` if it was the
    /// handshakes' own.
    ///
    /// # Errors
    /// [`OpenError`], which is counted, and is no fault of a peer.
    pub fn handle_frame(
        &mut self,
        frame: Bytes,
        from: &A,
        now: Instant,
    ) -> Result<Option<OpenedFrame>, OpenError> {
        let received = match frame.first() {
            Some(first) if SealHeader::begins_with(*first) => self.open(frame, from, now),
            _ => self.handle_handshake(&frame, from, now).map(|()| None),
        };
        received.inspect_err(|error| self.refusals.count(error))
    }

    fn open(
        &mut self,
        frame: Bytes,
        from: &A,
        now: Instant,
    ) -> Result<Option<OpenedFrame>, OpenError> {
        let malformed = WireError::Malformed { what: "the header of a sealed frame" };
        let header = SealHeader::decode(&frame).ok_or(malformed)?;
        let peer = *self.numbers.get(&header.channel).ok_or(OpenError::Unknown)?;
        let known = self.peers.get_mut(&peer).ok_or(OpenError::Unknown)?;
        // A frame that a transport has received into a buffer of its own is opened there.
        let mut frame = frame.try_into_mut().unwrap_or_else(|frame| BytesMut::from(&frame[..]));
        let limits = &self.config.limits;
        let (opening, incarnation) = known.channels.open(&header, &mut frame, limits, now)?;
        if let Opening::InUse(open) = opening {
            let (address, refused) = (from.clone(), incarnation);
            self.outputs.push_back(SealerOutput::KeyInUse { peer, address, open, refused });
            return Ok(None);
        }
        if opening != Opening::Continued {
            let renewed = known.handle_open(incarnation, from.clone());
            let address = from.clone();
            self.outputs.push_back(SealerOutput::PeerOpen { peer, address, incarnation, renewed });
            self.index(peer);
            self.rearm();
        }
        if frame.is_empty() {
            self.handle_confirmation(peer, from);
            return Ok(None);
        }
        let plain = frame.freeze();
        Ok(Some(OpenedFrame { peer, incarnation, lane: header.lane, plain }))
    }

    /// Whether a message of a handshake waits for a turn.
    pub fn has_handshake_step(&self) -> bool {
        !self.steps.is_empty()
    }

    /// Does the arithmetic for one message of a handshake, the one that waits longest: some 0.2 ms.
    pub fn handle_turn(&mut self, now: Instant) {
        if let Some(step) = self.steps.pop_front() {
            self.handle_step(step, now);
            self.rearm();
        }
    }

    /// The state of the peer's channel; `None` while it has none that both ends use.
    pub fn channel(&self, peer: NodeId) -> Option<ChannelStatus> {
        let present = self.peers.get(&peer)?.channels.present.as_ref()?;
        let terms = &present.terms;
        present.confirmed.then_some(ChannelStatus {
            profile: terms.profile,
            suite: terms.suite,
            since: present.since,
            incarnation: terms.peer,
        })
    }

    /// What was refused so far without proof of its sender.
    pub fn refusals(&self) -> &SealRefusals {
        &self.refusals
    }

    /// What was refused so far that only a holder of this pair's key can have sent.
    pub fn refused_of(&self, peer: NodeId) -> u64 {
        self.peers.get(&peer).map_or(0, |known| known.refused)
    }

    /// Reads the peer's numbers again, after one of its channels or handshakes came or went.
    fn index(&mut self, peer: NodeId) {
        self.numbers.retain(|_, of| *of != peer);
        if let Some(known) = self.peers.get(&peer) {
            self.numbers.extend(known.numbers().map(|number| (number, peer)));
        }
    }

    /// Notes when to wake next, so that a frame does not ask every peer.
    fn rearm(&mut self) {
        self.wake_at = self.next_due();
    }
}

impl<C: SealCrypto, A: Clone + Eq + Hash> Machine for Sealer<C, A> {
    type Output = SealerOutput<A>;

    fn poll_output(&mut self) -> Option<SealerOutput<A>> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.wake_at
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.fire_due(now);
        self.rearm();
    }
}

#[cfg(test)]
mod tests;
