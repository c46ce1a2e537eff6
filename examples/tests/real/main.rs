//! Tests of the examples on real threads, with real processes, sockets or clocks. They take turns,
//! wait for events with a generous bound, and judge counts and order, never a duration.

mod examples;
mod paper_process;
