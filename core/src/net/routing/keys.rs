//! What a router does with keys.
//!
//! ```text
//!  A ─────── B ─────── C       A seals for C what it sends by way of B: B passes it on,
//!    sealed by the links       and cannot read, change, repeat or invent it
//! ```
//!
//! **Advertisements** are signed by their origin and checked before they count or are passed on. A
//! node can say nothing of another's links.
//!
//! **Segments** that go over a relay are sealed for their destination, each copy by itself. One
//! that goes to a neighbour is sealed by the link alone. What arrives over a relay without a seal
//! is refused. Two nodes agree on keys as soon as one of them has a route to the other, also while
//! they are neighbours: the keys for a detour are there before the detour is needed.
//!
//! A relay sees the source, the destination and the class of a packet, and can drop it.

use super::{Router, RouterOutput};
use crate::net::seal::{
    ChannelPurpose, ChannelStatus, FrameLane, NoiseCrypto, OpenedFrame, SealProfile, SealRefusals,
    Sealer, SealerConfig, SealerOutput, is_handshake, is_seal_frame,
};
use crate::net::trust::crypto::{AdvertisementSigner, PublicKey, PublicKeys, Seed};
use crate::net::trust::roster::NodeRoster;
use crate::net::wire::advertisement::{Advertisement, SIGNATURE_LENGTH};
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::net::wire::packet::{PacketPriority, Payload};
use crate::sorted::SortedMap;
use crate::{GatherBuffer, Instant, Machine};
use bytes::Bytes;
use std::time::Duration;

/// So many signatures of one neighbour's advertisements are checked in a second; the protocol
/// repeats what is beyond. A check takes some 50 µs.
pub(super) const CHECKS_MAX: u32 = 256;
pub(super) const CHECKS_PERIOD: Duration = Duration::from_secs(1);

/// How long init and answer may take over several slow links; lost ones are repeated after three
/// times as long.
const EXCHANGE_TIME: Duration = Duration::from_millis(50);

/// The keys of a router: its own, and those of the robot's other nodes.
#[derive(Debug)]
pub struct RouterKeys {
    robot: String,
    signer: AdvertisementSigner,
    listed: SortedMap<NodeId, PublicKeys>,
    sealer: Sealer<NoiseCrypto, NodeId>,
}

/// What is known of an advertisement's signature.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SignatureCheck {
    ByOrigin,
    /// It counts for nothing; it may do so when there is another roster.
    Refused,
    /// Too many were checked. The neighbour repeats it.
    Later,
}

impl RouterKeys {
    /// The keys of the node that has this seed. The configuration is that of the seals of paths;
    /// the random bytes are the system's, and used once.
    pub fn new(
        seed: &Seed,
        roster: &NodeRoster,
        config: SealerConfig,
        random: [u8; 32],
        now: Instant,
    ) -> Self {
        let (own, profile) = (config.node, SealProfile::Full);
        let (purpose, exchange_time) = (ChannelPurpose::Path, EXCHANGE_TIME);
        let config = SealerConfig { purpose, profile, exchange_time, ..config };
        let robot = config.robot.clone();
        let sealer = Sealer::new(config, seed.handshakes(), random, now);
        let signer = seed.advertisement_signer();
        let listed = listed(roster, own);
        RouterKeys { robot, signer, listed, sealer }
    }

    /// The bytes that a seal takes of a segment.
    pub(super) fn overhead(&self) -> usize {
        self.sealer.overhead()
    }

    /// What a signature covers.
    fn message(&self, advertisement: &Advertisement) -> Vec<u8> {
        let (robot, part) = (self.robot.as_bytes(), advertisement.signed_part());
        [b"blastema advertisement 1\0", robot, b"\0", &part].concat()
    }

    pub(super) fn sign(&self, advertisement: &Advertisement) -> [u8; SIGNATURE_LENGTH] {
        self.signer.sign(&self.message(advertisement))
    }

    /// The signature, and the key that checks it; `None` for one without a signature, and for an
    /// origin that is not in the roster.
    fn signed(
        &self,
        own: NodeId,
        advertisement: &Advertisement,
    ) -> Option<([u8; SIGNATURE_LENGTH], PublicKey)> {
        let origin = advertisement.id.origin;
        let key = match origin == own {
            true => self.signer.public_key(),
            false => self.listed.get(&origin)?.ed25519,
        };
        Some((advertisement.signature?, key))
    }

    /// Knows the peer's key, if it is listed.
    fn know(&mut self, peer: NodeId) -> bool {
        let Some(keys) = self.listed.get(&peer) else { return false };
        self.sealer.add_peer(peer, keys.x25519.bytes()).is_ok()
    }

    /// When a handshake goes on. Each of its messages costs some 0.2 ms and has a turn of its own.
    pub(super) fn due(&self) -> Option<Instant> {
        match self.sealer.has_handshake_step() {
            true => Some(Instant::ORIGIN),
            false => self.sealer.poll_timeout(),
        }
    }
}

fn listed(roster: &NodeRoster, own: NodeId) -> SortedMap<NodeId, PublicKeys> {
    let nodes = roster.nodes().iter().map(|node| (NodeId::of(&node.name), node.keys));
    nodes.filter(|(node, _)| *node != own).collect()
}

impl Router {
    /// The same router with keys: it counts what its peers have signed and sealed, and nothing
    /// else.
    pub fn with_keys(mut self, keys: RouterKeys) -> Router {
        self.keys = Some(keys);
        self.sign();
        self
    }

    /// What was refused of the seals of paths; `None` without keys.
    pub fn seal_refusals(&self) -> Option<&SealRefusals> {
        self.keys.as_ref().map(|keys| keys.sealer.refusals())
    }

    /// The keys for what goes to this node over relays, while both have agreed on them.
    pub fn channel(&self, node: NodeId) -> Option<ChannelStatus> {
        self.keys.as_ref()?.sealer.channel(node)
    }

    /// There is a newer roster. What a node has said is forgotten that is not in it any more, or
    /// has another key; its channel is closed.
    pub fn handle_roster(&mut self, roster: &NodeRoster, now: Instant) {
        self.now = now;
        let Some(keys) = &mut self.keys else { return };
        let before = std::mem::replace(&mut keys.listed, listed(roster, self.database.id()));
        for (node, had) in before {
            if keys.listed.get(&node) == Some(&had) {
                continue;
            }
            keys.sealer.remove_peer(node);
            self.database.known.remove(&node);
        }
        for node in self.table.routes.keys().copied() {
            if keys.know(node) && keys.sealer.channel(node).is_none() {
                keys.sealer.connect(node, node, now);
            }
        }
        self.outdate();
        self.collect_seals();
    }

    /// Signs this node's own advertisement.
    pub(super) fn sign(&mut self) {
        self.database.own.signature = self.keys.as_ref().map(|keys| keys.sign(&self.database.own));
    }

    /// Whether an advertisement is its origin's; without keys nothing says that it is not.
    pub(super) fn check_signature(
        &mut self,
        advertisement: &Advertisement,
        from: LinkId,
    ) -> SignatureCheck {
        if advertisement.signature.is_some() != self.keys.is_some() {
            self.tell_of_keys(advertisement.id.origin, from);
            self.refusals.forged += 1;
            return SignatureCheck::Refused;
        }
        let Some(keys) = &self.keys else { return SignatureCheck::ByOrigin };
        let Some((signature, key)) = keys.signed(self.database.id(), advertisement) else {
            self.refusals.unexpected += 1;
            return SignatureCheck::Refused;
        };
        let message = keys.message(advertisement);
        if !self.links.get_mut(&from).is_some_and(|adjacent| adjacent.checks.add((), self.now)) {
            return SignatureCheck::Later;
        }
        if key.has_signed(&message, &signature) {
            return SignatureCheck::ByOrigin;
        }
        self.refusals.forged += 1;
        SignatureCheck::Refused
    }

    /// Tells once for each link that one end of it has keys and the other has not.
    fn tell_of_keys(&mut self, origin: NodeId, from: LinkId) {
        let Some(adjacent) = self.links.get_mut(&from).filter(|link| link.id == origin) else {
            return;
        };
        if !std::mem::replace(&mut adjacent.keys_differ, true) {
            let neighbour = adjacent.neighbour.node.clone();
            self.outputs.push_back(RouterOutput::KeysDiffer { neighbour });
        }
    }

    /// Asks a node for keys to which there is a route now.
    pub(super) fn ask_for_keys(&mut self, node: NodeId) {
        let (now, route) = (self.now, self.table.routes.get(&node));
        let (Some(keys), Some(route)) = (&mut self.keys, route) else { return };
        let agreed = keys.sealer.channel(node).map(|channel| channel.incarnation);
        if agreed != Some(route.incarnation) && keys.know(node) {
            keys.sealer.connect(node, node, now);
        }
    }

    /// No route leads to a node any more. Its keys are kept.
    pub(super) fn stop_asking_for_keys(&mut self, node: NodeId) {
        if let Some(keys) = &mut self.keys {
            keys.sealer.stop_asking(node);
        }
    }

    /// Seals what goes over a relay; `None` while there are no keys for it.
    pub(super) fn protect(
        &mut self,
        destination: NodeId,
        next: LinkId,
        class: PacketPriority,
        segment: GatherBuffer,
    ) -> Option<GatherBuffer> {
        let is_direct = self.leads_to(next, destination);
        let Some(keys) = self.keys.as_mut().filter(|_| !is_direct) else { return Some(segment) };
        let lane = match class {
            PacketPriority::Control => FrameLane::Urgent,
            PacketPriority::Data => FrameLane::Usual,
        };
        let sealed = keys.sealer.seal(destination, lane, &segment.pieces(), self.now);
        self.collect_seals();
        sealed.map(GatherBuffer::from)
    }

    fn leads_to(&self, link: LinkId, node: NodeId) -> bool {
        self.links.get(&link).is_some_and(|link| link.id == node)
    }

    /// A segment for this node came over a link.
    pub(super) fn take_segment(&mut self, link: LinkId, source: NodeId, segment: Bytes) {
        let (now, is_direct) = (self.now, self.leads_to(link, source));
        let Some(keys) = &mut self.keys else {
            let output = RouterOutput::Segment { source, segment, authentic: is_direct };
            return self.outputs.push_back(output);
        };
        if is_seal_frame(&segment) {
            if is_handshake(&segment) {
                keys.know(source);
            }
            // What is not opened is counted by the sealer.
            let opened = keys.sealer.handle_frame(segment, &source, now);
            self.collect_seals();
            let Ok(Some(OpenedFrame { peer, plain, .. })) = opened else { return };
            if self.isolation.nodes.contains(&peer) {
                self.refusals.isolated += 1;
                return;
            }
            let output = RouterOutput::Segment { source: peer, segment: plain, authentic: true };
            self.outputs.push_back(output);
        } else if is_direct {
            self.outputs.push_back(RouterOutput::Segment { source, segment, authentic: true });
        } else if self.links.contains_key(&link) {
            self.refusals.forged += 1;
        } else {
            // The neighbour knows of the link a moment earlier.
            self.refusals.unexpected += 1;
        }
    }

    pub(super) fn handle_handshakes(&mut self) {
        let now = self.now;
        if let Some(keys) = &mut self.keys {
            keys.sealer.handle_turn(now);
            if keys.sealer.poll_timeout().is_some_and(|due| due <= now) {
                keys.sealer.handle_timeout(now);
            }
        }
        self.collect_seals();
    }

    /// Does what the sealer of paths wants done.
    pub(super) fn collect_seals(&mut self) {
        while let Some(output) = self.keys.as_mut().and_then(|keys| keys.sealer.poll_output()) {
            match output {
                SealerOutput::Transmit { to, frame } => {
                    if let Some(link) = self.choose(to, &[]) {
                        let payload = Payload::Segment(frame.into());
                        self.originate(link, to, PacketPriority::Control, payload);
                    }
                }
                // What was sent before had no seal, and was not sent.
                SealerOutput::PeerOpen { peer, renewed: false, .. } => {
                    if let Some(route) = self.table.routes.get(&peer)
                        && !route.chosen.is_some_and(|link| self.leads_to(link, peer))
                    {
                        let mtu = route.segment_limit();
                        self.outputs.push_back(RouterOutput::PathChanged { node: peer, mtu });
                    }
                }
                // The peer's neighbours tell of another node with its key.
                SealerOutput::PeerOpen { .. }
                | SealerOutput::KeyInUse { .. }
                | SealerOutput::KeyWornOut { .. } => {}
            }
        }
        if let Some(due) = self.keys.as_ref().and_then(RouterKeys::due) {
            self.wake_at = self.wake_at.min(due);
        }
    }
}
