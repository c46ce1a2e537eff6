//! What the tests of many modules begin with.

use crate::name::{NodeName, ObjectName};
use crate::time::Instant;

/// So many milliseconds after the origin.
pub(crate) fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

pub(crate) fn node(name: &str) -> NodeName {
    NodeName::new(name).expect("a name of a node")
}

pub(crate) fn object(name: &str) -> ObjectName {
    ObjectName::new(name).expect("a name of an object")
}
