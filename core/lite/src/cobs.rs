//! Consistent overhead byte stuffing (Cheshire and Baker, SIGCOMM 1997): packets on a byte stream.
//!
//! A zero byte ends each frame and stands nowhere else in it. A packet is shorter than 254 bytes,
//! so a frame has one code byte before the packet and the delimiter behind it.

use crate::packet::PACKET_MAX;

/// The longest frame: a packet, one code byte, the delimiter.
pub const FRAME_MAX: usize = PACKET_MAX + 2;

/// Writes the frame of `packet` and returns it.
///
/// # Panics
///
/// If the packet is longer than [`PACKET_MAX`].
///
/// ```
/// use blastema_lite::cobs;
/// let mut frame = [0; cobs::FRAME_MAX];
/// assert_eq!(cobs::encode(&[0x40, 0, 0, 3], &mut frame), [2, 0x40, 1, 2, 3, 0]);
/// ```
pub fn encode<'f>(packet: &[u8], frame: &'f mut [u8; FRAME_MAX]) -> &'f [u8] {
    let mut code_at = 0;
    for (at, &byte) in packet.iter().chain(&[0]).enumerate() {
        frame[at + 1] = byte;
        if byte == 0 {
            // The difference is at most the length of a packet and the delimiter, 247.
            frame[code_at] = (at + 1 - code_at) as u8;
            code_at = at + 1;
        }
    }
    &frame[..packet.len() + 2]
}

/// Finds packets in a stream of bytes.
///
/// Refuses a frame whose delimiter comes inside a block, and one that is longer than a packet can
/// be. The next frame is found in each case.
///
/// ```
/// use blastema_lite::CobsDecoder;
/// let mut decoder = CobsDecoder::default();
/// let found = [2, 0x40, 1, 2, 3].map(|byte| decoder.push(byte).is_some());
/// assert_eq!(found, [false; 5]);
/// assert_eq!(decoder.push(0), Some(&[0x40, 0, 0, 3][..]));
/// ```
#[derive(Clone, Debug)]
pub struct CobsDecoder {
    packet: [u8; PACKET_MAX],
    length: usize,
    /// Bytes of the block that are still to come.
    left: u8,
    started: bool,
    overlong: bool,
}

impl Default for CobsDecoder {
    fn default() -> Self {
        CobsDecoder { packet: [0; PACKET_MAX], length: 0, left: 0, started: false, overlong: false }
    }
}

impl CobsDecoder {
    /// Takes the next byte of the stream; returns the packet that it completes.
    pub fn push(&mut self, byte: u8) -> Option<&[u8]> {
        if byte == 0 {
            let whole = self.started && self.left == 0 && !self.overlong;
            let length = core::mem::take(&mut self.length);
            (self.left, self.started, self.overlong) = (0, false, false);
            return whole.then_some(&self.packet[..length]);
        }
        if self.left > 0 {
            self.left -= 1;
            self.keep(byte);
        } else {
            // A zero of the packet stands between two blocks.
            if core::mem::replace(&mut self.started, true) {
                self.keep(0);
            }
            self.left = byte - 1;
        }
        None
    }

    fn keep(&mut self, byte: u8) {
        match self.packet.get_mut(self.length) {
            Some(place) => {
                *place = byte;
                self.length += 1;
            }
            None => self.overlong = true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn check(stream: &[u8], expected: &[&[u8]]) {
        let mut decoder = CobsDecoder::default();
        let mut found = 0;
        for &byte in stream {
            if let Some(packet) = decoder.push(byte) {
                assert_eq!(packet, expected[found]);
                found += 1;
            }
        }
        assert_eq!(found, expected.len());
    }

    #[test]
    fn a_packet_of_any_length_and_any_zeros_comes_back() {
        for length in 0..=PACKET_MAX {
            for zeros in [1, 2, 3, 7, 255] {
                let mut packet = [0; PACKET_MAX];
                for (at, byte) in packet.iter_mut().enumerate() {
                    *byte = if at % zeros == zeros - 1 { 0 } else { (at % 255) as u8 + 1 };
                }
                let mut frame = [0; FRAME_MAX];
                let frame = encode(&packet[..length], &mut frame);
                assert!(!frame[..length + 1].contains(&0));
                check(frame, &[&packet[..length]]);
            }
        }
    }

    #[test]
    fn a_delimiter_inside_a_block_ends_the_frame_without_a_packet() {
        check(&[3, 1, 0, 2, 9, 0], &[&[9]]);
    }

    #[test]
    fn an_overlong_frame_is_refused_and_the_next_one_found() {
        let mut stream = [1; PACKET_MAX + 6];
        let end = stream.len();
        stream[end - 4..].copy_from_slice(&[0, 2, 9, 0]);
        check(&stream, &[&[9]]);
    }

    #[test]
    fn delimiters_alone_are_no_packets() {
        check(&[0, 0, 0], &[]);
    }
}
