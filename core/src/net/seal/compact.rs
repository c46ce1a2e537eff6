//! Tags without encryption, for cables with small frames such as CAN.
//!
//! The tag is HMAC-SHA-256 over the nonce and the frame, of which the first 8 bytes are sent. HMAC
//! is a pseudorandom function, so a truncated code is as hard to guess as its length says. Tags of
//! GCM and Poly1305 must not be truncated: a forged one is then more likely than its length says,
//! and with GCM the first success gives the key away (NIST SP 800-38D, appendix C).
//!
//! Every node on the medium can read these frames.

use super::cipher::{ChannelKeys, FrameCipher};
use super::noise::MacKey;
use bytes::BytesMut;

/// The bytes of a tag.
const TAG: usize = 8;

/// Authenticates frames by truncated codes.
#[derive(Debug)]
pub(super) struct CompactCipher {
    seal: MacKey,
    open: MacKey,
}

impl CompactCipher {
    /// With these keys, which seal nothing else: the prologue of a compact channel's handshake is
    /// its own.
    pub(super) fn new(keys: &ChannelKeys) -> Self {
        CompactCipher { seal: MacKey::new(&keys.seal), open: MacKey::new(&keys.open) }
    }
}

impl FrameCipher for CompactCipher {
    fn seal(&mut self, nonce: u64, frame: &mut BytesMut, from: usize) {
        let tag = self.seal.short_mac(&[&nonce.to_be_bytes(), &frame[from..]]);
        frame.extend_from_slice(&tag);
    }

    fn open(&mut self, nonce: u64, sealed: &mut [u8]) -> Option<usize> {
        let (frame, tag) = sealed.split_last_chunk::<TAG>()?;
        let genuine = self.open.verify_short(&[&nonce.to_be_bytes(), frame], tag);
        genuine.then_some(frame.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tag_holds_for_its_nonce_and_its_frame_only() {
        let keys = ChannelKeys { seal: [7; 32], open: [7; 32] };
        let mut cipher = CompactCipher::new(&keys);
        let mut frame = BytesMut::from("head, text");
        cipher.seal(3, &mut frame, 6);
        // HMAC-SHA-256 under 32 times 07 over 0000000000000003 and "text", by Python's `hmac`.
        let tag = [0xbd, 0x0f, 0xeb, 0x90, 0xd7, 0x2e, 0x3b, 0x9f];
        assert_eq!(frame, [&b"head, text"[..], &tag].concat());

        assert_eq!(cipher.open(3, &mut frame[6..].to_vec()), Some(4));
        assert_eq!(cipher.open(4, &mut frame[6..].to_vec()), None);
        for bit in 0..12 * 8 {
            let mut changed = frame[6..].to_vec();
            changed[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(cipher.open(3, &mut changed), None);
        }
        for length in 0..12 {
            assert_eq!(cipher.open(3, &mut frame[6..6 + length].to_vec()), None);
        }
    }
}
