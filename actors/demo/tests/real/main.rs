//! Tests of the demonstration on real threads, with real processes, sockets or clocks. They take
//! turns, wait for events with a generous bound, and judge counts and order, never a duration.
#![allow(clippy::disallowed_methods, reason = "no event announces what a program does")]

mod demo;
