//! The fault chain: thin actors over the machines of `blastema_core::detection` and `recovery`.
//!
//! Each of them runs under the guardian. After a panic of its own, a body keeps its addresses and
//! makes
//! its machine anew from the plain facts of the old one, in `restarting`; the input that struck it
//! is
//! lost, and everything that was under way is sent again.
//!
//! On their thread runs no code of the application but the subscriber of `tracing` that it has
//! installed: its
//! strategies, safe outputs and cut-offs are [called elsewhere](callbacks), and [a thread of its
//! own](outside) looks
//! whether the chain answers.

pub(crate) mod detector;
pub(crate) mod directory;
pub(crate) mod log;
pub(crate) mod monitor;
pub(crate) mod notifier;
pub(crate) mod outside;
pub(crate) mod recoverer;
#[cfg(test)]
pub(crate) mod scripted;
pub(crate) mod strategy;
pub(crate) mod supervisor;

#[cfg(test)]
mod tests;
