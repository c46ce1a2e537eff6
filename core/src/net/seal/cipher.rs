//! What the seals need of cryptography, so that tests can put a fast double in its place.
//!
//! `noise` is the product's implementation. `blastema-doubles` has one that computes no curve,
//! gives the same bytes for the same seeds, and panics when a nonce is used twice.

use bytes::BytesMut;
use std::fmt;
use zeroize::{Zeroize, ZeroizeOnDrop};

/// The bytes of a public key of X25519.
pub const PUBLIC_KEY: usize = 32;
/// The bytes that each message of a handshake carries for its sender.
pub const PAYLOAD: usize = 12;
/// The bytes of each message of the pattern `KK`: ephemeral key, payload and tag.
pub const NOISE_MESSAGE: usize = PUBLIC_KEY + PAYLOAD + 16;

/// The AEAD of a handshake, and of the frames that are sealed with its keys.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum CipherSuite {
    /// AES-256-GCM: several times as fast where the processor has instructions for it.
    AesGcm,
    /// ChaCha20-Poly1305: fast on every processor.
    ChaChaPoly,
}

impl CipherSuite {
    /// The number by which frames name it.
    pub const fn number(self) -> u8 {
        match self {
            CipherSuite::AesGcm => 0,
            CipherSuite::ChaChaPoly => 1,
        }
    }

    /// The suite of this number.
    pub const fn of(number: u8) -> Option<CipherSuite> {
        match number {
            0 => Some(CipherSuite::AesGcm),
            1 => Some(CipherSuite::ChaChaPoly),
            _ => None,
        }
    }
}

/// What both ends of a handshake must agree on.
#[derive(Clone, Copy)]
pub struct HandshakeTerms<'a> {
    /// The AEAD of the handshake and of its channel.
    pub suite: CipherSuite,
    /// What else both ends know: use of the channel, robot, initiator and responder.
    pub prologue: &'a [u8],
    /// The other end's static public key.
    pub peer: &'a [u8; PUBLIC_KEY],
}

/// The two keys of a channel, one for each direction. They are wiped when dropped.
#[derive(Zeroize, ZeroizeOnDrop, PartialEq, Eq)]
pub struct ChannelKeys {
    /// Seals what this end sends.
    pub seal: [u8; 32],
    /// Opens what the other end sent.
    pub open: [u8; 32],
}

/// Seals and opens the frames of one channel, in place.
pub trait FrameCipher: fmt::Debug + Send {
    /// Seals what stands in `frame` from `from` on, and appends the tag. The caller uses each nonce
    /// once.
    fn seal(&mut self, nonce: u64, frame: &mut BytesMut, from: usize);

    /// Opens sealed bytes, tag included. Returns how many of them, from the first, are now the
    /// plain ones; `None` if the other end has not sealed these bytes under this nonce.
    fn open(&mut self, nonce: u64, sealed: &mut [u8]) -> Option<usize>;
}

/// The cryptography of one node: it knows the node's static key.
///
/// `None` always means that the other end does not have the key that it should have, or that the
/// message was changed.
pub trait SealCrypto {
    /// One end of a handshake that is not complete.
    type Handshake;

    /// What this node and the one with that public key can compute, and no other.
    fn pair_secret(&self, peer: &[u8; PUBLIC_KEY]) -> Option<[u8; 32]>;

    /// Begins a handshake with an ephemeral key from this seed. Returns its first message.
    fn write_init(
        &self,
        terms: HandshakeTerms<'_>,
        seed: [u8; 32],
        payload: &[u8; PAYLOAD],
    ) -> Option<(Self::Handshake, [u8; NOISE_MESSAGE])>;

    /// Reads the first message. Returns what it carries. The other end may be a replay.
    fn read_init(
        &self,
        terms: HandshakeTerms<'_>,
        seed: [u8; 32],
        message: &[u8; NOISE_MESSAGE],
    ) -> Option<(Self::Handshake, [u8; PAYLOAD])>;

    /// Completes the handshake at the responder. Returns the second message.
    fn write_answer(
        &self,
        handshake: Self::Handshake,
        payload: &[u8; PAYLOAD],
    ) -> Option<([u8; NOISE_MESSAGE], ChannelKeys)>;

    /// Reads the second message: then the other end is known to have its key, and to be there now.
    /// A message that is refused leaves the handshake as it was.
    fn read_answer(
        &self,
        handshake: &mut Self::Handshake,
        message: &[u8; NOISE_MESSAGE],
    ) -> Option<([u8; PAYLOAD], ChannelKeys)>;

    /// The cipher for the frames of a channel.
    fn cipher(&self, suite: CipherSuite, keys: &ChannelKeys) -> Box<dyn FrameCipher>;
}
