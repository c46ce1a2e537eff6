//! One suite for both device sides: the Rust machine, and the C library as a child process, each on
//! a serial line, a multi-drop line and datagrams, driven by the host machine in virtual time.
//!
//! `BLASTEMA_LONG=1` compiles the C side with sanitizers and makes the trials as long as a night
//! allows.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]
#![allow(clippy::disallowed_methods, clippy::disallowed_types, reason = "as a test may")]
#![allow(clippy::print_stdout, reason = "the trials report their figures")]

mod alike;
mod bench;
mod c_side;
mod channel;
mod multidrop;
mod once;
mod robot;
mod suite;
