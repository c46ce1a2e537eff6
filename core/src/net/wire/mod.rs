//! Reading and writing bytes that come from, or go to, outside.

pub mod advertisement;
pub mod frame;
pub mod hello_state;
pub mod link_id;
pub mod message;
pub mod node_id;
pub mod packet;
pub mod segment;

use bytes::{Buf, BufMut, Bytes, BytesMut};
use std::fmt;

/// Why bytes from outside were refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum WireError {
    /// The first byte is not ours: something else speaks on this medium.
    #[error("not a frame of this middleware: it begins with {first:#04x}")]
    Foreign {
        /// The first byte.
        first: u8,
    },
    /// Another release speaks; both must run the same major release.
    #[error("the sender speaks version {theirs} of the protocol, this node {ours}")]
    Version {
        /// The version that the sender speaks.
        theirs: u8,
        /// The version that this node speaks.
        ours: u8,
    },
    /// The bytes end before the thing they describe.
    #[error("truncated")]
    Truncated,
    /// More bytes than the thing they describe, or than may be sent.
    #[error("{what} is too large")]
    TooLarge {
        /// What is too large, for display.
        what: &'static str,
    },
    /// A value that cannot stand at its place.
    #[error("{what} is malformed")]
    Malformed {
        /// What is malformed, for display.
        what: &'static str,
    },
}

/// How many things from outside were refused, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Refusals {
    /// Not of this middleware.
    pub foreign: u64,
    /// Of another release.
    pub version: u64,
    /// Ended too early.
    pub truncated: u64,
    /// Larger than allowed.
    pub too_large: u64,
    /// Could not be understood, or made no sense.
    pub malformed: u64,
    /// Understood, but from the past: an old incarnation, an old session, an old announcement.
    pub stale: u64,
    /// Understood, but there was no receiver.
    pub unexpected: u64,
    /// Understood, but from a node that is isolated, or by its way.
    pub isolated: u64,
    /// Not signed, or not sealed, by the node that it names as its origin.
    pub forged: u64,
}

impl Refusals {
    /// Counts a refusal under its cause.
    pub fn count(&mut self, error: &WireError) {
        match error {
            WireError::Foreign { .. } => self.foreign += 1,
            WireError::Version { .. } => self.version += 1,
            WireError::Truncated => self.truncated += 1,
            WireError::TooLarge { .. } => self.too_large += 1,
            WireError::Malformed { .. } => self.malformed += 1,
        }
    }

    /// What has come since `before`. A counter that was reset counts in full.
    pub fn since(&self, before: &Refusals) -> Refusals {
        let since = |now: u64, before: u64| now.checked_sub(before).unwrap_or(now);
        Refusals {
            foreign: since(self.foreign, before.foreign),
            version: since(self.version, before.version),
            truncated: since(self.truncated, before.truncated),
            too_large: since(self.too_large, before.too_large),
            malformed: since(self.malformed, before.malformed),
            stale: since(self.stale, before.stale),
            unexpected: since(self.unexpected, before.unexpected),
            isolated: since(self.isolated, before.isolated),
            forged: since(self.forged, before.forged),
        }
    }

    /// All but what was of the past: another node may have recorded and replayed that.
    #[doc(hidden)]
    pub fn of_the_present(&self) -> u64 {
        self.total() - self.stale
    }

    /// All of them.
    pub fn total(&self) -> u64 {
        self.counts().iter().map(|(count, _)| count).sum()
    }

    fn counts(&self) -> [(u64, &'static str); 9] {
        [
            (self.foreign, "foreign"),
            (self.version, "of another version"),
            (self.truncated, "truncated"),
            (self.too_large, "too large"),
            (self.malformed, "malformed"),
            (self.stale, "stale"),
            (self.unexpected, "unexpected"),
            (self.isolated, "of isolated nodes"),
            (self.forged, "forged"),
        ]
    }
}

impl fmt::Display for Refusals {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut counts = self.counts().into_iter().filter(|(count, _)| *count > 0);
        let Some((count, what)) = counts.next() else { return f.write_str("none") };
        write!(f, "{count} {what}")?;
        counts.try_for_each(|(count, what)| write!(f, ", {count} {what}"))
    }
}

/// Takes bytes apart from the front; never panics.
#[derive(Clone, Debug)]
pub(crate) struct Reader(Bytes);

impl Reader {
    pub(crate) fn new(bytes: Bytes) -> Self {
        Reader(bytes)
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    fn need(&self, length: usize) -> Result<(), WireError> {
        if self.0.len() < length { Err(WireError::Truncated) } else { Ok(()) }
    }

    pub(crate) fn u8(&mut self) -> Result<u8, WireError> {
        self.need(1)?;
        Ok(self.0.get_u8())
    }

    pub(crate) fn u16(&mut self) -> Result<u16, WireError> {
        self.need(2)?;
        Ok(self.0.get_u16())
    }

    pub(crate) fn u32(&mut self) -> Result<u32, WireError> {
        self.need(4)?;
        Ok(self.0.get_u32())
    }

    pub(crate) fn u64(&mut self) -> Result<u64, WireError> {
        self.need(8)?;
        Ok(self.0.get_u64())
    }

    pub(crate) fn array<const N: usize>(&mut self) -> Result<[u8; N], WireError> {
        self.need(N)?;
        let mut array = [0; N];
        self.0.copy_to_slice(&mut array);
        Ok(array)
    }

    /// An unsigned number in groups of seven bits, the lowest first (LEB128): one byte up to 127.
    pub(crate) fn varint(&mut self) -> Result<u64, WireError> {
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = self.u8()?;
            let group = u64::from(byte & 0x7f);
            if group << shift >> shift != group {
                break;
            }
            value |= group << shift;
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(WireError::Malformed { what: "a number" })
    }

    pub(crate) fn bytes(&mut self, length: usize) -> Result<Bytes, WireError> {
        self.need(length)?;
        Ok(self.0.split_to(length))
    }

    /// As many bytes as a leading number says, at most `limit`.
    pub(crate) fn sized(&mut self, limit: usize, what: &'static str) -> Result<Bytes, WireError> {
        let length = self.varint()?;
        match usize::try_from(length) {
            Ok(length) if length <= limit => self.bytes(length),
            _ => Err(WireError::TooLarge { what }),
        }
    }

    /// A name, or whatever else is parsed from a short text.
    pub(crate) fn parsed<T: std::str::FromStr>(
        &mut self,
        what: &'static str,
    ) -> Result<T, WireError> {
        // Longer than any name, so that the name's own limit decides.
        const LIMIT: usize = 255;
        let bytes = self.sized(LIMIT, what)?;
        let text = std::str::from_utf8(&bytes).map_err(|_| WireError::Malformed { what })?;
        text.parse().map_err(|_| WireError::Malformed { what })
    }

    pub(crate) fn rest(&mut self) -> Bytes {
        std::mem::take(&mut self.0)
    }

    /// Nothing may follow.
    pub(crate) fn end(&self, what: &'static str) -> Result<(), WireError> {
        if self.0.is_empty() { Ok(()) } else { Err(WireError::TooLarge { what }) }
    }
}

/// What [`Reader`] reads.
pub(crate) trait Write {
    fn varint(&mut self, value: u64);
    fn sized(&mut self, bytes: &[u8]);
}

impl Write for BytesMut {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.put_u8(value as u8 | 0x80);
            value >>= 7;
        }
        self.put_u8(value as u8);
    }

    fn sized(&mut self, bytes: &[u8]) {
        self.varint(bytes.len() as u64);
        self.put_slice(bytes);
    }
}

/// How many bytes [`Write::varint`] takes for this value.
pub(crate) fn varint_length(value: u64) -> usize {
    (64 - (value | 1).leading_zeros() as usize).div_ceil(7)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_takes_as_many_bytes_as_it_needs_and_comes_back() {
        for value in [0, 1, 127, 128, 16_383, 16_384, u64::from(u32::MAX), u64::MAX] {
            let mut bytes = BytesMut::new();
            bytes.varint(value);
            assert_eq!(bytes.len(), varint_length(value));
            let mut reader = Reader::new(bytes.freeze());
            assert_eq!(reader.varint(), Ok(value));
            assert!(reader.is_empty());
        }
    }

    #[test]
    fn a_number_that_is_too_large_or_cut_off_is_refused() {
        let endless = Bytes::from_static(&[0xff; 12]);
        assert!(matches!(Reader::new(endless).varint(), Err(WireError::Malformed { .. })));
        let cut = Bytes::from_static(&[0x80]);
        assert_eq!(Reader::new(cut).varint(), Err(WireError::Truncated));
        let claims_too_much = Bytes::from_static(&[0xff, 0xff, 0x7f, 1, 2]);
        assert!(matches!(
            Reader::new(claims_too_much).sized(100, "a text"),
            Err(WireError::TooLarge { .. })
        ));
    }
}
