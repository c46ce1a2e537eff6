//! One hash for whatever must be the same in every build and on every platform: FNV-1a. It finds
//! accidents, and not against an attacker who makes two things look alike.

/// The hash of these bytes, by the offset basis and the prime for 64 bits, as published by its
/// authors.
pub(crate) fn of(bytes: impl IntoIterator<Item = u8>) -> u64 {
    const BASIS: u64 = 0xcbf2_9ce4_8422_2325;
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    bytes.into_iter().fold(BASIS, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(PRIME))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_authors_own_examples_come_out() {
        assert_eq!(of(*b""), 0xcbf2_9ce4_8422_2325);
        assert_eq!(of(*b"a"), 0xaf63_dc4c_8601_ec8c);
        assert_eq!(of(*b"foobar"), 0x8594_4171_f739_67e8);
    }
}
