//! Whole nodes and what strikes them, through the public interface and the whole fault chain.
//!
//! Everything but the modules `real` runs in virtual time on one thread. Each scenario says what was
//! done to the robot, and what its record of faults, its table and its tree show afterwards.

mod chain;
mod changes;
mod command_timeouts;
mod commanders;
mod conditions;
mod declared;
mod either_order;
mod endings;
mod error_texts;
mod errors;
mod escalation;
mod events;
mod floods;
mod groups;
mod initialization;
mod isolation;
mod last_hooks;
mod lost_communication;
mod message_log;
mod names;
mod networks;
mod orders;
mod panics;
mod parameters;
mod puppet;
mod real;
mod rest;
mod retries;
mod sending;
mod services;
mod silence;
mod stops;
mod strategies;
mod throwers;
mod topics;
mod two_types;
mod variables;
mod watching;
