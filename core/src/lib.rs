//! The logic of the Blastema middleware as pure machines.
//!
//! Nothing here performs IO, reads a clock or knows an actor. Time, randomness and identity are
//! arguments; collections iterate in a fixed order, so that one seed gives one run, bit for bit.

mod backoff;
mod hash;
mod sliding_window;
#[cfg(test)]
mod testing;
mod timer;

pub mod connection;
pub mod contract;
pub mod delivery;
pub mod detection;
pub mod directory;
pub mod fault;
pub mod incarnation;
pub mod lease;
pub mod lifecycle;
pub mod machine;
pub mod machine_set;
pub mod medium;
pub mod name;
pub mod net;
pub mod parameters;
pub mod port;
pub mod random;
pub mod recovery;
pub mod service;
pub mod sorted;
pub mod suggestion;
pub mod time;
pub mod variables;

pub use contract::blob::Blob;
pub use contract::codec::{DecodeError, EncodeError};
pub use contract::gather_buffer::GatherBuffer;
pub use contract::layout::description::LayoutDescription;
pub use contract::layout::difference::Difference;
pub use contract::layout::{Described, Layout};
pub use contract::previous_version::PreviousVersion;
pub use contract::{
    Contract, ContractIdentity, Event, PeerIdentity, PeerStructure, Request, Variable,
};
pub use delivery::credit::{Credit, CreditPool};
pub use delivery::quarantine::MessageId;
pub use delivery::retry::RetryPolicy;
pub use delivery::traffic_class::TrafficClass;
pub use delivery::{Delivery, DeliveryError, Outcome};
pub use fault::{Fault, FaultId, FaultKind, FaultLocation, Severity};
pub use incarnation::Incarnation;
pub use lifecycle::Lifecycle;
pub use machine::Machine;
pub use name::{NameError, NodeName, ObjectAddress, ObjectName};
/// The codec's interface, for the code that the derives write.
#[doc(hidden)]
pub use serde;
pub use sliding_window::SlidingWindow;
pub use time::Instant;
