//! Fault-tolerant middleware for robots: typed actors that grow back.

mod chain;
mod drive;
mod guardian;
mod panics;
pub mod platform;

#[cfg(panic = "abort")]
compile_error!(
    "Blastema recovers from panics and cannot do so with `panic = \"abort\"`: remove that line from \
     the profile in Cargo.toml, or set `panic = \"unwind\"`"
);

pub use blastema_core as core;
pub use blastema_core::{Contract, Described};
pub use blastema_core::{Incarnation, NodeName, ObjectAddress, ObjectName, Why};
pub use blastema_macros::{Event, Request, Structure, main};
pub use serde;
