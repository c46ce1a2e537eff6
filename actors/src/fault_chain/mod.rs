//! The fault chain: thin actors over the machines of `blastema_core::detection` and `recovery`.
//!
//! One actor drives monitor, detector and notifier, another drives the recoverer, and each
//! supervisor has one. Each runs under the guardian. After a panic of its own, an actor keeps its
//! addresses and the facts of its machine, in `restarting`. The input that caused the panic is lost,
//! and unconfirmed outputs are sent again.
//!
//! On their thread runs no code of the application but the subscriber of `tracing` that it has
//! installed, and the `Drop` of two things: the messages that wait for a component that is not
//! started again, and what the factory of a removed component had captured. Its strategies, safe
//! outputs and cut-offs are [called elsewhere](callbacks), and [a thread of its own](outside) looks
//! whether the chain answers. So the chain needs no other thread to go to.

pub(crate) mod detection;
pub(crate) mod log;
pub(crate) mod outside;
pub(crate) mod recoverer;
pub(crate) mod strategy;
pub(crate) mod supervisor;

#[cfg(test)]
pub(crate) mod tests;
