//! The life cycle of an object.

use serde::{Deserialize, Serialize};
use std::fmt;

/// Where an object stands in its life.
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
    /// At work.
    Active,
    /// A fault stopped its work; `on_reset` may bring it back.
    Error,
    /// This incarnation is over; only `on_finalize` is left to it.
    Fatal,
    /// The end.
    Finalized,
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
