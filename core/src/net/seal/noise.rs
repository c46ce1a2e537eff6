//! Handshake, ciphers, HMAC and HKDF by `snow`, `ring` and `x25519-dalek`.
//!
//! No other file of the seals knows these crates. `snow` does the handshake,
//! `Noise_KK_25519_AESGCM_SHA256` or `Noise_KK_25519_ChaChaPoly_SHA256` (Noise Protocol Framework,
//! revision 34), with ciphers and hash of `ring`, the curve of `x25519-dalek`, and ephemeral keys
//! from a seed that the caller gives: one seed gives one handshake, byte for byte. Its default
//! resolver, which asks the operating system for randomness, is not compiled.
//!
//! Frames are sealed by `ring` with the keys of Noise's `Split()`, and not by `snow`, which copies
//! each frame into a second buffer and has no key for tags alone (see `compact`). Nonces have the
//! layout that the Noise specification gives them (section 12), so the frames are those of a Noise
//! transport.
#![expect(clippy::disallowed_types, reason = "the one file that knows the handshake's crates")]

use super::cipher::{
    ChannelKeys, CipherSuite, FrameCipher, HandshakeTerms, NOISE_MESSAGE, PAYLOAD, PUBLIC_KEY,
    SealCrypto,
};
use bytes::BytesMut;
use ring::aead::{self, Aad, LessSafeKey, Nonce, UnboundKey};
use ring::{hkdf, hmac};
use snow::params::{CipherChoice, DHChoice, HashChoice, NoiseParams};
use snow::resolvers::{CryptoResolver, RingResolver};
use snow::types::{Cipher, Dh, Hash, Random};
use snow::{Builder, HandshakeState};
use std::fmt;
use std::hint::black_box;
use x25519_dalek::{PublicKey, StaticSecret};
use zeroize::Zeroizing;

/// Shows the name of a type that holds a secret, and nothing else.
macro_rules! secret {
    ($($name:ident),*) => {
        $(impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(concat!(stringify!($name), "(…)"))
            }
        })*
    };
}
secret!(NoiseCrypto, SeedGenerator, MacKey, CookieCipher, ChannelKeys);

/// The cryptography of a node, with its static key.
pub struct NoiseCrypto {
    secret: StaticSecret,
}

impl NoiseCrypto {
    /// With this secret key of X25519.
    pub fn new(secret: [u8; 32]) -> Self {
        NoiseCrypto { secret: secret.into() }
    }

    /// The public key that belongs to it.
    pub fn public_key(&self) -> [u8; PUBLIC_KEY] {
        PublicKey::from(&self.secret).to_bytes()
    }

    fn builder<'a>(&'a self, terms: &HandshakeTerms<'a>, seed: [u8; 32]) -> Option<Builder<'a>> {
        let name = match terms.suite {
            CipherSuite::AesGcm => "Noise_KK_25519_AESGCM_SHA256",
            CipherSuite::ChaChaPoly => "Noise_KK_25519_ChaChaPoly_SHA256",
        };
        let params: NoiseParams = name.parse().ok()?;
        let resolver = SeededResolver(Zeroizing::new(seed));
        let builder = Builder::with_resolver(params, Box::new(resolver));
        let builder = builder.local_private_key(self.secret.as_bytes()).ok()?;
        builder.remote_public_key(terms.peer).ok()?.prologue(terms.prologue).ok()
    }
}

impl SealCrypto for NoiseCrypto {
    type Handshake = Box<HandshakeState>;

    fn pair_secret(&self, peer: &[u8; PUBLIC_KEY]) -> Option<[u8; 32]> {
        let shared = self.secret.diffie_hellman(&PublicKey::from(*peer));
        shared.was_contributory().then(|| shared.to_bytes())
    }

    fn write_init(
        &self,
        terms: HandshakeTerms<'_>,
        seed: [u8; 32],
        payload: &[u8; PAYLOAD],
    ) -> Option<(Self::Handshake, [u8; NOISE_MESSAGE])> {
        let mut handshake = Box::new(self.builder(&terms, seed)?.build_initiator().ok()?);
        let message = written(&mut handshake, payload)?;
        Some((handshake, message))
    }

    fn read_init(
        &self,
        terms: HandshakeTerms<'_>,
        seed: [u8; 32],
        message: &[u8; NOISE_MESSAGE],
    ) -> Option<(Self::Handshake, [u8; PAYLOAD])> {
        let mut handshake = Box::new(self.builder(&terms, seed)?.build_responder().ok()?);
        let payload = read(&mut handshake, message)?;
        Some((handshake, payload))
    }

    fn write_answer(
        &self,
        mut handshake: Self::Handshake,
        payload: &[u8; PAYLOAD],
    ) -> Option<([u8; NOISE_MESSAGE], ChannelKeys)> {
        let message = written(&mut handshake, payload)?;
        let (open, seal) = handshake.dangerously_get_raw_split();
        Some((message, ChannelKeys { seal, open }))
    }

    fn read_answer(
        &self,
        handshake: &mut Self::Handshake,
        message: &[u8; NOISE_MESSAGE],
    ) -> Option<([u8; PAYLOAD], ChannelKeys)> {
        let payload = read(handshake, message)?;
        let (seal, open) = handshake.dangerously_get_raw_split();
        Some((payload, ChannelKeys { seal, open }))
    }

    fn cipher(&self, suite: CipherSuite, keys: &ChannelKeys) -> Box<dyn FrameCipher> {
        Box::new(AeadCipher::new(suite, keys))
    }
}

fn written(handshake: &mut HandshakeState, payload: &[u8]) -> Option<[u8; NOISE_MESSAGE]> {
    let mut message = [0; NOISE_MESSAGE];
    let length = handshake.write_message(payload, &mut message).ok()?;
    (length == NOISE_MESSAGE).then_some(message)
}

fn read(handshake: &mut HandshakeState, message: &[u8; NOISE_MESSAGE]) -> Option<[u8; PAYLOAD]> {
    // snow decrypts into a buffer of the message's size.
    let mut payload = [0; NOISE_MESSAGE];
    let length = handshake.read_message(message, &mut payload).ok()?;
    (length == PAYLOAD).then(|| payload.first_chunk().copied())?
}

/// Seals frames with an AEAD of `ring`.
pub struct AeadCipher {
    suite: CipherSuite,
    seal: LessSafeKey,
    open: LessSafeKey,
}

impl AeadCipher {
    /// With these keys.
    pub fn new(suite: CipherSuite, keys: &ChannelKeys) -> Self {
        let algorithm = match suite {
            CipherSuite::AesGcm => &aead::AES_256_GCM,
            CipherSuite::ChaChaPoly => &aead::CHACHA20_POLY1305,
        };
        let key = |bytes: &[u8; 32]| {
            let key = UnboundKey::new(algorithm, bytes).expect("both AEADs take keys of 32 bytes");
            LessSafeKey::new(key)
        };
        AeadCipher { suite, seal: key(&keys.seal), open: key(&keys.open) }
    }

    fn nonce(&self, nonce: u64) -> Nonce {
        let mut bytes = [0; 12];
        bytes[4..].copy_from_slice(&match self.suite {
            CipherSuite::AesGcm => nonce.to_be_bytes(),
            CipherSuite::ChaChaPoly => nonce.to_le_bytes(),
        });
        Nonce::assume_unique_for_key(bytes)
    }
}

impl fmt::Debug for AeadCipher {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "AeadCipher({:?})", self.suite)
    }
}

impl FrameCipher for AeadCipher {
    fn seal(&mut self, nonce: u64, frame: &mut BytesMut, from: usize) {
        let plain = &mut frame[from..];
        let sealed = self.seal.seal_in_place_separate_tag(self.nonce(nonce), Aad::empty(), plain);
        let tag = sealed.expect("a frame is shorter than the 64 GiB that a nonce may seal");
        frame.extend_from_slice(tag.as_ref());
    }

    fn open(&mut self, nonce: u64, sealed: &mut [u8]) -> Option<usize> {
        let opened = self.open.open_in_place(self.nonce(nonce), Aad::empty(), sealed);
        opened.ok().map(|plain| plain.len())
    }
}

/// Ciphers and hash of `ring`, the curve of `x25519-dalek`, and randomness from a seed.
struct SeededResolver(Zeroizing<[u8; 32]>);

impl CryptoResolver for SeededResolver {
    fn resolve_rng(&self) -> Option<Box<dyn Random>> {
        Some(Box::new(SeedGenerator::new(*self.0)))
    }

    fn resolve_dh(&self, choice: &DHChoice) -> Option<Box<dyn Dh>> {
        matches!(choice, DHChoice::Curve25519).then(|| Box::<X25519>::default() as Box<dyn Dh>)
    }

    fn resolve_hash(&self, choice: &HashChoice) -> Option<Box<dyn Hash>> {
        RingResolver.resolve_hash(choice)
    }

    fn resolve_cipher(&self, choice: &CipherChoice) -> Option<Box<dyn Cipher>> {
        RingResolver.resolve_cipher(choice)
    }
}

/// A key pair for snow; without keys until it is given some.
#[derive(Default)]
struct X25519 {
    secret: Option<StaticSecret>,
    public: [u8; PUBLIC_KEY],
}

impl Dh for X25519 {
    fn name(&self) -> &'static str {
        "25519"
    }

    fn pub_len(&self) -> usize {
        PUBLIC_KEY
    }

    fn priv_len(&self) -> usize {
        32
    }

    fn set(&mut self, secret: &[u8]) {
        let bytes: [u8; 32] = secret.try_into().expect("snow gives keys of `priv_len` bytes");
        let secret = StaticSecret::from(bytes);
        self.public = PublicKey::from(&secret).to_bytes();
        self.secret = Some(secret);
    }

    fn generate(&mut self, random: &mut dyn Random) -> Result<(), snow::Error> {
        let mut bytes = Zeroizing::new([0; 32]);
        random.try_fill_bytes(&mut *bytes)?;
        self.set(&*bytes);
        Ok(())
    }

    fn pubkey(&self) -> &[u8] {
        &self.public
    }

    fn privkey(&self) -> &[u8] {
        self.secret.as_ref().map_or(&[], |secret| secret.as_bytes())
    }

    fn dh(&self, public: &[u8], out: &mut [u8]) -> Result<(), snow::Error> {
        let public: &[u8; PUBLIC_KEY] = public.first_chunk().ok_or(snow::Error::Dh)?;
        let secret = self.secret.as_ref().ok_or(snow::Error::Dh)?;
        let shared = secret.diffie_hellman(&PublicKey::from(*public));
        // A public key of low order gives zeros whatever the secret is (RFC 7748, 6.1).
        if !shared.was_contributory() {
            return Err(snow::Error::Dh);
        }
        out[..32].copy_from_slice(shared.as_bytes());
        Ok(())
    }
}

/// Random numbers for keys and cookies, from one seed of the system's random source.
///
/// Each seed that it gives comes from HMAC under a state that is then replaced, so that the state
/// in memory does not give away earlier ones (fast key erasure: Bernstein 2017).
pub struct SeedGenerator(Zeroizing<[u8; 32]>);

impl SeedGenerator {
    /// The sequence that belongs to `seed`. Two machines never get the same seed.
    pub fn new(seed: [u8; 32]) -> Self {
        SeedGenerator(Zeroizing::new(seed))
    }

    /// The next seed.
    pub fn next_seed(&mut self) -> [u8; 32] {
        let key = MacKey::new(&*self.0);
        self.0 = Zeroizing::new(key.mac(&[b"next"]));
        key.mac(&[b"seed"])
    }
}

impl Random for SeedGenerator {
    fn try_fill_bytes(&mut self, out: &mut [u8]) -> Result<(), snow::Error> {
        for chunk in out.chunks_mut(32) {
            chunk.copy_from_slice(&self.next_seed()[..chunk.len()]);
        }
        Ok(())
    }
}

/// A key for HMAC-SHA-256 (RFC 2104).
#[derive(Clone)]
pub struct MacKey(hmac::Key);

impl MacKey {
    /// With these bytes.
    pub fn new(key: &[u8]) -> Self {
        MacKey(hmac::Key::new(hmac::HMAC_SHA256, key))
    }

    /// The code over these bytes, one piece behind the other.
    pub fn mac(&self, pieces: &[&[u8]]) -> [u8; 32] {
        let mut context = hmac::Context::with_key(&self.0);
        pieces.iter().for_each(|piece| context.update(piece));
        *context.sign().as_ref().first_chunk().expect("SHA-256 gives 32 bytes")
    }

    /// The code's first 8 bytes. HMAC may be truncated (RFC 2104, section 5).
    pub fn short_mac(&self, pieces: &[&[u8]]) -> [u8; 8] {
        *self.mac(pieces).first_chunk().expect("8 of 32 bytes")
    }

    /// Whether these are its first 8 bytes. It takes the same time for every wrong code.
    pub fn verify_short(&self, pieces: &[&[u8]], mac: &[u8]) -> bool {
        let right = self.short_mac(pieces);
        let differing =
            right.iter().zip(mac).fold(0, |bits, (ours, theirs)| black_box(bits | (ours ^ theirs)));
        mac.len() == right.len() && differing == 0
    }
}

/// Fills `out` by HKDF-SHA-256 (RFC 5869), for at most 255 times 32 bytes.
pub fn hkdf_sha256(salt: &[u8], secret: &[u8], info: &[u8], out: &mut [u8]) {
    struct Length(usize);
    impl hkdf::KeyType for Length {
        fn len(&self) -> usize {
            self.0
        }
    }
    let extracted = hkdf::Salt::new(hkdf::HKDF_SHA256, salt).extract(secret);
    let info = [info];
    let expanded = extracted.expand(&info, Length(out.len()));
    let filled = expanded.and_then(|material| material.fill(out));
    filled.expect("no more than 255 times 32 bytes are asked for");
}

/// A key from what a pair of nodes shares, for the use that the label names.
pub fn derived_key(secret: &[u8; 32], label: &str) -> Zeroizing<[u8; 32]> {
    let mut key = Zeroizing::new([0; 32]);
    hkdf_sha256(&[], secret, label.as_bytes(), &mut *key);
    key
}

/// Seals cookies for one peer, with ChaCha20-Poly1305.
pub struct CookieCipher(LessSafeKey);

impl CookieCipher {
    /// With this key.
    pub fn new(key: &[u8; 32]) -> Self {
        let key = UnboundKey::new(&aead::CHACHA20_POLY1305, key);
        CookieCipher(LessSafeKey::new(key.expect("ChaCha20-Poly1305 takes keys of 32 bytes")))
    }

    /// Seals a cookie in answer to the message with this code. The nonce is random.
    pub fn seal(&self, nonce: [u8; 12], mac: &[u8; 8], cookie: [u8; 16]) -> [u8; 32] {
        let mut sealed = [0; 32];
        let (text, tag) = sealed.split_at_mut(16);
        text.copy_from_slice(&cookie);
        let nonce = Nonce::assume_unique_for_key(nonce);
        let made = self.0.seal_in_place_separate_tag(nonce, Aad::from(mac), text);
        tag.copy_from_slice(made.expect("16 bytes can be sealed").as_ref());
        sealed
    }

    /// Opens what `seal` has sealed in answer to the message with this code.
    pub fn open(&self, nonce: [u8; 12], mac: &[u8; 8], mut sealed: [u8; 32]) -> Option<[u8; 16]> {
        let nonce = Nonce::assume_unique_for_key(nonce);
        let opened = self.0.open_in_place(nonce, Aad::from(mac), &mut sealed);
        opened.ok()?.first_chunk().copied()
    }
}

#[cfg(test)]
mod tests;
