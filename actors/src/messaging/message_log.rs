//! The log of messages: where each is sent, and where its handler begins. One that does not come so
//! far is shown as refused, or among the dead letters.
//!
//! Nothing is computed unless a subscriber wants [`TARGET`] at DEBUG.

use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::{DeliveryError, Incarnation, ObjectName};
use tracing::{Level, debug, enabled};

/// The target of all events about messages.
const TARGET: &str = "blastema::message";

/// A message is sent; `from` is empty for what no component of this node sends.
#[inline]
pub(crate) fn sent(contract: &str, to: &ObjectName, from: impl FnOnce() -> String) {
    if enabled!(target: TARGET, Level::DEBUG) {
        log_sent(contract, to, &from());
    }
}

#[cold]
fn log_sent(contract: &str, to: &ObjectName, from: &str) {
    debug!(target: TARGET, contract, from, to = to.as_str(), step = "sent");
}

/// A component takes it into service.
#[inline]
pub(crate) fn begun(contract: &str, to: &ObjectName, incarnation: Incarnation) {
    if enabled!(target: TARGET, Level::DEBUG) {
        log_begun(contract, to, incarnation);
    }
}

#[cold]
fn log_begun(contract: &str, to: &ObjectName, incarnation: Incarnation) {
    let (to, incarnation) = (to.as_str(), incarnation.0);
    debug!(target: TARGET, contract, to, incarnation, step = "begun");
}

/// It was refused, and is returned to its sender.
#[cold]
pub(crate) fn refused(contract: &str, to: &ObjectName, why: &DeliveryError) {
    debug!(target: TARGET, contract, to = to.as_str(), step = "refused", reason = %why);
}

/// So many are not served, or were not served to their end.
#[cold]
pub(crate) fn lost(contract: &str, to: &ObjectName, reason: DeadReason, count: u64) {
    let (to, reason) = (to.as_str(), reason.text());
    debug!(target: TARGET, contract, to, step = "dead letter", reason, count);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_subscriber_nothing_is_computed() {
        sent("test/add", &"sum".parse().unwrap(), || panic!("not asked for"));
    }
}
