//! The logic of the Blastema middleware as pure machines.
//!
//! Nothing here performs IO, reads a clock or knows an actor. Time, randomness and identity are
//! arguments; collections iterate in a fixed order, so that one seed gives one run, bit for bit.

pub mod audience;
pub mod blob;
pub mod can;
pub mod codec;
pub mod contract;
pub mod dead_letters;
pub mod delivery;
pub mod dependencies;
pub mod description;
pub mod detection;
pub mod difference;
pub mod fault;
pub mod field;
pub mod former;
mod hash;
pub mod identity;
pub mod impairment;
pub mod layout;
pub mod lease;
pub mod lifecycle;
pub mod machine;
pub mod name;
pub mod net;
pub mod occupancy;
pub mod parameters;
pub mod parcel;
pub mod quarantine;
pub mod random;
pub mod recovery;
pub mod retry;
pub mod scanner;
pub mod service;
pub mod spelling;
pub mod time;
pub mod variables;

pub use blob::Blob;
pub use codec::{DecodeError, EncodeError};
pub use contract::{
    Contract, ContractIdentity, Event, PeerIdentity, PeerStructure, Request, Variable,
};
pub use delivery::{Delivery, Outcome, Why};
pub use description::{DescriptionError, LayoutDescription};
pub use difference::Difference;
pub use fault::{Fault, FaultId, FaultKind, Place, Severity};
pub use former::Former;
pub use identity::Incarnation;
pub use layout::{Described, Layout};
pub use lifecycle::Lifecycle;
pub use machine::Machine;
pub use name::{NameError, NodeName, ObjectAddress, ObjectName};
pub use parcel::Parcel;
pub use quarantine::MessageId;
pub use retry::RetryRule;
/// The codec's interface, for the code that the derives write.
#[doc(hidden)]
pub use serde;
pub use time::Instant;
