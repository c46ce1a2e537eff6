//! Networks of robots over Zenoh, and topics as plain keys.
#![doc = include_str!("../README.md")]

mod bridge;
mod client;
mod ends;
mod network;

pub use bridge::{BridgeError, ZenohBridge};
pub use network::ZenohNetwork;
