//! Whether a request is asked again, and when.

use crate::DeliveryError;
use crate::recovery::Backoff;
use std::time::Duration;

/// How often a request is asked, where asking again can do no harm.
///
/// That is so where it was not taken up: there was no room, no way, or the receiver was between two
/// incarnations. Where it may have taken effect (the receiver died while it served it, or the way
/// to its answer was lost), it is asked again only if its contract is declared `idempotent`.
///
/// ```
/// use blastema_core::delivery::retry::FailedAttempt;
/// use blastema_core::{RetryPolicy, DeliveryError};
///
/// let rule = RetryPolicy { attempts: 2, ..RetryPolicy::default() };
/// let full = FailedAttempt { asked: 1, why: &DeliveryError::Full, idempotent: false };
/// assert!(rule.again(full, 7).is_some());
/// assert!(rule.again(FailedAttempt { asked: 2, ..full }, 7).is_none());
/// let unknown = DeliveryError::OutcomeUnknown { reason: "the cable was cut".into() };
/// let unknown = FailedAttempt { why: &unknown, ..full };
/// assert!(rule.again(unknown, 7).is_none());
/// assert!(rule.again(FailedAttempt { idempotent: true, ..unknown }, 7).is_some());
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RetryPolicy {
    /// How often it is asked at most, the first time included; 0 is taken for 1. More outlasts
    /// longer faults; each that is served is work for the receiver.
    pub attempts: u32,
    /// How long to wait in between. Longer spares a receiver that has no room.
    pub backoff: Backoff,
    /// All of it is over by then: the deadline of the last attempt.
    pub within: Duration,
}

impl Default for RetryPolicy {
    /// Ten times at most, after 10, 20, 40 ms and so on up to half a second, within five seconds:
    /// longer than a component, or a process, needs to come back.
    fn default() -> Self {
        let backoff =
            Backoff { factor: 2, limit: Duration::from_millis(500), ..Backoff::default() };
        RetryPolicy { attempts: 10, backoff, within: Duration::from_secs(5) }
    }
}

/// An attempt that was in vain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FailedAttempt<'a> {
    /// Which it was, from 1.
    pub asked: u32,
    /// What stood in the way.
    pub why: &'a DeliveryError,
    /// The request's contract is declared so: it may take effect twice.
    pub idempotent: bool,
}

impl RetryPolicy {
    /// How long to wait before it is asked again after this attempt; `None` if that would do harm,
    /// or not help. The same `seed` gives the same jitter.
    pub fn again(&self, attempt: FailedAttempt<'_>, seed: u64) -> Option<Duration> {
        let FailedAttempt { asked, why, idempotent } = attempt;
        let helps = match why {
            DeliveryError::Full
            | DeliveryError::WayFull { .. }
            | DeliveryError::Restarting
            | DeliveryError::Unreachable { .. }
            | DeliveryError::Undelivered { .. }
            | DeliveryError::Left { .. } => true,
            DeliveryError::PeerDied { .. } | DeliveryError::OutcomeUnknown { .. } => idempotent,
            _ => false,
        };
        (helps && asked < self.attempts).then(|| self.backoff.delay(asked.saturating_add(1), seed))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Incarnation;

    #[test]
    fn what_may_have_taken_effect_is_asked_again_only_if_that_does_no_harm() {
        let rule = RetryPolicy::default();
        let again = |why: &DeliveryError, idempotent| {
            rule.again(FailedAttempt { asked: 1, why, idempotent }, 1).is_some()
        };

        for why in [
            DeliveryError::Full,
            DeliveryError::Restarting,
            DeliveryError::Unreachable { node: "far".into() },
        ] {
            assert!(again(&why, false) && again(&why, true), "{why}");
        }
        let died = DeliveryError::PeerDied { incarnation: Incarnation(1) };
        assert!(!again(&died, false) && again(&died, true));
        for why in [
            DeliveryError::DeadlinePassed,
            DeliveryError::Stopped,
            DeliveryError::Quarantined { kills: 3 },
            DeliveryError::isolated("arm"),
            DeliveryError::SenderIsolated,
        ] {
            assert!(!again(&why, true), "{why} does not pass by itself");
        }
    }

    #[test]
    fn waits_grow_and_attempts_end() {
        let rule = RetryPolicy {
            attempts: 4,
            backoff: Backoff { jitter_percent: 0, ..RetryPolicy::default().backoff },
            ..RetryPolicy::default()
        };
        let full = |asked| FailedAttempt { asked, why: &DeliveryError::Full, idempotent: false };
        let wait = |asked| rule.again(full(asked), 1).map(|wait| wait.as_millis());
        let waits: Vec<_> = (1..6).map(wait).collect();
        assert_eq!(waits, [Some(10), Some(20), Some(40), None, None]);
    }
}
