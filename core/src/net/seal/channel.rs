//! A channel: two keys, and the counters under them; and the channels of one peer.
//!
//! A peer has up to three. Frames are sealed under the *present* one. The *offered* one is that of
//! a handshake which this node has answered: it replaces the present one when a frame was opened
//! under it, and not before, since the init may be a replay (key confirmation). The *former* one is
//! that which was replaced last: for two seconds it opens frames that are still in flight, and
//! seals none, so that new keys lose nothing.
//!
//! Keys are in memory only, with the counters that go with them, and are dropped together: a nonce
//! that is used twice tells an attacker the key of GCM's authentication.

use super::cipher::{ChannelKeys, CipherSuite, FrameCipher, SealCrypto};
use super::compact::CompactCipher;
use super::header::{COUNTER_END, SealHeader, SealProfile};
use super::window::ReplayWindow;
use crate::medium::lane::FrameLane;
use crate::net::wire::WireError;
use crate::{Incarnation, Instant};
use bytes::{Buf, Bytes, BytesMut};
use std::time::Duration;

/// How long keys may be used.
#[derive(Clone, Debug)]
pub struct KeyLimits {
    /// So many frames sealed by this end make it ask for new keys.
    pub renew_after_frames: u64,
    /// A key seals no more than that. RFC 9001, 6.6, allows AES-GCM 2^23 packets of 2^16 bytes.
    pub frames_max: u64,
    /// So many forged frames under its number make this end ask for new keys. Few never do: they
    /// cost a handshake.
    pub renew_after_forged: u64,
    /// No frame is opened after so many. RFC 9001, 6.6, allows ChaCha20-Poly1305 2^36.
    pub forged_max: u64,
    /// Keys that are so old are renewed.
    pub renew_after: Duration,
    /// Keys that are so old are dropped, although no new ones could be made.
    pub age_max: Duration,
    /// How long replaced keys open frames that were in flight: at least three hellos.
    pub former: Duration,
}

impl Default for KeyLimits {
    fn default() -> Self {
        KeyLimits {
            renew_after_frames: 1 << 22,
            frames_max: 1 << 23,
            renew_after_forged: 1 << 34,
            forged_max: 1 << 35,
            renew_after: Duration::from_secs(3600),
            age_max: Duration::from_secs(7200),
            former: Duration::from_secs(2),
        }
    }
}

/// A compact counter is ambiguous after 2^15 frames that were lost in a row. A peer that sends as
/// many frames, and opened none of ours, is asked for new keys at half of that.
const UNANSWERED_MAX: u64 = 1 << 14;

/// Why a frame was not opened.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OpenError {
    /// It is neither sealed nor of a handshake, or of another release, or cut.
    #[error(transparent)]
    Malformed(#[from] WireError),
    /// Its channel, or the node that it names, is not known here.
    #[error("sealed for a channel that is not known")]
    Unknown,
    /// A duplicate, or older than the window. Networks duplicate and reorder; so do attackers.
    #[error("seen before, or too old")]
    Stale,
    /// The holder of the channel's keys has not sealed it.
    #[error("not sealed by the peer")]
    Forged,
    /// Its sender does not have the key of the pair.
    #[error("not from a node that has the pair's key")]
    Filtered,
    /// A handshake's frame that was received before.
    #[error("a handshake that was seen before")]
    Repeated,
    /// There are more handshakes than this node takes part in.
    #[error("too many handshakes")]
    Limited,
}

/// What a handshake has agreed on.
#[derive(Clone, Copy, Debug)]
pub(super) struct ChannelTerms {
    pub(super) profile: SealProfile,
    pub(super) suite: CipherSuite,
    /// The channel's number in frames to this node.
    pub(super) local: u32,
    /// The channel's number in frames to the peer.
    pub(super) remote: u32,
    /// The peer's incarnation, as the handshake says.
    pub(super) peer: Incarnation,
}

/// Two keys, and the counters under them.
#[derive(Debug)]
pub(super) struct Channel {
    pub(super) terms: ChannelTerms,
    cipher: Box<dyn FrameCipher>,
    pub(super) since: Instant,
    /// A frame was opened under it.
    pub(super) confirmed: bool,
    next: [u64; 3],
    windows: [ReplayWindow; 3],
    sealed: u64,
    /// What was sealed since a frame was opened.
    unanswered: u64,
    forged: u64,
}

impl Channel {
    pub(super) fn new(
        terms: ChannelTerms,
        keys: &ChannelKeys,
        crypto: &impl SealCrypto,
        now: Instant,
    ) -> Self {
        let cipher = match terms.profile {
            SealProfile::Full => crypto.cipher(terms.suite, keys),
            SealProfile::Compact => Box::new(CompactCipher::new(keys)),
        };
        Channel {
            terms,
            cipher,
            since: now,
            confirmed: false,
            next: [0; 3],
            windows: Default::default(),
            sealed: 0,
            unanswered: 0,
            forged: 0,
        }
    }

    fn suite(&self) -> Option<CipherSuite> {
        (self.terms.profile == SealProfile::Full).then_some(self.terms.suite)
    }

    /// Whether new keys are due, by their use.
    fn is_worn(&self, limits: &KeyLimits) -> bool {
        let ambiguous = self.terms.profile == SealProfile::Compact;
        self.sealed >= limits.renew_after_frames
            || self.forged >= limits.renew_after_forged
            || ambiguous && self.unanswered >= UNANSWERED_MAX
    }

    /// Whether these keys must not be used any more.
    fn is_worn_out(&self, limits: &KeyLimits) -> bool {
        self.sealed >= limits.frames_max || self.forged >= limits.forged_max
    }

    /// Seals a frame, given in pieces. One buffer is allocated.
    pub(super) fn seal(&mut self, lane: FrameLane, pieces: &[&[u8]]) -> Bytes {
        let (profile, suite, channel) = (self.terms.profile, self.suite(), self.terms.remote);
        let counter = self.next[lane.number()];
        self.next[lane.number()] += 1;
        self.sealed += 1;
        self.unanswered += 1;

        let before = profile.header_length();
        let plain: usize = pieces.iter().map(|piece| piece.len()).sum();
        let mut frame = BytesMut::with_capacity(plain + profile.overhead());
        // The receiver completes the counter from its low bits.
        let header = SealHeader { profile, suite, lane, channel, counter: counter as u32 };
        header.encode(&mut frame);
        pieces.iter().for_each(|piece| frame.extend_from_slice(piece));
        self.cipher.seal(lane.nonce(counter), &mut frame, before);
        frame.freeze()
    }

    /// Opens a frame in place: its plain bytes are left. The window is asked before the cipher,
    /// which costs more, and marked after it: a forged frame must not use up a counter.
    fn open(&mut self, header: &SealHeader, frame: &mut BytesMut) -> Result<(), OpenError> {
        let profile = self.terms.profile;
        let window = &mut self.windows[header.lane.number()];
        let low = u64::from(header.counter);
        let counter = window
            .nearest(low, profile.counter_bits(), COUNTER_END)
            .filter(|counter| window.is_new(*counter))
            .ok_or(OpenError::Stale)?;
        let sealed = &mut frame[profile.header_length()..];
        let Some(plain) = self.cipher.open(header.lane.nonce(counter), sealed) else {
            self.forged += 1;
            return Err(OpenError::Forged);
        };
        window.mark(counter);
        self.unanswered = 0;
        frame.advance(profile.header_length());
        frame.truncate(plain);
        Ok(())
    }

    /// Whether a frame with this header can be of this channel.
    fn has(&self, header: &SealHeader) -> bool {
        let terms = &self.terms;
        terms.local == header.channel
            && terms.profile == header.profile
            && self.suite() == header.suite
    }
}

/// A channel that no frame was opened under, of a handshake that this node has answered.
#[derive(Debug)]
pub(super) struct OfferedChannel {
    pub(super) channel: Channel,
    pub(super) since: Instant,
    /// Which init it answers, and the answer.
    pub(super) ephemeral: u64,
    pub(super) answer: Bytes,
}

/// What a frame that was opened did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Opening {
    /// It continues a channel.
    Continued,
    /// It is the first under the present channel.
    Confirmed,
    /// It is the first under the offered channel, which is now the present one.
    Accepted,
    /// It came under the offered channel, and the peer is heard in this other incarnation. The
    /// present channel stays.
    InUse(Incarnation),
}

/// The channels of one peer.
#[derive(Debug, Default)]
pub(super) struct PeerChannels {
    pub(super) present: Option<Channel>,
    pub(super) offered: Option<OfferedChannel>,
    /// With the instant at which it is dropped.
    former: Option<(Channel, Instant)>,
    /// When a frame was opened under the present channel.
    opened_at: Option<Instant>,
}

impl PeerChannels {
    /// How long an offer waits for its first frame. The initiator asks again after a second.
    pub(super) const OFFER_MAX: Duration = Duration::from_secs(5);
    /// A peer whose frames were opened within this time is there, in that incarnation. Links know
    /// after 175 ms of silence that a neighbour is gone.
    const HEARD_WITHIN: Duration = Duration::from_millis(200);

    /// The numbers of all channels in frames to this node.
    pub(super) fn local_numbers(&self) -> impl Iterator<Item = u32> {
        let offered = self.offered.as_ref().map(|offer| &offer.channel);
        let former = self.former.as_ref().map(|(channel, _)| channel);
        let all = [self.present.as_ref(), offered, former];
        all.into_iter().flatten().map(|channel| channel.terms.local)
    }

    /// The peer's incarnation, if it is another one than this, and is heard.
    pub(super) fn in_use_by_other(
        &self,
        incarnation: Incarnation,
        now: Instant,
    ) -> Option<Incarnation> {
        let present = self.present.as_ref()?;
        let open = present.terms.peer;
        let is_heard = self.opened_at.is_some_and(|at| now - at < Self::HEARD_WITHIN);
        (is_heard && open != incarnation).then_some(open)
    }

    /// Whether new keys are due by use of the present ones.
    pub(super) fn is_worn(&self, limits: &KeyLimits) -> bool {
        self.present.as_ref().is_some_and(|channel| channel.is_worn(limits))
    }

    /// Seals under the present channel, if its keys may still be used.
    pub(super) fn seal(
        &mut self,
        lane: FrameLane,
        pieces: &[&[u8]],
        limits: &KeyLimits,
    ) -> Option<Bytes> {
        let present = self.present.as_mut().filter(|channel| !channel.is_worn_out(limits))?;
        Some(present.seal(lane, pieces))
    }

    /// Opens a frame under the channel that its header names. Returns the peer's
    /// incarnation, as that channel's handshake says.
    pub(super) fn open(
        &mut self,
        header: &SealHeader,
        frame: &mut BytesMut,
        limits: &KeyLimits,
        now: Instant,
    ) -> Result<(Opening, Incarnation), OpenError> {
        let usable = |channel: &Channel| channel.has(header) && !channel.is_worn_out(limits);
        if let Some(present) = self.present.as_mut().filter(|channel| usable(channel)) {
            present.open(header, frame)?;
            self.opened_at = Some(now);
            let was_confirmed = std::mem::replace(&mut present.confirmed, true);
            let opening = if was_confirmed { Opening::Continued } else { Opening::Confirmed };
            return Ok((opening, present.terms.peer));
        }
        if let Some((former, _)) = self.former.as_mut().filter(|(channel, _)| usable(channel)) {
            former.open(header, frame)?;
            return Ok((Opening::Continued, former.terms.peer));
        }
        let offered = self.offered.as_mut().filter(|offer| usable(&offer.channel));
        let offered = &mut offered.ok_or(OpenError::Unknown)?.channel;
        offered.open(header, frame)?;
        let peer = offered.terms.peer;
        if let Some(open) = self.in_use_by_other(peer, now) {
            return Ok((Opening::InUse(open), peer));
        }
        let mut channel = self.offered.take().expect("it was opened under it").channel;
        channel.confirmed = true;
        self.replace(channel, limits, now);
        self.opened_at = Some(now);
        Ok((Opening::Accepted, peer))
    }

    /// Takes the offered channel into use, and offers the present one instead. Returns the
    /// peer's incarnation in the channel that is used now.
    pub(super) fn exchange(&mut self, now: Instant) -> Option<Incarnation> {
        let (offer, present) = (self.offered.as_mut()?, self.present.as_mut()?);
        std::mem::swap(&mut offer.channel, present);
        (offer.since, offer.answer) = (now, Bytes::new());
        present.confirmed = true;
        (self.former, self.opened_at) = (None, Some(now));
        Some(present.terms.peer)
    }

    /// Takes a channel into use. Frames of another incarnation of the peer are not opened any more.
    pub(super) fn replace(&mut self, channel: Channel, limits: &KeyLimits, now: Instant) {
        let incarnation = channel.terms.peer;
        let former = self.present.replace(channel);
        self.former = former
            .filter(|former| former.terms.peer == incarnation)
            .map(|former| (former, now + limits.former));
    }

    /// When keys are dropped by their age.
    pub(super) fn drop_due(&self, limits: &KeyLimits) -> Option<Instant> {
        let former = self.former.as_ref().map(|(_, due)| *due);
        let offered = self.offered.as_ref().map(|offer| offer.since + Self::OFFER_MAX);
        let present = self.present.as_ref().map(|channel| channel.since + limits.age_max);
        [former, offered, present].into_iter().flatten().min()
    }

    /// Drops what is due, and what is worn out. Returns whether that was the present channel.
    pub(super) fn drop_due_keys(&mut self, limits: &KeyLimits, now: Instant) -> bool {
        self.former.take_if(|(_, due)| *due <= now);
        self.offered.take_if(|offer| offer.since + Self::OFFER_MAX <= now);
        let is_over = |channel: &mut Channel| {
            channel.since + limits.age_max <= now || channel.is_worn_out(limits)
        };
        self.present.take_if(is_over).is_some()
    }
}

#[cfg(test)]
mod tests;
