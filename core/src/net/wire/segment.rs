//! The segment: what two sessions say to each other, whatever path lies between them.
//!
//! The first byte holds the kind in its upper three bits and flags below. Every segment but an open
//! carries its receiver's tag, a number that the receiver chose for this session and no other: what
//! was meant for an earlier session, or an earlier incarnation, is known by it. Lengths in bytes;
//! `v` is a number of one byte up to 127, two up to 16383, and so on.
//!
//! ```text
//! open         100 00011 │ version 1 │ tag 4 │ echo 4 │ incarnation 8 │ number 4
//! data         001 palfs │ tag 4 │ sequence v │ p: index v, count v │ a: ack │ payload
//!              101 palfs, 000 palf0 │ the same
//! redundant    111 palfr │ as data, and a copy goes over every path
//! datagram     010 p000n │ tag 4 │ channel v │ sequence v │ n: number v │ p: index v, count v │
//!                        payload
//! acknowledge  011 00000 │ tag 4 │ 0nbeqprc 1 │ ack of each stream: c control, r redundant, of which
//!                        a copy goes over every path, p replication, q requests, e events, b bulk
//!                        │ n: next v, received v, arrived 2
//! close        100 00000 │ tag 4
//! closed       100 00001 │ tag 4
//! reset        100 00010 │ tag 4, the one of the unknown segment
//!
//! s     stream: with 001 0 control, 1 requests; with 101 0 events, 1 bulk; with 000 replication
//! r     sent again: no copy of what was sent before
//! f, l  the first, the last part of a message; with both the payload is one or more whole messages,
//!       each after its length v; the first of several parts begins with the whole length v
//! n     datagrams with a number are acknowledged: all below next were sent before the last that
//!       arrived, and so many of all were received
//! p     one of `count` pieces of what was cut for a larger MTU
//! ack   next expected v │ window v │ arrived 2 │ n 1 │ n × (gap v, length v): beyond, these arrived as
//!       well
//! arrived  when the last part arrived, by the receiver's clock: tenths of a millisecond, the lower 16
//!       bits. Its offset is not known; what changes is the delay of the path (RFC 6817)
//! ```

use super::{Reader, WireError, Write, varint_length};
use crate::{GatherBuffer, Incarnation, Instant, TrafficClass};
use bytes::{BufMut, Bytes, BytesMut};
use std::ops::Sub;
use std::time::Duration;

/// The most ranges that one acknowledgement lists; the rest is listed in later ones.
pub const RANGES_MAX: usize = 16;
/// The most pieces of one thing. A part never needs so many; a message that is not repeated is
/// refused when it would, which in the smallest segments is one of more than 228 KiB.
pub const PIECES_MAX: u16 = 4096;

/// The most bytes that say which piece it is.
pub(crate) const PIECE_HEADER: usize = 4;

/// The bytes that a data segment puts before its payload, acknowledgement and pieces apart.
pub(crate) fn data_header(sequence: u64) -> usize {
    1 + 4 + varint_length(sequence)
}

/// What two sessions say to each other.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Segment {
    /// This is me; this is what I know of you.
    Open(OpenSegment),
    /// A part of an ordered stream.
    Data(Data),
    /// A message, or a piece of one, that is not repeated.
    Datagram(Datagram),
    /// What has arrived.
    Acknowledge {
        /// The receiver's tag.
        tag: u32,
        /// For each stream, in the order of [`TrafficClass::ALL`].
        streams: [Option<Ack>; TrafficClass::COUNT],
        /// For datagrams; `None` if none is acknowledged.
        datagrams: Option<DatagramAck>,
    },
    /// All that I had to say is said and acknowledged.
    Close {
        /// The receiver's tag.
        tag: u32,
    },
    /// I have heard the close.
    Closed {
        /// The receiver's tag.
        tag: u32,
    },
    /// There is no session with this tag here.
    Reset {
        /// The tag that is not known.
        tag: u32,
    },
}

/// The handshake: one side opens a session, or answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OpenSegment {
    /// The version of the session's protocol.
    pub version: u8,
    /// The sender's tag.
    pub tag: u32,
    /// The receiver's tag, as the sender knows it; 0 for not at all.
    pub echo: u32,
    /// The sender's incarnation.
    pub incarnation: Incarnation,
    /// The n-th session of that incarnation.
    pub number: u32,
    /// What the sender had received in the session before, if it had one.
    pub before: Option<SessionReceipt>,
}

/// What one end of a session had received when it ended that session. It received no more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionReceipt {
    /// The other end's tag in that session; never 0.
    pub tag: u32,
    /// For each stream, the first part that had not arrived.
    pub next: [u64; TrafficClass::COUNT],
}

/// A part of an ordered stream.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Data {
    /// The receiver's tag.
    pub tag: u32,
    /// The stream that it belongs to.
    pub stream: TrafficClass,
    /// Its place there.
    pub sequence: u64,
    /// A message begins here.
    pub first: bool,
    /// A message ends here.
    pub last: bool,
    /// It was sent before. Told on the redundant stream only, where copies are counted.
    pub again: bool,
    /// This is not the whole part.
    pub piece: Option<Fragment>,
    /// What has arrived in the other direction.
    pub ack: Option<Ack>,
    /// The bytes of the part, or of its piece.
    pub payload: GatherBuffer,
}

/// A message that is not repeated.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Datagram {
    /// The receiver's tag.
    pub tag: u32,
    /// Of one channel, the newest message counts and no older one.
    pub channel: u32,
    /// Its place in its channel.
    pub sequence: u64,
    /// Its place among all datagrams of which the sender wants to be told.
    pub number: Option<u64>,
    /// This is not the whole message.
    pub piece: Option<Fragment>,
    /// The bytes of the message, or of its piece.
    pub payload: GatherBuffer,
}

/// One of several pieces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fragment {
    /// Which, from 0.
    pub index: u16,
    /// How many there are, 2 to [`PIECES_MAX`].
    pub count: u16,
}

/// A time of one node's clock: tenths of a millisecond, the lower 16 bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DelayTicks(pub u16);

impl DelayTicks {
    const NANOS: u64 = 100_000;

    /// The time of an instant.
    pub fn of(at: Instant) -> Self {
        DelayTicks((at.as_nanos() / Self::NANOS) as u16)
    }

    /// How much later than the other this is; earlier times are zero. Right for three seconds.
    pub fn since(self, other: DelayTicks) -> Duration {
        let ticks = self.0.wrapping_sub(other.0).cast_signed();
        Duration::from_nanos(u64::try_from(ticks).unwrap_or(0) * Self::NANOS)
    }
}

impl Sub for DelayTicks {
    type Output = DelayTicks;

    fn sub(self, other: DelayTicks) -> DelayTicks {
        DelayTicks(self.0.wrapping_sub(other.0))
    }
}

/// What has arrived of a stream.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ack {
    /// The first that has not.
    pub next: u64,
    /// How many from there on the receiver takes.
    pub window: u32,
    /// When the last of them arrived, by the receiver's clock.
    pub arrived: DelayTicks,
    /// What has arrived beyond, rising: first and last of each run. At most [`RANGES_MAX`].
    pub ranges: Vec<(u64, u64)>,
}

/// What has arrived of numbered datagrams.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DatagramAck {
    /// One more than the greatest number.
    pub next: u64,
    /// How many were received; what is missing to `next` was lost, or is late.
    pub received: u64,
    /// When the last of them arrived, by the receiver's clock.
    pub arrived: DelayTicks,
}

const REPLICATION_DATA: u8 = 0;
const DATA: u8 = 1;
const DATAGRAM: u8 = 2;
const ACKNOWLEDGE: u8 = 3;
const END: u8 = 4;
const LATER_DATA: u8 = 5;
const REDUNDANT: u8 = 7;

/// What an [`END`] says, in its flags.
const CLOSE: u8 = 0;
const CLOSED: u8 = 1;
const RESET: u8 = 2;
const OPEN: u8 = 3;

impl Segment {
    /// The segment's bytes, in one piece.
    pub fn encode(&self) -> Bytes {
        self.parcel().into_bytes()
    }

    /// The segment's bytes. What is large of what it carries is not copied.
    pub fn parcel(&self) -> GatherBuffer {
        match self {
            Segment::Open(open) => {
                let mut bytes = begin(END, OPEN, 32);
                bytes.put_u8(open.version);
                bytes.put_u32(open.tag);
                bytes.put_u32(open.echo);
                bytes.put_u64(open.incarnation.0);
                bytes.put_u32(open.number);
                bytes.put_u32(open.before.map_or(0, |before| before.tag));
                let next = open.before.iter().flat_map(|before| before.next);
                next.for_each(|next| bytes.varint(next));
                bytes.freeze().into()
            }
            Segment::Data(data) => data.parcel(),
            Segment::Datagram(datagram) => datagram.parcel(),
            Segment::Acknowledge { tag, streams, datagrams } => {
                let present = streams.iter().map(Option::is_some).chain([datagrams.is_some()]);
                let flags = (0..).zip(present).map(|(bit, present)| u8::from(present) << bit).sum();
                let mut bytes = begin(ACKNOWLEDGE, 0, 32);
                bytes.put_u32(*tag);
                bytes.put_u8(flags);
                for ack in streams.iter().flatten() {
                    ack.put(&mut bytes);
                }
                if let Some(DatagramAck { next, received, arrived }) = datagrams {
                    bytes.varint(*next);
                    bytes.varint(*received);
                    bytes.put_u16(arrived.0);
                }
                bytes.freeze().into()
            }
            Segment::Close { tag } => end(CLOSE, *tag),
            Segment::Closed { tag } => end(CLOSED, *tag),
            Segment::Reset { tag } => end(RESET, *tag),
        }
    }

    /// Reads a segment.
    ///
    /// # Errors
    /// [`WireError`] for anything that [`encode`](Segment::encode) does not write.
    pub fn decode(bytes: Bytes) -> Result<Segment, WireError> {
        let mut reader = Reader::new(bytes);
        let first = reader.u8()?;
        let (kind, flags) = (first >> 5, first & 0x1f);
        let allowed = match kind {
            DATA | LATER_DATA | REDUNDANT => 0b11111,
            REPLICATION_DATA => 0b11110,
            DATAGRAM => 0b10001,
            END => 0b00011,
            _ => 0,
        };
        if flags & !allowed != 0 {
            return Err(WireError::Malformed { what: "a segment's flags" });
        }
        if (kind, flags) == (END, OPEN) {
            return OpenSegment::read(reader).map(Segment::Open);
        }
        let tag = reader.u32()?;
        match kind {
            REPLICATION_DATA | DATA | LATER_DATA | REDUNDANT => {
                Data::read(kind, tag, flags, reader).map(Segment::Data)
            }
            DATAGRAM => Datagram::read(tag, flags, reader).map(Segment::Datagram),
            ACKNOWLEDGE => {
                let flags = reader.u8()?;
                if flags & 1 << 7 != 0 {
                    return Err(WireError::Malformed { what: "an acknowledgement" });
                }
                let mut streams = [const { None }; TrafficClass::COUNT];
                for (bit, ack) in streams.iter_mut().enumerate() {
                    *ack = (flags & 1 << bit != 0).then(|| Ack::read(&mut reader)).transpose()?;
                }
                let has_datagrams = flags & 1 << TrafficClass::COUNT != 0;
                let datagrams =
                    has_datagrams.then(|| DatagramAck::read(&mut reader)).transpose()?;
                reader.end("an acknowledgement")?;
                Ok(Segment::Acknowledge { tag, streams, datagrams })
            }
            END => {
                reader.end("a segment")?;
                Ok(match flags {
                    CLOSE => Segment::Close { tag },
                    CLOSED => Segment::Closed { tag },
                    _ => Segment::Reset { tag },
                })
            }
            _ => Err(WireError::Malformed { what: "a segment's kind" }),
        }
    }
}

fn begin(kind: u8, flags: u8, length: usize) -> BytesMut {
    let mut bytes = BytesMut::with_capacity(length);
    bytes.put_u8(kind << 5 | flags);
    bytes
}

fn end(says: u8, tag: u32) -> GatherBuffer {
    let mut bytes = begin(END, says, 5);
    bytes.put_u32(tag);
    bytes.freeze().into()
}

impl OpenSegment {
    fn read(mut reader: Reader) -> Result<OpenSegment, WireError> {
        let version = reader.u8()?;
        let (tag, echo) = (reader.u32()?, reader.u32()?);
        let incarnation = Incarnation(reader.u64()?);
        let number = reader.u32()?;
        let before = match reader.u32()? {
            0 => None,
            tag => {
                let mut next = [0; TrafficClass::COUNT];
                for next in &mut next {
                    *next = reader.varint()?;
                }
                Some(SessionReceipt { tag, next })
            }
        };
        reader.end("an open")?;
        if tag == 0 {
            return Err(WireError::Malformed { what: "a tag" });
        }
        Ok(OpenSegment { version, tag, echo, incarnation, number, before })
    }
}

impl Data {
    fn parcel(&self) -> GatherBuffer {
        let (kind, lowest) = match self.stream {
            TrafficClass::Control => (DATA, false),
            TrafficClass::Request => (DATA, true),
            TrafficClass::Event => (LATER_DATA, false),
            TrafficClass::Bulk => (LATER_DATA, true),
            TrafficClass::Redundant => (REDUNDANT, self.again),
            TrafficClass::Replication => (REPLICATION_DATA, false),
        };
        let flags = u8::from(lowest)
            | u8::from(self.first) << 1
            | u8::from(self.last) << 2
            | u8::from(self.ack.is_some()) << 3
            | u8::from(self.piece.is_some()) << 4;
        let mut bytes = begin(kind, flags, data_header(self.sequence) + 16 + self.payload.copied());
        bytes.put_u32(self.tag);
        bytes.varint(self.sequence);
        Fragment::put(self.piece, &mut bytes);
        if let Some(ack) = &self.ack {
            ack.put(&mut bytes);
        }
        self.payload.behind(bytes)
    }

    fn read(kind: u8, tag: u32, flags: u8, mut reader: Reader) -> Result<Data, WireError> {
        let lowest = flags & 1 != 0;
        let (stream, again) = match (kind, lowest) {
            (REDUNDANT, again) => (TrafficClass::Redundant, again),
            (DATA, false) => (TrafficClass::Control, false),
            (DATA, true) => (TrafficClass::Request, false),
            (LATER_DATA, false) => (TrafficClass::Event, false),
            (LATER_DATA, true) => (TrafficClass::Bulk, false),
            (_, _) => (TrafficClass::Replication, false),
        };
        let sequence = reader.varint()?;
        let piece = Fragment::read(flags, &mut reader)?;
        let ack = (flags & 8 != 0).then(|| Ack::read(&mut reader)).transpose()?;
        let (first, last) = (flags & 2 != 0, flags & 4 != 0);
        let payload = reader.rest().into();
        Ok(Data { tag, stream, sequence, first, last, again, piece, ack, payload })
    }
}

impl Datagram {
    fn parcel(&self) -> GatherBuffer {
        let flags = u8::from(self.piece.is_some()) << 4 | u8::from(self.number.is_some());
        let mut bytes = begin(DATAGRAM, flags, 24 + self.payload.copied());
        bytes.put_u32(self.tag);
        bytes.varint(self.channel.into());
        bytes.varint(self.sequence);
        if let Some(number) = self.number {
            bytes.varint(number);
        }
        Fragment::put(self.piece, &mut bytes);
        self.payload.behind(bytes)
    }

    fn read(tag: u32, flags: u8, mut reader: Reader) -> Result<Datagram, WireError> {
        let channel = u32::try_from(reader.varint()?)
            .map_err(|_| WireError::TooLarge { what: "a channel's number" })?;
        let sequence = reader.varint()?;
        let number = (flags & 1 != 0).then(|| reader.varint()).transpose()?;
        let piece = Fragment::read(flags, &mut reader)?;
        Ok(Datagram { tag, channel, sequence, number, piece, payload: reader.rest().into() })
    }
}

impl Fragment {
    fn put(piece: Option<Fragment>, bytes: &mut BytesMut) {
        if let Some(Fragment { index, count }) = piece {
            bytes.varint(index.into());
            bytes.varint(count.into());
        }
    }

    fn read(flags: u8, reader: &mut Reader) -> Result<Option<Fragment>, WireError> {
        if flags & 16 == 0 {
            return Ok(None);
        }
        let (index, count) = (reader.varint()?, reader.varint()?);
        if count < 2 || count > u64::from(PIECES_MAX) || index >= count {
            return Err(WireError::Malformed { what: "a piece's place" });
        }
        Ok(Some(Fragment { index: index as u16, count: count as u16 }))
    }
}

impl Ack {
    /// How many bytes it takes.
    pub(in crate::net) fn length(&self) -> usize {
        let mut length = varint_length(self.next) + varint_length(self.window.into()) + 2 + 1;
        let mut before = self.next;
        for (first, last) in self.ranges.iter().take(RANGES_MAX) {
            length += varint_length(first - before) + varint_length(last - first);
            before = *last;
        }
        length
    }

    fn put(&self, bytes: &mut BytesMut) {
        bytes.varint(self.next);
        bytes.varint(self.window.into());
        bytes.put_u16(self.arrived.0);
        bytes.put_u8(self.ranges.len().min(RANGES_MAX) as u8);
        let mut before = self.next;
        for (first, last) in self.ranges.iter().take(RANGES_MAX) {
            bytes.varint(first - before);
            bytes.varint(last - first);
            before = *last;
        }
    }

    fn read(reader: &mut Reader) -> Result<Ack, WireError> {
        let malformed = || WireError::Malformed { what: "an acknowledgement" };
        let next = reader.varint()?;
        let window = u32::try_from(reader.varint()?).unwrap_or(u32::MAX);
        let arrived = DelayTicks(reader.u16()?);
        let count = usize::from(reader.u8()?);
        if count > RANGES_MAX {
            return Err(malformed());
        }
        let mut before = next;
        let mut ranges = Vec::with_capacity(count);
        for _ in 0..count {
            let first = before.checked_add(reader.varint()?).ok_or_else(malformed)?;
            let last = first.checked_add(reader.varint()?).ok_or_else(malformed)?;
            ranges.push((first, last));
            before = last;
        }
        Ok(Ack { next, window, arrived, ranges })
    }
}

impl DatagramAck {
    fn read(reader: &mut Reader) -> Result<DatagramAck, WireError> {
        let (next, received) = (reader.varint()?, reader.varint()?);
        Ok(DatagramAck { next, received, arrived: DelayTicks(reader.u16()?) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn examples() -> Vec<(Segment, &'static [u8])> {
        let version = crate::net::session::VERSION;
        let (incarnation, before) = (Incarnation(2), None);
        let open = OpenSegment { version, tag: 7, echo: 0, incarnation, number: 3, before };
        let before = Some(SessionReceipt { tag: 9, next: [1, 0, 0, 300, 0, 2] });
        let next = OpenSegment { number: 4, before, ..open };
        let arrived = DelayTicks(0x1234);
        let ack = Ack { next: 5, window: 200, arrived, ranges: vec![(7, 8), (300, 300)] };
        let data = Data {
            tag: 0x01020304,
            stream: TrafficClass::Request,
            sequence: 300,
            first: true,
            last: true,
            again: false,
            piece: None,
            ack: None,
            payload: Bytes::from_static(b"\x02hi").into(),
        };
        let piece = Some(Fragment { index: 1, count: 2 });
        let acking = Data { piece, ack: Some(ack.clone()), ..data.clone() };
        let copied = Data { stream: TrafficClass::Redundant, again: true, ..data.clone() };
        let event = Data { stream: TrafficClass::Event, ..data.clone() };
        let bulk = Data { stream: TrafficClass::Bulk, ..data.clone() };
        let replication = Data { stream: TrafficClass::Replication, ..data.clone() };
        let datagram = Datagram {
            tag: 1,
            channel: 4,
            sequence: 9,
            number: None,
            piece: None,
            payload: Bytes::from_static(b"x").into(),
        };
        let numbered = Datagram { number: Some(300), ..datagram.clone() };
        let acks = DatagramAck { next: 301, received: 299, arrived };
        vec![
            (
                Segment::Open(open),
                b"\x83\x09\0\0\0\x07\0\0\0\0\0\0\0\0\0\0\0\x02\0\0\0\x03\0\0\0\0",
            ),
            (
                Segment::Open(next),
                b"\x83\x09\0\0\0\x07\0\0\0\0\0\0\0\0\0\0\0\x02\0\0\0\x04\0\0\0\x09\x01\0\0\xac\x02\0\x02",
            ),
            (Segment::Data(copied), b"\xe7\x01\x02\x03\x04\xac\x02\x02hi"),
            (Segment::Data(data), b"\x27\x01\x02\x03\x04\xac\x02\x02hi"),
            (Segment::Data(event), b"\xa6\x01\x02\x03\x04\xac\x02\x02hi"),
            (Segment::Data(replication), b"\x06\x01\x02\x03\x04\xac\x02\x02hi"),
            (Segment::Data(bulk), b"\xa7\x01\x02\x03\x04\xac\x02\x02hi"),
            (
                Segment::Data(acking),
                b"\x3f\x01\x02\x03\x04\xac\x02\x01\x02\x05\xc8\x01\x12\x34\x02\x02\x01\xa4\x02\x00\x02hi",
            ),
            (Segment::Datagram(datagram), b"\x40\0\0\0\x01\x04\x09x"),
            (Segment::Datagram(numbered), b"\x41\0\0\0\x01\x04\x09\xac\x02x"),
            (
                Segment::Acknowledge { tag: 1, streams: [const { None }; 6], datagrams: Some(acks) },
                b"\x60\0\0\0\x01\x40\xad\x02\xab\x02\x12\x34",
            ),
            (
                Segment::Acknowledge {
                    tag: 1,
                    streams: [None, Some(ack.clone()), None, None, None, None],
                    datagrams: None,
                },
                b"\x60\0\0\0\x01\x02\x05\xc8\x01\x12\x34\x02\x02\x01\xa4\x02\x00",
            ),
            (
                Segment::Acknowledge {
                    tag: 1,
                    streams: [None, None, None, Some(ack.clone()), None, None],
                    datagrams: None,
                },
                b"\x60\0\0\0\x01\x08\x05\xc8\x01\x12\x34\x02\x02\x01\xa4\x02\x00",
            ),
            (
                Segment::Acknowledge {
                    tag: 1,
                    streams: [None, None, None, None, None, Some(ack)],
                    datagrams: None,
                },
                b"\x60\0\0\0\x01\x20\x05\xc8\x01\x12\x34\x02\x02\x01\xa4\x02\x00",
            ),
            (Segment::Close { tag: 1 }, b"\x80\0\0\0\x01"),
            (Segment::Closed { tag: 1 }, b"\x81\0\0\0\x01"),
            (Segment::Reset { tag: 1 }, b"\x82\0\0\0\x01"),
        ]
    }

    #[test]
    fn the_bytes_of_segments_are_these_for_ever_and_come_back() {
        for (segment, golden) in examples() {
            assert_eq!(&segment.encode()[..], golden, "{segment:?}");
            assert_eq!(Segment::decode(Bytes::from_static(golden)), Ok(segment));
        }
    }

    #[test]
    fn what_no_session_writes_is_refused() {
        let check = |bytes: &'static [u8]| {
            let refused = Segment::decode(Bytes::from_static(bytes));
            assert!(matches!(refused, Err(WireError::Malformed { .. })), "{refused:?}");
        };
        check(b"\xc2\0\0\0\x01");
        check(b"\x84\0\0\0\x01");
        check(b"\x01\0\0\0\x01");
        check(b"\x42\0\0\0\x01");
        check(b"\x30\0\0\0\x01\x01\x02\x02");
        check(b"\x61\0\0\0\x01\0");
        check(b"\x60\0\0\0\x01\x80");
        check(b"\x60\0\0\0\x01\x08\x05\x05\0\0\x11");
        check(b"\x60\0\0\0\x01\x08\x05\x05\0\0\x01\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01\x01");
        for (segment, golden) in examples() {
            if !matches!(segment, Segment::Data(_) | Segment::Datagram(_)) {
                for cut in 0..golden.len() {
                    let refused = Segment::decode(Bytes::from_static(&golden[..cut]));
                    assert_eq!(refused, Err(WireError::Truncated), "{segment:?} {cut}");
                }
            }
        }
    }
}
