//! The life cycle of an object.

use serde::{Deserialize, Serialize};
use std::fmt;

/// Where an object stands in its incarnation.
///
/// ```text
/// Created ─► Initialized ⇄ Active ─► Error ─► (reset) ─► Initialized
///    │            │          │         │
///    └────────────┴──────────┴─────────┴──► Fatal ─► (finalize) ─► Created of the next incarnation
///                                                              └─► Finalized, when there is none
/// ```
///
/// `Initialized` is the *Inactive* of OMG RTC and ROS 2.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Lifecycle {
    /// The object exists; `on_initialize` has not yet succeeded.
    Created,
    /// Ready, and doing nothing.
    Initialized,
    /// The object does its work.
    Active,
    /// A fault stopped its work; `on_reset` may bring it back.
    Error,
    /// This incarnation is over; only `on_finalize` is left to it.
    Fatal,
    /// The incarnation has ended; no state follows.
    Finalized,
}

/// One way from one state to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transition {
    /// The state before the change.
    pub from: Lifecycle,
    /// The hook that was called, or what happened.
    pub by: &'static str,
    /// The state after the change.
    pub to: Lifecycle,
}

const fn transition(from: Lifecycle, by: &'static str, to: Lifecycle) -> Transition {
    Transition { from, by, to }
}

impl Lifecycle {
    /// Every way that one incarnation may take. There is no way back from `Fatal` and `Finalized`:
    /// what follows is another incarnation, which begins at `Created`.
    pub const TRANSITIONS: [Transition; 16] = {
        use Lifecycle::{Active, Created, Error, Fatal, Finalized, Initialized};
        [
            transition(Created, "on_initialize", Initialized),
            transition(Created, "on_initialize failed", Fatal),
            transition(Created, "stopped before it was initialised", Finalized),
            transition(Initialized, "on_activated", Active),
            transition(Initialized, "on_activated failed", Error),
            transition(Initialized, "a fatal fault", Fatal),
            transition(Initialized, "on_finalize", Finalized),
            transition(Active, "on_deactivated", Initialized),
            transition(Active, "on_aborting, on_error", Error),
            transition(Active, "a fatal fault", Fatal),
            transition(Active, "on_deactivated, on_finalize", Finalized),
            transition(Error, "on_reset", Initialized),
            transition(Error, "on_reset failed", Fatal),
            transition(Error, "a fatal fault", Fatal),
            transition(Error, "on_finalize", Finalized),
            transition(Fatal, "on_finalize", Finalized),
        ]
    };

    /// Whether one incarnation may change from this state to `next` in one step.
    pub(crate) fn may_become(self, next: Lifecycle) -> bool {
        Self::TRANSITIONS.iter().any(|step| step.from == self && step.to == next)
    }

    /// Whether one incarnation may reach `next` from this state in any number of steps.
    pub(crate) fn may_reach(self, next: Lifecycle) -> bool {
        let mut reached = vec![self];
        let mut at = 0;
        while let Some(&state) = reached.get(at) {
            if state.may_become(next) {
                return true;
            }
            let ways = Self::TRANSITIONS.iter().filter(|way| way.from == state);
            let new: Vec<_> = ways.map(|way| way.to).filter(|to| !reached.contains(to)).collect();
            reached.extend(new);
            at += 1;
        }
        false
    }
}

impl fmt::Display for Lifecycle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Lifecycle::Created => "created",
            Lifecycle::Initialized => "initialized",
            Lifecycle::Active => "active",
            Lifecycle::Error => "error",
            Lifecycle::Fatal => "fatal",
            Lifecycle::Finalized => "finalized",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::Lifecycle::{self, Active, Created, Error, Fatal, Finalized, Initialized};

    const ALL: [Lifecycle; 6] = [Created, Initialized, Active, Error, Fatal, Finalized];

    #[test]
    fn every_state_leads_where_the_picture_says() {
        let leads = |from: Lifecycle| ALL.map(|to| from.may_become(to));

        //                     Created Initialized Active Error Fatal Finalized
        assert_eq!(leads(Created), [false, true, false, false, true, true]);
        assert_eq!(leads(Initialized), [false, false, true, true, true, true]);
        assert_eq!(leads(Active), [false, true, false, true, true, true]);
        assert_eq!(leads(Error), [false, true, false, false, true, true]);
        assert_eq!(leads(Fatal), [false, false, false, false, false, true]);
        assert_eq!(leads(Finalized), [false; 6]);
    }

    #[test]
    fn no_incarnation_comes_back_from_fatal_or_finalized_and_none_to_created() {
        for from in ALL {
            for to in ALL {
                let over = matches!(from, Fatal | Finalized);
                let expected = to != Created && (!over || (from == Fatal && to == Finalized));
                assert_eq!(from.may_reach(to), expected, "{from} to {to}");
            }
        }
    }
}
