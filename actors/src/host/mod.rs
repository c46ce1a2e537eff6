//! The host: what stands between a user's component and actix.
//!
//! ```text
//!  senders ──► ComponentCell: queue, name, core  ◄── ComponentChild ◄── supervisor
//!                  │ what all incarnations share         │ start, stop, abandon …
//!  commands ──► ComponentExecutor ◄──────────────────────┘
//!                  │ a task of the arbiter: one incarnation after another, each under the guard
//!                  │ ComponentSlot, IncarnationLifecycle, ScheduledWork, ActivityRecord
//!  sampler ──► ArbiterHeartbeat of each arbiter, ActivityRecord of each component
//! ```
//!
//! Commands come from the framework alone, on a [queue](crate::component::control) of their own
//! that the executor looks at first, so that a flooded component, or one that awaits, still obeys.
//! Messages of the application travel in the [queue](crate::messaging::queue), which belongs to the
//! cell.
//!
//! A handler that keeps its thread is found by the sampler, which reads what workers write and
//! never waits for them. The supervisor then abandons the incarnation: its arbiter is *fenced*, so
//! that nothing the handler still says gets out. If the handler returns within the grace time the
//! fence is lifted and its neighbours have only lost time; else the arbiter is *lost*, and they are
//! re-created elsewhere, each with its queue.

pub(crate) mod child;
pub(crate) mod executor;
pub(crate) mod lifecycle;
pub(crate) mod reference;
pub(crate) mod schedule;
pub(crate) mod spec;

#[cfg(test)]
mod tests;
