//! The crate's tests, in virtual time: files go in, and ticks, calls and errors come out.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]
#![allow(clippy::disallowed_methods, clippy::disallowed_types, reason = "as a test may")]

mod allocations;
mod boards;
mod controls;
mod drivers;
mod loading;
mod models;
mod oracle;
mod scripted;
mod scripts;
mod timers;
mod traps;
