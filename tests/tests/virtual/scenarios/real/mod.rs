//! Scenarios on real threads.

mod hangs;
mod starving;
