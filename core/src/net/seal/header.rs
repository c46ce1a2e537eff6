//! The header of a sealed frame.
//!
//! ```text
//! full:      0        1            4             8
//! ┌─────────┬───────────┬────────────┬─────────────────────┬────────┐
//! │1101 ff ll│ channel 3 │ counter 4  │ encrypted frame      │ tag 16 │
//! └─────────┴───────────┴────────────┴─────────────────────┴────────┘
//! compact:   0        1            2             4
//! ┌─────────┬───────────┬────────────┬─────────────────────┬────────┐
//! │1101 ff ll│ channel 1 │ counter 2  │ frame, not encrypted │ tag 8  │
//! └─────────┴───────────┴────────────┴─────────────────────┴────────┘
//!   ff  format: 0 AES-256-GCM, 1 ChaCha20-Poly1305, 2 compact
//!   ll  lane: 0 hello, 1 urgent, 2 usual
//! ```
//!
//! The receiver of a channel's frames chooses the channel's number. The counter is the low part of
//! a number of 62 bits. The nonce is the lane, in the two highest of 64 bits, and that number.
//! There is no associated data: the channel's number chooses the keys, the format is a fact of the
//! channel, and lane and counter are the nonce.

use super::cipher::CipherSuite;
use crate::medium::lane::FrameLane;
use bytes::{BufMut, BytesMut};

/// The high half of the first byte of a sealed frame.
const SEALED: u8 = 0b1101_0000;
/// Counters end below this: the two bits above are the lane's.
pub(super) const COUNTER_END: u64 = 1 << 62;

/// How the frames of a network are protected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SealProfile {
    /// Encrypted and authenticated: 24 bytes more.
    Full,
    /// Authenticated and readable, for cables with small frames: 12 bytes more.
    Compact,
}

impl SealProfile {
    /// The bytes before the frame.
    pub(super) const fn header_length(self) -> usize {
        match self {
            SealProfile::Full => 8,
            SealProfile::Compact => 4,
        }
    }

    /// The bytes that a seal adds to a frame.
    pub const fn overhead(self) -> usize {
        match self {
            SealProfile::Full => 8 + 16,
            SealProfile::Compact => 4 + 8,
        }
    }

    /// How many bits of the counter travel.
    pub(super) const fn counter_bits(self) -> u32 {
        match self {
            SealProfile::Full => 32,
            SealProfile::Compact => 16,
        }
    }

    /// Channels have numbers below this.
    pub(super) const fn channels(self) -> u64 {
        match self {
            SealProfile::Full => 1 << 24,
            SealProfile::Compact => 1 << 8,
        }
    }
}

/// Each lane has counters of its own, since frames of one overtake those of another on their way to
/// the medium.
impl FrameLane {
    pub(super) const fn number(self) -> usize {
        self as usize
    }

    /// The nonce of the frame with this counter.
    pub(super) const fn nonce(self, counter: u64) -> u64 {
        (self as u64) << 62 | counter
    }
}

/// What stands before the sealed bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct SealHeader {
    pub(super) profile: SealProfile,
    /// The AEAD of the full profile.
    pub(super) suite: Option<CipherSuite>,
    pub(super) lane: FrameLane,
    pub(super) channel: u32,
    /// The low bits of the counter.
    pub(super) counter: u32,
}

impl SealHeader {
    /// Whether a frame that begins with this byte is sealed.
    pub(super) fn begins_with(first: u8) -> bool {
        first & 0xf0 == SEALED
    }

    pub(super) fn encode(&self, out: &mut BytesMut) {
        let format = self.suite.map_or(2, CipherSuite::number);
        out.put_u8(SEALED | format << 2 | self.lane as u8);
        match self.profile {
            SealProfile::Full => {
                out.put_slice(&self.channel.to_be_bytes()[1..]);
                out.put_u32(self.counter);
            }
            SealProfile::Compact => {
                out.put_u8(self.channel as u8);
                out.put_u16(self.counter as u16);
            }
        }
    }

    /// Reads the header of a frame; `None` for anything that `encode` does not write.
    pub(super) fn decode(frame: &[u8]) -> Option<SealHeader> {
        let first = *frame.first().filter(|first| Self::begins_with(**first))?;
        let lane = *FrameLane::ALL.get(usize::from(first & 3))?;
        let format = first >> 2 & 3;
        Some(match CipherSuite::of(format) {
            Some(suite) => {
                let [_, channel @ .., a, b, c, d] = *frame.first_chunk::<8>()?;
                let channel = u32::from_be_bytes([0, channel[0], channel[1], channel[2]]);
                let counter = u32::from_be_bytes([a, b, c, d]);
                let (profile, suite) = (SealProfile::Full, Some(suite));
                SealHeader { profile, suite, lane, channel, counter }
            }
            None if format == 2 => {
                let [_, channel, a, b] = *frame.first_chunk::<4>()?;
                let counter = u16::from_be_bytes([a, b]).into();
                let (profile, suite) = (SealProfile::Compact, None);
                SealHeader { profile, suite, lane, channel: channel.into(), counter }
            }
            None => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_reads_as_it_was_written_and_no_cut_one_reads_at_all() {
        use SealProfile::{Compact, Full};
        let check = |profile, suite, lane, channel, counter, expected: &[u8]| {
            let header = SealHeader { profile, suite, lane, channel, counter };
            let mut bytes = BytesMut::new();
            header.encode(&mut bytes);
            assert_eq!(bytes, expected);
            assert_eq!(SealHeader::decode(&bytes), Some(header));
            for length in 0..bytes.len() {
                assert_eq!(SealHeader::decode(&bytes[..length]), None);
            }
        };
        let (aes, chacha) = (Some(CipherSuite::AesGcm), Some(CipherSuite::ChaChaPoly));

        check(Full, aes, FrameLane::Hello, 0x12_3456, 7, &[0xd0, 0x12, 0x34, 0x56, 0, 0, 0, 7]);
        check(Full, chacha, FrameLane::Usual, 1, u32::MAX, &[0xd6, 0, 0, 1, 255, 255, 255, 255]);
        check(Compact, None, FrameLane::Urgent, 0xab, 0x1234, &[0xd9, 0xab, 0x12, 0x34]);
        for first in [0xd3, 0xd7, 0xdb, 0xdc, 0xb2, 0x00] {
            assert_eq!(SealHeader::decode(&[first, 0, 0, 0, 0, 0, 0, 0, 0]), None, "{first:#x}");
        }
    }
}
