//! The fault chain: thin actors over the machines of `blastema_core::detection` and `recovery`.
//!
//! Each of them runs under the guardian. After a panic of its own, a body keeps its addresses and makes
//! its machine anew from the plain facts of the old one, in `restarting`; the input that struck it is
//! lost, and everything that was under way is sent again.

pub(crate) mod detector;
pub(crate) mod directory;
pub(crate) mod monitor;
pub(crate) mod notifier;
pub(crate) mod recoverer;
#[cfg(test)]
pub(crate) mod scripted;
pub(crate) mod strategy;
pub(crate) mod supervisor;

use blastema_contract::reports::Alive;
use blastema_core::{Incarnation, Lifecycle};
use std::time::Duration;

/// What an actor of the chain answers to the question whether it is alive. It answers from its mailbox,
/// behind everything else that waits there: that it answers is all there is to say.
fn at_work(incarnation: Incarnation) -> Alive {
    let (state, queued, oldest) = (Lifecycle::Active, 0, Duration::ZERO);
    Alive { incarnation, state, queued, oldest, long_operation: false }
}

#[cfg(test)]
mod tests;
