//! Whole nodes and what strikes them, through the public interface and the whole fault chain.
//!
//! Everything but `hangs` runs in virtual time on one thread. Each scenario says what was done to the
//! robot, and what its record of faults, its table and its tree show afterwards.

mod errors;
mod initialization;
mod panics;
mod puppet;
