//! The ids of requests that may come twice.

use crate::platform;
use blastema_core::MessageId;
use std::sync::OnceLock;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;

/// A fresh identity for a message of this process.
pub(crate) fn next_id() -> MessageId {
    static NEXT: AtomicU64 = AtomicU64::new(1);
    static SENDER: OnceLock<u64> = OnceLock::new();
    let sender = *SENDER.get_or_init(platform::random_seed);
    MessageId { sender, sequence: NEXT.fetch_add(1, Relaxed) }
}
