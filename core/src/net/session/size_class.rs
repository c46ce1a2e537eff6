//! How large a message is, and so what it shares room with on its way to another node.
//!
//! Bulk has room of its own at each place where messages wait, so that it never fills that of what
//! is small: an order finds room while images stand in a row. Within a
//! [`Strand`](crate::net::OrderingKey) both go in the order in which they were sent; what is small
//! and of another one goes between the parts of what is large.

/// Whether a message is small, or bulk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum SizeClass {
    /// Of [`SMALL_MAX`](SizeClass::SMALL_MAX) bytes at most: an order, a reading, the scan of a
    /// laser.
    Small,
    /// Larger: an image, a map.
    Bulk,
}

impl SizeClass {
    /// The most bytes of a small message. The room that small ones have anywhere takes 64 of them
    /// at least.
    pub const SMALL_MAX: usize = 16 * 1024;

    /// Both, in the order of their places.
    pub const ALL: [SizeClass; 2] = [SizeClass::Small, SizeClass::Bulk];

    /// What a message of so many bytes is.
    pub fn of(bytes: usize) -> Self {
        if bytes > Self::SMALL_MAX { SizeClass::Bulk } else { SizeClass::Small }
    }
}
