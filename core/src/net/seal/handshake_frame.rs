//! The frames of a handshake.
//!
//! ```text
//! init    1011 0011 │ kind 8+suite │ my channel 3 │ from 4 │ to 4 │ Noise 60 │ mac 8          81
//! answer  1011 0011 │ kind 10      │ my channel 3 │ your channel 3 │ Noise 60 │ mac 8          76
//! prefer  1011 0011 │ kind 12      │ your channel 3 │ suite 1 │ mac 8                          14
//! knock   1011 0011 │ kind 13      │ from 4 │ to 4 │ nonce 8 │ zeros 55 │ mac 8                81
//!
//! payload within Noise: own incarnation 6 │ zeros 6
//! ```
//!
//! `mac` is the first 8 bytes of HMAC-SHA-256 under the pair's filter key over all bytes before it,
//! WireGuard's `mac1` (Donenfeld, NDSS 2017). Every answer is at most as long as what it answers,
//! so no address receives more than was sent from there.

use super::cipher::{CipherSuite, NOISE_MESSAGE, PAYLOAD};
use crate::Incarnation;
use crate::net::wire::WireError;
use crate::net::wire::node_id::NodeId;

/// The first byte: the magic number of frames, and version 3 of the protocol.
const FIRST: u8 = 0xb3;
const INIT: u8 = 8;
const ANSWER: u8 = 10;
const PREFER: u8 = 12;
const KNOCK: u8 = 13;

/// The longest frame of a handshake, in bytes.
pub(crate) const INIT_LENGTH: usize = 81;
const ANSWER_LENGTH: usize = 76;
const PREFER_LENGTH: usize = 14;
/// The code at the end of each frame.
const MAC_LENGTH: usize = 8;

/// Whether this is a frame of a handshake, by its first byte.
pub(crate) fn is_handshake(frame: &[u8]) -> bool {
    frame.first() == Some(&FIRST)
}

/// What a handshake says of its sender: the incarnation, which has no more than 48 bits.
pub(super) fn encode_payload(incarnation: Incarnation) -> [u8; PAYLOAD] {
    let mut bytes = [0; PAYLOAD];
    bytes[..6].copy_from_slice(&incarnation.0.to_be_bytes()[2..]);
    bytes
}

pub(super) fn decode_payload(bytes: &[u8; PAYLOAD]) -> Incarnation {
    Incarnation(bytes[..6].iter().fold(0, |number, byte| number << 8 | u64::from(*byte)))
}

/// A frame of a handshake. Codes are not checked yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum HandshakeFrame {
    Init(InitFrame),
    Answer(AnswerFrame),
    Prefer { channel: u32, suite: CipherSuite },
    Knock { from: NodeId, to: NodeId, nonce: u64 },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct InitFrame {
    pub(super) suite: CipherSuite,
    /// The number that frames to the initiator bear.
    pub(super) channel: u32,
    pub(super) from: NodeId,
    pub(super) to: NodeId,
    pub(super) noise: [u8; NOISE_MESSAGE],
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct AnswerFrame {
    /// The number that frames to the responder bear.
    pub(super) channel: u32,
    /// The number of the init that it answers.
    pub(super) answered: u32,
    pub(super) noise: [u8; NOISE_MESSAGE],
}

impl InitFrame {
    /// What is different in each handshake: the beginning of the ephemeral key.
    pub(super) fn ephemeral(&self) -> u64 {
        u64::from_be_bytes(*self.noise.first_chunk().expect("8 of 60 bytes"))
    }
}

impl HandshakeFrame {
    /// The frame's bytes, with the code that this function gives over what stands before it.
    pub(super) fn encode(&self, mac: impl FnOnce(&[u8]) -> [u8; MAC_LENGTH]) -> Vec<u8> {
        let mut out = Vec::with_capacity(INIT_LENGTH);
        out.push(FIRST);
        let number = |channel: u32| channel.to_be_bytes().into_iter().skip(1);
        match self {
            HandshakeFrame::Init(init) => {
                out.push(INIT + init.suite.number());
                out.extend(number(init.channel));
                out.extend(init.from.0.to_be_bytes());
                out.extend(init.to.0.to_be_bytes());
                out.extend(init.noise);
            }
            HandshakeFrame::Answer(answer) => {
                out.push(ANSWER);
                out.extend(number(answer.channel));
                out.extend(number(answer.answered));
                out.extend(answer.noise);
            }
            HandshakeFrame::Prefer { channel, suite } => {
                out.push(PREFER);
                out.extend(number(*channel));
                out.push(suite.number());
            }
            HandshakeFrame::Knock { from, to, nonce } => {
                out.push(KNOCK);
                out.extend(from.0.to_be_bytes());
                out.extend(to.0.to_be_bytes());
                out.extend(nonce.to_be_bytes());
                out.resize(INIT_LENGTH - MAC_LENGTH, 0);
            }
        }
        out.extend(mac(&out));
        out
    }

    /// Reads a frame.
    ///
    /// # Errors
    /// [`WireError`] for anything that `encode` does not write, whatever the code is.
    pub(super) fn decode(frame: &[u8]) -> Result<HandshakeFrame, WireError> {
        let (&first, rest) = frame.split_first().ok_or(WireError::Truncated)?;
        if first & 0xf0 != FIRST & 0xf0 {
            return Err(WireError::Foreign { first });
        }
        if first != FIRST {
            return Err(WireError::Version { theirs: first & 0x0f, ours: FIRST & 0x0f });
        }
        let (&kind, mut fields) = rest.split_first().ok_or(WireError::Truncated)?;
        let length = match kind {
            ANSWER => ANSWER_LENGTH,
            PREFER => PREFER_LENGTH,
            _ => INIT_LENGTH,
        };
        if frame.len() != length {
            return Err(WireError::Malformed { what: "the length of a handshake's frame" });
        }
        // The length is right, so no field is missing.
        let fields = &mut fields;
        Ok(match kind {
            ANSWER => HandshakeFrame::Answer(AnswerFrame {
                channel: channel(fields)?,
                answered: channel(fields)?,
                noise: array(fields)?,
            }),
            PREFER => HandshakeFrame::Prefer {
                channel: channel(fields)?,
                suite: suite(array::<1>(fields)?[0])?,
            },
            KNOCK => HandshakeFrame::Knock {
                from: NodeId(u32::from_be_bytes(array(fields)?)),
                to: NodeId(u32::from_be_bytes(array(fields)?)),
                nonce: u64::from_be_bytes(array(fields)?),
            },
            _ => HandshakeFrame::Init(InitFrame {
                suite: suite(kind.wrapping_sub(INIT))?,
                channel: channel(fields)?,
                from: NodeId(u32::from_be_bytes(array(fields)?)),
                to: NodeId(u32::from_be_bytes(array(fields)?)),
                noise: array(fields)?,
            }),
        })
    }
}

fn array<const N: usize>(fields: &mut &[u8]) -> Result<[u8; N], WireError> {
    let (field, rest) = fields.split_first_chunk().ok_or(WireError::Truncated)?;
    *fields = rest;
    Ok(*field)
}

fn channel(fields: &mut &[u8]) -> Result<u32, WireError> {
    let [a, b, c] = array(fields)?;
    Ok(u32::from_be_bytes([0, a, b, c]))
}

fn suite(number: u8) -> Result<CipherSuite, WireError> {
    CipherSuite::of(number).ok_or(WireError::Malformed { what: "the kind of a handshake's frame" })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all() -> [(HandshakeFrame, usize); 5] {
        let init = |suite| {
            let (from, to) = (NodeId(0x0102_0304), NodeId(0x0506_0708));
            InitFrame { suite, channel: 0x12_3456, from, to, noise: [0xee; 60] }
        };
        let answer = AnswerFrame { channel: 1, answered: 0xff_ffff, noise: [0xaa; 60] };
        let (channel, suite) = (9, CipherSuite::ChaChaPoly);
        [
            (HandshakeFrame::Init(init(CipherSuite::AesGcm)), 81),
            (HandshakeFrame::Init(init(CipherSuite::ChaChaPoly)), 81),
            (HandshakeFrame::Answer(answer), 76),
            (HandshakeFrame::Prefer { channel, suite }, 14),
            (HandshakeFrame::Knock { from: NodeId(1), to: NodeId(2), nonce: 3 }, 81),
        ]
    }

    #[test]
    fn frames_read_as_they_were_written_and_no_other_length_reads() {
        for (frame, length) in all() {
            let bytes = frame.encode(|_| [1; 8]);
            assert_eq!(bytes.len(), length);
            assert_eq!(HandshakeFrame::decode(&bytes), Ok(frame));
            for length in 0..length {
                assert!(HandshakeFrame::decode(&bytes[..length]).is_err());
            }
            assert!(HandshakeFrame::decode(&[&bytes[..], &[0]].concat()).is_err());
        }
    }

    #[test]
    fn the_code_is_the_end_of_each_frame_and_covers_all_before_it() {
        for (frame, length) in all() {
            let mut covered = Vec::new();
            let mac = |bytes: &[u8]| {
                covered = bytes.to_vec();
                [1; 8]
            };
            let bytes = frame.encode(mac);
            assert_eq!(bytes.split_at(length - 8), (&covered[..], &[1; 8][..]));
        }
    }

    #[test]
    fn other_protocols_versions_and_kinds_are_refused() {
        let refused = |first: u8, kind: u8| {
            let mut bytes = vec![0; INIT_LENGTH];
            (bytes[0], bytes[1]) = (first, kind);
            HandshakeFrame::decode(&bytes).unwrap_err()
        };
        assert_eq!(refused(0x42, 8), WireError::Foreign { first: 0x42 });
        assert_eq!(refused(0xb1, 8), WireError::Version { theirs: 1, ours: 3 });
        for kind in [0, 7, 11, 14, 255] {
            assert!(matches!(refused(0xb3, kind), WireError::Malformed { .. }), "{kind}");
        }
    }

    #[test]
    fn a_payload_reads_as_it_was_written() {
        let incarnation = Incarnation(0x0102_0304_0506);
        let payload = encode_payload(incarnation);
        assert_eq!(payload, [1, 2, 3, 4, 5, 6, 0, 0, 0, 0, 0, 0]);
        assert_eq!(decode_payload(&payload), incarnation);
    }
}
