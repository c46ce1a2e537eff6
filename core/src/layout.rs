//! The structure of a message as data.

/// The structure of one type.
#[derive(Debug)]
pub struct Layout {
    /// The type's name.
    pub name: &'static str,
}

/// A type whose structure is known and the same on every platform.
pub trait Described: 'static {
    /// The type's structure.
    fn layout() -> &'static Layout;
}
