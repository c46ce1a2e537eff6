//! One frame of a CAN bus.

use std::fmt;

/// The most bytes that a classic frame carries.
pub const CLASSIC_MAX: usize = 8;
/// The most bytes that a CAN FD frame carries.
pub const FD_MAX: usize = 64;

/// The lengths that a CAN FD frame can have beyond eight bytes (ISO 11898-1).
pub(crate) const FD_LENGTHS: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];
const STANDARD_MAX: u32 = 0x7ff;
const EXTENDED_MAX: u32 = 0x1fff_ffff;

/// What a frame is about: a number of 11 bits, or one of 29. On the bus, of two that begin at the
/// same time the lower number goes first.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CanId {
    is_extended: bool,
    number: u32,
}

impl CanId {
    /// An identifier of 11 bits; `None` where the number has more.
    pub const fn standard(number: u32) -> Option<Self> {
        if number > STANDARD_MAX { None } else { Some(CanId { is_extended: false, number }) }
    }

    /// An identifier of 29 bits; `None` where the number has more.
    pub const fn extended(number: u32) -> Option<Self> {
        if number > EXTENDED_MAX { None } else { Some(CanId { is_extended: true, number }) }
    }

    /// Its number, whatever its kind.
    pub const fn number(self) -> u32 {
        self.number
    }

    /// Whether it has 29 bits.
    pub const fn is_extended(self) -> bool {
        self.is_extended
    }
}

/// As `candump` writes it: three digits for 11 bits, eight for 29.
impl fmt::Display for CanId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = if self.is_extended { 8 } else { 3 };
        write!(f, "{:0width$X}", self.number)
    }
}

impl fmt::Debug for CanId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

/// Which of the bus's formats a frame has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Format {
    /// Up to 8 bytes, all at one bit rate.
    Classic,
    /// Up to 64 bytes (ISO 11898-1:2015).
    Fd {
        /// The data at the bus's second, higher bit rate.
        fast: bool,
    },
}

impl Format {
    /// The most bytes that a frame carries.
    pub const fn capacity(self) -> usize {
        match self {
            Format::Classic => CLASSIC_MAX,
            Format::Fd { .. } => FD_MAX,
        }
    }

    /// The least length that a frame can have and that holds so many bytes; `None` beyond the
    /// largest.
    pub fn length_for(self, bytes: usize) -> Option<usize> {
        match self {
            _ if bytes <= CLASSIC_MAX => Some(bytes),
            Format::Classic => None,
            Format::Fd { .. } => FD_LENGTHS.into_iter().find(|length| *length >= bytes),
        }
    }
}

/// One frame: an identifier, and up to 8 or 64 bytes. Requests for a frame are of other things on
/// the bus.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct CanFrame {
    id: CanId,
    format: Format,
    length: u8,
    bytes: [u8; FD_MAX],
}

impl CanFrame {
    /// A frame with these bytes; `None` where the format has no frame of that length.
    ///
    /// ```
    /// use blastema_core::medium::can::{CanFrame, CanId, Format};
    /// let id = CanId::standard(0x123).unwrap();
    /// assert!(CanFrame::new(id, Format::Classic, b"12345678").is_some());
    /// assert!(CanFrame::new(id, Format::Classic, b"123456789").is_none());
    /// assert!(CanFrame::new(id, Format::Fd { fast: true }, b"123456789abc").is_some());
    /// ```
    pub fn new(id: CanId, format: Format, data: &[u8]) -> Option<Self> {
        if format.length_for(data.len()) != Some(data.len()) {
            return None;
        }
        let mut bytes = [0; FD_MAX];
        bytes[..data.len()].copy_from_slice(data);
        Some(CanFrame { id, format, length: data.len() as u8, bytes })
    }

    /// What it is about.
    pub fn id(&self) -> CanId {
        self.id
    }

    /// Classic or FD.
    pub fn format(&self) -> Format {
        self.format
    }

    /// How many bytes it carries.
    pub fn length(&self) -> usize {
        self.length.into()
    }

    /// What it carries.
    pub fn data(&self) -> &[u8] {
        &self.bytes[..self.length()]
    }
}

/// How many bits a frame with so many bytes takes on the bus, with the pause after it. Stuffed bits
/// are counted as a tenth: it is every fifth at worst. A faster rate for FD's data is not counted
/// on.
///
/// ```
/// // 3,472 full classic frames a second at 500 kbit/s.
/// assert_eq!(500_000 / blastema_core::medium::can::bits_on_bus(true, 8), 3_472);
/// ```
pub fn bits_on_bus(extended: bool, bytes: usize) -> u64 {
    // Start, control, checksum, confirmation, end and pause (ISO 11898-1).
    let fixed = if extended { 67 } else { 47 };
    (fixed + 8 * bytes as u64) * 11 / 10
}

impl fmt::Debug for CanFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mark = match self.format {
            Format::Classic => "",
            Format::Fd { fast: false } => "#0",
            Format::Fd { fast: true } => "#1",
        };
        write!(f, "{}#{mark}", self.id)?;
        self.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_identifier_has_11_or_29_bits() {
        assert!(CanId::standard(0x7ff).is_some() && CanId::standard(0x800).is_none());
        assert!(CanId::extended(0x1fff_ffff).is_some() && CanId::extended(0x2000_0000).is_none());
        let (short, long) = (CanId::standard(7).unwrap(), CanId::extended(7).unwrap());
        assert_ne!(short, long);
        assert_eq!((short.to_string(), long.to_string()), ("007".into(), "00000007".into()));
    }

    #[test]
    fn a_frame_has_only_the_lengths_that_its_format_knows() {
        let id = CanId::standard(1).unwrap();
        let lengths = |format| {
            let data = [0; 70];
            let fits = |n: &usize| CanFrame::new(id, format, &data[..*n]).is_some();
            (0..70).filter(fits).collect::<Vec<_>>()
        };
        assert_eq!(lengths(Format::Classic), (0..=8).collect::<Vec<_>>());
        let fd: Vec<usize> = (0..=8).chain(FD_LENGTHS).collect();
        assert_eq!(lengths(Format::Fd { fast: false }), fd);
        assert_eq!(Format::Fd { fast: true }.length_for(33), Some(48));
        assert_eq!(Format::Fd { fast: true }.length_for(65), None);
    }
}
