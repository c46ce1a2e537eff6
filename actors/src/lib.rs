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

pub use chain::strategy::{RecoveryStrategy, Tools};

pub use blastema_contract::link::LinkRow;
pub use blastema_contract::naming::NodeRow;
pub use blastema_contract::session::SessionRow;
pub use blastema_core as core;
pub use blastema_core::{Contract, Described};
pub use blastema_core::{Incarnation, NodeName, ObjectAddress, ObjectName, Why};
pub use blastema_macros::{Event, Request, Structure, main};
pub use component::{Component, Failure, Handle};
pub use context::{Context, LongOperation};
pub use death_watch::{Down, Ending};
pub use host::life::TimerId;
pub use host::office::DeadLetterOffice;
pub use host::spec::{ChildSpec, SpecError};
pub use lane::WhenFull;
pub use node::{
    Cable, Direction, FaultEvents, Impairment, Link, MemoryMedium, Network, Node, NodeBuilder,
    NodeState, StartError, SupervisorSpec,
};
pub use ports::{ListenPort, Ports};
pub use reference::ActorRef;
pub use sender::{DEFAULT_DEADLINE, Repeatable, RequestError, SendError, Sender};
pub use serde;
pub use topic::Publisher;

pub use blastema_contract::detector::FaultEvent;
pub use blastema_contract::supervisor::Branch;
pub use blastema_core::Instant;
pub use blastema_core::dead_letters::DeadReason;
pub use blastema_core::detection::{
    CheckFailed, Freshness, Invariant, Opinion, Range, Rate, Record, Row, Turn,
};
pub use blastema_core::net::Route;
pub use blastema_core::{Event, Fault, FaultKind, Lifecycle, Place, Request, Severity};

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
