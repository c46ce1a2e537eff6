//! The protocol data unit of ISO 15765-2 in one CAN frame.
//!
//! ```text
//! byte            0         1         2       …
//! single      │ 0 │ n │ data, n = 1 to 7
//!             │ 0 │ 0 │ n, 8 to 62 │ data …               in CAN FD frames of more than 8 bytes
//! first       │ 1 │ length, 12 bits │ data …
//!             │ 1 │ 0   0           │ length, 32 bits │ data …           above 4,095 bytes
//! consecutive │ 2 │ number, 1 to 15, 0, 1 … │ data …
//! flow        │ 3 │ 0 go on, 1 wait, 2 too long │ block size │ STmin │
//! ```

use super::super::frame::{CLASSIC_MAX, CanFrame, CanId, Format};
use std::time::Duration;

const SINGLE: u8 = 0;
const FIRST: u8 = 1;
const CONSECUTIVE: u8 = 2;
const FLOW: u8 = 3;

/// The longest message whose length fits into 12 bits.
pub const SHORT_LENGTH_MAX: usize = 4095;
/// What stands in bytes that say nothing, where a frame cannot be shorter: with it, no bit is
/// stuffed.
const FILLER: u8 = 0xcc;

/// What one frame says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pdu<'a> {
    /// A whole message.
    Single(&'a [u8]),
    /// The beginning of a message.
    First {
        /// The message's length.
        length: u32,
        /// Its first bytes.
        data: &'a [u8],
    },
    /// More of a message.
    Consecutive {
        /// Its place, counted in 16s.
        sequence: u8,
        /// The bytes, and after the last of them some that say nothing.
        data: &'a [u8],
    },
    /// How the rest of a message is to be sent.
    Flow(FlowControl),
}

/// How the rest of a message is to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FlowControl {
    /// Whether the sender goes on, waits or stops.
    pub status: FlowStatus,
    /// After so many frames the sender waits for the next word; 0 for never.
    pub block_size: u8,
    /// The least time between two frames.
    pub separation: SeparationTime,
}

/// Whether the rest of a message is to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FlowStatus {
    /// The sender sends the next block.
    Continue,
    /// Not yet: wait for the next word.
    Wait,
    /// Never: the message is too long.
    Overflow,
}

/// STmin, the least time between two consecutive frames, as it is written in a byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SeparationTime(pub u8);

impl SeparationTime {
    /// The longest that can be written.
    const LONGEST: u8 = 0x7f;

    /// The least that is not below `span`: steps of 100 µs below a millisecond, of 1 ms up to 127.
    pub fn at_least(span: Duration) -> Self {
        let micros = span.as_micros();
        SeparationTime(match micros {
            0 => 0,
            1..=900 => 0xf0 + micros.div_ceil(100) as u8,
            901..=127_000 => micros.div_ceil(1000) as u8,
            _ => Self::LONGEST,
        })
    }

    /// As a span. What the standard reserves counts as the longest, as it demands.
    pub fn span(self) -> Duration {
        match self.0 {
            millis @ 0..=Self::LONGEST => Duration::from_millis(millis.into()),
            tenths @ 0xf1..=0xf9 => Duration::from_micros(u64::from(tenths - 0xf0) * 100),
            _ => Duration::from_millis(Self::LONGEST.into()),
        }
    }
}

impl<'a> Pdu<'a> {
    /// Reads the data of a CAN frame; `None` for anything that the standard does not let a node
    /// send. It is ignored, as the standard demands.
    pub fn decode(data: &'a [u8]) -> Option<Pdu<'a>> {
        let (&first, rest) = data.split_first()?;
        let low = first & 0x0f;
        match first >> 4 {
            SINGLE => Self::single(low, data),
            FIRST => Self::first(low, data),
            CONSECUTIVE => {
                (!rest.is_empty()).then_some(Pdu::Consecutive { sequence: low, data: rest })
            }
            FLOW => {
                let [block_size, separation, ..] = *rest else { return None };
                let status = match low {
                    0 => FlowStatus::Continue,
                    1 => FlowStatus::Wait,
                    2 => FlowStatus::Overflow,
                    _ => return None,
                };
                let separation = SeparationTime(separation);
                Some(Pdu::Flow(FlowControl { status, block_size, separation }))
            }
            _ => None,
        }
    }

    fn single(low: u8, data: &'a [u8]) -> Option<Pdu<'a>> {
        let is_short = data.len() <= CLASSIC_MAX;
        let (length, header) = match (low, data) {
            (1..=7, _) if is_short => (low, 1),
            (0, [_, length @ 8..=u8::MAX, ..]) if !is_short => (*length, 2),
            _ => return None,
        };
        data.get(header..header + usize::from(length)).map(Pdu::Single)
    }

    fn first(low: u8, data: &'a [u8]) -> Option<Pdu<'a>> {
        let &[_, second, a, b, c, d, _, _, ..] = data else { return None };
        let short = u32::from(low) << 8 | u32::from(second);
        if short != 0 {
            // Shorter messages fit into a single frame.
            let least = if data.len() == CLASSIC_MAX { CLASSIC_MAX } else { data.len() - 1 };
            let fits = (short as usize) < least;
            return (!fits).then_some(Pdu::First { length: short, data: &data[2..] });
        }
        let length = u32::from_be_bytes([a, b, c, d]);
        let is_long = length as usize > SHORT_LENGTH_MAX;
        is_long.then_some(Pdu::First { length, data: &data[6..] })
    }
}

/// Writes frames to one target.
#[derive(Clone, Copy, Debug)]
pub struct PduWriter {
    /// What stands before the data.
    pub id: CanId,
    /// Classic or FD.
    pub format: Format,
}

impl PduWriter {
    /// The longest message that fits into a single frame.
    pub fn single_max(&self) -> usize {
        match self.format {
            Format::Classic => self.format.capacity() - 1,
            Format::Fd { .. } => self.format.capacity() - 2,
        }
    }

    /// A message in one frame. It is at most [`single_max`](PduWriter::single_max) long.
    pub fn single(&self, message: &[u8]) -> CanFrame {
        let length = message.len() as u8;
        if message.len() < CLASSIC_MAX {
            self.frame(&[SINGLE << 4 | length], message)
        } else {
            self.frame(&[SINGLE << 4, length], message)
        }
    }

    /// The beginning of a message, and how much of it that was.
    pub fn first(&self, message: &[u8]) -> (CanFrame, usize) {
        // Longer than 4 GiB is no message that any limit allows.
        let length = u32::try_from(message.len()).unwrap_or(u32::MAX);
        let [a, b, c, d] = length.to_be_bytes();
        let long = [FIRST << 4, 0, a, b, c, d];
        let short = [FIRST << 4 | c, d];
        let header = if message.len() > SHORT_LENGTH_MAX { &long[..] } else { &short[..] };
        let taken = self.format.capacity() - header.len();
        (self.frame(header, &message[..taken]), taken)
    }

    /// More of a message, from what is left, and how much of it that was.
    pub fn consecutive(&self, sequence: u8, rest: &[u8]) -> (CanFrame, usize) {
        let taken = rest.len().min(self.format.capacity() - 1);
        (self.frame(&[CONSECUTIVE << 4 | sequence & 0x0f], &rest[..taken]), taken)
    }

    /// How the rest of a message is to be sent.
    pub fn flow(&self, flow: FlowControl) -> CanFrame {
        let status = match flow.status {
            FlowStatus::Continue => 0,
            FlowStatus::Wait => 1,
            FlowStatus::Overflow => 2,
        };
        self.frame(&[FLOW << 4 | status, flow.block_size, flow.separation.0], &[])
    }

    fn frame(&self, header: &[u8], data: &[u8]) -> CanFrame {
        let mut bytes = [FILLER; super::super::frame::FD_MAX];
        let (head, rest) = bytes.split_at_mut(header.len());
        head.copy_from_slice(header);
        rest[..data.len()].copy_from_slice(data);
        let length = self.format.length_for(header.len() + data.len());
        let length = length.expect("no more is written than the format holds");
        CanFrame::new(self.id, self.format, &bytes[..length])
            .expect("the length is one that the format has")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FD: Format = Format::Fd { fast: true };

    fn writer(format: Format) -> PduWriter {
        PduWriter { id: CanId::standard(1).unwrap(), format }
    }

    #[test]
    fn the_bytes_of_frames_are_those_of_the_standard() {
        let classic = writer(Format::Classic);
        assert_eq!(classic.single(b"abc").data(), b"\x03abc");
        let (first, taken) = classic.first(&[7; 0x123]);
        assert_eq!((first.data(), taken), (&b"\x11\x23\x07\x07\x07\x07\x07\x07"[..], 6));
        let (first, taken) = classic.first(&[7; 0x12345]);
        assert_eq!((first.data(), taken), (&b"\x10\x00\x00\x01\x23\x45\x07\x07"[..], 2));
        let (next, taken) = classic.consecutive(17, b"xy");
        assert_eq!((next.data(), taken), (&b"\x21xy"[..], 2));
        let flow = FlowControl {
            status: FlowStatus::Wait,
            block_size: 8,
            separation: SeparationTime::at_least(Duration::from_millis(20)),
        };
        assert_eq!(classic.flow(flow).data(), b"\x31\x08\x14");

        let fd = writer(FD);
        assert_eq!(fd.single(b"1234567").data(), b"\x071234567");
        assert_eq!(fd.single(b"12345678").data(), b"\x00\x0812345678\xcc\xcc");
        assert_eq!(fd.single(&[1; 62]).length(), 64);
        assert_eq!(fd.first(&[1; 63]).1, 62);
    }

    #[test]
    fn what_is_written_is_read_back() {
        for format in [Format::Classic, FD] {
            let writer = writer(format);
            for length in 1..=writer.single_max() {
                let message = vec![9; length];
                let frame = writer.single(&message);
                assert_eq!(Pdu::decode(frame.data()), Some(Pdu::Single(&message)));
            }
            for length in [writer.single_max() + 1, 4095, 4096, 70_000] {
                let message = vec![9; length];
                let (frame, taken) = writer.first(&message);
                let (length, data) = (length as u32, &message[..taken]);
                assert_eq!(Pdu::decode(frame.data()), Some(Pdu::First { length, data }));
            }
        }
    }

    #[test]
    fn what_the_standard_does_not_let_a_node_send_is_refused() {
        let check = |data: &[u8]| assert_eq!(Pdu::decode(data), None, "{data:02x?}");
        check(b"");
        check(b"\x00");
        check(b"\x08abcdefg");
        check(b"\x03ab");
        check(&[3; 12]); // The short form in a long frame.
        check(b"\x00\x07abcdefg..."); // The long form of a short length.
        check(b"\x00\x0babcdefghij");
        check(b"\x10\x14abcde");
        check(b"\x10\x07abcdef"); // It would have fitted into a single frame.
        let mut first = [0; 64];
        first[..2].copy_from_slice(&[0x10, 62]);
        check(&first);
        check(b"\x10\x00\x00\x00\x0f\xffab");
        check(b"\x20");
        check(b"\x30\x00");
        check(b"\x40abc");
        check(b"\xffabc");
        check(b"\x35\x00\x00");
    }

    #[test]
    fn a_separation_is_rounded_up_and_what_is_reserved_is_the_longest() {
        let written = |span| SeparationTime::at_least(span);
        let micros = Duration::from_micros;
        assert_eq!(written(Duration::ZERO), SeparationTime(0));
        assert_eq!(written(micros(1)), SeparationTime(0xf1));
        assert_eq!(written(micros(900)), SeparationTime(0xf9));
        assert_eq!(written(micros(901)), SeparationTime(1));
        assert_eq!(written(micros(1001)), SeparationTime(2));
        assert_eq!(written(Duration::from_secs(9)), SeparationTime(0x7f));
        for byte in 0..=u8::MAX {
            let span = SeparationTime(byte).span();
            match byte {
                0..=0x7f | 0xf1..=0xf9 => assert_eq!(written(span), SeparationTime(byte)),
                _ => assert_eq!(span, Duration::from_millis(127), "{byte:02x}"),
            }
        }
    }
}
