//! An encoded message on its way to the wire.

use bytes::{BufMut, Bytes, BytesMut};
use std::ops::Range;

/// The bytes of a message, in one piece or two.
///
/// A large payload is not copied behind what stands before it: it is cut into parts as it is.
#[derive(Clone, Debug, Default)]
pub struct Parcel {
    head: Bytes,
    body: Bytes,
}

impl Parcel {
    /// Payloads from this size on stay where they are, in bytes.
    pub(crate) const APART: usize = 4096;

    /// What stands before a payload, and the payload.
    pub(crate) fn apart(head: Bytes, body: Bytes) -> Self {
        Parcel { head, body }
    }

    /// How many bytes it has.
    pub fn len(&self) -> usize {
        self.head.len() + self.body.len()
    }

    /// Whether it has none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// All of it in one piece, which may take a copy.
    pub fn into_bytes(self) -> Bytes {
        if self.body.is_empty() {
            return self.head;
        }
        let mut bytes = BytesMut::with_capacity(self.len());
        self.put(0..self.len(), &mut bytes);
        bytes.freeze()
    }

    /// Some of it, not copied where it lies within the payload.
    pub(crate) fn slice(&self, range: Range<usize>) -> Bytes {
        let head = self.head.len();
        if range.start >= head {
            return self.body.slice(range.start - head..range.end - head);
        }
        let mut bytes = BytesMut::with_capacity(range.len());
        self.put(range, &mut bytes);
        bytes.freeze()
    }

    /// Writes some of it.
    pub(crate) fn put(&self, range: Range<usize>, to: &mut BytesMut) {
        let head = self.head.len();
        to.put_slice(&self.head[range.start.min(head)..range.end.min(head)]);
        let (start, end) = (range.start.max(head) - head, range.end.max(head) - head);
        to.put_slice(&self.body[start..end]);
    }
}

impl From<Bytes> for Parcel {
    fn from(bytes: Bytes) -> Self {
        Parcel { head: bytes, body: Bytes::new() }
    }
}

/// Two that are the same message are equal, in however many pieces.
impl PartialEq for Parcel {
    fn eq(&self, other: &Self) -> bool {
        self.clone().into_bytes() == other.clone().into_bytes()
    }
}

impl Eq for Parcel {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_part_of_two_pieces_is_that_part_of_the_whole() {
        let whole = Bytes::from_static(b"head and body");
        for cut in 0..=whole.len() {
            let parcel = Parcel::apart(whole.slice(..cut), whole.slice(cut..));
            assert_eq!(parcel, Parcel::from(whole.clone()));
            for start in 0..=whole.len() {
                for end in start..=whole.len() {
                    assert_eq!(parcel.slice(start..end), whole.slice(start..end));
                }
            }
        }
    }
}
