//! What a message between two objects must be, and how two parties find out that they mean the same.

use crate::layout::{Described, Layout};
use serde::{Serialize, de::DeserializeOwned};
use std::time::Duration;

/// A type of message: an event, or a request with its reply.
///
/// Derive it with `#[derive(Event)]` or `#[derive(Request)]`; do not implement it by hand.
pub trait Contract: Serialize + DeserializeOwned + Described + Send + 'static {
    /// What the receiver answers; `()` for an event.
    type Reply: Serialize + DeserializeOwned + Described + Send + 'static;

    /// The name by which both parties know the contract.
    const NAME: &'static str;
    /// Raised by whoever changes the contract's meaning.
    const VERSION: u16 = 1;
    /// The most bytes that one encoded message may take.
    const MAX_SIZE: usize = 64 * 1024;
    /// An event older than this is not delivered but counted.
    const MAX_AGE: Option<Duration> = None;
}

/// A contract without an answer, which may have many listeners.
pub trait Event: Contract<Reply = ()> + Clone + Sync {}

/// A contract with an answer.
pub trait Request: Contract {}

/// What two parties compare when they bind.
#[derive(Clone, Debug)]
pub struct ContractIdentity {
    /// The contract's name.
    pub name: &'static str,
    /// Its version.
    pub version: u16,
    /// The hash of its structure and of its reply's.
    pub fingerprint: u64,
    /// The message's structure.
    pub message: fn() -> &'static Layout,
    /// The reply's structure.
    pub reply: fn() -> &'static Layout,
}
