//! Tests of whole robots on real threads, with real processes, sockets or clocks. They take turns,
//! wait for events with a generous bound, and judge counts and order, never a duration.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod actix_facts;
mod books;
mod busy;
mod busy_computer;
mod chain_outside;
mod conditions;
mod devices;
mod discovery;
mod dropped_nodes;
mod exposure;
mod inspection;
mod kill_storm;
mod large_messages;
mod media;
mod mesh;
mod namesakes;
mod narrow_path;
mod node_start;
mod outages;
mod overload;
mod panic_strategy;
mod processes;
mod program_ends;
mod program_errors;
mod readiness;
mod robot_file;
mod rounds;
mod sealed;
mod settings;
mod slow_machine;
mod slow_path;
mod supervised_processes;
mod trees;
mod unread_errors;
