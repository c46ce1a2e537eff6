//! Cryptography that protects nothing, and notices when a nonce is used twice.

use blastema_core::net::seal::cipher::{
    ChannelKeys, CipherSuite, FrameCipher, HandshakeTerms, NOISE_MESSAGE, PAYLOAD, PUBLIC_KEY,
    SealCrypto,
};
use bytes::BytesMut;
use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};

/// A key, and a nonce that was used under it.
type UsedNonce = ([u8; 32], u64);

/// The nonces that all nodes of a test have used, by key. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct NonceLedger(Arc<Mutex<BTreeSet<UsedNonce>>>);

impl NonceLedger {
    /// How many nonces were used.
    pub fn count(&self) -> usize {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).len()
    }

    fn insert(&self, key: [u8; 32], nonce: u64) {
        let mut used = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        assert!(used.insert((key, nonce)), "the nonce {nonce:#x} is used twice under one key");
    }
}

/// Stands in for the cryptography of one node: a hash instead of curves and ciphers.
///
/// One seed gives one handshake. Changed bytes are refused, as are other keys and other terms. What
/// is sealed stays readable, and a test that knows the public keys can forge everything.
///
/// # Panics
/// When a frame is sealed with a nonce that was used under the same key.
#[derive(Clone, Debug)]
pub struct FakeCrypto {
    public: [u8; PUBLIC_KEY],
    ledger: NonceLedger,
}

impl FakeCrypto {
    /// The cryptography of the node with this number.
    pub fn new(node: u32, ledger: NonceLedger) -> Self {
        FakeCrypto { public: Self::public_key(node), ledger }
    }

    /// The public key of the node with this number.
    pub fn public_key(node: u32) -> [u8; PUBLIC_KEY] {
        hash(&[b"public", &node.to_be_bytes()])
    }

    /// What both ends know before the handshake.
    fn known(&self, terms: &HandshakeTerms<'_>) -> [u8; 32] {
        let pair = pair(&self.public, terms.peer);
        hash(&[b"known", &pair, &[terms.suite.number()], terms.prologue])
    }
}

/// One end of a handshake of [`FakeCrypto`].
#[derive(Debug)]
pub struct FakeHandshake {
    known: [u8; 32],
    initiator: [u8; 32],
    responder: [u8; 32],
}

impl FakeHandshake {
    /// The keys by which the initiator, and the responder, seal.
    fn keys(&self) -> [[u8; 32]; 2] {
        [&b"initiator"[..], b"responder"]
            .map(|side| hash(&[side, &self.known, &self.initiator, &self.responder]))
    }
}

fn pair(one: &[u8], other: &[u8]) -> [u8; 32] {
    hash(&[b"pair", one.min(other), one.max(other)])
}

fn message(ephemeral: &[u8], payload: &[u8], context: &[&[u8]]) -> [u8; NOISE_MESSAGE] {
    let tag = hash(&[&hash(context), ephemeral, payload]);
    let bytes = [ephemeral, payload, &tag[..16]].concat();
    bytes.try_into().expect("an ephemeral key, a payload and a tag")
}

fn read(
    bytes: &[u8; NOISE_MESSAGE],
    context: &[&[u8]],
) -> Option<([u8; PUBLIC_KEY], [u8; PAYLOAD])> {
    let (ephemeral, rest) = bytes.split_first_chunk()?;
    let (payload, _) = rest.split_first_chunk()?;
    (message(ephemeral, payload, context) == *bytes).then_some((*ephemeral, *payload))
}

impl SealCrypto for FakeCrypto {
    type Handshake = FakeHandshake;

    fn pair_secret(&self, peer: &[u8; PUBLIC_KEY]) -> Option<[u8; 32]> {
        Some(pair(&self.public, peer))
    }

    fn write_init(
        &self,
        terms: HandshakeTerms<'_>,
        seed: [u8; 32],
        payload: &[u8; PAYLOAD],
    ) -> Option<(FakeHandshake, [u8; NOISE_MESSAGE])> {
        let (known, initiator) = (self.known(&terms), hash(&[b"ephemeral", &seed]));
        let init = message(&initiator, payload, &[b"init", &known]);
        Some((FakeHandshake { known, initiator, responder: [0; 32] }, init))
    }

    fn read_init(
        &self,
        terms: HandshakeTerms<'_>,
        seed: [u8; 32],
        message: &[u8; NOISE_MESSAGE],
    ) -> Option<(FakeHandshake, [u8; PAYLOAD])> {
        let known = self.known(&terms);
        let (initiator, payload) = read(message, &[b"init", &known])?;
        let responder = hash(&[b"ephemeral", &seed]);
        Some((FakeHandshake { known, initiator, responder }, payload))
    }

    fn write_answer(
        &self,
        handshake: FakeHandshake,
        payload: &[u8; PAYLOAD],
    ) -> Option<([u8; NOISE_MESSAGE], ChannelKeys)> {
        let [open, seal] = handshake.keys();
        let context = [b"answer", &handshake.known[..], &handshake.initiator];
        Some((message(&handshake.responder, payload, &context), ChannelKeys { seal, open }))
    }

    fn read_answer(
        &self,
        handshake: &mut FakeHandshake,
        message: &[u8; NOISE_MESSAGE],
    ) -> Option<([u8; PAYLOAD], ChannelKeys)> {
        let context = [b"answer", &handshake.known[..], &handshake.initiator];
        let (responder, payload) = read(message, &context)?;
        handshake.responder = responder;
        let [seal, open] = handshake.keys();
        Some((payload, ChannelKeys { seal, open }))
    }

    fn cipher(&self, _: CipherSuite, keys: &ChannelKeys) -> Box<dyn FrameCipher> {
        Box::new(FakeCipher { seal: keys.seal, open: keys.open, ledger: self.ledger.clone() })
    }
}

/// The cipher of [`FakeCrypto`]: a tag, and no encryption.
#[derive(Debug)]
struct FakeCipher {
    seal: [u8; 32],
    open: [u8; 32],
    ledger: NonceLedger,
}

fn tag(key: &[u8; 32], nonce: u64, plain: &[u8]) -> [u8; 16] {
    let hash = hash(&[key, &nonce.to_be_bytes(), plain]);
    *hash.first_chunk().expect("16 of 32 bytes")
}

impl FrameCipher for FakeCipher {
    fn seal(&mut self, nonce: u64, frame: &mut BytesMut, from: usize) {
        self.ledger.insert(self.seal, nonce);
        let tag = tag(&self.seal, nonce, &frame[from..]);
        frame.extend_from_slice(&tag);
    }

    fn open(&mut self, nonce: u64, sealed: &mut [u8]) -> Option<usize> {
        let (plain, found) = sealed.split_last_chunk()?;
        (tag(&self.open, nonce, plain) == *found).then_some(plain.len())
    }
}

/// Four hashes of 64 bits (FNV-1a), each with a start of its own. Good against changed bits, and
/// against nothing else.
fn hash(pieces: &[&[u8]]) -> [u8; 32] {
    let mut out = [0; 32];
    for (start, chunk) in (0u64..).zip(out.chunks_exact_mut(8)) {
        let mut hash = 0xcbf2_9ce4_8422_2325 ^ start.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        for piece in pieces {
            for byte in piece.len().to_be_bytes().iter().chain(*piece) {
                hash = (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
                hash ^= hash >> 29;
            }
        }
        chunk.copy_from_slice(&hash.to_be_bytes());
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cipher(ledger: &NonceLedger) -> Box<dyn FrameCipher> {
        let keys = ChannelKeys { seal: [1; 32], open: [1; 32] };
        FakeCrypto::new(1, ledger.clone()).cipher(CipherSuite::AesGcm, &keys)
    }

    #[test]
    fn what_is_sealed_opens_and_what_is_changed_does_not() {
        let mut cipher = cipher(&NonceLedger::default());
        let mut frame = BytesMut::from("text");
        cipher.seal(3, &mut frame, 0);

        assert_eq!(cipher.open(3, &mut frame.to_vec()), Some(4));
        assert_eq!(cipher.open(4, &mut frame.to_vec()), None);
        for bit in 0..frame.len() * 8 {
            let mut changed = frame.to_vec();
            changed[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(cipher.open(3, &mut changed), None);
        }
    }

    #[test]
    #[should_panic(expected = "used twice")]
    fn a_nonce_that_is_used_twice_is_noticed_also_by_another_cipher_of_the_key() {
        let ledger = NonceLedger::default();
        cipher(&ledger).seal(3, &mut BytesMut::new(), 0);
        cipher(&ledger).seal(3, &mut BytesMut::new(), 0);
    }
}
