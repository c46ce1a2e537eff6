//! Seeds, the keys that follow from them, and signatures by Ed25519 (RFC 8032). The only file here
//! that knows a cryptographic library.

use crate::net::seal::NoiseCrypto;
use crate::net::seal::noise::derived_key;
use ring::digest;
use ring::signature::{ED25519, Ed25519KeyPair, KeyPair, UnparsedPublicKey};
use std::fmt;
use zeroize::{Zeroize, ZeroizeOnDrop, Zeroizing};

/// Length of a seed and of a public key, in bytes.
pub const KEY_BYTES: usize = 32;
/// Length of a signature, in bytes.
pub const SIGNATURE_BYTES: usize = 64;
/// So many bytes of a hash are enough for a person to tell keys apart.
const FINGERPRINT_BYTES: usize = 8;

/// A secret of which all keys of one node, or of one robot's signer, are derived. Wiped when it is
/// dropped, and never printed.
#[derive(Clone, PartialEq, Eq, Zeroize, ZeroizeOnDrop)]
pub struct Seed([u8; KEY_BYTES]);

impl fmt::Debug for Seed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Seed(..)")
    }
}

impl Seed {
    /// A seed of these bytes, which the system's random source has made.
    pub fn new(random: [u8; KEY_BYTES]) -> Self {
        Seed(random)
    }

    pub(super) fn bytes(&self) -> &[u8; KEY_BYTES] {
        &self.0
    }

    /// The cryptography of the handshakes of the node that has this seed.
    pub fn handshakes(&self) -> NoiseCrypto {
        NoiseCrypto::new(*self.derive("x25519"))
    }

    /// The public keys of the node that has this seed.
    pub fn public_keys(&self) -> PublicKeys {
        PublicKeys {
            x25519: PublicKey(self.handshakes().public_key()),
            ed25519: public_key(&key_pair(&self.derive("ed25519"))),
        }
    }

    /// What signs the advertisements of the node that has this seed.
    pub fn advertisement_signer(&self) -> AdvertisementSigner {
        AdvertisementSigner(key_pair(&self.derive("ed25519")))
    }

    /// The public key of the robot that has this seed: it checks rosters.
    pub fn signer(&self) -> PublicKey {
        public_key(&key_pair(&self.derive("roster")))
    }

    /// Signs the text of a roster.
    pub(super) fn sign_roster(&self, text: &[u8]) -> [u8; SIGNATURE_BYTES] {
        signature(&key_pair(&self.derive("roster")), text)
    }

    /// The key for one use, whose label keeps it apart from the others.
    fn derive(&self, label: &str) -> Zeroizing<[u8; KEY_BYTES]> {
        derived_key(&self.0, label)
    }
}

/// The key by which a node signs its advertisements.
pub struct AdvertisementSigner(Ed25519KeyPair);

impl AdvertisementSigner {
    /// Signs: some 20 µs.
    pub fn sign(&self, message: &[u8]) -> [u8; SIGNATURE_BYTES] {
        signature(&self.0, message)
    }

    /// The key that checks it.
    pub fn public_key(&self) -> PublicKey {
        public_key(&self.0)
    }
}

impl fmt::Debug for AdvertisementSigner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "AdvertisementSigner({})", public_key(&self.0))
    }
}

fn key_pair(secret: &[u8; KEY_BYTES]) -> Ed25519KeyPair {
    Ed25519KeyPair::from_seed_unchecked(secret).expect("a secret has 32 bytes")
}

fn public_key(pair: &Ed25519KeyPair) -> PublicKey {
    PublicKey(pair.public_key().as_ref().try_into().expect("a public key has 32 bytes"))
}

fn signature(pair: &Ed25519KeyPair, message: &[u8]) -> [u8; SIGNATURE_BYTES] {
    pair.sign(message).as_ref().try_into().expect("a signature has 64 bytes")
}

/// A public key, of Ed25519 or X25519.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PublicKey(pub(super) [u8; KEY_BYTES]);

impl fmt::Debug for PublicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl PublicKey {
    /// Returns the key's bytes.
    pub fn bytes(&self) -> &[u8; KEY_BYTES] {
        &self.0
    }

    /// Whether this Ed25519 key has signed the message: some 50 µs.
    pub(crate) fn has_signed(&self, message: &[u8], signature: &[u8]) -> bool {
        UnparsedPublicKey::new(&ED25519, &self.0).verify(message, signature).is_ok()
    }

    /// The fingerprint of this key alone.
    pub fn fingerprint(&self) -> Fingerprint {
        Fingerprint::of(&self.0)
    }
}

/// The public keys of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PublicKeys {
    /// The X25519 key, for handshakes.
    pub x25519: PublicKey,
    /// Checks what the node has signed.
    pub ed25519: PublicKey,
}

impl PublicKeys {
    /// The fingerprint of both.
    pub fn fingerprint(&self) -> Fingerprint {
        Fingerprint::of(&[self.x25519.0, self.ed25519.0].concat())
    }
}

/// The first bytes of the SHA-256 hash of public keys, for people: `9f:3c:…`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fingerprint([u8; FINGERPRINT_BYTES]);

impl Fingerprint {
    fn of(keys: &[u8]) -> Self {
        let hash = digest::digest(&digest::SHA256, keys);
        let (first, _) = hash.as_ref().split_first_chunk().expect("a hash has 32 bytes");
        Fingerprint(*first)
    }
}

impl fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (place, byte) in self.0.iter().enumerate() {
            let colon = if place == 0 { "" } else { ":" };
            write!(f, "{colon}{byte:02x}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hex(text: &str) -> Vec<u8> {
        let digits: Vec<u32> = text.chars().filter_map(|digit| digit.to_digit(16)).collect();
        digits.chunks(2).map(|pair| (pair[0] * 16 + pair[1]) as u8).collect()
    }

    #[test]
    fn signatures_are_those_of_rfc_8032() {
        // Section 7.1, tests 1 and 2.
        for (secret, public, message, signature) in [
            (
                "9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60",
                "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
                "",
                "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e065224901555fb8821590a33bac\
                 c61e39701cf9b46bd25bf5f0595bbe24655141438e7a100b",
            ),
            (
                "4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb",
                "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c",
                "72",
                "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da085ac1e43e15996e\
                 458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00",
            ),
        ] {
            let (secret, message) = (hex(secret).try_into().unwrap(), hex(message));
            let key = public_key(&key_pair(&secret));

            assert_eq!(key.0.as_slice(), hex(public));
            assert_eq!(super::signature(&key_pair(&secret), &message).as_slice(), hex(signature));
            assert!(key.has_signed(&message, &hex(signature)));
            assert!(!key.has_signed(b"another", &hex(signature)));
        }
    }

    #[test]
    fn the_uses_of_a_seed_share_no_key_and_it_is_never_printed() {
        let seed = Seed::new([7; KEY_BYTES]);
        let PublicKeys { x25519, ed25519 } = seed.public_keys();

        assert!(x25519 != ed25519 && ed25519 != seed.signer());
        assert_eq!(format!("{seed:?}"), "Seed(..)");
        assert_eq!(seed.signer().fingerprint().to_string().len(), 3 * FINGERPRINT_BYTES - 1);
    }
}
