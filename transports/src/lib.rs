//! Media of the Blastema middleware: one file and one feature each.
//!
//! A transport is an actor that owns a medium and speaks [`blastema_contract::transport`], nothing
//! else. Adding a medium is adding one file here. What all of them share:
//!
//! * `pump.rs`: reading and writing are polled on the actor's own arbiter, after its mailbox and with
//!   a budget, so that a flooded medium still takes orders.
//! * `outlet.rs`: frames go to whoever is attached, never more than a few hundred unconfirmed; a
//!   receiver that hangs makes the medium's own buffers overflow, not the process.
//! * `legacy.rs`: what one life leaves to the next. The factories ([`Udp::factory`] and the like)
//!   build a transport anew after a panic; it takes its port again and knows who is attached.
//! * `reopening.rs`: a medium that cannot be opened is tried again, with back-off.
//!
//! Deliberately not here: who is a neighbour and whether it lives (the link), what a frame says
//! (router, session), order and repetition (session).

mod legacy;
#[cfg(feature = "memory")]
pub mod memory;
mod outlet;
mod pump;
#[cfg(any(feature = "memory", feature = "udp", feature = "tcp"))]
mod reopening;
#[cfg(feature = "udp")]
pub mod udp;

#[cfg(feature = "memory")]
pub use memory::{Memory, MemoryConfig, MemoryMedium};
#[cfg(feature = "udp")]
pub use udp::{Udp, UdpConfig};
