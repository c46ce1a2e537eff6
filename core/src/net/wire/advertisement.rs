//! The messages between neighbouring routers: the links of each node, and database summaries.
//!
//! ```text
//! announce:  0 │ advertisement … to the frame's end
//! have:      1 │ range 0 or 1 │ first 4 │ last 4 │ id … to the frame's end
//! dispute:   2 │ id 16 │ n 1 │ name n
//! defend:    3 │ incarnation 8 │ advertisement
//! numbered:  4 │ link 2
//! gave up:   5 │ link 2
//!
//! advertisement: id 16 │ n 1 │ name n │ count 1 │ count × (neighbour 4, incarnation 1, cost 2, mtu 2)
//! id:            origin 4 │ incarnation 8 │ sequence 4
//! ```
//!
//! A count of 128 withdraws the advertisement with that id. Only so can an origin remove an
//! advertisement that another node has sent in its name under the highest sequence, or with an
//! incarnation that it never had (RFC 2328, 12.1.6 and 14.1, where an age does the same).
//!
//! Flooding is reliable hop by hop, as in IS-IS: an advertisement is repeated until the neighbour
//! confirms it (or a newer one). A `have` with a range lists everything between two nodes' numbers,
//! so that the neighbour lacks whatever is not in it.

use super::node_id::NodeId;
use super::{Reader, WireError, Write};
use crate::net::wire::link_id::LinkId;
use crate::{Incarnation, NodeName};
use bytes::{BufMut, Bytes, BytesMut};

/// The most neighbours that one node may have: its advertisement takes 626 bytes then, which is one
/// frame of most media, and seven of the smallest.
pub const NEIGHBOURS_MAX: usize = 64;
/// The bytes of one id.
pub(crate) const ID_LENGTH: usize = 16;
/// The bytes of a `have` without its ids.
pub(crate) const HAVE_HEADER: usize = 10;

const ANNOUNCE: u8 = 0;
const HAVE: u8 = 1;
const WITHDRAWN: u8 = 128;
const DISPUTE: u8 = 2;
const DEFEND: u8 = 3;
const NUMBERED: u8 = 4;
const GAVE_UP: u8 = 5;

/// Which advertisement: of two of one origin, the greater is the newer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct AdvertisementId {
    /// Whose.
    pub origin: NodeId,
    /// In which incarnation.
    pub incarnation: Incarnation,
    /// The n-th of that incarnation.
    pub sequence: u32,
}

/// One node's links, as it sees them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Advertisement {
    /// Which.
    pub id: AdvertisementId,
    /// The origin's name.
    pub node: NodeName,
    /// Whom it has links to, at most [`NEIGHBOURS_MAX`].
    pub edges: Vec<Edge>,
    /// The advertisement with this id is void; it has no edges.
    pub withdrawn: bool,
}

/// One link, in one direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Edge {
    /// To whom.
    pub to: NodeId,
    /// To which of its incarnations, as [`incarnation_tag`](Edge::incarnation_tag) has it: while a
    /// node restarts, some know its new incarnation already, and their links lead to no earlier
    /// one.
    pub incarnation: u8,
    /// How dear it is to use; at least 1.
    pub cost: u16,
    /// The largest frame that it carries, in bytes; saturates.
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
    /// A later incarnation of a node has come up, while routes lead to an older one: is that still
    /// there?
    Dispute {
        /// The later incarnation; its sequence says nothing.
        contender: AdvertisementId,
        /// The name of both.
        node: NodeName,
    },
    /// The older incarnation is there.
    Defend {
        /// The later incarnation, which is another node.
        against: Incarnation,
        /// The older one's newest.
        advertisement: Advertisement,
    },
    /// I call this link so.
    Numbered(LinkId),
    /// Another link between us, which you call so, carries no more at this end.
    GaveUp(LinkId),
}

impl Edge {
    /// What an edge says of an incarnation: its last eight bits, which two incarnations that follow
    /// each other share by chance at most.
    pub fn incarnation_tag(incarnation: Incarnation) -> u8 {
        incarnation.0 as u8
    }
}

impl AdvertisementId {
    fn put(&self, bytes: &mut BytesMut) {
        bytes.put_u32(self.origin.0);
        bytes.put_u64(self.incarnation.0);
        bytes.put_u32(self.sequence);
    }

    fn read(reader: &mut Reader) -> Result<AdvertisementId, WireError> {
        Ok(AdvertisementId {
            origin: NodeId(reader.u32()?),
            incarnation: Incarnation(reader.u64()?),
            sequence: reader.u32()?,
        })
    }
}

impl Advertisement {
    /// How many bytes it takes.
    pub(crate) fn length(&self) -> usize {
        ID_LENGTH + 2 + self.node.as_str().len() + 9 * self.edges.len()
    }

    /// What takes this one back.
    pub(crate) fn withdrawal(&self) -> Advertisement {
        let node = self.node.clone();
        Advertisement { id: self.id, node, edges: Vec::new(), withdrawn: true }
    }

    fn put(&self, bytes: &mut BytesMut) {
        self.id.put(bytes);
        bytes.sized(self.node.as_str().as_bytes());
        if self.withdrawn {
            return bytes.put_u8(WITHDRAWN);
        }
        bytes.put_u8(self.edges.len().min(NEIGHBOURS_MAX) as u8);
        for edge in self.edges.iter().take(NEIGHBOURS_MAX) {
            bytes.put_u32(edge.to.0);
            bytes.put_u8(edge.incarnation);
            bytes.put_u16(edge.cost);
            bytes.put_u16(edge.mtu);
        }
    }

    fn read(reader: &mut Reader) -> Result<Advertisement, WireError> {
        let advertisement_id = AdvertisementId::read(reader)?;
        let node: NodeName = reader.parsed("a node's name")?;
        if NodeId::of(&node) != advertisement_id.origin || advertisement_id.sequence == 0 {
            return Err(WireError::Malformed { what: "an advertisement's origin" });
        }
        let count = reader.u8()?;
        if count == WITHDRAWN {
            return Ok(Advertisement {
                id: advertisement_id,
                node,
                edges: Vec::new(),
                withdrawn: true,
            });
        }
        let count = usize::from(count);
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
        Ok(Advertisement { id: advertisement_id, node, edges, withdrawn: false })
    }
}

impl RoutingMessage {
    /// Its bytes.
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
            RoutingMessage::Dispute { contender, node } => {
                bytes.put_u8(DISPUTE);
                contender.put(&mut bytes);
                bytes.sized(node.as_str().as_bytes());
            }
            RoutingMessage::Defend { against, advertisement } => {
                bytes.put_u8(DEFEND);
                bytes.put_u64(against.0);
                advertisement.put(&mut bytes);
            }
            RoutingMessage::Numbered(link) | RoutingMessage::GaveUp(link) => {
                let gave_up = matches!(self, RoutingMessage::GaveUp(_));
                bytes.put_u8(if gave_up { GAVE_UP } else { NUMBERED });
                bytes.put_u16(link.0);
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
            DISPUTE => {
                let contender = AdvertisementId::read(&mut reader)?;
                let node: NodeName = reader.parsed("a node's name")?;
                if NodeId::of(&node) != contender.origin {
                    return Err(WireError::Malformed { what: "a dispute's origin" });
                }
                Ok(RoutingMessage::Dispute { contender, node })
            }
            DEFEND => {
                let against = Incarnation(reader.u64()?);
                let advertisement = Advertisement::read(&mut reader)?;
                Ok(RoutingMessage::Defend { against, advertisement })
            }
            kind @ (NUMBERED | GAVE_UP) => {
                let link = LinkId(reader.u16()?);
                reader.end("a link's number")?;
                Ok(if kind == GAVE_UP {
                    RoutingMessage::GaveUp(link)
                } else {
                    RoutingMessage::Numbered(link)
                })
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
        let advertisement_id =
            AdvertisementId { origin: NodeId::of(&node), incarnation: Incarnation(2), sequence: 3 };
        let edges = vec![Edge { to: NodeId(9), incarnation: 7, cost: 10, mtu: 1400 }];
        Advertisement { id: advertisement_id, node, edges, withdrawn: false }
    }

    #[test]
    fn the_bytes_of_routing_messages_are_these_for_ever() {
        let origin = NodeId::of(&NodeName::new("m1").unwrap()).0.to_be_bytes();
        let advertisement_id = [&origin[..], &[0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 3]].concat();
        let announce =
            [&[0], &advertisement_id[..], b"\x02m1\x01\0\0\0\x09\x07\0\x0a\x05\x78"].concat();
        assert_eq!(&RoutingMessage::Announce(vec![advertisement()]).encode()[..], announce);
        let range = Some((NodeId(1), NodeId(2)));
        let have = RoutingMessage::Have { range, ids: vec![advertisement().id] };
        assert_eq!(
            &have.encode()[..],
            [b"\x01\x01\0\0\0\x01\0\0\0\x02", &advertisement_id[..]].concat()
        );
    }

    #[test]
    fn routing_messages_come_back_as_they_were_and_cut_ones_do_not() {
        let withdrawal = advertisement().withdrawal();
        let announce = RoutingMessage::Announce(vec![advertisement(), withdrawal, advertisement()]);
        assert_eq!(RoutingMessage::decode(announce.encode()), Ok(announce));
        for range in [None, Some((NodeId(0), NodeId(u32::MAX)))] {
            let have = RoutingMessage::Have { range, ids: vec![advertisement().id; 3] };
            assert_eq!(RoutingMessage::decode(have.encode()), Ok(have));
        }
        let contender = AdvertisementId { sequence: 0, ..advertisement().id };
        let dispute = RoutingMessage::Dispute { contender, node: advertisement().node };
        assert_eq!(RoutingMessage::decode(dispute.encode()), Ok(dispute));
        let against = Incarnation(9);
        let defend = RoutingMessage::Defend { against, advertisement: advertisement() };
        assert_eq!(RoutingMessage::decode(defend.encode()), Ok(defend));
        for (sent, bytes) in [
            (RoutingMessage::Numbered(LinkId(0x0102)), b"\x04\x01\x02"),
            (RoutingMessage::GaveUp(LinkId(0x0102)), b"\x05\x01\x02"),
        ] {
            assert_eq!(&sent.encode()[..], bytes);
            assert_eq!(RoutingMessage::decode(sent.encode()), Ok(sent));
            assert!(RoutingMessage::decode([&bytes[..], b"\0"].concat().into()).is_err());
        }
        let one = RoutingMessage::Announce(vec![advertisement()]).encode();
        assert_eq!(one.len(), 1 + advertisement().length());
        for cut in 2..one.len() {
            assert_eq!(RoutingMessage::decode(one.slice(..cut)), Err(WireError::Truncated));
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
