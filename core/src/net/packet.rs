//! The packet: what routers pass on from node to node.
//!
//! ```text
//!      0          1               5               9
//! ┌──────────┬───────────────┬───────────────┬──────────────────────┐
//! │ cc k hops│ destination   │ source        │ segment, or a return │
//! └──────────┴───────────────┴───────────────┴──────────────────────┘
//!   cc   class: 0 control, 1 data, 2 bulk
//!   k    0 a segment for the destination's session, 1 a packet's return to its source
//!   hops how many more nodes may pass it on, 0 to 31
//!
//! return: the destination that was not reached (4), the reason (1)
//! ```

use super::node_id::NodeId;
use super::wire::{Reader, WireError};
use bytes::{BufMut, Bytes, BytesMut};
use std::fmt;

/// The bytes that a packet puts before what it carries.
pub const PACKET_HEADER: usize = 9;
/// The most nodes that may pass a packet on: five bits.
pub const HOPS_MAX: u8 = 31;

const RETURN: u8 = 0x20;

/// How urgent a packet is. A queue that is not empty lets the more urgent go first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Class {
    /// What keeps the robot together: bindings, faults, commands to recover.
    Control,
    /// What its objects say to each other.
    Data,
    /// What may wait: recordings, pictures.
    Bulk,
}

/// One packet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Packet {
    /// How urgent it is.
    pub class: Class,
    /// How many more nodes may pass it on.
    pub hops: u8,
    /// Whom it is for.
    pub destination: NodeId,
    /// Whom it is from.
    pub source: NodeId,
    /// What it carries.
    pub payload: Payload,
}

/// What a packet carries.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Payload {
    /// For the destination's session with the source.
    Segment(Bytes),
    /// A packet of the receiver's could not be delivered.
    Return {
        /// Where it should have gone.
        destination: NodeId,
        /// Why it did not.
        reason: Undelivered,
    },
}

/// Why a packet did not reach its destination.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Undelivered {
    /// No path leads there.
    NoRoute,
    /// Too many nodes have passed it on.
    TooManyHops,
    /// It is larger than the next link can carry.
    TooLarge,
}

impl Undelivered {
    /// What somebody can do about it.
    pub fn advice(self) -> &'static str {
        match self {
            Undelivered::NoRoute => "see the links of the nodes in between",
            Undelivered::TooManyHops => {
                "the path is too long, or nodes disagree about it: compare their routes"
            }
            Undelivered::TooLarge => "let the links on the way carry larger frames",
        }
    }
}

impl fmt::Display for Undelivered {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Undelivered::NoRoute => "no path leads there",
            Undelivered::TooManyHops => "too many nodes have passed it on",
            Undelivered::TooLarge => "it is larger than the next link can carry",
        })
    }
}

impl Packet {
    /// The packet's bytes.
    pub fn encode(&self) -> Bytes {
        let (kind, length) = match &self.payload {
            Payload::Segment(segment) => (0, segment.len()),
            Payload::Return { .. } => (RETURN, 5),
        };
        let mut bytes = BytesMut::with_capacity(PACKET_HEADER + length);
        bytes.put_u8((self.class as u8) << 6 | kind | self.hops.min(HOPS_MAX));
        bytes.put_u32(self.destination.0);
        bytes.put_u32(self.source.0);
        match &self.payload {
            Payload::Segment(segment) => bytes.put_slice(segment),
            Payload::Return { destination, reason } => {
                bytes.put_u32(destination.0);
                bytes.put_u8(*reason as u8);
            }
        }
        bytes.freeze()
    }

    /// Reads a packet.
    ///
    /// # Errors
    /// [`WireError`] for anything that [`encode`](Packet::encode) does not write.
    pub fn decode(bytes: Bytes) -> Result<Packet, WireError> {
        let mut reader = Reader::new(bytes);
        let first = reader.u8()?;
        let class = match first >> 6 {
            0 => Class::Control,
            1 => Class::Data,
            2 => Class::Bulk,
            _ => return Err(WireError::Malformed { what: "a packet's class" }),
        };
        let hops = first & HOPS_MAX;
        let destination = NodeId(reader.u32()?);
        let source = NodeId(reader.u32()?);
        let payload = if first & RETURN == 0 {
            Payload::Segment(reader.rest())
        } else {
            let destination = NodeId(reader.u32()?);
            let reason = match reader.u8()? {
                0 => Undelivered::NoRoute,
                1 => Undelivered::TooManyHops,
                2 => Undelivered::TooLarge,
                _ => return Err(WireError::Malformed { what: "a return's reason" }),
            };
            reader.end("a return")?;
            Payload::Return { destination, reason }
        };
        Ok(Packet { class, hops, destination, source, payload })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(payload: Payload) -> Packet {
        Packet {
            class: Class::Data,
            hops: 8,
            destination: NodeId(0x01020304),
            source: NodeId(5),
            payload,
        }
    }

    #[test]
    fn the_bytes_of_a_packet_are_these_for_ever() {
        let segment = packet(Payload::Segment(Bytes::from_static(b"hi")));
        assert_eq!(&segment.encode()[..], b"\x48\x01\x02\x03\x04\0\0\0\x05hi");
        let returned = Payload::Return { destination: NodeId(7), reason: Undelivered::TooManyHops };
        assert_eq!(&packet(returned).encode()[..], b"\x68\x01\x02\x03\x04\0\0\0\x05\0\0\0\x07\x01");
    }

    #[test]
    fn a_packet_comes_back_as_it_was_and_nothing_else_does() {
        let returned = Payload::Return { destination: NodeId(7), reason: Undelivered::NoRoute };
        for payload in [Payload::Segment(Bytes::from_static(b"hi")), returned] {
            let packet = packet(payload);
            assert_eq!(Packet::decode(packet.encode()), Ok(packet.clone()));
            for cut in 0..PACKET_HEADER {
                assert_eq!(Packet::decode(packet.encode().slice(..cut)), Err(WireError::Truncated));
            }
        }
        let no_class = Packet::decode(Bytes::from_static(&[0xc0; 9]));
        assert!(matches!(no_class, Err(WireError::Malformed { .. })));
        let no_reason =
            Packet::decode(Bytes::from_static(&[0x20, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 9]));
        assert!(matches!(no_reason, Err(WireError::Malformed { .. })));
    }
}
