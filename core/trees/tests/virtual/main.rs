//! The crate's tests, in virtual time: files go in, and ticks, calls and errors come out.

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
