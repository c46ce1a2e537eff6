//! What a sealer knows of one peer.

use super::ChannelPurpose;
use super::admission::CookieJar;
use super::channel::{OpenError, PeerChannels};
use super::cipher::{CipherSuite, PUBLIC_KEY, SealCrypto};
use super::handshake_frame::{HandshakeFrame, InitFrame};
use super::noise::{CookieCipher, MacKey, derived_key};
use crate::{Incarnation, Instant};
use bytes::Bytes;
use std::fmt;
use zeroize::Zeroizing;

/// A peer, its channels, and how far a handshake with it is.
pub(super) struct SealedPeer<C: SealCrypto, A> {
    pub(super) keys: PairKeys,
    pub(super) channels: PeerChannels,
    /// The incarnation in which it was open last.
    pub(super) was_open: Option<Incarnation>,
    /// Where it is.
    pub(super) address: Option<A>,
    /// Where it has knocked from, for one init.
    pub(super) knocked_from: Option<A>,
    /// The handshake that goes on with it.
    pub(super) attempt: Option<HandshakeAttempt<C::Handshake, A>>,
    pub(super) suite: CipherSuite,
    /// Its next knock, and its next init with a cookie, are taken from here on.
    pub(super) knock_at: Instant,
    pub(super) proven_at: Instant,
    /// What only a holder of the pair's key can have sent, and is wrong.
    pub(super) refused: u64,
}

/// What protects the frames of handshakes with one peer.
pub(super) struct PairKeys {
    pub(super) public: [u8; PUBLIC_KEY],
    /// The key of `mac1` in the frames of handshakes.
    filter: MacKey,
    pub(super) cookie_cipher: CookieCipher,
    /// The peer's last cookie, and when it was received.
    pub(super) cookie: Option<([u8; 16], Instant)>,
}

/// A handshake, until both ends use its keys.
pub(super) struct HandshakeAttempt<H, A> {
    pub(super) approach: Approach<H, A>,
    pub(super) count: u32,
    pub(super) retransmit_at: Instant,
}

/// What this node does to have a channel with a peer.
pub(super) enum Approach<H, A> {
    /// It sends an init as soon as it has a turn, or at its next attempt.
    Waiting,
    /// It has sent an init.
    Asking { handshake: H, init: InitFrame, to: A, since: Instant },
    /// The peer is the initiator: it has sent a knock.
    Knocking,
    /// It has sealed frames under new keys, and has received none.
    Confirming { to: A, since: Instant },
}

impl PairKeys {
    fn new(public: [u8; PUBLIC_KEY], secret: [u8; 32], purpose: ChannelPurpose) -> Self {
        let secret = Zeroizing::new(secret);
        // A handshake of one purpose is not taken for one of the other, and is refused unread.
        let (filter, cookie) = match purpose {
            ChannelPurpose::Link => ("filter", "cookie"),
            ChannelPurpose::Path => ("path filter", "path cookie"),
        };
        PairKeys {
            public,
            filter: MacKey::new(&*derived_key(&secret, filter)),
            cookie_cipher: CookieCipher::new(&derived_key(&secret, cookie)),
            cookie: None,
        }
    }

    /// A frame with the code that proves the pair's key, and for an init the cookie.
    pub(super) fn encoded(&self, frame: &HandshakeFrame, now: Instant) -> Bytes {
        let cookie = self.cookie.filter(|(_, since)| now - *since < CookieJar::GOOD_FOR);
        let mac2 = |bytes: &[u8]| {
            cookie.map_or([0; 8], |(cookie, _)| MacKey::new(&cookie).short_mac(&[bytes]))
        };
        frame.encode(|bytes| self.filter.short_mac(&[bytes]), mac2).into()
    }

    /// Whether the frame's sender has the pair's key.
    pub(super) fn has_proof(&self, frame: &HandshakeFrame, bytes: &[u8]) -> Result<(), OpenError> {
        let (covered, mac) = frame.mac1(bytes);
        if self.filter.verify_short(&[covered], mac) { Ok(()) } else { Err(OpenError::Filtered) }
    }
}

impl<C: SealCrypto, A> SealedPeer<C, A> {
    pub(super) fn new(
        public: [u8; PUBLIC_KEY],
        secret: [u8; 32],
        suite: CipherSuite,
        purpose: ChannelPurpose,
    ) -> Self {
        SealedPeer {
            keys: PairKeys::new(public, secret, purpose),
            channels: PeerChannels::default(),
            was_open: None,
            address: None,
            knocked_from: None,
            attempt: None,
            suite,
            knock_at: Instant::ORIGIN,
            proven_at: Instant::ORIGIN,
            refused: 0,
        }
    }

    pub(super) fn approach(&self) -> Option<&Approach<C::Handshake, A>> {
        self.attempt.as_ref().map(|attempt| &attempt.approach)
    }

    /// Begins a handshake again; its next attempt is scheduled then.
    pub(super) fn restart(&mut self, approach: Approach<C::Handshake, A>, now: Instant) {
        self.attempt = Some(HandshakeAttempt { approach, count: 1, retransmit_at: now });
    }

    /// Goes on with the handshake in another way.
    pub(super) fn go_on(&mut self, approach: Approach<C::Handshake, A>) {
        if let Some(attempt) = &mut self.attempt {
            attempt.approach = approach;
        }
    }

    /// Both ends use the present channel. Returns whether these are new keys for a peer that was
    /// open in the same incarnation.
    ///
    /// The address that a frame came from may be forged. It does not replace one that the caller
    /// has given, or that has answered an init.
    pub(super) fn handle_open(&mut self, incarnation: Incarnation, from: A) -> bool {
        self.attempt = None;
        self.address.get_or_insert(from);
        self.was_open.replace(incarnation) == Some(incarnation)
    }

    /// The numbers of its channels, and of the handshake, in frames to this node.
    pub(super) fn numbers(&self) -> impl Iterator<Item = u32> {
        self.channels.local_numbers().chain(self.init().map(|init| init.channel))
    }

    /// The init that was sent and waits for an answer.
    pub(super) fn init(&self) -> Option<&InitFrame> {
        match self.approach()? {
            Approach::Asking { init, .. } => Some(init),
            _ => None,
        }
    }
}

impl<C: SealCrypto, A> fmt::Debug for SealedPeer<C, A> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let approach = match self.approach() {
            None => "idle",
            Some(Approach::Waiting) => "waiting",
            Some(Approach::Asking { .. }) => "asking",
            Some(Approach::Knocking) => "knocking",
            Some(Approach::Confirming { .. }) => "confirming",
        };
        write!(f, "SealedPeer({approach}, open as {:?})", self.was_open)
    }
}
