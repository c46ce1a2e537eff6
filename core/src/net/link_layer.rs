//! The links of one network, with the address of each neighbour and, where nodes have keys, its
//! seals.
//!
//! ```text
//!  router ──packets, routing──► LinkSet ──frames──► Sealer ──sealed frames──► transport
//!         ◄────────────────────         ◄─────────        ◄─────────────────
//! ```
//!
//! **Without keys** a frame belongs to the link that leads to the address which it came from.
//!
//! **With keys** every frame is sealed for the neighbour, hellos included, and a frame belongs to
//! the link whose neighbour has sealed it: an address proves nothing. What no node of this robot
//! has sealed is counted in [`SealRefusals`] and reaches no link. A neighbour that shakes hands in
//! another incarnation has restarted; its link goes down at once.
//!
//! Nodes may *dial in*, as into a PPP server, if their keys are given: a link is made for one when
//! its handshake is complete ([`LinkLayerOutput::DialedIn`]), to wherever it comes from.
//!
//! A connection of a stream medium whose other end is not known yet has an address of its own. The
//! first frame on it that a neighbour has sealed makes it the neighbour's
//! ([`LinkLayerOutput::Adopt`]).

use super::link::Link;
use super::link::link_set::{LinkSet, LinkSetOutput};
use super::link::{LinkOutput, LinkState};
use super::link_traffic::LinkTraffic;
use super::seal::cipher::PUBLIC_KEY;
use super::seal::{
    ChannelStatus, FrameLane, OpenedFrame, PeerKeyError, SealCrypto, SealRefusals, Sealer,
    SealerOutput,
};
use super::wire::Refusals;
use super::wire::frame::{Frame, NameHolder, is_hello, is_urgent};
use super::wire::link_id::LinkId;
use super::wire::node_id::NodeId;
use crate::sorted::SortedMap;
use crate::{GatherBuffer, Incarnation, Instant, Machine};
use bytes::Bytes;
use std::collections::VecDeque;
use std::fmt;
use std::hash::Hash;
use std::time::Duration;

/// An address of a medium.
pub trait LinkAddress: Clone + Ord + Hash + fmt::Display {
    /// Whether it is that of a connection whose other end has made it, and has not proved who it
    /// is.
    fn is_connection(&self) -> bool;
    /// The address that the other end of a connection claims; else this one.
    fn peer(&self) -> &Self {
        self
    }
}

/// A neighbour's key, by which its frames are opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NeighbourKey {
    /// The neighbour's node id.
    pub node: NodeId,
    /// Its static public key.
    pub public: [u8; PUBLIC_KEY],
}

/// Why a link cannot be added.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AddLinkError {
    /// The network is sealed, and there is no key of the neighbour.
    #[error("the network is sealed, and the neighbour has no key")]
    NoKey,
    /// Another link of this network leads to the same node.
    #[error("another link of this network leads to the same node")]
    PeerTwice,
    /// The key is none.
    #[error(transparent)]
    Key(#[from] PeerKeyError),
}

/// What the links of a network want done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkLayerOutput<A> {
    /// What a link wants done; it is never to transmit.
    Of(LinkId, LinkOutput),
    /// Give this frame to the transport.
    Transmit {
        /// The address of the receiver.
        to: A,
        /// The frame, as the medium carries it.
        frame: GatherBuffer,
        /// What it may overtake.
        lane: FrameLane,
    },
    /// This connection is the neighbour's at this address: it has sealed a frame there.
    Adopt {
        /// The connection's own address.
        connection: A,
        /// The address of the neighbour.
        peer: A,
    },
    /// A node that may dial in has proved itself, and no link leads to it: make one
    /// ([`LinkLayer::insert_dialed_in`]). This is repeated with each of its frames.
    DialedIn {
        /// The node that has proved itself.
        peer: NodeId,
        /// Where it comes from.
        address: A,
    },
    /// The first frame of an address that no link leads to.
    Stranger(A),
    /// This node was not run for so long: a timer fired so late.
    Stalled(Duration),
    /// A node with the neighbour's key is there in another incarnation, and the neighbour has
    /// answered a hello that was sent after that one came. The other one is told so, each time.
    KeyInUse {
        /// The neighbour's link.
        link: LinkId,
        /// The incarnation that has answered.
        open: Incarnation,
        /// The other one, which is refused.
        refused: Incarnation,
        /// Where the one that has answered is.
        at: A,
        /// Where the other one is.
        address: A,
    },
}

/// Where a link leads.
#[derive(Clone, Debug)]
struct LinkEnd<A> {
    address: A,
    /// The neighbour, where frames are sealed for it.
    peer: Option<NodeId>,
    /// The address of the connection that was adopted last. What came over it before still bears
    /// that address.
    adopted: Option<A>,
    /// The neighbour has come by itself: it is where it proves itself.
    dialed_in: bool,
    traffic: LinkTraffic,
}

/// The machine of all links of one network. `A` are the medium's addresses.
#[derive(Debug)]
pub struct LinkLayer<C: SealCrypto, A> {
    links: LinkSet,
    sealer: Option<Sealer<C, A>>,
    ends: SortedMap<LinkId, LinkEnd<A>>,
    by_address: SortedMap<A, LinkId>,
    by_peer: SortedMap<NodeId, LinkId>,
    /// The keys of nodes that may come without a link.
    may_dial_in: SortedMap<NodeId, [u8; PUBLIC_KEY]>,
    /// The last other node with a neighbour's key, and since when it is there.
    others: SortedMap<LinkId, (Incarnation, Instant)>,
    /// What came from addresses that no link leads to.
    strangers: Refusals,
    outputs: VecDeque<LinkLayerOutput<A>>,
}

impl<C: SealCrypto, A: LinkAddress> LinkLayer<C, A> {
    /// No links yet. With a sealer, all frames are sealed.
    pub fn new(sealer: Option<Sealer<C, A>>) -> Self {
        let overhead = sealer.as_ref().map_or(0, Sealer::overhead);
        LinkLayer {
            links: LinkSet::with_overhead(overhead),
            sealer,
            ends: SortedMap::new(),
            by_address: SortedMap::new(),
            by_peer: SortedMap::new(),
            may_dial_in: SortedMap::new(),
            others: SortedMap::new(),
            strangers: Refusals::default(),
            outputs: VecDeque::new(),
        }
    }

    /// Adds a link to the neighbour at this address; where frames are sealed, with its key.
    ///
    /// # Errors
    /// [`AddLinkError`]; nothing was added.
    pub fn insert(
        &mut self,
        number: LinkId,
        link: Link,
        address: A,
        key: Option<NeighbourKey>,
        now: Instant,
    ) -> Result<(), AddLinkError> {
        let mut peer = None;
        if let Some(sealer) = &mut self.sealer {
            let NeighbourKey { node, public } = key.ok_or(AddLinkError::NoKey)?;
            if self.by_peer.contains_key(&node) {
                return Err(AddLinkError::PeerTwice);
            }
            sealer.add_peer(node, &public)?;
            sealer.connect(node, address.clone(), now);
            self.by_peer.insert(node, number);
            peer = Some(node);
        }
        self.add(number, link, address, peer, false);
        self.collect(now);
        Ok(())
    }

    /// Adds a link to a node that has [dialed in](LinkLayerOutput::DialedIn), and returns whether
    /// it could: another one leads to the node or the address meanwhile, its keys are gone, or the
    /// medium has connections, which belong to links that are known.
    pub fn insert_dialed_in(
        &mut self,
        number: LinkId,
        mut link: Link,
        peer: NodeId,
        address: A,
        now: Instant,
    ) -> bool {
        let channel = self.sealer.as_ref().and_then(|sealer| sealer.channel(peer));
        let is_known = self.by_peer.contains_key(&peer) || self.by_address.contains_key(&address);
        let Some(channel) = channel.filter(|_| !is_known && !address.is_connection()) else {
            return false;
        };
        link.handle_authenticated(channel.incarnation, now);
        self.by_peer.insert(peer, number);
        self.add(number, link, address, Some(peer), true);
        self.collect(now);
        true
    }

    fn add(
        &mut self,
        number: LinkId,
        link: Link,
        address: A,
        peer: Option<NodeId>,
        dialed_in: bool,
    ) {
        self.by_address.insert(address.clone(), number);
        let (adopted, traffic) = (None, LinkTraffic::default());
        self.ends.insert(number, LinkEnd { address, peer, adopted, dialed_in, traffic });
        self.links.insert(number, link);
    }

    /// These nodes may dial in from now on, and no others. A link that was made for one stays.
    ///
    /// # Errors
    /// [`PeerKeyError`]: the key of one is none; those before it may.
    pub fn set_dial_in(
        &mut self,
        nodes: impl IntoIterator<Item = NeighbourKey>,
    ) -> Result<(), PeerKeyError> {
        let before = std::mem::take(&mut self.may_dial_in);
        let nodes: SortedMap<_, _> =
            nodes.into_iter().map(|NeighbourKey { node, public }| (node, public)).collect();
        let Some(sealer) = &mut self.sealer else { return Ok(()) };
        for (node, _) in before {
            if !nodes.contains_key(&node) && !self.by_peer.contains_key(&node) {
                sealer.remove_peer(node);
            }
        }
        for (node, public) in nodes {
            if !self.by_peer.contains_key(&node) {
                sealer.add_peer(node, &public)?;
            }
            self.may_dial_in.insert(node, public);
        }
        Ok(())
    }

    /// Takes a link out, and forgets its keys, unless its neighbour may dial in.
    pub fn remove(&mut self, number: LinkId) {
        self.links.remove(number);
        self.others.remove(&number);
        let Some(LinkEnd { address, peer, .. }) = self.ends.remove(&number) else { return };
        self.by_address.remove(&address);
        if let (Some(sealer), Some(peer)) = (&mut self.sealer, peer) {
            self.by_peer.remove(&peer);
            match self.may_dial_in.contains_key(&peer) {
                // It need not shake hands again when it comes.
                true => sealer.stop_asking(peer),
                false => sealer.remove_peer(peer),
            }
        }
    }

    /// The roster has changed: the neighbour of a link has this key now, or none any more. Keys
    /// that were agreed on by another one are dropped at once, and the link goes down.
    ///
    /// # Errors
    /// [`PeerKeyError`]: the key is none, and the neighbour has no other.
    pub fn set_key(
        &mut self,
        number: LinkId,
        key: Option<[u8; PUBLIC_KEY]>,
        now: Instant,
    ) -> Result<(), PeerKeyError> {
        let end = self.ends.get(&number).and_then(|end| Some((end.address.clone(), end.peer?)));
        let (Some(sealer), Some((address, peer))) = (&mut self.sealer, end) else { return Ok(()) };
        let was_open = sealer.channel(peer).is_some();
        let added = match key {
            Some(public) => sealer.add_peer(peer, &public),
            None => {
                sealer.remove_peer(peer);
                Ok(())
            }
        };
        if sealer.channel(peer).is_none() {
            if was_open && let Some(link) = self.links.get_mut(number) {
                let reason = match key {
                    Some(_) => {
                        "the roster has another key for the neighbour: start it with its new key file"
                    }
                    None => "the neighbour is not in the roster any more: it was revoked",
                };
                link.handle_no_carrier(reason, now);
            }
            if key.is_some() {
                sealer.connect(peer, address, now);
            }
        }
        self.collect(now);
        added
    }

    /// Returns the link of this number.
    pub fn get(&self, number: LinkId) -> Option<&Link> {
        self.links.get(number)
    }

    /// All links, in the order of their numbers.
    pub fn iter(&self) -> impl Iterator<Item = (LinkId, &Link)> {
        self.links.iter()
    }

    /// The link that leads to this address.
    pub fn link_at(&self, address: &A) -> Option<LinkId> {
        self.by_address.get(address).copied()
    }

    /// Whether frames are sealed.
    pub fn is_sealed(&self) -> bool {
        self.sealer.is_some()
    }

    /// How many bytes of a frame the seal takes.
    pub fn overhead(&self) -> usize {
        self.sealer.as_ref().map_or(0, Sealer::overhead)
    }

    /// The keys of a link, while its neighbour has agreed on them.
    pub fn channel(&self, number: LinkId) -> Option<ChannelStatus> {
        self.sealer.as_ref()?.channel(self.ends.get(&number)?.peer?)
    }

    /// What was refused of a link's neighbour: only it can have sent it.
    pub fn refused_of(&self, number: LinkId) -> Refusals {
        let link = self.links.get(number).map(Link::refusals).unwrap_or_default();
        let peer = self.ends.get(&number).and_then(|end| end.peer);
        let handshakes =
            self.sealer.as_ref().zip(peer).map_or(0, |(sealer, peer)| sealer.refused_of(peer));
        Refusals { unexpected: link.unexpected + handshakes, ..link }
    }

    /// What a link has carried since it was added.
    pub fn traffic(&self, number: LinkId) -> LinkTraffic {
        let carried = self.ends.get(&number).map(|end| end.traffic).unwrap_or_default();
        let not_up = self.links.get(number).map_or(0, Link::frames_dropped);
        LinkTraffic { frames_dropped: carried.frames_dropped + not_up, ..carried }
    }

    /// What was refused that came from addresses which no link leads to; nothing where frames are
    /// sealed.
    pub fn strangers(&self) -> Refusals {
        self.strangers
    }

    /// What was refused without proof of its sender; `None` where frames are not sealed.
    pub fn seal_refusals(&self) -> Option<&SealRefusals> {
        self.sealer.as_ref().map(Sealer::refusals)
    }

    /// Gives one link an input.
    pub fn with_link<T>(
        &mut self,
        number: LinkId,
        now: Instant,
        input: impl FnOnce(&mut Link) -> T,
    ) -> Option<T> {
        let result = self.links.get_mut(number).map(input);
        self.collect(now);
        result
    }

    /// The medium has received a frame from this address.
    pub fn handle_frame(&mut self, from: A, frame: Bytes, now: Instant) {
        let bytes = frame.len() as u64;
        let opened = match &mut self.sealer {
            Some(sealer) => match sealer.handle_frame(frame, &from, now) {
                Ok(Some(OpenedFrame { peer, plain, .. })) => {
                    let link = self.by_peer.get(&peer).copied();
                    if link.is_none() && self.may_dial_in.contains_key(&peer) {
                        let address = from.clone();
                        self.outputs.push_back(LinkLayerOutput::DialedIn { peer, address });
                        None
                    } else {
                        Some((link, plain))
                    }
                }
                // The sealer's own, or counted by it.
                Ok(None) | Err(_) => None,
            },
            None => Some((self.by_address.get(&from).copied(), frame)),
        };
        // What a frame proves counts before what it says.
        self.collect(now);
        let Some((link, frame)) = opened else { return };
        if let Some(end) = link.and_then(|link| self.ends.get_mut(&link)) {
            end.traffic.frames_received += 1;
            end.traffic.bytes_received += bytes;
        }
        match link.and_then(|link| self.links.get_mut(link)) {
            Some(link) => link.handle_frame(frame, now),
            None => {
                if self.strangers.total() == 0 {
                    self.outputs.push_back(LinkLayerOutput::Stranger(from));
                }
                self.strangers.unexpected += 1;
            }
        }
        self.collect(now);
    }

    /// The medium's largest frame has so many bytes. Where paths may drop it, each link finds by
    /// probes what passes.
    pub fn handle_mtu(&mut self, mtu: usize, is_probed: bool) {
        self.links.handle_mtu(mtu.saturating_sub(self.overhead()), is_probed);
    }

    /// The medium carries so many bytes in a second.
    pub fn handle_rate(&mut self, bytes_per_second: u64) {
        if let Some(sealer) = &mut self.sealer {
            sealer.handle_rate(bytes_per_second);
        }
        self.links.handle_rate(bytes_per_second);
    }

    /// Takes what links and sealer want done: the links' frames are sealed here.
    fn collect(&mut self, now: Instant) {
        loop {
            self.collect_sealer(now);
            let Some(output) = self.links.poll_output() else { break };
            match output {
                LinkSetOutput::Of(link, LinkOutput::Transmit(frame)) => {
                    self.transmit(link, frame, now);
                }
                LinkSetOutput::Of(link, output) => {
                    self.reopen(link, &output, now);
                    self.outputs.push_back(LinkLayerOutput::Of(link, output));
                }
                LinkSetOutput::Stalled(gap) => {
                    self.outputs.push_back(LinkLayerOutput::Stalled(gap));
                }
            }
        }
    }

    fn transmit(&mut self, link: LinkId, frame: GatherBuffer, now: Instant) {
        let Some(end) = self.ends.get_mut(&link) else { return };
        let lane = match &frame {
            frame if is_hello(frame) => FrameLane::Hello,
            frame if is_urgent(frame) => FrameLane::Urgent,
            _ => FrameLane::Usual,
        };
        let frame = match &mut self.sealer {
            None => frame,
            Some(sealer) => {
                // Before the handshake no neighbour opens it; nothing goes out unsealed.
                let sealed =
                    end.peer.and_then(|peer| sealer.seal(peer, lane, &frame.pieces(), now));
                let Some(sealed) = sealed else {
                    // Hellos to a neighbour that is not there are no loss.
                    end.traffic.frames_dropped += u64::from(lane != FrameLane::Hello);
                    return;
                };
                sealed.into()
            }
        };
        end.traffic.frames_sent += 1;
        end.traffic.bytes_sent += frame.len() as u64;
        let to = end.address.clone();
        self.outputs.push_back(LinkLayerOutput::Transmit { to, frame, lane });
    }

    /// A neighbour that is not heard is asked for new keys. If it has stopped for a while, and
    /// another process with its key has its place, that one answers.
    fn reopen(&mut self, link: LinkId, output: &LinkOutput, now: Instant) {
        let (Some(sealer), Some(end)) = (&mut self.sealer, self.ends.get(&link)) else { return };
        let Some(peer) = end.peer else { return };
        let open = sealer.channel(peer).map(|channel| channel.incarnation);
        let is_silent = match output {
            LinkOutput::Missing { .. } => true,
            // Where it has restarted, the keys of its new incarnation are open already.
            LinkOutput::Changed { state: LinkState::Down, neighbour, .. } => {
                open.is_some() && neighbour.as_ref().map(|known| known.incarnation) == open
            }
            _ => false,
        };
        if is_silent {
            sealer.connect(peer, end.address.clone(), now);
        }
    }

    fn collect_sealer(&mut self, now: Instant) {
        while let Some(output) = self.sealer.as_mut().and_then(Machine::poll_output) {
            match output {
                SealerOutput::Transmit { to, frame } => {
                    let adopted = |end: &&LinkEnd<A>| end.adopted.as_ref() == Some(&to);
                    let end = self.ends.values().find(adopted);
                    let to = end.map_or_else(|| to.clone(), |end| end.address.clone());
                    let (frame, lane) = (frame.into(), FrameLane::Hello);
                    self.outputs.push_back(LinkLayerOutput::Transmit { to, frame, lane });
                }
                SealerOutput::PeerOpen { peer, address, incarnation, .. } => {
                    let Some(link) = self.by_peer.get(&peer).copied() else {
                        if self.may_dial_in.contains_key(&peer) {
                            self.outputs.push_back(LinkLayerOutput::DialedIn { peer, address });
                        }
                        continue;
                    };
                    self.follow_dialed_in(link, &address);
                    self.adopt(link, peer, address);
                    if let Some(link) = self.links.get_mut(link) {
                        link.handle_authenticated(incarnation, now);
                    }
                }
                SealerOutput::KeyInUse { peer, address, open, refused } => {
                    self.refuse_other(peer, address, open, refused, now);
                }
                SealerOutput::KeyWornOut { peer } => {
                    let Some(link) = self.by_peer.get(&peer).copied() else { continue };
                    if let Some(link) = self.links.get_mut(link) {
                        link.handle_no_carrier("no new keys could be agreed on in two hours", now);
                    }
                }
            }
        }
    }

    /// Another node with a neighbour's key is there. It waits until the neighbour has answered a
    /// hello, and is told so then; only the neighbour reads hellos, so the answer is no earlier
    /// one. If no answer comes within the detection time, the other node is the neighbour.
    fn refuse_other(
        &mut self,
        peer: NodeId,
        address: A,
        open: Incarnation,
        refused: Incarnation,
        now: Instant,
    ) {
        let Some(link) = self.by_peer.get(&peer).copied() else { return };
        let before = self.others.get(&link).filter(|(other, _)| *other == refused);
        let since = before.map_or(now, |(_, since)| *since);
        self.others.insert(link, (refused, since));
        let (Some(machine), Some(end)) = (self.links.get(link), self.ends.get(&link)) else {
            return;
        };
        let Some(sealer) = &mut self.sealer else { return };
        if !machine.has_answered(since) {
            if now >= since + machine.answer_within() {
                sealer.accept_other(peer, address, now);
            }
            return;
        }
        // Over a connection it may have come from another place than where the link leads.
        let at = end.adopted.as_ref().unwrap_or(&end.address).clone();
        let taken = Frame::Taken { refused, by: NameHolder::new(open, at.peer()) }.encode();
        if let Some(sealed) = sealer.seal_for_other(peer, &taken) {
            let (to, frame, lane) = (address.clone(), sealed.into(), FrameLane::Hello);
            self.outputs.push_back(LinkLayerOutput::Transmit { to, frame, lane });
        }
        self.outputs.push_back(LinkLayerOutput::KeyInUse { link, open, refused, at, address });
    }

    /// A node that has dialed in is where it comes from, which may be another place than before. No
    /// user has said where it is.
    fn follow_dialed_in(&mut self, link: LinkId, from: &A) {
        let is_free = !self.by_address.contains_key(from) && !from.is_connection();
        let Some(end) = self.ends.get_mut(&link).filter(|end| end.dialed_in && is_free) else {
            return;
        };
        let before = std::mem::replace(&mut end.address, from.clone());
        self.by_address.remove(&before);
        self.by_address.insert(from.clone(), link);
    }

    /// The neighbour has proved itself at this address. Where that is a connection's, the
    /// connection is the neighbour's from here on. Both ends use the same one: the initiator
    /// receives the responder's first frame on the connection that the responder has adopted. Any
    /// other address proves nothing: it may be forged, and frames go where the user has said.
    fn adopt(&mut self, link: LinkId, peer: NodeId, from: A) {
        let Some(end) = self.ends.get_mut(&link) else { return };
        if end.adopted.as_ref() == Some(&from) {
            return;
        }
        let address = end.address.clone();
        if let Some(sealer) = &mut self.sealer {
            sealer.set_address(peer, address.clone());
        }
        end.adopted = from.is_connection().then_some(from);
        if let Some(connection) = end.adopted.clone() {
            self.outputs.push_back(LinkLayerOutput::Adopt { connection, peer: address });
        }
    }
}

impl<C: SealCrypto, A: LinkAddress> Machine for LinkLayer<C, A> {
    type Output = LinkLayerOutput<A>;

    fn poll_output(&mut self) -> Option<LinkLayerOutput<A>> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let sealer = self.sealer.as_ref().and_then(|sealer| {
            // One message of a handshake costs some 0.2 ms: each has a turn of its own.
            if sealer.has_handshake_step() { Some(Instant::ORIGIN) } else { sealer.poll_timeout() }
        });
        [self.links.poll_timeout(), sealer].into_iter().flatten().min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        let due = |at: Option<Instant>| at.is_some_and(|at| at <= now);
        if due(self.links.poll_timeout()) {
            self.links.handle_timeout(now);
        }
        if let Some(sealer) = &mut self.sealer {
            sealer.handle_turn(now);
            if due(sealer.poll_timeout()) {
                sealer.handle_timeout(now);
            }
        }
        self.collect(now);
    }
}

#[cfg(test)]
mod tests;
