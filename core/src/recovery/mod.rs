//! The acting half of the fault chain: which action, and which children it touches.
//!
//! ```text
//!            Plan                    Rules
//!             │                        │
//! Fault ─► Recoverer ─RecoveryOrder─► strategy ─► Supervisor ─► start, stop, abandon, reset …
//!          which action                           which children, in which order,
//!          by fault kind                          and whether it is still worth it
//! ```
//!
//! One master per decision. The [`Recoverer`] climbs the [`Plan`]'s ladder of actions for a kind
//! of fault, one rung after the other, and ends in the safe state. [`Supervisor`] keeps the tree as
//! in Erlang/OTP: start in order, stop in reverse, restart one, all, or the rest; more restarts
//! than the intensity allows, and it ends and escalates. Neither of them detects anything.

mod ladder;
mod plan;
mod rules;

pub mod recoverer;
pub mod supervision;

pub use crate::backoff::Backoff;
pub use ladder::{Ladder, LadderStep, RecoveryAction};
pub use plan::{Plan, PlanError};
pub use recoverer::{
    CASES_MAX, Recoverer, RecovererOutput, RecoveryDone, RecoveryFailed, RecoveryOrder,
};
pub use rules::{ChildRules, Restart, Strategy, SupervisorRules, WhenExceeded};
pub use supervision::{
    CallId, ChildOrder, ChildState, ChildStatus, GiveUpReason, ReplacementCause, Supervisor,
    SupervisorOutput,
};
