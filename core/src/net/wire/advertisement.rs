//! The messages between neighbouring routers: the links of each node, and database summaries.
//!
//! ```text
//! announce:  0 │ advertisement … to the frame's end
//! have:      1 │ range 0 or 1 │ first 4 │ last 4 │ id … to the frame's end
//!
//! advertisement: id 12 │ incarnation 8 │ n 1 │ name n │ s 1 bit, count 7 bits
//!                │ count × (neighbour 4, incarnation 1, cost 2, mtu 2) │ s: signature 64
//! id:            origin 4 │ sequence 8
//! ```
//!
//! Where nodes have keys, the origin signs its advertisement by Ed25519, so that no other node can
//! make one: it covers all bytes before it. What is no advertisement counts for the neighbour
//! alone.
//!
//! A node outdoes what an earlier incarnation of its own has said by a greater sequence (RFC 2328,
//! 13.4), whatever the clock is that numbers incarnations.
//!
//! Flooding is reliable hop by hop, as in IS-IS: an advertisement is repeated until the neighbour
//! confirms it (or a newer one). A `have` with a range lists everything between two nodes' numbers,
//! so that the neighbour lacks whatever is not in it.

use super::node_id::NodeId;
use super::{Reader, WireError, Write};
use crate::{Incarnation, NodeName};
use bytes::{BufMut, Bytes, BytesMut};

/// The most neighbours that one node may have: its advertisement takes 694 bytes then, which is one
/// frame of most media, and eight of the smallest.
pub const NEIGHBOURS_MAX: usize = 64;
/// No node numbers its incarnations as high: as milliseconds since 1970 it is in the year 2248.
pub const INCARNATION_MAX: Incarnation = Incarnation((1 << 43) - 1);
/// The bytes of one id.
pub(crate) const ID_LENGTH: usize = 12;
/// The bytes of a signature.
pub const SIGNATURE_LENGTH: usize = 64;
/// The bytes of a `have` without its ids.
pub(crate) const HAVE_HEADER: usize = 10;

const ANNOUNCE: u8 = 0;
const HAVE: u8 = 1;
const SIGNED: u8 = 128;

/// Which advertisement: of two of one origin, the greater is the newer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct AdvertisementId {
    /// The node whose links it lists.
    pub origin: NodeId,
    /// Rises with each. An incarnation begins at
    /// [`first_sequence`](AdvertisementId::first_sequence).
    pub sequence: u64,
}

/// One node's links, as it sees them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Advertisement {
    /// Its origin and its place among the origin's advertisements.
    pub id: AdvertisementId,
    /// The origin's incarnation.
    pub incarnation: Incarnation,
    /// The origin's name.
    pub node: NodeName,
    /// Whom it has links to, at most [`NEIGHBOURS_MAX`].
    pub edges: Vec<Edge>,
    /// The origin's, by Ed25519, where nodes have keys.
    pub signature: Option<[u8; SIGNATURE_LENGTH]>,
}

/// One link, in one direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Edge {
    /// The node at the link's other end.
    pub to: NodeId,
    /// To which of its incarnations, as [`incarnation_tag`](Edge::incarnation_tag) has it: while a
    /// node restarts, some know its new incarnation already, and their links lead to no earlier
    /// one.
    pub incarnation: u8,
    /// How dear it is to use; at least 1.
    pub cost: u16,
    /// The largest frame that it carries, in bytes; saturates.
    /// [`CHALLENGE`](Edge::CHALLENGE) is no link.
    pub mtu: u16,
}

/// What a router says to its neighbour's.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RoutingMessage {
    /// These are the newest that I know.
    Announce(Vec<Advertisement>),
    /// I have these.
    Have {
        /// Of all origins from the first to the last, I have exactly these.
        range: Option<(NodeId, NodeId)>,
        /// Which. A sequence of 0 asks for the origin's advertisement.
        ids: Vec<AdvertisementId>,
    },
}

impl Edge {
    /// The MTU of an edge by which the origin challenges a node: is it there? The node answers by
    /// its next advertisement. No path leads over it.
    pub const CHALLENGE: u16 = 0;

    /// What an edge says of an incarnation: its last eight bits, which two incarnations that follow
    /// each other share by chance at most.
    pub fn incarnation_tag(incarnation: Incarnation) -> u8 {
        incarnation.0 as u8
    }
}

impl AdvertisementId {
    /// The sequence with which an incarnation begins: above all of those of an earlier one, unless
    /// the clock was set back, and far below the highest.
    pub fn first_sequence(incarnation: Incarnation) -> u64 {
        // Milliseconds, each with room for a million advertisements.
        (incarnation.0 & INCARNATION_MAX.0) << 20
    }

    fn put(&self, bytes: &mut BytesMut) {
        bytes.put_u32(self.origin.0);
        bytes.put_u64(self.sequence);
    }

    fn read(reader: &mut Reader) -> Result<AdvertisementId, WireError> {
        Ok(AdvertisementId { origin: NodeId(reader.u32()?), sequence: reader.u64()? })
    }
}

impl Advertisement {
    /// How many bytes it takes.
    pub(crate) fn length(&self) -> usize {
        let signature = self.signature.map_or(0, |signature| signature.len());
        ID_LENGTH + 8 + 2 + self.node.as_str().len() + 9 * self.edges.len() + signature
    }

    /// Of two of one origin, every node takes the greater, also of two that differ and have one id
    /// (RFC 2328, 13.1).
    pub(crate) fn rank(&self) -> impl PartialOrd + use<'_> {
        (self.id, self.incarnation, &self.edges, self.signature)
    }

    /// The bytes that a signature covers.
    pub(crate) fn signed_part(&self) -> Bytes {
        let mut bytes = BytesMut::with_capacity(self.length());
        self.put_unsigned(&mut bytes, SIGNED);
        bytes.freeze()
    }

    fn put(&self, bytes: &mut BytesMut) {
        self.put_unsigned(bytes, if self.signature.is_some() { SIGNED } else { 0 });
        bytes.extend_from_slice(self.signature.as_ref().map_or(&[][..], |signature| signature));
    }

    fn put_unsigned(&self, bytes: &mut BytesMut, signed: u8) {
        self.id.put(bytes);
        bytes.put_u64(self.incarnation.0);
        bytes.sized(self.node.as_str().as_bytes());
        bytes.put_u8(signed | self.edges.len().min(NEIGHBOURS_MAX) as u8);
        for edge in self.edges.iter().take(NEIGHBOURS_MAX) {
            bytes.put_u32(edge.to.0);
            bytes.put_u8(edge.incarnation);
            bytes.put_u16(edge.cost);
            bytes.put_u16(edge.mtu);
        }
    }

    fn read(reader: &mut Reader) -> Result<Advertisement, WireError> {
        let id = AdvertisementId::read(reader)?;
        let incarnation = Incarnation(reader.u64()?);
        let node: NodeName = reader.parsed("a node's name")?;
        if NodeId::of(&node) != id.origin || id.sequence == 0 {
            return Err(WireError::Malformed { what: "an advertisement's origin" });
        }
        let count = reader.u8()?;
        let (is_signed, count) = (count & SIGNED != 0, usize::from(count & !SIGNED));
        if count > NEIGHBOURS_MAX {
            return Err(WireError::TooLarge { what: "an advertisement" });
        }
        let mut edges = Vec::with_capacity(count);
        for _ in 0..count {
            let (to, incarnation) = (NodeId(reader.u32()?), reader.u8()?);
            let edge = Edge { to, incarnation, cost: reader.u16()?, mtu: reader.u16()? };
            if edge.cost == 0 {
                return Err(WireError::Malformed { what: "a link's cost" });
            }
            edges.push(edge);
        }
        let signature = if is_signed { Some(reader.array()?) } else { None };
        Ok(Advertisement { id, incarnation, node, edges, signature })
    }
}

impl RoutingMessage {
    /// Returns the encoded message.
    pub fn encode(&self) -> Bytes {
        let mut bytes = BytesMut::new();
        match self {
            RoutingMessage::Announce(advertisements) => {
                bytes.put_u8(ANNOUNCE);
                for advertisement in advertisements {
                    advertisement.put(&mut bytes);
                }
            }
            RoutingMessage::Have { range, ids } => {
                bytes.put_u8(HAVE);
                let (first, last) = range.unwrap_or((NodeId(0), NodeId(0)));
                bytes.put_u8(range.is_some().into());
                bytes.put_u32(first.0);
                bytes.put_u32(last.0);
                for advertisement_id in ids {
                    advertisement_id.put(&mut bytes);
                }
            }
        }
        bytes.freeze()
    }

    /// Reads what a neighbour's router said.
    ///
    /// # Errors
    /// [`WireError`] for anything that [`encode`](RoutingMessage::encode) does not write.
    pub fn decode(bytes: Bytes) -> Result<RoutingMessage, WireError> {
        let mut reader = Reader::new(bytes);
        match reader.u8()? {
            ANNOUNCE => {
                let mut advertisements = Vec::new();
                while !reader.is_empty() {
                    advertisements.push(Advertisement::read(&mut reader)?);
                }
                Ok(RoutingMessage::Announce(advertisements))
            }
            HAVE => {
                let ranged = match reader.u8()? {
                    0 => false,
                    1 => true,
                    _ => return Err(WireError::Malformed { what: "a have's range" }),
                };
                let range = (NodeId(reader.u32()?), NodeId(reader.u32()?));
                let mut ids = Vec::new();
                while !reader.is_empty() {
                    ids.push(AdvertisementId::read(&mut reader)?);
                }
                Ok(RoutingMessage::Have { range: ranged.then_some(range), ids })
            }
            _ => Err(WireError::Malformed { what: "a routing message's kind" }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn advertisement() -> Advertisement {
        let node = NodeName::new("m1").unwrap();
        let advertisement_id = AdvertisementId { origin: NodeId::of(&node), sequence: 3 };
        let edges = vec![Edge { to: NodeId(9), incarnation: 7, cost: 10, mtu: 1400 }];
        let incarnation = Incarnation(2);
        Advertisement { id: advertisement_id, incarnation, node, edges, signature: None }
    }

    #[test]
    fn the_bytes_of_routing_messages_are_these_for_ever() {
        let origin = NodeId::of(&NodeName::new("m1").unwrap()).0.to_be_bytes();
        let advertisement_id = [&origin[..], &[0, 0, 0, 0, 0, 0, 0, 3]].concat();
        let head = [&[0], &advertisement_id[..], &[0, 0, 0, 0, 0, 0, 0, 2]].concat();
        let announce = [&head[..], b"\x02m1\x01\0\0\0\x09\x07\0\x0a\x05\x78"].concat();
        assert_eq!(&RoutingMessage::Announce(vec![advertisement()]).encode()[..], announce);
        let signed = Advertisement { signature: Some([5; SIGNATURE_LENGTH]), ..advertisement() };
        let part = [&head[1..], b"\x02m1\x81\0\0\0\x09\x07\0\x0a\x05\x78"].concat();
        assert_eq!(&signed.signed_part()[..], part);
        let announce = [&[0], &part[..], &[5; SIGNATURE_LENGTH]].concat();
        assert_eq!(&RoutingMessage::Announce(vec![signed]).encode()[..], announce);
        let range = Some((NodeId(1), NodeId(2)));
        let have = RoutingMessage::Have { range, ids: vec![advertisement().id] };
        assert_eq!(
            &have.encode()[..],
            [b"\x01\x01\0\0\0\x01\0\0\0\x02", &advertisement_id[..]].concat()
        );
    }

    #[test]
    fn routing_messages_come_back_as_they_were_and_cut_ones_do_not() {
        let signed = Advertisement { signature: Some([5; SIGNATURE_LENGTH]), ..advertisement() };
        let announce =
            RoutingMessage::Announce(vec![advertisement(), signed.clone(), advertisement()]);
        assert_eq!(RoutingMessage::decode(announce.encode()), Ok(announce));
        for range in [None, Some((NodeId(0), NodeId(u32::MAX)))] {
            let have = RoutingMessage::Have { range, ids: vec![advertisement().id; 3] };
            assert_eq!(RoutingMessage::decode(have.encode()), Ok(have));
        }
        for advertisement in [advertisement(), signed] {
            let one = RoutingMessage::Announce(vec![advertisement.clone()]).encode();
            assert_eq!(one.len(), 1 + advertisement.length());
            for cut in 2..one.len() {
                assert_eq!(RoutingMessage::decode(one.slice(..cut)), Err(WireError::Truncated));
            }
        }
    }

    #[test]
    fn an_advertisement_whose_number_is_not_its_names_is_refused() {
        let mut forged = advertisement();
        forged.id.origin = NodeId(1);
        let bytes = RoutingMessage::Announce(vec![forged]).encode();
        assert!(matches!(RoutingMessage::decode(bytes), Err(WireError::Malformed { .. })));
    }
}
