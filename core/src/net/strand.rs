//! Which messages to a node stay in order among themselves.

use crate::ObjectName;
use std::hash::{DefaultHasher, Hash, Hasher};

/// Messages of one strand arrive in the order in which they were sent. What is small, and of another strand, does
/// not wait behind the rest of what is large.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Strand {
    /// What has no other.
    #[default]
    Common,
    /// All that is for one object, whatever its contract: it shares the object's queue and its order. Two that
    /// are alike by chance stay in order, too.
    Object(u64),
    /// The events of one subscription.
    Subscription(u32),
    /// The reply to one request: whoever waits for it waits for no other.
    Call(u64),
}

impl Strand {
    /// That of an object.
    pub fn to(object: &ObjectName) -> Self {
        let mut hasher = DefaultHasher::new();
        object.as_str().hash(&mut hasher);
        Strand::Object(hasher.finish())
    }
}
