//! Bytes on their way to the wire: a message, a segment, a packet, a frame.

use bytes::{BufMut, Bytes, BytesMut};
use std::ops::Range;

/// Bytes in one piece or two.
///
/// A large payload is not copied behind what stands before it: it is cut into parts as it is, each
/// layer puts its header before that, and the medium writes both pieces.
#[derive(Clone, Debug, Default)]
pub struct GatherBuffer {
    head: Bytes,
    body: Bytes,
}

impl GatherBuffer {
    /// Payloads from this size on stay where they are, in bytes.
    pub(crate) const APART: usize = 4096;

    /// What stands before a payload, and the payload.
    pub(crate) fn apart(head: Bytes, body: Bytes) -> Self {
        GatherBuffer { head, body }
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

    /// Makes one piece of it, which may take a copy.
    pub fn make_whole(&mut self) -> &mut Bytes {
        *self = std::mem::take(self).into_bytes().into();
        &mut self.head
    }

    /// Its pieces, in order; one may be empty.
    pub fn pieces(&self) -> [&[u8]; 2] {
        [&self.head, &self.body]
    }

    /// Some of it, not copied.
    pub(crate) fn slice(&self, range: Range<usize>) -> GatherBuffer {
        let (head, body) = self.within(range);
        GatherBuffer { head: self.head.slice(head), body: self.body.slice(body) }
    }

    /// Writes some of it.
    pub(crate) fn put(&self, range: Range<usize>, to: &mut BytesMut) {
        let (head, body) = self.within(range);
        to.put_slice(&self.head[head]);
        to.put_slice(&self.body[body]);
    }

    /// Which bytes of each piece these are of the whole.
    fn within(&self, Range { start, end }: Range<usize>) -> (Range<usize>, Range<usize>) {
        let head = self.head.len();
        (start.min(head)..end.min(head), start.max(head) - head..end.max(head) - head)
    }

    /// Where one piece is so large that it stays where it is, nothing stands before it yet.
    fn is_bare(&self) -> bool {
        self.body.is_empty() && self.head.len() >= Self::APART
    }

    /// How many bytes [`behind`](GatherBuffer::behind) copies behind the header.
    pub(crate) fn copied(&self) -> usize {
        if self.is_bare() { 0 } else { self.head.len() }
    }

    /// The same behind a header.
    pub(crate) fn behind(&self, mut header: BytesMut) -> GatherBuffer {
        if self.is_bare() {
            return GatherBuffer { head: header.freeze(), body: self.head.clone() };
        }
        header.put_slice(&self.head);
        GatherBuffer { head: header.freeze(), body: self.body.clone() }
    }
}

impl From<Bytes> for GatherBuffer {
    fn from(bytes: Bytes) -> Self {
        GatherBuffer { head: bytes, body: Bytes::new() }
    }
}

impl From<Vec<u8>> for GatherBuffer {
    fn from(bytes: Vec<u8>) -> Self {
        Bytes::from(bytes).into()
    }
}

impl From<&'static str> for GatherBuffer {
    fn from(bytes: &'static str) -> Self {
        Bytes::from(bytes).into()
    }
}

/// Two that are the same message are equal, in however many pieces.
impl PartialEq for GatherBuffer {
    fn eq(&self, other: &Self) -> bool {
        self.clone().into_bytes() == other.clone().into_bytes()
    }
}

impl Eq for GatherBuffer {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_part_of_two_pieces_is_that_part_of_the_whole() {
        let whole = Bytes::from_static(b"head and body");
        for cut in 0..=whole.len() {
            let parcel = GatherBuffer::apart(whole.slice(..cut), whole.slice(cut..));
            assert_eq!(parcel, GatherBuffer::from(whole.clone()));
            assert_eq!(parcel.pieces().concat(), whole);
            for start in 0..=whole.len() {
                for end in start..=whole.len() {
                    assert_eq!(parcel.slice(start..end), whole.slice(start..end).into());
                }
            }
        }
    }

    #[test]
    fn a_large_payload_stays_where_it_is_behind_any_number_of_headers() {
        for length in [1, 10, GatherBuffer::APART - 1, GatherBuffer::APART, 100_000] {
            let payload = Bytes::from(vec![7; length]);
            let place = payload.as_ptr();

            let one = GatherBuffer::from(payload.clone()).behind(BytesMut::from("inner"));
            let two = one.behind(BytesMut::from("outer "));

            assert_eq!(two.pieces().concat(), [b"outer inner", &payload[..]].concat());
            let stays = two.pieces().iter().any(|piece| piece.as_ptr() == place);
            assert_eq!(stays, length >= GatherBuffer::APART, "{length}");
        }
    }
}
