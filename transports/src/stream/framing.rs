//! Frames in a stream of bytes.
//!
//! ```text
//! each side:  preamble ─ frame ─ frame ─ …
//!
//! preamble    0       4        5       6      8
//!             │ "BLST"│ version│ zero  │ port │          TCP: the port on which the speaker listens
//!             │ "BLST"│ version│ one   │ length │ path … Unix: the path at which it listens
//!
//! frame       0        4
//!             │ length │ bytes …                  numbers are big-endian
//! ```

use crate::frame_split::part_frame;
use bytes::{Bytes, BytesMut};
use socket2::SockRef;
use std::io;
use tokio::io::{AsyncRead, AsyncReadExt};

/// How long a preamble is, in bytes.
pub const PREAMBLE: usize = 8;
/// How long the length before each frame is, in bytes.
pub const HEADER: usize = 4;
/// Memory is taken in pieces of this size, and shared by the frames in it.
const CHUNK: usize = 64 * 1024;
/// From this size on a frame is not copied out of what was read, in bytes.
const LARGE: usize = CHUNK / 4;

const MAGIC: [u8; 4] = *b"BLST";
const VERSION: u8 = 1;

/// Why bytes are not ours. The connection they came on cannot be understood any further.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FramingError {
    /// The other side speaks another protocol.
    #[error("the peer does not speak this protocol")]
    Foreign,
    /// The other side speaks another version of this protocol. Bring both nodes to the same.
    #[error("the peer speaks version {version} of the framing, we speak {VERSION}")]
    Version {
        /// What it speaks.
        version: u8,
    },
    /// The other side says that it listens at what is no port, or no path of a socket.
    #[error("the peer listens at no address")]
    NoAddress,
    /// A frame larger than agreed is announced. Raise the limit on this side if it is wanted.
    #[error("a frame of {length} bytes is announced, the limit is {limit}")]
    TooLarge {
        /// The announced length, in bytes.
        length: usize,
        /// The configured limit, in bytes.
        limit: usize,
    },
}

/// What kind of address a preamble tells: the port of TCP, or the length of a path that follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PreambleKind {
    /// A port.
    Port = 0,
    /// The length of a path.
    Path = 1,
}

/// The longest path of a socket that Linux takes, in bytes (`sun_path` is 108 with its closing
/// zero).
pub const LONGEST_PATH: usize = 107;

fn preamble(kind: PreambleKind, number: u16) -> [u8; PREAMBLE] {
    let [high, low] = number.to_be_bytes();
    let [a, b, c, d] = MAGIC;
    [a, b, c, d, VERSION, kind as u8, high, low]
}

/// What a node says first on every connection: the port on which it listens. Its address needs no
/// word: the connection comes from there.
pub fn encode_preamble(port: u16) -> [u8; PREAMBLE] {
    preamble(PreambleKind::Port, port)
}

/// What a node says first on every connection between sockets with paths: the path at which it
/// listens. A path that no socket can have is cut off.
pub fn encode_path_preamble(path: &[u8]) -> Vec<u8> {
    let path = &path[..path.len().min(LONGEST_PATH)];
    [&preamble(PreambleKind::Path, path.len() as u16), path].concat()
}

/// Reads the port, or the length of the path, from a preamble.
///
/// # Errors
/// The bytes are no preamble of ours.
pub fn decode_preamble(bytes: [u8; PREAMBLE], kind: PreambleKind) -> Result<u16, FramingError> {
    let [a, b, c, d, version, named, high, low] = bytes;
    if [a, b, c, d] != MAGIC {
        return Err(FramingError::Foreign);
    }
    if version != VERSION {
        return Err(FramingError::Version { version });
    }
    if named != kind as u8 {
        return Err(FramingError::Foreign);
    }
    match u16::from_be_bytes([high, low]) {
        0 => Err(FramingError::NoAddress),
        length if kind == PreambleKind::Path && usize::from(length) > LONGEST_PATH => {
            Err(FramingError::NoAddress)
        }
        number => Ok(number),
    }
}

/// Reads a preamble from a new connection.
pub(crate) async fn read_preamble(
    stream: &mut (impl AsyncRead + Unpin),
    kind: PreambleKind,
) -> io::Result<u16> {
    let mut preamble = [0; PREAMBLE];
    stream.read_exact(&mut preamble).await?;
    decode_preamble(preamble, kind)
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
}

/// Says a preamble: the first word on a new connection, whose empty buffer takes it whole.
pub(crate) fn say_preamble(stream: SockRef<'_>, preamble: &[u8]) -> io::Result<()> {
    match stream.send(preamble)? {
        sent if sent == preamble.len() => Ok(()),
        _ => Err(io::ErrorKind::WriteZero.into()),
    }
}

/// What stands before a frame of this length.
///
/// # Panics
/// When the length is above 4 GiB, which no limit allows.
pub fn encode_header(length: usize) -> [u8; HEADER] {
    u32::try_from(length).expect("frames are far below 4 GiB").to_be_bytes()
}

/// How long the first frame in the buffer says that it is, if that much is there.
pub(super) fn announced(buffer: &BytesMut) -> Option<usize> {
    let header = buffer.first_chunk::<HEADER>()?;
    // On machines where this does not fit, the frame does not either.
    Some(usize::try_from(u32::from_be_bytes(*header)).unwrap_or(usize::MAX))
}

/// Takes the first frame from the buffer, if it is all there.
///
/// A buffer without a whole frame in it is shorter than `HEADER + limit`, whatever came from
/// outside: who reads only then never holds more than that and one read.
///
/// # Errors
/// The announced frame is larger than `limit`.
pub fn decode(buffer: &mut BytesMut, limit: usize) -> Result<Option<Bytes>, FramingError> {
    let Some(length) = announced(buffer) else { return Ok(None) };
    if length > limit {
        return Err(FramingError::TooLarge { length, limit });
    }
    if buffer.len() - HEADER < length {
        return Ok(None);
    }
    bytes::Buf::advance(buffer, HEADER);
    Ok(Some(part_frame(buffer, length, CHUNK)))
}

/// How many bytes should be read next, into a buffer without a whole frame in it.
///
/// A large frame is read to its end, and with it the header of the next, so that each lies in
/// memory of its own and nothing of it is moved.
pub(super) fn capacity(buffer: &BytesMut, limit: usize) -> usize {
    match announced(buffer).unwrap_or(0) {
        length @ LARGE.. if length <= limit => 2 * HEADER + length - buffer.len(),
        _ => CHUNK.min(2 * HEADER + limit),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_core::random::Random;

    fn stream(frames: &[Bytes]) -> Vec<u8> {
        frames.iter().flat_map(|frame| [&encode_header(frame.len())[..], frame].concat()).collect()
    }

    fn decode_in_pieces(bytes: &[u8], piece: usize, limit: usize) -> Vec<Bytes> {
        let (mut buffer, mut frames) = (BytesMut::new(), vec![]);
        for piece in bytes.chunks(piece) {
            buffer.extend_from_slice(piece);
            while let Some(frame) = decode(&mut buffer, limit).unwrap() {
                frames.push(frame);
            }
        }
        assert!(buffer.is_empty());
        frames
    }

    #[test]
    fn frames_come_out_as_they_went_in_however_the_stream_is_cut() {
        let frames = [0, 1, 4, 300, 0, 20_000, 65_536]
            .map(|length| Bytes::from((0..length).map(|i| (i % 251) as u8).collect::<Vec<_>>()));
        let bytes = stream(&frames);

        for piece in [1, 3, 4, 5, 1000, 16_384, bytes.len()] {
            assert_eq!(decode_in_pieces(&bytes, piece, 65_536), frames, "in pieces of {piece}");
        }
    }

    #[test]
    fn a_large_frame_is_read_in_one_go_with_the_header_of_the_next_and_small_ones_together() {
        let reads = |length: usize| {
            let frames = vec![Bytes::from(vec![7; length]); 50];
            let (bytes, mut buffer, mut came) = (stream(&frames), BytesMut::new(), 0);
            let (mut rest, mut reads) = (&bytes[..], 0);
            while !rest.is_empty() {
                let (read, later) = rest.split_at(capacity(&buffer, 65_535).min(rest.len()));
                buffer.extend_from_slice(read);
                (rest, reads) = (later, reads + 1);
                while let Some(frame) = decode(&mut buffer, 65_535).unwrap() {
                    assert_eq!(frame, frames[0]);
                    came += 1;
                }
                assert!(length < LARGE || buffer.len() == HEADER || reads == 1 || rest.is_empty());
            }
            assert_eq!(came, 50);
            reads
        };

        assert_eq!(reads(65_535), 50 + 1, "the first in two, because its size was not known");
        assert_eq!(reads(100), 1);
    }

    #[test]
    fn the_wire_format_is_this() {
        assert_eq!(stream(&[Bytes::from("hello")]), b"\0\0\0\x05hello");
        assert_eq!(encode_preamble(7400), *b"BLST\x01\0\x1c\xe8");
    }

    #[test]
    fn a_path_is_read_back_and_anything_else_refused() {
        let preamble = encode_path_preamble(b"/run/a.sock");
        assert_eq!(preamble, b"BLST\x01\x01\0\x0b/run/a.sock");
        let head =
            |bytes: &[u8]| decode_preamble(*bytes.first_chunk().unwrap(), PreambleKind::Path);

        assert_eq!(head(&preamble), Ok(11));
        assert_eq!(head(b"BLSTx\x01\0\x0b"), Err(FramingError::Version { version: b'x' }));
        assert_eq!(head(b"BLST\x01\0\x1c\xe8"), Err(FramingError::Foreign));
        assert_eq!(head(b"GET / HT"), Err(FramingError::Foreign));
        assert_eq!(head(b"BLST\x01\x01\0\0"), Err(FramingError::NoAddress));
        assert_eq!(head(b"BLST\x01\x01\0\x6c"), Err(FramingError::NoAddress));
        assert_eq!(encode_path_preamble(&[b'x'; 200]).len(), PREAMBLE + LONGEST_PATH);
    }

    #[test]
    fn a_frame_above_the_limit_is_refused_before_it_arrives() {
        let mut buffer = BytesMut::from(&encode_header(101)[..]);

        let refused = decode(&mut buffer, 100).unwrap_err();

        assert_eq!(refused, FramingError::TooLarge { length: 101, limit: 100 });
    }

    #[test]
    fn garbage_never_panics_and_never_makes_the_buffer_grow() {
        const LIMIT: usize = 1000;
        for seed in 0..2000 {
            let mut random = Random::new(seed);
            let mut buffer = BytesMut::new();
            for _ in 0..50 {
                let read = (random.next() % 600) as usize;
                // Small lengths now and then, so that some garbage passes for frames.
                let plausible = random.chance(0.5);
                buffer.extend((0..read).map(|i| match (plausible, i % 4) {
                    (true, 0 | 1) => 0,
                    _ => random.next() as u8,
                }));
                let refused = loop {
                    match decode(&mut buffer, LIMIT) {
                        Ok(Some(frame)) => assert!(frame.len() <= LIMIT),
                        Ok(None) => break false,
                        Err(_) => break true,
                    }
                };
                if refused {
                    break;
                }
                assert!(buffer.len() < HEADER + LIMIT, "seed {seed}");
            }
        }
    }

    #[test]
    fn a_preamble_is_read_back_and_anything_else_refused() {
        let check = |bytes: &[u8; PREAMBLE], expected| {
            assert_eq!(decode_preamble(*bytes, PreambleKind::Port), expected, "{bytes:?}");
        };
        check(&encode_preamble(7400), Ok(7400));
        check(b"GET / HT", Err(FramingError::Foreign));
        check(b"BLST\x02\0\x1c\xe8", Err(FramingError::Version { version: 2 }));
        check(b"BLST\x01\x07\x1c\xe8", Err(FramingError::Foreign));
        check(b"BLST\x01\0\0\0", Err(FramingError::NoAddress));
        let mut random = Random::new(7);
        for _ in 0..100_000 {
            let _ = decode_preamble(random.next().to_be_bytes(), PreambleKind::Port);
        }
    }
}
