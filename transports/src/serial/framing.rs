//! Frames on a line that may lose, change and invent bytes: a pure machine, given bytes from
//! outside.
//!
//! ```text
//! 0 │ COBS of: frame … CRC-32C │ 0        the checksum is little-endian
//! ```
//!
//! COBS (Cheshire and Baker, 1999) takes every zero out of a frame, so that a zero is nothing but
//! an end: after any garbage, the next zero is where understanding begins again. There is one
//! before each frame too, so that garbage ends before the frame and takes nothing of it along.
//! CRC-32C finds every change of up to five bits in the frames of a slow line (up to 655 bytes;
//! Koopman 2002).

use bytes::Bytes;
use crc::{CRC_32_ISCSI, Crc};

static CHECK: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);
/// How long the checksum is, in bytes.
const CHECK_LENGTH: usize = 4;

/// How many bytes a frame of this length takes on the line at most.
pub fn encoded_length(length: usize) -> usize {
    // Two zeros around it.
    2 + cobs::max_encoding_length(length + CHECK_LENGTH)
}

/// Writes a frame as it goes onto the line, in place of what was in `out`.
pub fn encode(frame: &[u8], out: &mut Vec<u8>) {
    out.clear();
    out.resize(encoded_length(frame.len()), 0);
    let mut encoder = cobs::CobsEncoder::new(&mut out[1..]);
    let check = CHECK.checksum(frame).to_le_bytes();
    for part in [frame, &check] {
        encoder.push(part).expect("the longest encoding has room");
    }
    let length = 1 + encoder.finalize();
    out.truncate(length);
    out.push(0);
}

/// Something came that is no frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("noise on the line")]
pub struct InvalidFrame;

/// Finds frames in what comes from a line.
///
/// It holds no more than the longest frame takes on the line, whatever comes.
///
/// ```
/// use blastema_transports::serial::framing::{Deframer, InvalidFrame, encode};
///
/// let mut line = b"garbage".to_vec();
/// let mut sent = Vec::new();
/// encode(b"hello", &mut sent);
/// line.extend(&sent);
///
/// let (mut deframer, mut rest) = (Deframer::new(100), &line[..]);
/// assert_eq!(deframer.push(&mut rest), Some(Err(InvalidFrame)));
/// assert_eq!(deframer.push(&mut rest), Some(Ok("hello".into())));
/// assert_eq!(deframer.push(&mut rest), None);
/// ```
#[derive(Clone, Debug)]
pub struct Deframer {
    /// What has come since the last zero.
    held: Vec<u8>,
    limit: usize,
    /// More has come than a frame can have: nothing counts before the next zero.
    lost: bool,
}

impl Deframer {
    /// For frames of at most `mtu` bytes.
    pub fn new(mtu: usize) -> Self {
        Deframer { held: Vec::new(), limit: encoded_length(mtu) - 2, lost: false }
    }

    /// Takes bytes from the front of `input` up to the end of a frame or of noise, and says which
    /// it was; `None` when more must come first.
    pub fn push(&mut self, input: &mut &[u8]) -> Option<Result<Bytes, InvalidFrame>> {
        while let Some(end) = input.iter().position(|&byte| byte == 0) {
            self.hold(&input[..end]);
            *input = &input[end + 1..];
            let lost = std::mem::take(&mut self.lost);
            if lost || !self.held.is_empty() {
                let found = if lost { None } else { self.decode() };
                self.held.clear();
                return Some(found.ok_or(InvalidFrame));
            }
        }
        self.hold(input);
        *input = &[];
        None
    }

    fn hold(&mut self, bytes: &[u8]) {
        if self.lost || self.held.len() + bytes.len() > self.limit {
            self.lost = true;
            self.held.clear();
        } else {
            self.held.extend_from_slice(bytes);
        }
    }

    fn decode(&mut self) -> Option<Bytes> {
        let length = cobs::decode_in_place(&mut self.held).ok()?;
        let (frame, check) = self.held.get(..length)?.split_last_chunk::<CHECK_LENGTH>()?;
        (CHECK.checksum(frame).to_le_bytes() == *check).then(|| Bytes::copy_from_slice(frame))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_core::random::Random;

    fn line(frames: &[Bytes]) -> Vec<u8> {
        let mut out = Vec::new();
        frames
            .iter()
            .flat_map(|frame| {
                encode(frame, &mut out);
                assert!(out.len() <= encoded_length(frame.len()));
                out.clone()
            })
            .collect()
    }

    fn read(deframer: &mut Deframer, mut bytes: &[u8]) -> Vec<Result<Bytes, InvalidFrame>> {
        std::iter::from_fn(|| deframer.push(&mut bytes)).collect()
    }

    fn some_frames() -> Vec<Bytes> {
        [0, 1, 4, 253, 254, 255, 300, 0, 1000]
            .map(|length| (0..length).map(|i| (i % 7) as u8).collect::<Bytes>())
            .into()
    }

    #[test]
    fn the_wire_format_is_this() {
        let mut out = Vec::new();
        encode(b"1\x002", &mut out);
        let [a, b, c, d] = CHECK.checksum(b"1\x002").to_le_bytes();
        assert_eq!(out, [0, 2, b'1', 6, b'2', a, b, c, d, 0]);
        // The check value of CRC-32C in RFC 3720 and the catalogue.
        assert_eq!(CHECK.checksum(b"123456789"), 0xE306_9283);
    }

    #[test]
    fn frames_come_out_as_they_went_in_however_the_line_is_cut() {
        let frames = some_frames();
        let bytes = line(&frames);

        for piece in [1, 2, 3, 5, 64, 999, bytes.len()] {
            let mut deframer = Deframer::new(1000);
            let read: Vec<_> =
                bytes.chunks(piece).flat_map(|piece| read(&mut deframer, piece)).collect();
            assert_eq!(read, frames.iter().cloned().map(Ok).collect::<Vec<_>>(), "by {piece}");
        }
    }

    #[test]
    fn garbage_between_frames_takes_none_of_them_along() {
        let frames = some_frames();
        for seed in 0..500 {
            let mut random = Random::new(seed);
            let mut bytes = Vec::new();
            for frame in &frames {
                // No zero at its end is needed: the frame brings one.
                bytes.extend((0..random.next() % 3000).map(|_| random.next() as u8));
                bytes.extend(line(std::slice::from_ref(frame)));
            }

            let mut deframer = Deframer::new(1000);
            let read = read(&mut deframer, &bytes).into_iter().filter_map(Result::ok);

            assert_eq!(read.collect::<Vec<_>>(), frames, "seed {seed}");
        }
    }

    #[test]
    fn a_changed_lost_or_invented_byte_costs_one_frame_or_two_and_never_makes_another() {
        let frames: Vec<Bytes> = (0..20_u8).map(|n| Bytes::from(vec![n; 40])).collect();
        for seed in 0..2000 {
            let mut random = Random::new(seed);
            let mut bytes = line(&frames);
            let place = random.next() as usize % bytes.len();
            match random.next() % 3 {
                0 => bytes[place] ^= 1 << (random.next() % 8),
                1 => drop(bytes.remove(place)),
                _ => bytes.insert(place, random.next() as u8),
            }

            let mut deframer = Deframer::new(1000);
            let read: Vec<_> =
                read(&mut deframer, &bytes).into_iter().filter_map(Result::ok).collect();

            assert!(read.len() >= 18, "seed {seed}: {} frames are left", read.len());
            assert!(read.iter().all(|frame| frames.contains(frame)), "seed {seed}");
        }
    }

    #[test]
    fn what_is_held_is_bounded_and_a_frame_that_is_too_long_is_noise() {
        let mut deframer = Deframer::new(100);

        for _ in 0..1000 {
            assert_eq!(read(&mut deframer, &[7; 999]), []);
            assert!(deframer.held.capacity() <= 4 * encoded_length(100));
        }
        let long_and_short = line(&[vec![1; 101].into(), vec![1; 100].into()]);
        let expected = [Err(InvalidFrame), Err(InvalidFrame), Ok(Bytes::from(vec![1; 100]))];
        assert_eq!(read(&mut deframer, &long_and_short), expected);
    }
}
