//! The course of a handshake, on both sides.

use super::channel::{Channel, ChannelTerms, OfferedChannel, OpenError};
use super::cipher::{ChannelKeys, CipherSuite, HandshakeTerms, SealCrypto};
use super::handshake_frame::{
    AnswerFrame, CookieFrame, HandshakeFrame, InitFrame, decode_payload, encode_payload, mac2,
};
use super::noise::MacKey;
use super::sealed_peer::{Approach, SealedPeer};
use super::{Sealer, SealerOutput};
use crate::medium::lane::FrameLane;
use crate::net::wire::node_id::NodeId;
use crate::{Incarnation, Instant};
use bytes::Bytes;
use std::hash::Hash;
use std::time::Duration;

/// Handshakes that this node has begun, or has answered, and that are not complete. Beyond that the
/// oldest is given up; its initiator asks again.
pub(super) const ASKING_MAX: usize = 16;
pub(super) const OFFERS_MAX: usize = 16;
/// Messages that wait for their turn: a turn takes 0.2 ms, and an init is repeated after 50 ms.
const STEPS_MAX: usize = 32;
/// A knock is answered by an init once in this time.
const KNOCK_INTERVAL: Duration = Duration::from_millis(500);
/// An init with a cookie is taken once in this time, whatever the budget says.
const PROVEN_INTERVAL: Duration = Duration::from_millis(100);

/// One message's worth of arithmetic that waits for its turn.
#[derive(Debug)]
pub(super) enum HandshakeStep<A> {
    Begin(NodeId),
    Init(InitFrame, A),
    Answer(NodeId, AnswerFrame, A),
}

impl<A> HandshakeStep<A> {
    pub(super) fn peer(&self) -> NodeId {
        match self {
            HandshakeStep::Begin(peer) | HandshakeStep::Answer(peer, ..) => *peer,
            HandshakeStep::Init(init, _) => init.from,
        }
    }
}

impl<C: SealCrypto, A: Clone + Eq + Hash> Sealer<C, A> {
    /// Whether handshakes with this peer are begun here.
    pub(super) fn is_initiator(&self, peer: NodeId) -> bool {
        self.config.node < peer
    }

    /// Asks for a channel with new keys, from the first attempt on.
    pub(super) fn begin(&mut self, node: NodeId, now: Instant) {
        let initiator = self.is_initiator(node);
        let Some(peer) = self.peers.get_mut(&node) else { return };
        peer.restart(if initiator { Approach::Waiting } else { Approach::Knocking }, now);
        self.index(node);
        if initiator {
            self.push_begin(node);
        } else {
            self.knock(node, now);
        }
        self.schedule(node, now);
    }

    /// Begins with an init once more, as soon as it has a turn.
    fn wait_for_turn(&mut self, node: NodeId) {
        if let Some(peer) = self.peers.get_mut(&node) {
            peer.go_on(Approach::Waiting);
        }
        self.index(node);
        self.push_begin(node);
    }

    fn push_begin(&mut self, node: NodeId) {
        let waits = |step: &HandshakeStep<A>| matches!(step, HandshakeStep::Begin(n) if *n == node);
        // One for each peer at most.
        if !self.steps.iter().any(waits) {
            self.steps.push_back(HandshakeStep::Begin(node));
        }
    }

    /// Sets when to try again.
    fn schedule(&mut self, node: NodeId, now: Instant) {
        let jitter = u64::from_be_bytes(*self.seeds.next_seed().first_chunk().expect("32 bytes"));
        let peer = self.peers.get_mut(&node);
        let Some(attempt) = peer.and_then(|peer| peer.attempt.as_mut()) else { return };
        attempt.count = attempt.count.saturating_add(1);
        attempt.retransmit_at = now + self.config.backoff().delay(attempt.count, jitter);
    }

    fn transmit(&mut self, to: A, frame: Bytes) {
        self.outputs.push_back(SealerOutput::Transmit { to, frame });
    }

    /// The time for another attempt has come.
    pub(super) fn retransmit(&mut self, node: NodeId, now: Instant) {
        let first = self.config.backoff().first;
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let Some(approach) = peer.approach() else { return };
        match approach {
            Approach::Knocking => self.knock(node, now),
            Approach::Asking { since, init, to, .. } if now - *since < first * 10 => {
                // Another address was not given to this node: a knock named it, which may be a
                // replay, and gets one init. The peer knocks again.
                if peer.address.as_ref() == Some(to) {
                    let frame = peer.keys.encoded(&HandshakeFrame::Init(*init), now);
                    let to = to.clone();
                    self.transmit(to, frame);
                }
            }
            Approach::Confirming { to, since } if now - *since < first * 20 => {
                let to = to.clone();
                self.confirm(node, to);
            }
            Approach::Waiting | Approach::Asking { .. } | Approach::Confirming { .. } => {
                self.wait_for_turn(node);
            }
        }
        self.schedule(node, now);
    }

    fn knock(&mut self, node: NodeId, now: Instant) {
        let nonce = u64::from_be_bytes(*self.seeds.next_seed().first_chunk().expect("32 bytes"));
        let knock = HandshakeFrame::Knock { from: self.config.node, to: node, nonce };
        if let Some(peer) = self.peers.get(&node)
            && let Some(to) = peer.address.clone()
        {
            let frame = peer.keys.encoded(&knock, now);
            self.transmit(to, frame);
        }
    }

    /// Sends a sealed frame without content, which shows the peer that these keys are used.
    fn confirm(&mut self, node: NodeId, to: A) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        if let Some(frame) = peer.channels.seal(FrameLane::Hello, &[], &self.config.limits) {
            self.transmit(to, frame);
        }
    }

    /// The peer has sent such a frame from there. The initiator sends them until it has received
    /// one.
    pub(super) fn handle_confirmation(&mut self, node: NodeId, from: &A) {
        if !self.is_initiator(node) {
            self.confirm(node, from.clone());
        }
    }

    /// Drops keys that are due.
    pub(super) fn drop_keys(&mut self, node: NodeId, now: Instant) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        if peer.channels.drop_due_keys(&self.config.limits, now) {
            peer.was_open = None;
            self.outputs.push_back(SealerOutput::KeyWornOut { peer: node });
            if self.peers[&node].attempt.is_none() {
                self.begin(node, now);
            }
        }
        self.index(node);
    }

    /// A frame that is not sealed was received.
    pub(super) fn handle_handshake(
        &mut self,
        bytes: &[u8],
        from: &A,
        now: Instant,
    ) -> Result<(), OpenError> {
        let frame = HandshakeFrame::decode(bytes)?;
        let done = match &frame {
            HandshakeFrame::Init(init) => self.handle_init(init, &frame, bytes, from, now),
            HandshakeFrame::Knock { from: node, to, nonce } => {
                self.check_initiator(*to, self.config.node < *node)?;
                self.peer(*node)?.keys.has_proof(&frame, bytes)?;
                self.handle_knock(*node, *nonce, from, now)
            }
            HandshakeFrame::Answer(answer) => {
                let (node, _) = self.asked(answer.answered)?;
                self.peer(node)?.keys.has_proof(&frame, bytes)?;
                self.push(HandshakeStep::Answer(node, *answer, from.clone()))
            }
            HandshakeFrame::Cookie(cookie) => self.handle_cookie(cookie, now),
            HandshakeFrame::Prefer { channel, suite } => {
                let (node, _) = self.asked(*channel)?;
                self.peer(node)?.keys.has_proof(&frame, bytes)?;
                self.handle_prefer(node, *suite)
            }
        };
        self.rearm();
        done
    }

    fn peer(&mut self, node: NodeId) -> Result<&mut SealedPeer<C, A>, OpenError> {
        self.peers.get_mut(&node).ok_or(OpenError::Unknown)
    }

    /// Whether a frame for that node is for this one, which has the right role.
    fn check_initiator(&self, to: NodeId, right_role: bool) -> Result<(), OpenError> {
        if to == self.config.node && right_role { Ok(()) } else { Err(OpenError::Unknown) }
    }

    /// The peer whose handshake has this number, and its init.
    fn asked(&self, number: u32) -> Result<(NodeId, InitFrame), OpenError> {
        let node = self.numbers.get(&number).ok_or(OpenError::Unknown)?;
        let init = self.peers.get(node).and_then(SealedPeer::init);
        let init = init.filter(|init| init.channel == number);
        Ok((*node, *init.ok_or(OpenError::Unknown)?))
    }

    fn push(&mut self, step: HandshakeStep<A>) -> Result<(), OpenError> {
        let same = |waiting: &HandshakeStep<A>| {
            waiting.peer() == step.peer()
                && std::mem::discriminant(waiting) == std::mem::discriminant(&step)
        };
        // The sender repeats what is not answered.
        if self.steps.len() >= STEPS_MAX || self.steps.iter().any(same) {
            return Err(OpenError::Limited);
        }
        self.steps.push_back(step);
        Ok(())
    }

    fn handle_init(
        &mut self,
        init: &InitFrame,
        frame: &HandshakeFrame,
        bytes: &[u8],
        from: &A,
        now: Instant,
    ) -> Result<(), OpenError> {
        self.check_initiator(init.to, init.from < self.config.node)?;
        let peer = self.peers.get(&init.from).ok_or(OpenError::Unknown)?;
        peer.keys.has_proof(frame, bytes)?;
        if self.repeats.contains(init.from, init.ephemeral()) {
            // Our answer may have been lost.
            if let Some(offer) = &peer.channels.offered
                && offer.ephemeral == init.ephemeral()
            {
                let answer = offer.answer.clone();
                self.transmit(from.clone(), answer);
            }
            return Err(OpenError::Repeated);
        }
        let (covered, cookie_mac) = mac2(bytes);
        self.admit(init, frame.mac1(bytes).1, covered, cookie_mac, from, now)?;
        if init.suite == CipherSuite::AesGcm && !self.config.fast_aes {
            let suite = self.config.suite();
            let prefer = HandshakeFrame::Prefer { channel: init.channel, suite };
            let frame = self.peer(init.from)?.keys.encoded(&prefer, now);
            self.transmit(from.clone(), frame);
            return Ok(());
        }
        self.push(HandshakeStep::Init(*init, from.clone()))
    }

    /// Whether there is a handshake left in the budget, or its sender has shown a cookie.
    fn admit(
        &mut self,
        init: &InitFrame,
        mac1: &[u8],
        covered: &[u8],
        mac2: &[u8],
        from: &A,
        now: Instant,
    ) -> Result<(), OpenError> {
        if self.budget.add((), now) {
            return Ok(());
        }
        if !self.config.forgeable_addresses {
            return Err(OpenError::Limited);
        }
        let cookie = self.cookies.cookie(init.from, from, &mut self.seeds, now);
        let nonce = *self.seeds.next_seed().first_chunk().expect("12 of 32 bytes");
        let peer = self.peer(init.from)?;
        if MacKey::new(&cookie).verify_short(&[covered], mac2) {
            if now < peer.proven_at {
                return Err(OpenError::Limited);
            }
            peer.proven_at = now + PROVEN_INTERVAL;
            return Ok(());
        }
        let mac1 = mac1.first_chunk().expect("mac1 was found right");
        let sealed = peer.keys.cookie_cipher.seal(nonce, mac1, cookie);
        let reply = CookieFrame { answered: init.channel, nonce, sealed };
        let frame = peer.keys.encoded(&HandshakeFrame::Cookie(reply), now);
        self.transmit(from.clone(), frame);
        Err(OpenError::Limited)
    }

    fn handle_knock(
        &mut self,
        node: NodeId,
        nonce: u64,
        from: &A,
        now: Instant,
    ) -> Result<(), OpenError> {
        if self.repeats.contains(node, nonce) {
            return Err(OpenError::Repeated);
        }
        let peer = self.peer(node)?;
        if let Some(Approach::Asking { init, to, .. }) = peer.approach()
            && (to == from || now >= peer.knock_at)
        {
            // The init was lost, or the peer is elsewhere: it is sent once more, which costs no
            // arithmetic.
            let frame = peer.keys.encoded(&HandshakeFrame::Init(*init), now);
            peer.knock_at = now + KNOCK_INTERVAL;
            self.repeats.insert(node, nonce);
            self.transmit(from.clone(), frame);
            return Ok(());
        }
        if now < peer.knock_at || !self.budget.add((), now) {
            return Err(OpenError::Limited);
        }
        self.repeats.insert(node, nonce);
        let peer = self.peer(node)?;
        peer.knock_at = now + KNOCK_INTERVAL;
        peer.knocked_from = Some(from.clone());
        self.begin(node, now);
        Ok(())
    }

    fn handle_cookie(&mut self, cookie: &CookieFrame, now: Instant) -> Result<(), OpenError> {
        let (node, init) = self.asked(cookie.answered)?;
        let peer = self.peer(node)?;
        // That of the init itself: mac1 does not depend on a cookie.
        let frame = HandshakeFrame::Init(init);
        let bytes = peer.keys.encoded(&frame, now);
        let mac1 = frame.mac1(&bytes).1.first_chunk().expect("8 bytes");
        let opened = peer.keys.cookie_cipher.open(cookie.nonce, mac1, cookie.sealed);
        peer.keys.cookie = Some((opened.ok_or(OpenError::Filtered)?, now));
        Ok(())
    }

    fn handle_prefer(&mut self, node: NodeId, suite: CipherSuite) -> Result<(), OpenError> {
        let peer = self.peer(node)?;
        // What every processor does well is all that can be asked for, so it is asked for once.
        if suite != CipherSuite::ChaChaPoly || peer.suite == suite {
            return Err(OpenError::Unknown);
        }
        peer.suite = suite;
        self.wait_for_turn(node);
        Ok(())
    }

    /// The arithmetic of one message.
    pub(super) fn handle_step(&mut self, step: HandshakeStep<A>, now: Instant) {
        match step {
            HandshakeStep::Begin(node) => self.send_init(node, now),
            HandshakeStep::Init(init, from) => self.answer(&init, from, now),
            HandshakeStep::Answer(node, answer, from) => self.complete(node, &answer, from, now),
        }
    }

    fn send_init(&mut self, node: NodeId, now: Instant) {
        let (from, seed, number) = (self.config.node, self.seeds.next_seed(), self.new_number());
        let prologue = self.config.prologue(from, node);
        let payload = encode_payload(self.config.incarnation);
        let Some(peer) = self.peers.get_mut(&node) else { return };
        if !matches!(peer.approach(), Some(Approach::Waiting)) {
            return;
        }
        let Some(to) = peer.knocked_from.take().or_else(|| peer.address.clone()) else {
            return peer.attempt = None;
        };
        let terms =
            HandshakeTerms { suite: peer.suite, prologue: &prologue, peer: &peer.keys.public };
        let Some((handshake, noise)) = self.crypto.write_init(terms, seed, &payload) else {
            return;
        };
        let init = InitFrame { suite: peer.suite, channel: number, from, to: node, noise };
        let frame = peer.keys.encoded(&HandshakeFrame::Init(init), now);
        peer.go_on(Approach::Asking { handshake, init, to: to.clone(), since: now });
        self.transmit(to, frame);
        self.index(node);
        let since = |peer: &SealedPeer<C, A>| match peer.approach()? {
            Approach::Asking { since, .. } => Some(*since),
            _ => None,
        };
        // It is begun once more at its next attempt.
        self.bound(ASKING_MAX, since, |peer| peer.go_on(Approach::Waiting));
    }

    /// Ends what is pending with the peer where that is the oldest, if there are more than `most`.
    fn bound(
        &mut self,
        most: usize,
        since: impl Fn(&SealedPeer<C, A>) -> Option<Instant>,
        end: impl FnOnce(&mut SealedPeer<C, A>),
    ) {
        let pending = self.peers.iter().filter_map(|(node, peer)| Some((since(peer)?, *node)));
        let (count, oldest) = (pending.clone().count(), pending.min());
        if let Some((_, node)) = oldest.filter(|_| count > most)
            && let Some(peer) = self.peers.get_mut(&node)
        {
            end(peer);
            self.index(node);
        }
    }

    fn answer(&mut self, init: &InitFrame, from: A, now: Instant) {
        let node = init.from;
        let (seed, number) = (self.seeds.next_seed(), self.new_number());
        let prologue = self.config.prologue(node, self.config.node);
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let terms =
            HandshakeTerms { suite: init.suite, prologue: &prologue, peer: &peer.keys.public };
        let Some((handshake, payload)) = self.crypto.read_init(terms, seed, &init.noise) else {
            peer.refused += 1;
            return;
        };
        self.repeats.insert(node, init.ephemeral());
        let theirs = decode_payload(&payload);
        let ours = encode_payload(self.config.incarnation);
        let Some((noise, keys)) = self.crypto.write_answer(handshake, &ours) else { return };
        let channel = self.new_channel(init.suite, number, init.channel, theirs, &keys, now);
        let answer = AnswerFrame { channel: number, answered: init.channel, noise };
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let answer = peer.keys.encoded(&HandshakeFrame::Answer(answer), now);
        let ephemeral = init.ephemeral();
        let offer = OfferedChannel { channel, since: now, ephemeral, answer: answer.clone() };
        peer.channels.offered = Some(offer);
        self.transmit(from, answer);
        self.index(node);
        let since = |peer: &SealedPeer<C, A>| Some(peer.channels.offered.as_ref()?.since);
        self.bound(OFFERS_MAX, since, |peer| peer.channels.offered = None);
    }

    fn complete(&mut self, node: NodeId, answer: &AnswerFrame, to: A, now: Instant) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let Some(attempt) = &mut peer.attempt else { return };
        let Approach::Asking { handshake, init, .. } = &mut attempt.approach else { return };
        if init.channel != answer.answered {
            return;
        }
        let (suite, number, ephemeral) = (init.suite, init.channel, init.ephemeral());
        let Some((payload, keys)) = self.crypto.read_answer(handshake, &answer.noise) else {
            peer.refused += 1;
            return;
        };
        attempt.approach = Approach::Waiting;
        let theirs = decode_payload(&payload);
        let channel = self.new_channel(suite, number, answer.channel, theirs, &keys, now);
        let Some(peer) = self.peers.get_mut(&node) else { return };
        if let Some(open) = peer.channels.in_use_by_other(theirs, now) {
            // For what the other one is told.
            let offer = OfferedChannel { channel, since: now, ephemeral, answer: Bytes::new() };
            peer.channels.offered = Some(offer);
            let in_use = SealerOutput::KeyInUse { peer: node, address: to, open, refused: theirs };
            self.outputs.push_back(in_use);
            return self.index(node);
        }
        // Its answer is fresh, since it depends on our ephemeral key: no confirmation is needed.
        peer.channels.replace(channel, &self.config.limits, now);
        peer.address = Some(to.clone());
        peer.restart(Approach::Confirming { to: to.clone(), since: now }, now);
        self.index(node);
        self.confirm(node, to);
        self.schedule(node, now);
    }

    fn new_channel(
        &self,
        suite: CipherSuite,
        local: u32,
        remote: u32,
        peer: Incarnation,
        keys: &ChannelKeys,
        now: Instant,
    ) -> Channel {
        let terms = ChannelTerms { profile: self.config.profile, suite, local, remote, peer };
        Channel::new(terms, keys, &self.crypto, now)
    }

    /// A number that no frame to this node bears yet. A used one is returned only if all are used:
    /// then a channel of another peer stops opening frames, and is asked for once more.
    fn new_number(&mut self) -> u32 {
        let channels = self.config.profile.channels();
        let seed = self.seeds.next_seed();
        let start = u64::from_be_bytes(*seed.first_chunk().expect("8 of 32 bytes"));
        let numbers = (0..channels).map(|step| (start.wrapping_add(step) % channels) as u32);
        let mut unused = numbers.filter(|number| !self.numbers.contains_key(number));
        unused.next().unwrap_or((start % channels) as u32)
    }
}
