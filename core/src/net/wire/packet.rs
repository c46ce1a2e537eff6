//! The packet: what routers pass on from node to node.
//!
//! ```text
//!      0          1               5               9
//! ┌──────────┬───────────────┬───────────────┬──────────────────────┐
//! │ cc k hops│ destination   │ source        │ segment, or a return │
//! └──────────┴───────────────┴───────────────┴──────────────────────┘
//!   cc   class: 0 control, 1 data; 3 for what was passed on, which has its class in its list
//!   k    0 a segment for the destination's session, 1 a packet's return to its source, or with cc 3
//!   hops how many more nodes may pass it on, 0 to 31
//!
//! return:    the destination that was not reached (4), the reason (1)
//! passed on: cc 2 bits, k 1 bit, n 5 bits │ n × relay 4 │ segment, or a return
//! ```
//!
//! Who passes a packet on writes itself behind those who did before, and gives it to none of them:
//! whatever the nodes know of each other, no packet goes over a node twice. Between neighbours the
//! list takes no byte.

use super::node_id::NodeId;
use super::{Reader, WireError};
use crate::GatherBuffer;
use bytes::{BufMut, Bytes, BytesMut};
use std::fmt;

/// The bytes that a packet puts before what it carries.
pub const PACKET_HEADER: usize = 9;
/// The most nodes that may pass a packet on: five bits.
pub const HOPS_MAX: u8 = 31;

/// The bytes that a list of so many takes who have passed a packet on.
pub(crate) const fn passed_length(relays: usize) -> usize {
    if relays == 0 { 0 } else { 1 + 4 * relays }
}

const RETURN: u8 = 0x20;
const PASSED: u8 = 0xe0;

/// How urgent a packet is. A queue that is not empty lets the more urgent go first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum PacketPriority {
    /// What keeps the robot together: bindings, faults, commands to recover.
    Control,
    /// What its objects say to each other.
    Data,
}

/// What routers pass on, with its header.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Packet {
    /// How urgent it is.
    pub class: PacketPriority,
    /// How many more nodes may pass it on.
    pub hops: u8,
    /// The node that it is for.
    pub destination: NodeId,
    /// The node that it is from.
    pub source: NodeId,
    /// Who has passed it on so far, at most [`HOPS_MAX`].
    pub passed: Vec<NodeId>,
    /// What it carries.
    pub payload: Payload,
}

/// What a packet carries.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Payload {
    /// For the destination's session with the source.
    Segment(GatherBuffer),
    /// A packet of the receiver's could not be delivered.
    Return {
        /// Where it should have gone.
        destination: NodeId,
        /// Why it did not.
        reason: UndeliveredReason,
    },
}

/// Why a packet did not reach its destination.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum UndeliveredReason {
    /// No path leads there.
    NoRoute,
    /// Too many nodes have passed it on.
    TooManyHops,
    /// It is larger than the next link can carry.
    TooLarge,
}

impl UndeliveredReason {
    /// What a user can do about it.
    pub fn advice(self) -> &'static str {
        match self {
            UndeliveredReason::NoRoute => "see the links of the nodes in between",
            UndeliveredReason::TooManyHops => {
                "the path is too long, or nodes disagree about it: compare their routes"
            }
            UndeliveredReason::TooLarge => "let the links on the way carry larger frames",
        }
    }
}

impl fmt::Display for UndeliveredReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            UndeliveredReason::NoRoute => "no path leads there",
            UndeliveredReason::TooManyHops => "too many nodes have passed it on",
            UndeliveredReason::TooLarge => "it is larger than the next link can carry",
        })
    }
}

impl Packet {
    /// The packet's bytes, in one piece.
    pub fn encode(&self) -> Bytes {
        self.parcel().into_bytes()
    }

    /// The packet's bytes. What is large of what it carries is not copied.
    pub fn parcel(&self) -> GatherBuffer {
        let class = (self.class as u8) << 6;
        let (kind, length) = match &self.payload {
            Payload::Segment(segment) => (class, segment.copied()),
            Payload::Return { .. } => (class | RETURN, 5),
        };
        let was_passed = !self.passed.is_empty();
        let list = passed_length(self.passed.len());
        let mut bytes = BytesMut::with_capacity(PACKET_HEADER + list + length);
        bytes.put_u8(if was_passed { PASSED } else { kind } | self.hops.min(HOPS_MAX));
        bytes.put_u32(self.destination.0);
        bytes.put_u32(self.source.0);
        if was_passed {
            debug_assert!(self.passed.len() <= HOPS_MAX.into());
            bytes.put_u8(kind | self.passed.len() as u8);
            self.passed.iter().for_each(|relay| bytes.put_u32(relay.0));
        }
        match &self.payload {
            Payload::Segment(segment) => segment.behind(bytes),
            Payload::Return { destination, reason } => {
                bytes.put_u32(destination.0);
                bytes.put_u8(*reason as u8);
                bytes.freeze().into()
            }
        }
    }

    /// Reads a packet.
    ///
    /// # Errors
    /// [`WireError`] for anything that [`encode`](Packet::encode) does not write.
    pub fn decode(bytes: Bytes) -> Result<Packet, WireError> {
        let mut reader = Reader::new(bytes);
        let first = reader.u8()?;
        let hops = first & HOPS_MAX;
        let destination = NodeId(reader.u32()?);
        let source = NodeId(reader.u32()?);
        let (mut kind, mut passed) = (first, Vec::new());
        if first & PASSED == PASSED {
            kind = reader.u8()?;
            passed = read_relays(&mut reader, kind & HOPS_MAX, destination, source)?;
            if passed.is_empty() {
                return Err(WireError::Malformed { what: "an empty list" });
            }
        }
        let class = read_class(kind)?;
        let payload = if kind & RETURN == 0 {
            Payload::Segment(reader.rest().into())
        } else {
            let destination = NodeId(reader.u32()?);
            let reason = match reader.u8()? {
                0 => UndeliveredReason::NoRoute,
                1 => UndeliveredReason::TooManyHops,
                2 => UndeliveredReason::TooLarge,
                _ => return Err(WireError::Malformed { what: "a return's reason" }),
            };
            reader.end("a return")?;
            Payload::Return { destination, reason }
        };
        Ok(Packet { class, hops, destination, source, passed, payload })
    }
}

/// Whether the first bytes of a packet say that it is of the class
/// [`Control`](PacketPriority::Control).
pub(crate) fn is_control(packet: &[u8]) -> bool {
    let class = match packet.first() {
        Some(first) if first & PASSED == PASSED => packet.get(PACKET_HEADER),
        first => first,
    };
    class.is_some_and(|class| class >> 6 == PacketPriority::Control as u8)
}

/// Nodes between the source and the destination, each once.
fn read_relays(
    reader: &mut Reader,
    count: u8,
    destination: NodeId,
    source: NodeId,
) -> Result<Vec<NodeId>, WireError> {
    let mut relays = Vec::new();
    for _ in 0..count {
        let relay = NodeId(reader.u32()?);
        if relay == destination || relay == source || relays.contains(&relay) {
            return Err(WireError::Malformed { what: "a packet's way, which goes in a circle," });
        }
        relays.push(relay);
    }
    Ok(relays)
}

fn read_class(first: u8) -> Result<PacketPriority, WireError> {
    match first >> 6 {
        0 => Ok(PacketPriority::Control),
        1 => Ok(PacketPriority::Data),
        _ => Err(WireError::Malformed { what: "a packet's class" }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(payload: Payload) -> Packet {
        Packet {
            class: PacketPriority::Data,
            hops: 8,
            destination: NodeId(0x01020304),
            source: NodeId(5),
            passed: Vec::new(),
            payload,
        }
    }

    fn passed_by(relays: &[u32], payload: Payload) -> Packet {
        Packet { passed: relays.iter().map(|relay| NodeId(*relay)).collect(), ..packet(payload) }
    }

    #[test]
    fn the_bytes_of_a_packet_are_these_for_ever() {
        let segment = packet(Payload::Segment(Bytes::from_static(b"hi").into()));
        assert_eq!(&segment.encode()[..], b"\x48\x01\x02\x03\x04\0\0\0\x05hi");
        let returned =
            Payload::Return { destination: NodeId(7), reason: UndeliveredReason::TooManyHops };
        assert_eq!(&packet(returned).encode()[..], b"\x68\x01\x02\x03\x04\0\0\0\x05\0\0\0\x07\x01");
        let segment = Payload::Segment(Bytes::from_static(b"hi").into());
        let bytes = b"\xe8\x01\x02\x03\x04\0\0\0\x05\x42\0\0\0\x07\0\0\0\x08hi";
        assert_eq!(&passed_by(&[7, 8], segment).encode()[..], bytes);
    }

    #[test]
    fn a_packet_comes_back_as_it_was_and_nothing_else_does() {
        let returned =
            Payload::Return { destination: NodeId(7), reason: UndeliveredReason::NoRoute };
        for payload in [Payload::Segment(Bytes::from_static(b"hi").into()), returned] {
            let packet = packet(payload);
            assert_eq!(Packet::decode(packet.encode()), Ok(packet.clone()));
            for cut in 0..PACKET_HEADER {
                assert_eq!(Packet::decode(packet.encode().slice(..cut)), Err(WireError::Truncated));
            }
        }
        for payload in [
            Payload::Segment(Bytes::from_static(b"hi").into()),
            Payload::Return { destination: NodeId(7), reason: UndeliveredReason::NoRoute },
        ] {
            let relays: Vec<_> = (10..10 + u32::from(HOPS_MAX)).collect();
            for relays in [&[7][..], &relays] {
                let packet = passed_by(relays, payload.clone());
                assert_eq!(Packet::decode(packet.encode()), Ok(packet.clone()));
                let list = PACKET_HEADER + passed_length(relays.len());
                for cut in 0..list {
                    let cut = packet.encode().slice(..cut);
                    assert_eq!(Packet::decode(cut), Err(WireError::Truncated));
                }
            }
        }
        let no_class = Packet::decode(Bytes::from_static(&[0xc0; 10]));
        assert!(matches!(no_class, Err(WireError::Malformed { .. })));
        let no_reason =
            Packet::decode(Bytes::from_static(&[0x20, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 9]));
        assert!(matches!(no_reason, Err(WireError::Malformed { .. })));
    }

    #[test]
    fn a_way_that_goes_in_a_circle_is_refused() {
        // Over a node twice, back to where it is from, or on from where it should end.
        for relays in [&[7, 8, 7][..], &[7, 5], &[0x01020304, 7]] {
            let segment = Payload::Segment(Bytes::from_static(b"hi").into());
            let refused = Packet::decode(passed_by(relays, segment).encode());
            assert!(matches!(refused, Err(WireError::Malformed { .. })), "{relays:?}");
        }
        let returned = Packet::decode(Bytes::from_static(&[0xe0; 10]));
        assert!(matches!(returned, Err(WireError::Malformed { .. })));
    }
}
