//! The log of messages: where each goes and what becomes of it, under one id.
//!
//! Nothing is computed unless a subscriber wants [`TARGET`] at DEBUG: a message gets an id only
//! then, and what follows is shown for messages that have one.

use blastema_core::{DeliveryError, Incarnation, ObjectName};
use std::num::NonZeroU64;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use tracing::{Level, debug, enabled};

/// The target of all events about messages.
const TARGET: &str = "blastema::message";

/// What a message is called in the log of this process.
pub(crate) type LogId = NonZeroU64;

/// A message is sent; `from` is empty for what no component of this node sends.
#[inline]
pub(crate) fn sent(
    contract: &str,
    to: &ObjectName,
    from: impl FnOnce() -> String,
) -> Option<LogId> {
    if !enabled!(target: TARGET, Level::DEBUG) {
        return None;
    }
    log_sent(contract, to, &from())
}

#[cold]
fn log_sent(contract: &str, to: &ObjectName, from: &str) -> Option<LogId> {
    static NEXT: AtomicU64 = AtomicU64::new(1);
    let id = LogId::new(NEXT.fetch_add(1, Relaxed))?;
    debug!(target: TARGET, id, contract, from, to = to.as_str(), step = "sent");
    Some(id)
}

/// A component takes it into service.
#[cold]
pub(crate) fn begun(id: LogId, contract: &str, to: &ObjectName, incarnation: Incarnation) {
    let (to, incarnation) = (to.as_str(), incarnation.0);
    debug!(target: TARGET, id, contract, to, incarnation, step = "begun");
}

/// It was served.
#[cold]
pub(crate) fn served(id: LogId, contract: &str, to: &ObjectName, replied: bool) {
    let step = if replied { "replied" } else { "served" };
    debug!(target: TARGET, id, contract, to = to.as_str(), step);
}

/// It was refused, and is returned to its sender.
#[cold]
pub(crate) fn refused(id: LogId, contract: &str, to: &ObjectName, why: &DeliveryError) {
    debug!(target: TARGET, id, contract, to = to.as_str(), step = "refused", reason = %why);
}

/// It is not served, or was not served to its end: it is counted among the dead letters.
#[cold]
pub(crate) fn lost(id: LogId, contract: &str, to: &ObjectName, why: &DeliveryError) {
    debug!(target: TARGET, id, contract, to = to.as_str(), step = "dead letter", reason = %why);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_subscriber_nothing_is_computed() {
        let id = sent("test/add", &"sum".parse().unwrap(), || panic!("not asked for"));
        assert_eq!(id, None);
    }
}
