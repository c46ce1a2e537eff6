//! Which messages to a node stay in order among themselves.

use crate::ObjectName;
use std::hash::{DefaultHasher, Hash, Hasher};

/// Messages of one key arrive in the order in which a session took them, in each of its streams.
/// What is small, and of another key, does not wait behind the rest of what is large, if it fits
/// into one part.
///
/// What is control goes by a stream of its own: it passes what was sent to its object before.
///
/// Before the session, messages wait for the binding of their contract, each contract by itself: to
/// one object, what is of a contract that is bound passes what waits for that of another. And
/// readings of which the newest counts are of no key.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum OrderingKey {
    /// What has no other.
    #[default]
    Common,
    /// All that is for one object, whatever its contract: it shares the object's queue. Two that
    /// are alike by chance stay in order, too.
    Object(u64),
    /// The events of one subscription.
    Subscription(u32),
    /// The reply to one request: its caller waits for no other.
    Call(u64),
}

impl OrderingKey {
    /// That of an object.
    pub fn to(object: &ObjectName) -> Self {
        let mut hasher = DefaultHasher::new();
        object.as_str().hash(&mut hasher);
        OrderingKey::Object(hasher.finish())
    }
}
