//! Which incarnation of an object or a node something belongs to.

use serde::{Deserialize, Serialize};
use std::fmt;

/// The n-th incarnation of a component or of a node.
///
/// A component's incarnations are counted from 1 by its supervisor. A node's incarnation is chosen
/// by its platform when the process starts, and is larger than that of any earlier process of that
/// node.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Incarnation(pub u64);

impl Incarnation {
    /// A component's first incarnation.
    pub const FIRST: Incarnation = Incarnation(1);

    /// The incarnation after this one.
    #[must_use]
    pub const fn next(self) -> Incarnation {
        Incarnation(self.0 + 1)
    }
}

impl fmt::Display for Incarnation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "#{}", self.0)
    }
}
