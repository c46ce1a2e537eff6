//! Tests of transports on real threads, with real processes, sockets or clocks. They take turns,
//! wait for events with a generous bound, and judge counts and order, never a duration.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod conformance;
// For a kernel that this machine may lack: tests/guest/run.
#[cfg(guest)]
mod guest;
mod hostile;
mod proven;
mod serial;
mod slcan;
mod tcp;
mod udp;
mod unix;
