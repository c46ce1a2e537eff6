//! Tests of the program on real threads, with real processes, sockets or clocks. They take turns,
//! wait for events with a generous bound, and judge counts and order, never a duration.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]
#![allow(clippy::disallowed_methods, reason = "no event announces what a program does")]

mod device;
mod fault_list;
mod keys;
mod monitor;
mod operator;
mod robot;
mod tree;
