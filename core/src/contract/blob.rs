//! Bytes that are shared, and not copied.

use crate::contract::gather_buffer::GatherBuffer;
use crate::contract::layout::{Described, Layout};
use bytes::Bytes;
use serde::de::{Deserialize, Deserializer, Error, SeqAccess, Visitor};
use serde::ser::{Serialize, Serializer};
use std::cell::Cell;
use std::fmt;
use std::ops::Deref;

/// Many bytes in a message: an image, a point cloud, a map.
///
/// In a message between nodes, and in a contract's structure, it is what a `Vec<u8>` is: one node
/// may declare the one, another the other. (On one node a contract is one Rust type.) A clone costs
/// a counter. A large one that is the last thing in a message, an event or a reply goes to the
/// network as it lies; before other things it is copied once. What comes from another node is a
/// part of the message as it arrived, which stays in memory as long as any of its blobs: to
/// keep a few bytes of a large message, copy them.
///
/// ```
/// use blastema_core::Blob;
///
/// let image = Blob::from(vec![7; 1024]);
/// let same = image.clone();
/// assert_eq!(image.as_ptr(), same.as_ptr());
/// assert_eq!(same.iter().map(|pixel| u32::from(*pixel)).sum::<u32>(), 7 * 1024);
/// ```
#[derive(Clone, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Blob(Bytes);

thread_local! {
    /// The message that is being decoded on this thread.
    static SOURCE: Cell<Option<Bytes>> = const { Cell::new(None) };
    /// The large blob that is being encoded on this thread, so that the codec can tell its bytes
    /// from others.
    static GIVEN: Cell<Option<Bytes>> = const { Cell::new(None) };
}

/// Decodes something whose blobs are to be parts of `source`.
pub(crate) fn sharing<T>(source: &Bytes, decode: impl FnOnce() -> T) -> T {
    /// What was there before comes back, also after a panic.
    struct Restore(Option<Bytes>);

    impl Drop for Restore {
        fn drop(&mut self) {
            SOURCE.set(self.0.take());
        }
    }

    let _before = Restore(SOURCE.replace(Some(source.clone())));
    decode()
}

/// The same bytes within the message that is being decoded, if they lie in it.
fn within_source(bytes: &[u8]) -> Option<Bytes> {
    let source = SOURCE.take()?;
    let (whole, part) = (source.as_ptr_range(), bytes.as_ptr_range());
    let lies_within = whole.start <= part.start && part.end <= whole.end;
    let shared = lies_within.then(|| source.slice_ref(bytes));
    SOURCE.set(Some(source));
    shared
}

/// The blob that is being encoded, if these are its bytes.
pub(crate) fn given(bytes: &[u8]) -> Option<Bytes> {
    if bytes.len() < GatherBuffer::APART {
        return None;
    }
    let blob = GIVEN.take()?;
    (blob.as_ptr_range() == bytes.as_ptr_range()).then_some(blob)
}

impl Deref for Blob {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.0
    }
}

impl AsRef<[u8]> for Blob {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

impl From<Vec<u8>> for Blob {
    fn from(bytes: Vec<u8>) -> Self {
        Blob(bytes.into())
    }
}

impl From<Bytes> for Blob {
    fn from(bytes: Bytes) -> Self {
        Blob(bytes)
    }
}

impl From<Blob> for Bytes {
    fn from(blob: Blob) -> Self {
        blob.0
    }
}

impl From<Blob> for Vec<u8> {
    /// Copies, unless this is the only reference.
    fn from(blob: Blob) -> Self {
        blob.0.into()
    }
}

impl FromIterator<u8> for Blob {
    fn from_iter<I: IntoIterator<Item = u8>>(bytes: I) -> Self {
        Blob(bytes.into_iter().collect())
    }
}

impl fmt::Debug for Blob {
    /// Its size: a mebibyte is not for display.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Blob({} bytes)", self.len())
    }
}

impl Described for Blob {
    fn layout() -> &'static Layout {
        Vec::<u8>::layout()
    }
}

impl Serialize for Blob {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        if self.len() < GatherBuffer::APART {
            return to.serialize_bytes(self);
        }
        GIVEN.set(Some(self.0.clone()));
        let done = to.serialize_bytes(self);
        GIVEN.set(None);
        done
    }
}

impl<'de> Deserialize<'de> for Blob {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        from.deserialize_bytes(Shared)
    }
}

struct Shared;

impl<'de> Visitor<'de> for Shared {
    type Value = Blob;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("bytes")
    }

    fn visit_bytes<E: Error>(self, bytes: &[u8]) -> Result<Blob, E> {
        Ok(Blob(within_source(bytes).unwrap_or_else(|| Bytes::copy_from_slice(bytes))))
    }

    fn visit_byte_buf<E: Error>(self, bytes: Vec<u8>) -> Result<Blob, E> {
        Ok(bytes.into())
    }

    /// Formats without bytes write numbers, such as JSON.
    fn visit_seq<A: SeqAccess<'de>>(self, mut numbers: A) -> Result<Blob, A::Error> {
        let mut bytes = Vec::new();
        while let Some(byte) = numbers.next_element()? {
            bytes.push(byte);
        }
        Ok(bytes.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contract::codec;

    type Message = (u32, Blob, String, Blob);

    fn message() -> Message {
        (7, vec![1; 300].into(), "between".into(), Blob::default())
    }

    fn encoded<T: Serialize>(value: &T) -> Bytes {
        let mut bytes = Vec::new();
        codec::encode_bounded(value, 1000, &mut bytes).unwrap();
        bytes.into()
    }

    #[test]
    fn it_is_on_the_wire_and_in_a_contract_what_a_vector_is() {
        let (number, image, text, empty) = message();
        let vectors = (number, image.to_vec(), text, empty.to_vec());
        assert_eq!(encoded(&message()), encoded(&vectors));
        assert_eq!(Blob::layout().shape, Vec::<u8>::layout().shape);
    }

    #[test]
    fn it_is_a_part_of_the_message_that_it_came_in_and_of_no_other() {
        let bytes = encoded(&message());
        let decode = || codec::decode_bounded::<Message, 1000>(&bytes).unwrap();
        let is_shared = |blob: &Blob| bytes.as_ptr_range().contains(&blob.as_ptr());

        let shared = sharing(&bytes, decode);
        assert!(is_shared(&shared.1));
        assert_eq!(shared, message());

        let other = Bytes::from_static(b"something else that is decoded, from another place");
        for copied in [decode(), sharing(&other, decode)] {
            assert!(!is_shared(&copied.1));
            assert_eq!(copied, message());
        }
    }

    #[test]
    fn a_large_one_that_ends_a_message_is_sent_as_it_lies_and_any_other_is_copied() {
        let large = || Blob::from(vec![1; GatherBuffer::APART]);
        let small = || Blob::from(vec![2; GatherBuffer::APART - 1]);
        let check = |message: &(Blob, u8, Blob), stays: bool| {
            let parcel = codec::parcel_of(message, 100_000).unwrap();
            let place = message.2.as_ptr();
            assert_eq!(parcel.pieces().iter().any(|piece| piece.as_ptr() == place), stays);
            let mut bytes = Vec::new();
            codec::encode_bounded(message, 100_000, &mut bytes).unwrap();
            assert_eq!(parcel.pieces().concat(), bytes);
        };
        check(&(small(), 7, large()), true);
        check(&(large(), 7, large()), true);
        check(&(large(), 7, small()), false);
        let refused = codec::parcel_of(&(7, large()), GatherBuffer::APART);
        assert_eq!(refused, Err(crate::EncodeError::TooLarge { limit: GatherBuffer::APART }));

        let (followed, same) = (large(), large());
        let parcel = codec::parcel_of(&(followed.clone(), 7), 100_000).unwrap();
        assert!(parcel.pieces().iter().all(|piece| piece.as_ptr() != followed.as_ptr()));
        let alike = codec::parcel_of(&(followed, same.to_vec()), 100_000).unwrap();
        assert_eq!(alike.pieces()[1].len(), 0, "a vector of the same bytes is no blob");
    }

    #[test]
    fn a_length_beyond_the_end_is_refused() {
        let bytes = Bytes::from_static(&[250, 1, 2]);
        let read = sharing(&bytes, || codec::decode_bounded::<Blob, 1000>(&bytes));
        assert_eq!(read, Err(crate::DecodeError::Truncated));
    }
}
