//! The frame: what one link gives one transport.
//!
//! ```text
//!      0        1
//! ┌────────┬────────┬──────────────────────────────┐
//! │ 1011 v │  kind  │ hello, routing, data         │   v = version of the protocol, 1
//! │        │        │ routing part, taken, probe   │
//! └────────┴────────┴──────────────────────────────┘
//!
//! hello, kind 0, 38 bytes and the name:
//!      2         10         14           18     19       21               29      33      37    38
//! ┌────────┬───────────┬──────────┬─────────────┬──────┬──────┬──────────────┬───────┬──────┬───┬──────┐
//! │ 1011 v │incarnation│ sequence │ interval µs │state │loss ‰│ echoed       │echoed │held  │ n │ name │
//! │   0    │     8     │    4     │     4       │  1   │  2   │ incarnation 8│ seq. 4│ µs 4 │ 1 │  n   │
//! └────────┴───────────┴──────────┴─────────────┴──────┴──────┴──────────────┴───────┴──────┴───┴──────┘
//! ```
//!
//! The echo says which hello of the neighbour arrived last and how long ago: the neighbour learns
//! that it is heard, and the round trip without any clock in common. State and loss say what this
//! end thinks of the link, so that both ends use it, or neither; beside the state stand six bits:
//! how many hellos before this one were not sent, since their node was not run. Numbers are
//! big-endian.
//!
//! What a router says and no frame of the medium carries whole goes in parts, kind 4: one byte,
//! which part it is from 0, with 128 added to the last, then the bytes.
//!
//! A node whose name another one has is told so by a frame of kind 5: its own incarnation, 8 bytes,
//! that of the other one, 8 bytes, and where the other one is reached, as text.
//!
//! A probe, kind 6, asks whether a frame of its own size passes; the rest of it is padding. Kind 7
//! answers it: the size of the probe that arrived, 2 bytes.
//!
//! A frame ends where the transport says that it ends; integrity is the transport's business.

use super::hello_state::HelloState;
use super::{Reader, WireError, Write, packet};
use crate::{GatherBuffer, Incarnation, NodeName};
use bytes::{BufMut, Bytes, BytesMut};
use std::fmt;

/// The protocol's version: the low half of the first byte.
pub const VERSION: u8 = 1;
/// The high half of the first byte.
const MAGIC: u8 = 0xb0;
/// The bytes that a frame puts before what it carries.
pub const FRAME_HEADER: usize = 2;

const HELLO: u8 = 0;
const ROUTING: u8 = 1;
const DATA: u8 = 2;
const ROUTING_PART: u8 = 4;
const TAKEN: u8 = 5;
const PROBE: u8 = 6;
const PROBE_ANSWER: u8 = 7;

/// What one link says to the link at the other end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Frame {
    /// I live, and I hear you.
    Hello(Hello),
    /// For the neighbour's router itself: what it should know of the network.
    Routing(Bytes),
    /// A packet on its way.
    Data(GatherBuffer),
    /// A part of what the neighbour's router should know, where no frame carries it whole.
    RoutingPart(RoutingFragment),
    /// Another node has the receiver's name.
    Taken {
        /// The incarnation that is told so, as its hellos name it.
        refused: Incarnation,
        /// The other node.
        by: NameHolder,
    },
    /// A frame of so many bytes, which asks for an answer.
    Probe(u16),
    /// A probe of so many bytes has arrived.
    ProbeAnswer(u16),
}

/// The node that has a name, as its neighbour tells another one of that name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NameHolder {
    /// The incarnation of that node.
    pub incarnation: Incarnation,
    /// Where the neighbour reaches it, in [`ADDRESS_MAX`](NameHolder::ADDRESS_MAX) bytes, or
    /// [`NOWHERE`](NameHolder::NOWHERE).
    pub address: String,
}

impl NameHolder {
    /// The longest address, in bytes: with it, the frame fits into the smallest one of a medium.
    pub const ADDRESS_MAX: usize = 72;

    /// In the place of an address that the neighbour does not know.
    pub const NOWHERE: &'static str = "an address that is not known";

    /// An address that is too long loses its end.
    pub fn new(incarnation: Incarnation, address: impl fmt::Display) -> Self {
        let mut address = address.to_string();
        while address.len() > Self::ADDRESS_MAX {
            address.pop();
        }
        NameHolder { incarnation, address }
    }
}

/// A part of something of the router's.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RoutingFragment {
    /// Which, from 0 to [`INDEX_MAX`](RoutingFragment::INDEX_MAX).
    pub index: u8,
    /// It is the last.
    pub last: bool,
    /// The fragment's bytes.
    pub bytes: Bytes,
}

/// A link's sign of life.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Hello {
    /// The node that sends it.
    pub node: NodeName,
    /// The incarnation of that node.
    pub incarnation: Incarnation,
    /// The number of the interval in which it was sent, counted from the link's start.
    pub sequence: u32,
    /// How long an interval is, in microseconds.
    pub interval_us: u32,
    /// So many hellos directly before this one were not sent, since their node was not run in time:
    /// they are not lost. At most [`SKIPPED_MAX`](Hello::SKIPPED_MAX).
    pub skipped: u8,
    /// Whether it would use the link.
    pub state: HelloState,
    /// How many of a thousand of the other's hellos it has lost lately.
    pub loss_permille: u16,
    /// What it last heard of the one that it speaks to; `None` if nothing yet.
    pub echo: Option<Echo>,
}

/// What a node last heard of its neighbour.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Echo {
    /// The neighbour's incarnation. Never 0.
    pub incarnation: Incarnation,
    /// The number of its last hello.
    pub sequence: u32,
    /// How long ago it came, in microseconds; saturates.
    pub held_us: u32,
}

impl Frame {
    /// The frame's bytes, in one piece.
    pub fn encode(&self) -> Bytes {
        self.parcel().into_bytes()
    }

    /// The frame's bytes. What is large of what it carries is not copied.
    pub fn parcel(&self) -> GatherBuffer {
        match self {
            Frame::Hello(hello) => hello.encode().into(),
            Frame::Routing(bytes) => wrap(ROUTING, &bytes.clone().into()),
            Frame::Data(packet) => wrap(DATA, packet),
            Frame::RoutingPart(RoutingFragment { index, last, bytes: part }) => {
                let mut bytes = begin(ROUTING_PART, 1 + part.len());
                let last = if *last { RoutingFragment::LAST } else { 0 };
                bytes.put_u8(last | index & RoutingFragment::INDEX_MAX);
                bytes.put_slice(part);
                bytes.freeze().into()
            }
            Frame::Taken { refused, by: NameHolder { incarnation, address } } => {
                let mut bytes = begin(TAKEN, 16 + address.len());
                bytes.put_u64(refused.0);
                bytes.put_u64(incarnation.0);
                bytes.put_slice(address.as_bytes());
                bytes.freeze().into()
            }
            Frame::Probe(size) => {
                let size = usize::from(*size).max(FRAME_HEADER);
                let mut bytes = begin(PROBE, size - FRAME_HEADER);
                bytes.resize(size, 0);
                bytes.freeze().into()
            }
            Frame::ProbeAnswer(size) => {
                let mut bytes = begin(PROBE_ANSWER, 2);
                bytes.put_u16(*size);
                bytes.freeze().into()
            }
        }
    }

    /// Reads a frame.
    ///
    /// # Errors
    /// [`WireError`] for anything that [`encode`](Frame::encode) does not write.
    pub fn decode(bytes: Bytes) -> Result<Frame, WireError> {
        let mut reader = Reader::new(bytes);
        let first = reader.u8()?;
        if first & 0xf0 != MAGIC {
            return Err(WireError::Foreign { first });
        }
        let theirs = first & 0x0f;
        if theirs != VERSION {
            return Err(WireError::Version { theirs, ours: VERSION });
        }
        match reader.u8()? {
            HELLO => Hello::decode(reader).map(Frame::Hello),
            ROUTING => Ok(Frame::Routing(reader.rest())),
            DATA => Ok(Frame::Data(reader.rest().into())),
            ROUTING_PART => {
                let first = reader.u8()?;
                let (index, last) =
                    (first & RoutingFragment::INDEX_MAX, first & RoutingFragment::LAST != 0);
                Ok(Frame::RoutingPart(RoutingFragment { index, last, bytes: reader.rest() }))
            }
            TAKEN => {
                let refused = Incarnation(reader.u64()?);
                let incarnation = Incarnation(reader.u64()?);
                let address = reader.rest();
                let malformed = WireError::Malformed { what: "a node's address" };
                let address = std::str::from_utf8(&address).map_err(|_| malformed)?;
                Ok(Frame::Taken { refused, by: NameHolder::new(incarnation, address) })
            }
            PROBE => {
                let size = u16::try_from(FRAME_HEADER + reader.rest().len());
                size.map(Frame::Probe).map_err(|_| WireError::TooLarge { what: "a probe" })
            }
            PROBE_ANSWER => {
                let size = reader.u16()?;
                reader.end("a probe's answer")?;
                Ok(Frame::ProbeAnswer(size))
            }
            _ => Err(WireError::Malformed { what: "a frame's kind" }),
        }
    }
}

impl RoutingFragment {
    /// The number of the last of the most parts.
    pub const INDEX_MAX: u8 = 127;
    const LAST: u8 = 128;
}

/// Whether these bytes are a hello. It goes before all else: a link that hellos do not keep up
/// carries nothing.
pub fn is_hello(frame: &GatherBuffer) -> bool {
    matches!(frame.pieces()[0], [_, HELLO, ..])
}

/// Whether these bytes of a frame should overtake what waits for a slow medium: hellos, what
/// routers tell each other, and packets of the class
/// [`Control`](crate::net::PacketPriority::Control), such as acknowledgements.
pub fn is_urgent(frame: &GatherBuffer) -> bool {
    let [head, body] = frame.pieces();
    match head {
        // A packet in one piece, which is too large to be copied behind this header.
        [_, DATA] => packet::is_control(body),
        [_, DATA, packet @ ..] => packet::is_control(packet),
        [_, kind, ..] => *kind != DATA,
        _ => false,
    }
}

fn wrap(kind: u8, payload: &GatherBuffer) -> GatherBuffer {
    payload.behind(begin(kind, payload.copied()))
}

/// The header of a frame, with room for so many more bytes.
fn begin(kind: u8, length: usize) -> BytesMut {
    let mut bytes = BytesMut::with_capacity(FRAME_HEADER + length);
    bytes.put_slice(&[MAGIC | VERSION, kind]);
    bytes
}

impl Hello {
    /// What six bits hold.
    pub const SKIPPED_MAX: u8 = 63;

    fn encode(&self) -> Bytes {
        let nothing = Echo { incarnation: Incarnation(0), sequence: 0, held_us: 0 };
        let echo = self.echo.unwrap_or(nothing);
        let mut bytes = begin(HELLO, 36 + self.node.as_str().len());
        bytes.put_u64(self.incarnation.0);
        bytes.put_u32(self.sequence);
        bytes.put_u32(self.interval_us);
        bytes.put_u8(self.skipped.min(Hello::SKIPPED_MAX) << 2 | self.state as u8);
        bytes.put_u16(self.loss_permille);
        bytes.put_u64(echo.incarnation.0);
        bytes.put_u32(echo.sequence);
        bytes.put_u32(echo.held_us);
        bytes.sized(self.node.as_str().as_bytes());
        bytes.freeze()
    }

    fn decode(mut reader: Reader) -> Result<Hello, WireError> {
        let incarnation = Incarnation(reader.u64()?);
        let sequence = reader.u32()?;
        let interval_us = reader.u32()?;
        let bits = reader.u8()?;
        let skipped = bits >> 2;
        let state = match bits & 3 {
            0 => HelloState::Unproved,
            1 => HelloState::Down,
            2 => HelloState::Ready,
            _ => return Err(WireError::Malformed { what: "a hello's state" }),
        };
        let loss_permille = reader.u16()?;
        let echo = Echo {
            incarnation: Incarnation(reader.u64()?),
            sequence: reader.u32()?,
            held_us: reader.u32()?,
        };
        let node = reader.parsed("a node's name")?;
        reader.end("a hello")?;
        if incarnation == Incarnation(0) {
            return Err(WireError::Malformed { what: "an incarnation" });
        }
        let echo = (echo.incarnation != Incarnation(0)).then_some(echo);
        Ok(Hello { node, incarnation, sequence, interval_us, skipped, state, loss_permille, echo })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::wire::node_id::NodeId;
    use crate::net::wire::packet::{Packet, PacketPriority, Payload};

    fn hello() -> Hello {
        Hello {
            node: NodeName::new("m1").unwrap(),
            incarnation: Incarnation(0x0102),
            sequence: 3,
            interval_us: 50_000,
            skipped: 0,
            state: HelloState::Ready,
            loss_permille: 0x0102,
            echo: Some(Echo { incarnation: Incarnation(0x0a), sequence: 9, held_us: 0x100 }),
        }
    }

    #[test]
    fn the_bytes_of_a_frame_are_these_for_ever() {
        let golden: &[u8] = &[
            0xb1, 0, 0, 0, 0, 0, 0, 0, 1, 2, 0, 0, 0, 3, 0, 0, 0xc3, 0x50, 2, 1, 2, 0, 0, 0, 0, 0,
            0, 0, 0x0a, 0, 0, 0, 9, 0, 0, 1, 0, 2, b'm', b'1',
        ];
        assert_eq!(&Frame::Hello(hello()).encode()[..], golden);
        assert_eq!(&Frame::Data(Bytes::from_static(b"xy").into()).encode()[..], b"\xb1\x02xy");
        assert_eq!(&Frame::Routing(Bytes::from_static(b"z")).encode()[..], b"\xb1\x01z");
        let part = RoutingFragment { index: 3, last: true, bytes: Bytes::from_static(b"z") };
        assert_eq!(&Frame::RoutingPart(part).encode()[..], b"\xb1\x04\x83z");
        assert_eq!(&Frame::Probe(5).encode()[..], b"\xb1\x06\0\0\0");
        assert_eq!(&Frame::ProbeAnswer(0x0102).encode()[..], b"\xb1\x07\x01\x02");
    }

    #[test]
    fn a_frame_comes_back_as_it_was() {
        let nothing_received = Hello { echo: None, ..hello() };
        let late = Hello { skipped: Hello::SKIPPED_MAX, ..hello() };
        let part = |last| RoutingFragment { index: 127, last, bytes: Bytes::from_static(b"z") };
        for frame in [
            Frame::Hello(hello()),
            Frame::Hello(nothing_received),
            Frame::Hello(late),
            Frame::Data(Bytes::new().into()),
            Frame::RoutingPart(part(false)),
            Frame::RoutingPart(part(true)),
            Frame::Taken {
                refused: Incarnation(6),
                by: NameHolder::new(Incarnation(7), "udp 127.0.0.1:7400"),
            },
            Frame::Probe(1_472),
            Frame::ProbeAnswer(u16::MAX),
        ] {
            assert_eq!(Frame::decode(frame.encode()), Ok(frame));
        }
    }

    #[test]
    fn hellos_and_routing_and_control_are_urgent_and_messages_are_not() {
        let check = |frame: Frame, expected| assert_eq!(is_urgent(&frame.parcel()), expected);
        check(Frame::Hello(hello()), true);
        check(Frame::Routing(Bytes::from_static(b"z")), true);
        assert!(is_hello(&Frame::Hello(hello()).parcel()));
        assert!(!is_hello(&Frame::Routing(Bytes::new()).parcel()));
        for (class, expected) in [(PacketPriority::Control, true), (PacketPriority::Data, false)] {
            let (destination, source) = (NodeId(1), NodeId(2));
            let (payload, passed) = (Payload::Segment(Bytes::new().into()), vec![]);
            let packet = Packet { class, hops: 1, destination, source, passed, payload };
            check(Frame::Data(packet.encode().into()), expected);
            // As large as is no longer copied, and after another node has forwarded it.
            for (length, passed) in (3_900..4_200).flat_map(|n| [(n, vec![]), (n, vec![NodeId(3)])])
            {
                let payload = Payload::Segment(Bytes::from(vec![7; length]).into());
                let (destination, source) = (NodeId(1), NodeId(2));
                let packet = Packet { class, hops: 1, destination, source, passed, payload };
                check(Frame::Data(packet.parcel()), expected);
            }
        }
        assert!(!is_urgent(&GatherBuffer::default()));
    }

    #[test]
    fn what_is_no_frame_is_refused_with_the_reason() {
        let check = |bytes: &[u8], expected| {
            assert_eq!(Frame::decode(Bytes::copy_from_slice(bytes)), Err(expected));
        };
        check(b"", WireError::Truncated);
        check(b"GET / HTTP/1.1", WireError::Foreign { first: b'G' });
        check(&[0xb2, 0], WireError::Version { theirs: 2, ours: 1 });
        check(&[0xb1, 3], WireError::Malformed { what: "a frame's kind" });
        check(&[0xb1, 9], WireError::Malformed { what: "a frame's kind" });
        check(&[0xb1, 7, 1, 2, 3], WireError::TooLarge { what: "a probe's answer" });
        check(
            &[[0xb1, 6].as_slice(), &[0; 65_534]].concat(),
            WireError::TooLarge { what: "a probe" },
        );
        let good = Frame::Hello(hello()).encode();
        for cut in 1..good.len() {
            check(&good[..cut], WireError::Truncated);
        }
        check(&[&good[..], b"!"].concat(), WireError::TooLarge { what: "a hello" });
    }
}
