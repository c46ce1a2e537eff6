//! The logic of the Blastema middleware as pure machines.
//!
//! Nothing here performs IO, reads a clock or knows an actor. Time, randomness and identity are
//! arguments; collections iterate in a fixed order, so that one seed gives one run, bit for bit.

pub mod contract;
pub mod delivery;
pub mod fault;
pub mod identity;
pub mod layout;
pub mod lifecycle;
pub mod machine;
pub mod name;
pub mod net;
pub mod time;

pub use contract::{Contract, ContractIdentity, Event, Request};
pub use delivery::Why;
pub use fault::{Fault, FaultId, FaultKind, Place, Severity};
pub use identity::Incarnation;
pub use lifecycle::Lifecycle;
pub use machine::Machine;
pub use name::{NameError, NodeName, ObjectAddress, ObjectName};
pub use time::Instant;
