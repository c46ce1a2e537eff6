//! Whole nodes and what strikes them, through the public interface and the whole fault chain.
//!
//! Everything but the modules `real` runs in virtual time on one thread. Each scenario says what was
//! done to the robot, and what its record of faults, its table and its tree show afterwards.

mod away;
mod chain;
mod changes;
mod chaos;
mod command_timeouts;
mod commanders;
mod conditions;
mod death_watch;
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
mod names;
mod networks;
mod orders;
mod panics;
mod parameters;
mod puppet;
mod real;
mod refusals;
mod rest;
mod retries;
mod sending;
mod services;
mod silence;
mod stops;
mod strategies;
mod throwers;
mod topics;
mod tree;
mod two_types;
mod variables;
mod watching;

use blastema::{Link, MemoryMedium, Network, Node, NodeBuilder};

/// A node with this neighbour on one network, `ethernet`, whose cable can be harmed.
fn linked(own: &str, neighbour: &str, medium: &MemoryMedium) -> NodeBuilder {
    let network = Network::memory("ethernet", medium, own);
    let network = network.link(Link::in_memory(neighbour, neighbour)).with_faults(7);
    Node::builder(own).network(network)
}
