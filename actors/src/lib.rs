//! Fault-tolerant middleware for robots: typed actors that grow back.

// The derives write `::blastema`, also where they are used within it.
#[cfg(test)]
extern crate self as blastema;

mod chain;
mod component;
mod context;
mod death_watch;
mod drive;
mod guardian;
mod host;
mod lane;
mod letter;
mod net;
mod node;
mod panics;
pub mod plain;
pub mod platform;
mod ports;
mod reference;
mod registry;
mod reply;
mod sender;
mod topic;

#[cfg(panic = "abort")]
compile_error!(
    "Blastema recovers from panics and cannot do so with `panic = \"abort\"`: remove that line from \
     the profile in Cargo.toml, or set `panic = \"unwind\"`"
);

// Messages, and what they are made of.
pub use blastema_core::{Contract, Described, Event, Request};
pub use blastema_macros::{Event, Request, Structure};
pub use serde;

// Components.
pub use component::{Component, Failure, Handle};
pub use context::{Context, LongOperation};
pub use host::life::TimerId;
pub use host::spec::{ChildSpec, SpecError};
pub use lane::WhenFull;
pub use ports::{ListenPort, Ports};

// Sending, and what becomes of messages.
pub use blastema_core::dead_letters::DeadReason;
pub use blastema_core::{Incarnation, NodeName, ObjectAddress, ObjectName, Why};
pub use death_watch::{Down, Ending};
pub use host::office::DeadLetterOffice;
pub use reference::ActorRef;
pub use sender::{DEFAULT_DEADLINE, Repeatable, RequestError, SendError, Sender};
pub use topic::Publisher;

// Nodes, their trees and their networks.
pub use blastema_contract::link::LinkRow;
pub use blastema_contract::naming::NodeRow;
pub use blastema_contract::session::SessionRow;
pub use blastema_contract::supervisor::Branch;
pub use blastema_core::net::Route;
pub use blastema_macros::main;
pub use node::{
    Cable, Direction, FaultEvents, Impairment, Link, MemoryMedium, Network, Node, NodeBuilder,
    NodeState, StartError, SupervisorSpec,
};

// Faults: found, shown, recovered.
pub use blastema_contract::detector::FaultEvent;
pub use blastema_core::detection::{
    CheckFailed, Freshness, Invariant, Opinion, Range, Rate, Record, Row, Turn,
};
pub use blastema_core::{Fault, FaultKind, Instant, Lifecycle, Place, Severity};
pub use chain::strategy::{RecoveryStrategy, Tools};

/// The machines behind all of it, and their vocabulary; needed for plans, watches and limits.
pub use blastema_core as core;

/// Everything that an application usually needs.
pub mod prelude {
    pub use crate::core::detection::Watch;
    pub use crate::core::recovery::{Ladder, Measure, Plan, Restart, Strategy};
    pub use crate::{
        ActorRef, ChildSpec, Component, Context, Event, Failure, FaultKind, Handle, Node,
        NodeState, Ports, Publisher, Request, Sender, StartError, Structure, SupervisorSpec,
        WhenFull, Why,
    };
}

/// Runs a future on this thread until it is done, with everything that nodes need around it.
///
/// `#[blastema::main]` does the same to a whole program.
pub fn run<F: Future>(future: F) -> F::Output {
    actix_rt::System::new().block_on(future)
}
