//! The frames of a handshake.
//!
//! ```text
//! init    1011 0010 │ kind 8+suite │ my channel 3 │ from 4 │ to 4 │ Noise 60 │ mac1 8 │ mac2 8           89
//! answer  1011 0010 │ kind 10      │ my channel 3 │ your channel 3 │ Noise 60 │ mac1 8                  76
//! cookie  1011 0010 │ kind 11      │ your channel 3 │ nonce 12 │ cookie 16 + tag 16                     49
//! prefer  1011 0010 │ kind 12      │ your channel 3 │ suite 1 │ mac1 8                                  14
//! knock   1011 0010 │ kind 13      │ from 4 │ to 4 │ nonce 8 │ mac1 8 │ zeros 63                        89
//!
//! payload within Noise: own incarnation 6 │ zeros 6
//! ```
//!
//! `mac1` is the first 8 bytes of HMAC-SHA-256 under the pair's filter key over all bytes before
//! it; `mac2` those under a cookie. The names are WireGuard's (Donenfeld, NDSS 2017). Every answer
//! is at most as long as what it answers, so no address receives more than was sent from there.

use super::cipher::{CipherSuite, NOISE_MESSAGE, PAYLOAD};
use crate::Incarnation;
use crate::net::wire::WireError;
use crate::net::wire::node_id::NodeId;

/// The first byte: the magic number of frames, and version 2 of the protocol.
const FIRST: u8 = 0xb2;
const INIT: u8 = 8;
const ANSWER: u8 = 10;
const COOKIE: u8 = 11;
const PREFER: u8 = 12;
const KNOCK: u8 = 13;

/// The longest frame of a handshake, in bytes.
pub(crate) const INIT_LENGTH: usize = 89;
const ANSWER_LENGTH: usize = 76;
const COOKIE_LENGTH: usize = 49;
const PREFER_LENGTH: usize = 14;
/// How much of an init `mac1` covers, and how much `mac2` does.
pub(super) const INIT_MAC1: usize = 73;
const INIT_MAC2: usize = 81;
const KNOCK_MAC1: usize = 18;

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
    Cookie(CookieFrame),
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

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CookieFrame {
    pub(super) answered: u32,
    pub(super) nonce: [u8; 12],
    pub(super) sealed: [u8; 32],
}

impl InitFrame {
    /// What is different in each handshake: the beginning of the ephemeral key.
    pub(super) fn ephemeral(&self) -> u64 {
        u64::from_be_bytes(*self.noise.first_chunk().expect("8 of 60 bytes"))
    }
}

impl HandshakeFrame {
    /// The frame's bytes with the codes that these functions give over what stands before them: the
    /// first under the pair's filter key, the second, for an init, under a cookie.
    pub(super) fn encode(
        &self,
        mac1: impl FnOnce(&[u8]) -> [u8; 8],
        mac2: impl FnOnce(&[u8]) -> [u8; 8],
    ) -> Vec<u8> {
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
                out.extend(mac1(&out));
                out.extend(mac2(&out));
            }
            HandshakeFrame::Answer(answer) => {
                out.push(ANSWER);
                out.extend(number(answer.channel));
                out.extend(number(answer.answered));
                out.extend(answer.noise);
                out.extend(mac1(&out));
            }
            HandshakeFrame::Cookie(cookie) => {
                out.push(COOKIE);
                out.extend(number(cookie.answered));
                out.extend(cookie.nonce);
                out.extend(cookie.sealed);
            }
            HandshakeFrame::Prefer { channel, suite } => {
                out.push(PREFER);
                out.extend(number(*channel));
                out.push(suite.number());
                out.extend(mac1(&out));
            }
            HandshakeFrame::Knock { from, to, nonce } => {
                out.push(KNOCK);
                out.extend(from.0.to_be_bytes());
                out.extend(to.0.to_be_bytes());
                out.extend(nonce.to_be_bytes());
                out.extend(mac1(&out));
                out.resize(INIT_LENGTH, 0);
            }
        }
        out
    }

    /// Reads a frame.
    ///
    /// # Errors
    /// [`WireError`] for anything that `encode` does not write, whatever the codes are.
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
            COOKIE => COOKIE_LENGTH,
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
            COOKIE => HandshakeFrame::Cookie(CookieFrame {
                answered: channel(fields)?,
                nonce: array(fields)?,
                sealed: array(fields)?,
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

    /// What `mac1` covers of this frame's bytes, and the code.
    pub(super) fn mac1<'a>(&self, frame: &'a [u8]) -> (&'a [u8], &'a [u8]) {
        match self {
            HandshakeFrame::Init(_) => (&frame[..INIT_MAC1], &frame[INIT_MAC1..INIT_MAC2]),
            HandshakeFrame::Knock { .. } => {
                (&frame[..KNOCK_MAC1], &frame[KNOCK_MAC1..KNOCK_MAC1 + 8])
            }
            _ => frame.split_at(frame.len() - 8),
        }
    }
}

/// What `mac2` covers of an init's bytes, and the code.
pub(super) fn mac2(init: &[u8]) -> (&[u8], &[u8]) {
    init.split_at(INIT_MAC2)
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

    fn all() -> [(HandshakeFrame, usize); 6] {
        let init = |suite| {
            let (from, to) = (NodeId(0x0102_0304), NodeId(0x0506_0708));
            InitFrame { suite, channel: 0x12_3456, from, to, noise: [0xee; 60] }
        };
        let answer = AnswerFrame { channel: 1, answered: 0xff_ffff, noise: [0xaa; 60] };
        let cookie = CookieFrame { answered: 5, nonce: [6; 12], sealed: [7; 32] };
        let (channel, suite) = (9, CipherSuite::ChaChaPoly);
        [
            (HandshakeFrame::Init(init(CipherSuite::AesGcm)), 89),
            (HandshakeFrame::Init(init(CipherSuite::ChaChaPoly)), 89),
            (HandshakeFrame::Answer(answer), 76),
            (HandshakeFrame::Cookie(cookie), 49),
            (HandshakeFrame::Prefer { channel, suite }, 14),
            (HandshakeFrame::Knock { from: NodeId(1), to: NodeId(2), nonce: 3 }, 89),
        ]
    }

    #[test]
    fn frames_read_as_they_were_written_and_no_other_length_reads() {
        for (frame, length) in all() {
            let bytes = frame.encode(|_| [1; 8], |_| [2; 8]);
            assert_eq!(bytes.len(), length);
            assert_eq!(HandshakeFrame::decode(&bytes), Ok(frame));
            for length in 0..length {
                assert!(HandshakeFrame::decode(&bytes[..length]).is_err());
            }
            assert!(HandshakeFrame::decode(&[&bytes[..], &[0]].concat()).is_err());
        }
    }

    #[test]
    fn codes_stand_where_their_receiver_looks_for_them_and_cover_all_before_them() {
        for (frame, _) in all() {
            let (mut covered1, mut covered2) = (Vec::new(), Vec::new());
            let mac1 = |bytes: &[u8]| {
                covered1 = bytes.to_vec();
                [1; 8]
            };
            let mac2_of = |bytes: &[u8]| {
                covered2 = bytes.to_vec();
                [2; 8]
            };
            let bytes = frame.encode(mac1, mac2_of);
            if !matches!(frame, HandshakeFrame::Cookie(_)) {
                assert_eq!(frame.mac1(&bytes), (&covered1[..], &[1; 8][..]));
            }
            if matches!(frame, HandshakeFrame::Init(_)) {
                assert_eq!(mac2(&bytes), (&covered2[..], &[2; 8][..]));
            }
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
        assert_eq!(refused(0xb1, 8), WireError::Version { theirs: 1, ours: 2 });
        for kind in [0, 7, 14, 255] {
            assert!(matches!(refused(0xb2, kind), WireError::Malformed { .. }), "{kind}");
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
