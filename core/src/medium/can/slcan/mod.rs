//! The text that CAN adapters on a serial line speak: SLCAN, after Lawicel's CAN232.
//!
//! ```text
//! to the adapter                     from it
//!   S6⏎     500 kbit/s                 ⏎    done
//!   O⏎      open                       BEL  refused
//!   C⏎      close                      z⏎   a short frame is sent (some: Z⏎ a long one)
//!
//! frames, both ways, in hexadecimal:
//!   t iii l dd…⏎        11 bits, l = 0 to 8 bytes          r iii l⏎  a request, not used here
//!   T iiiiiiii l dd…⏎   29 bits                            R iiiiiiii l⏎
//!   d, D                CAN FD, l = 0 to F as on the bus
//!   b, B                CAN FD with its data at the faster rate
//! ```
//!
//! A frame from the adapter may end with four digits of time, in milliseconds of a minute. A line
//! that says nothing is thrown away up to its end, so that after garbage the next line is
//! understood again; no line is longer than [`LINE_MAX`].

mod adapter_control;

pub use adapter_control::{AdapterControl, AdapterError};

use super::frame::{CanFrame, CanId, FD_LENGTHS, FD_MAX, Format};

/// The longest line: a CAN FD frame of 64 bytes with a time.
pub const LINE_MAX: usize = 1 + 8 + 1 + 2 * FD_MAX + 4;

const END: u8 = b'\r';
const REFUSAL: u8 = 0x07;
/// Milliseconds in the minute that an adapter's time counts.
const MINUTE: u32 = 60_000;

/// The bit rates of a bus that adapters know by a number, in bits a second.
pub const BIT_RATES_HZ: [u32; 9] =
    [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];

/// A bit rate that adapters know.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct BitRate(u8);

impl BitRate {
    /// The rate of so many bits a second; `None` where adapters have no number for it: 10, 20, 50,
    /// 100, 125, 250, 500, 800 and 1000 kbit/s have one.
    ///
    /// ```
    /// use blastema_core::medium::can::slcan::BitRate;
    /// assert_eq!(BitRate::of(500_000).map(BitRate::hz), Some(500_000));
    /// assert_eq!(BitRate::of(42), None);
    /// ```
    pub fn of(hz: u32) -> Option<Self> {
        BIT_RATES_HZ.iter().position(|known| *known == hz).map(|at| BitRate(at as u8))
    }

    /// In bits a second.
    pub fn hz(self) -> u32 {
        BIT_RATES_HZ[usize::from(self.0)]
    }
}

/// A data rate of CAN FD that adapters know, after the CANable's extension.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DataRate {
    /// A data rate of 2 Mbit/s.
    TwoMegabit,
    /// A data rate of 5 Mbit/s.
    FiveMegabit,
}

/// What is said to an adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AdapterCommand {
    /// Leave the bus.
    Close,
    /// Join the bus.
    Open,
    /// This is the bus's bit rate. Only while closed.
    BitRate(BitRate),
    /// This is its data rate for CAN FD. Only while closed.
    DataRate(DataRate),
    /// Sends this frame on the bus.
    Send(CanFrame),
}

/// What an adapter says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AdapterReply {
    /// This frame came from the bus. The time that an adapter may say with it is not used.
    Frame(CanFrame),
    /// The last command is done.
    Done,
    /// A frame of ours is sent, or at least taken.
    Sent,
    /// The last command, or frame, is refused.
    Refused,
    /// Nothing for this node: an answer to a question that it does not ask (`V1013`, `NA123`,
    /// `F00`), or the request for a frame.
    Answer,
}

impl AdapterCommand {
    /// Writes it as a line.
    pub fn encode(&self, line: &mut Vec<u8>) {
        match self {
            AdapterCommand::Close => line.push(b'C'),
            AdapterCommand::Open => line.push(b'O'),
            AdapterCommand::BitRate(BitRate(number)) => line.extend([b'S', b'0' + number]),
            AdapterCommand::DataRate(DataRate::TwoMegabit) => line.extend(b"Y2"),
            AdapterCommand::DataRate(DataRate::FiveMegabit) => line.extend(b"Y5"),
            AdapterCommand::Send(frame) => put_frame(frame, line),
        }
        line.push(END);
    }

    /// Reads a line without its end, as an adapter does; `None` for what adapters of this kind do
    /// not know.
    pub fn decode(line: &[u8]) -> Option<AdapterCommand> {
        Some(match line {
            b"C" => AdapterCommand::Close,
            b"O" => AdapterCommand::Open,
            [b'S', number @ b'0'..=b'8'] => AdapterCommand::BitRate(BitRate(number - b'0')),
            b"Y2" => AdapterCommand::DataRate(DataRate::TwoMegabit),
            b"Y5" => AdapterCommand::DataRate(DataRate::FiveMegabit),
            _ => match read_frame(line)? {
                (frame, []) => AdapterCommand::Send(frame),
                _ => return None,
            },
        })
    }
}

impl AdapterReply {
    /// Writes it as a line, as an adapter does.
    pub fn encode(&self, line: &mut Vec<u8>) {
        match self {
            AdapterReply::Frame(frame) => put_frame(frame, line),
            AdapterReply::Done => {}
            AdapterReply::Sent => line.push(b'z'),
            AdapterReply::Refused => return line.push(REFUSAL),
            AdapterReply::Answer => line.push(b'V'),
        }
        line.push(END);
    }

    /// Reads a line that ended well, without its end; `None` for what no adapter says.
    pub fn decode(line: &[u8]) -> Option<AdapterReply> {
        match line {
            [] => Some(AdapterReply::Done),
            b"z" | b"Z" => Some(AdapterReply::Sent),
            [b'V' | b'v' | b'N' | b'F' | b'r' | b'R', rest @ ..]
                if rest.iter().all(u8::is_ascii_graphic) =>
            {
                Some(AdapterReply::Answer)
            }
            _ => {
                let (frame, time) = read_frame(line)?;
                let is_time = time.len() == 4 && read_hex(time)? < MINUTE;
                (time.is_empty() || is_time).then_some(AdapterReply::Frame(frame))
            }
        }
    }
}

/// How a line ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LineEnd {
    /// As lines do.
    Whole(Vec<u8>),
    /// With a BEL: whatever stood before it is void.
    Refusal,
}

/// Parts a stream of bytes into lines.
#[derive(Debug, Default)]
pub struct LineSplitter {
    line: Vec<u8>,
    /// The line is too long: it is thrown away up to its end.
    lost: bool,
    refused: u64,
}

impl LineSplitter {
    /// How many lines were too long, or broken off.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// One more byte came. Line feeds say nothing: some adapters end lines with both.
    pub fn handle_byte(&mut self, byte: u8) -> Option<LineEnd> {
        match byte {
            END => {
                let line = std::mem::take(&mut self.line);
                (!std::mem::take(&mut self.lost)).then_some(LineEnd::Whole(line))
            }
            REFUSAL => {
                self.refused += u64::from(!self.line.is_empty());
                self.line.clear();
                self.lost = false;
                Some(LineEnd::Refusal)
            }
            b'\n' => None,
            _ if self.lost => None,
            _ if self.line.len() == LINE_MAX => {
                self.refused += 1;
                self.line.clear();
                self.lost = true;
                None
            }
            _ => {
                self.line.push(byte);
                None
            }
        }
    }
}

/// Hears what an adapter says.
#[derive(Debug, Default)]
pub struct ReplyParser {
    lines: LineSplitter,
    refused: u64,
}

impl ReplyParser {
    /// One more byte came from the adapter.
    pub fn handle_byte(&mut self, byte: u8) -> Option<AdapterReply> {
        match self.lines.handle_byte(byte)? {
            LineEnd::Refusal => Some(AdapterReply::Refused),
            LineEnd::Whole(line) => {
                let reply = AdapterReply::decode(&line);
                self.refused += u64::from(reply.is_none());
                reply
            }
        }
    }

    /// How many lines said nothing.
    pub fn refused(&self) -> u64 {
        self.refused + self.lines.refused()
    }
}

fn put_frame(frame: &CanFrame, line: &mut Vec<u8>) {
    let kind = match frame.format() {
        Format::Classic => b't',
        Format::Fd { fast: false } => b'd',
        Format::Fd { fast: true } => b'b',
    };
    if frame.id().is_extended() {
        line.push(kind.to_ascii_uppercase());
        put_hex(frame.id().number(), 8, line);
    } else {
        line.push(kind);
        put_hex(frame.id().number(), 3, line);
    }
    let code = FD_LENGTHS.iter().position(|length| *length == frame.length());
    let code = code.map_or(frame.length(), |at| at + 9);
    put_hex(code as u32, 1, line);
    frame.data().iter().for_each(|byte| put_hex((*byte).into(), 2, line));
}

/// Reads a frame; what follows it is handed back.
fn read_frame(line: &[u8]) -> Option<(CanFrame, &[u8])> {
    let (&first, rest) = line.split_first()?;
    let format = match first.to_ascii_lowercase() {
        b't' => Format::Classic,
        b'd' => Format::Fd { fast: false },
        b'b' => Format::Fd { fast: true },
        _ => return None,
    };
    let extended = first.is_ascii_uppercase();
    let (number, rest) = rest.split_at_checked(if extended { 8 } else { 3 })?;
    let number = read_hex(number)?;
    let id = if extended { CanId::extended(number) } else { CanId::standard(number) }?;
    let (code, rest) = rest.split_at_checked(1)?;
    let code = read_hex(code)? as usize;
    let length = match code.checked_sub(9) {
        None => code,
        Some(at) => *FD_LENGTHS.get(at)?,
    };
    let (digits, rest) = rest.split_at_checked(2 * length)?;
    let mut bytes = [0; FD_MAX];
    for (byte, digits) in bytes.iter_mut().zip(digits.chunks(2)) {
        *byte = read_hex(digits)? as u8;
    }
    Some((CanFrame::new(id, format, &bytes[..length])?, rest))
}

/// At most eight digits.
fn read_hex(digits: &[u8]) -> Option<u32> {
    digits.iter().try_fold(0, |number, digit| Some(number << 4 | char::from(*digit).to_digit(16)?))
}

fn put_hex(number: u32, digits: u32, line: &mut Vec<u8>) {
    let digit = |at| b"0123456789ABCDEF"[(number >> (4 * at) & 0xf) as usize];
    line.extend((0..digits).rev().map(digit));
}

#[cfg(test)]
mod tests;
