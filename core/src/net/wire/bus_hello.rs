//! The greeting: one hello that all nodes of a bus hear.
//!
//! ```text
//! as a frame of kind 3, 10 to 23 bytes and the name, then 9 or 13 bytes for each word:
//!      2         1..10         4        1..5         1     1    n
//! ┌────────┬─────────────┬──────────┬─────────────┬──────┬───┬──────┬──────┬──────┬─
//! │ 1011 v │ incarnation │ sequence │ interval µs │ turn │ n │ name │ word │ word │ …
//! │   3    │             │          │             │      │   │      │      │      │
//! └────────┴─────────────┴──────────┴─────────────┴──────┴───┴──────┴──────┴──────┴─
//!
//! word:     4             2                  2              2             3
//! ┌───────────────┬──────────────────┬───────────────┬───────────────┬─────────┐
//! │ whom it is to │ stance, e, loss ‰│ incarnation   │ echoed seq.   │held 4 µs│  the last three
//! └───────────────┴──────────────────┴───────────────┴───────────────┴─────────┘  only where e is set
//!   stance: 2 bits │ e: 1 bit, an echo follows │ 3 bits 0 │ loss: 10 bits
//! ```
//!
//! What a hello says to its one neighbour stands in a word here, and the words ride in turn: with
//! turn 3, each neighbour has one in every third greeting, whose silence in between says nothing.
//! That a greeting came is a sign of life to all. Of the echoed incarnation and sequence the lower
//! 16 bits are enough: the one who is spoken to knows the rest.

use super::hello_state::HelloState;
use super::node_id::NodeId;
use super::{Reader, WireError, Write};
use crate::{Incarnation, NodeName};
use bytes::{BufMut, BytesMut};

/// The most words that are read: as many as a bus has nodes.
const WORDS_MAX: usize = 255;
const ECHO: u16 = 1 << 13;
const LOSS: u16 = (1 << 10) - 1;
/// The unit in which it is said how long an echo was held, in microseconds: 24 bits are a minute
/// then.
const HELD_UNIT_US: u32 = 4;
const HELD_MAX: u32 = (1 << 24) - 1;

/// A sign of life to all nodes of a bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BusHello {
    /// Who speaks.
    pub node: NodeName,
    /// In which incarnation.
    pub incarnation: Incarnation,
    /// The number of the interval in which it was sent, counted from the clock's origin.
    pub sequence: u32,
    /// How long an interval is, in microseconds.
    pub interval_us: u32,
    /// Each neighbour has a word in one of so many greetings; never 0.
    pub turn: u8,
    /// To some of the neighbours.
    pub words: Vec<NeighbourEntry>,
}

/// What a greeting says to one of those who hear it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NeighbourEntry {
    /// To whom.
    pub to: NodeId,
    /// Whether the speaker would use the link between the two.
    pub stance: HelloState,
    /// How many of a thousand of the other's greetings it has lost lately.
    pub loss_permille: u16,
    /// What it heard last of the other; `None` if nothing yet.
    pub echo: Option<CompactEcho>,
}

/// What a node heard last of one that it greets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CompactEcho {
    /// The lower bits of the other's incarnation.
    pub incarnation: u16,
    /// The lower bits of the number of its last greeting.
    pub sequence: u16,
    /// How long ago it came, in microseconds, to four of them; saturates.
    pub held_us: u32,
}

impl BusHello {
    /// No greeting is longer than this, in bytes.
    pub(super) fn length_at_most(&self) -> usize {
        23 + self.node.as_str().len() + 13 * self.words.len()
    }

    pub(super) fn encode(&self, bytes: &mut BytesMut) {
        bytes.varint(self.incarnation.0);
        bytes.put_u32(self.sequence);
        bytes.varint(self.interval_us.into());
        bytes.put_u8(self.turn);
        bytes.sized(self.node.as_str().as_bytes());
        for word in &self.words {
            bytes.put_u32(word.to.0);
            let echo = if word.echo.is_some() { ECHO } else { 0 };
            bytes.put_u16((word.stance as u16) << 14 | echo | word.loss_permille.min(1_000));
            if let Some(CompactEcho { incarnation, sequence, held_us }) = word.echo {
                bytes.put_u16(incarnation);
                bytes.put_u16(sequence);
                let held = (held_us / HELD_UNIT_US).min(HELD_MAX);
                bytes.put_u8((held >> 16) as u8);
                bytes.put_u16(held as u16);
            }
        }
    }

    pub(super) fn decode(mut reader: Reader) -> Result<Self, WireError> {
        let incarnation = Incarnation(reader.varint()?);
        if incarnation == Incarnation(0) {
            return Err(WireError::Malformed { what: "an incarnation" });
        }
        let sequence = reader.u32()?;
        let interval_us = u32::try_from(reader.varint()?)
            .map_err(|_| WireError::Malformed { what: "a greeting's interval" })?;
        let turn = reader.u8()?;
        if turn == 0 {
            return Err(WireError::Malformed { what: "a greeting's turn" });
        }
        let node = reader.parsed("a node's name")?;
        let mut words = Vec::new();
        while !reader.is_empty() {
            if words.len() == WORDS_MAX {
                return Err(WireError::TooLarge { what: "a greeting" });
            }
            words.push(NeighbourEntry::decode(&mut reader)?);
        }
        Ok(BusHello { node, incarnation, sequence, interval_us, turn, words })
    }
}

impl NeighbourEntry {
    fn decode(reader: &mut Reader) -> Result<Self, WireError> {
        let to = NodeId(reader.u32()?);
        let flags = reader.u16()?;
        let stance = match flags >> 14 {
            0 => HelloState::Unproved,
            1 => HelloState::Down,
            2 => HelloState::Ready,
            _ => return Err(WireError::Malformed { what: "a word's stance" }),
        };
        if flags & !(LOSS | ECHO | 3 << 14) != 0 || flags & LOSS > 1_000 {
            return Err(WireError::Malformed { what: "a word" });
        }
        let echo = if flags & ECHO == 0 {
            None
        } else {
            let (incarnation, sequence) = (reader.u16()?, reader.u16()?);
            let held = u32::from(reader.u8()?) << 16 | u32::from(reader.u16()?);
            Some(CompactEcho { incarnation, sequence, held_us: held * HELD_UNIT_US })
        };
        Ok(NeighbourEntry { to, stance, loss_permille: flags & LOSS, echo })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::wire::frame::Frame;
    use bytes::Bytes;

    fn greeting() -> BusHello {
        let echo = CompactEcho { incarnation: 0x0a0b, sequence: 9, held_us: 0x400 };
        let word = NeighbourEntry {
            to: NodeId(0x0102_0304),
            stance: HelloState::Ready,
            loss_permille: 1_000,
            echo: Some(echo),
        };
        let unheard = NeighbourEntry {
            to: NodeId(5),
            stance: HelloState::Down,
            loss_permille: 0,
            echo: None,
        };
        BusHello {
            node: NodeName::new("m1").unwrap(),
            incarnation: Incarnation(0x80),
            sequence: 3,
            interval_us: 50_000,
            turn: 2,
            words: vec![word, unheard],
        }
    }

    #[test]
    fn the_bytes_of_a_greeting_are_these_for_ever() {
        let golden: &[u8] = &[
            0xb1, 3, 0x80, 1, 0, 0, 0, 3, 0xd0, 0x86, 3, 2, 2, b'm', b'1', //
            1, 2, 3, 4, 0xa3, 0xe8, 0x0a, 0x0b, 0, 9, 0, 1, 0, //
            0, 0, 0, 5, 0x40, 0,
        ];
        assert_eq!(&Frame::Greeting(greeting()).encode()[..], golden);
    }

    #[test]
    fn a_greeting_comes_back_as_it_was_and_nothing_else_does() {
        let frame = Frame::Greeting(greeting());
        let bytes = frame.encode();
        assert_eq!(Frame::decode(bytes.clone()), Ok(frame));
        assert!(bytes.len() <= greeting().length_at_most());
        // A greeting that ends between two words is one with fewer words.
        for cut in (2..bytes.len()).filter(|cut| ![15, 28].contains(cut)) {
            assert_eq!(Frame::decode(bytes.slice(..cut)), Err(WireError::Truncated), "{cut}");
        }
        // No incarnation, no turn, no name, no stance, a bit that means nothing, more lost than
        // there was.
        for (at, byte) in [(2, 0), (11, 0), (13, b'/'), (19, 0xe3), (19, 0xa7), (20, 0xe9)] {
            let mut wrong = bytes.to_vec();
            wrong[at] = byte;
            assert!(Frame::decode(Bytes::from(wrong)).is_err(), "{byte:#04x} at {at}");
        }
    }

    #[test]
    fn a_flood_of_words_is_refused() {
        let word = greeting().words[1];
        let flood = BusHello { words: vec![word; WORDS_MAX + 1], ..greeting() };

        let refused = Frame::decode(Frame::Greeting(flood).encode());

        assert_eq!(refused, Err(WireError::TooLarge { what: "a greeting" }));
    }

    #[test]
    fn an_echo_that_was_held_for_longer_than_can_be_said_is_said_as_the_longest() {
        let mut long = greeting();
        long.words[0].echo = Some(CompactEcho { incarnation: 1, sequence: 1, held_us: u32::MAX });

        let Ok(Frame::Greeting(read)) = Frame::decode(Frame::Greeting(long).encode()) else {
            panic!("it is a greeting");
        };

        assert_eq!(read.words[0].echo.unwrap().held_us, HELD_MAX * HELD_UNIT_US);
    }
}
