//! Parting frames from a buffer that is read into again.

use bytes::{Buf, Bytes, BytesMut};

/// Parts the first `length` bytes from a buffer that takes its memory in pieces of `chunk` bytes.
///
/// A large frame shares the buffer's memory. A small one is copied: it would keep a whole piece
/// from being freed for as long as a receiver holds it.
pub(crate) fn part_frame(buffer: &mut BytesMut, length: usize, chunk: usize) -> Bytes {
    if length >= chunk / 4 {
        return buffer.split_to(length).freeze();
    }
    let frame = Bytes::copy_from_slice(&buffer[..length]);
    if length == buffer.len() {
        // All of the buffer is free again, from its beginning.
        buffer.clear();
    } else {
        buffer.advance(length);
    }
    frame
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_frame_does_not_hold_the_buffer_and_a_large_one_is_not_copied() {
        let mut buffer = BytesMut::with_capacity(1024);
        buffer.extend_from_slice(&[1; 100]);
        buffer.extend_from_slice(&[2; 300]);
        let second = buffer[100..].as_ptr();

        let small = part_frame(&mut buffer, 100, 1024);
        let large = part_frame(&mut buffer, 300, 1024);

        assert_eq!((&small[..], &large[..]), (&[1; 100][..], &[2; 300][..]));
        assert_eq!(large.as_ptr(), second);
        assert!(buffer.is_empty());
    }
}
