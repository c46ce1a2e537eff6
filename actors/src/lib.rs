//! Fault-tolerant middleware for robots: typed actors that grow back.
//!
//! A robot is made of [components](Component), which send each other [messages](Contract) and live
//! on [nodes](Node). When one of them panics, hangs, falls silent or cannot be reached, Blastema
//! finds the fault, names it, and recovers from it in bounded time, or brings the robot to the safe
//! state. The application declares its components and their dependencies.
//!
//! Here a request kills a laser scanner. The caller learns so, and the same sender reaches the
//! scanner's next incarnation:
//!
//! ```
//! use blastema::prelude::*;
//!
//! /// Asks how near the nearest thing is.
//! #[derive(Debug, Request)]
//! #[contract(name = "laser/nearest", version = 1, reply = f32)]
//! struct Nearest {
//!     /// To either side of straight ahead.
//!     #[contract(unit = "rad")]
//!     within: f32,
//! }
//!
//! /// A laser scanner.
//! struct Laser {
//!     ranges: Vec<f32>,
//! }
//!
//! impl Component for Laser {
//!     fn ports(ports: &mut Ports<Self>) {
//!         ports.serve::<Nearest>();
//!     }
//! }
//!
//! impl Handle<Nearest> for Laser {
//!     async fn handle(&mut self, request: Nearest, _: &mut Context<Self>) -> f32 {
//!         assert!(request.within > 0.0, "nothing can be seen within {} rad", request.within);
//!         self.ranges.iter().copied().fold(f32::INFINITY, f32::min)
//!     }
//! }
//!
//! #[blastema::main]
//! async fn main() -> Result<(), Box<dyn std::error::Error>> {
//!     let node = Node::builder("module1")
//!         .child(ChildSpec::new("laser", || Laser { ranges: vec![2.5, 0.8] }))
//!         .start()
//!         .await?;
//!     let laser: Sender<Nearest> = node.sender("laser")?;
//!
//!     if let Err(error) = laser.ask(Nearest { within: 0.0 }).await {
//!         println!("{error}"); // … the receiver died in its incarnation #1 while it served this message
//!     }
//!     println!("{} m", laser.ask(Nearest { within: 0.1 }).await?);
//!     node.shutdown().await;
//!     Ok(())
//! }
//! ```
//!
//! The [manual] begins with [getting started](manual::start); it has a page on every subject, with
//! all [guarantees](manual::guarantees) and all [limits](manual::limits).
//!
//! | to | see |
//! | --- | --- |
//! | write a component | [`Component`], [`Handle`], [`Ports`], [`Context`], [`Failure`] |
//! | describe messages | [`Event`](derive@Event), [`Request`](derive@Request), [`Structure`] |
//! | run components | [`Node`], [`NodeBuilder`], [`ChildSpec`], [`SupervisorSpec`] |
//! | send | [`Sender`], [`ActorRef`], [`Publisher`], [`DeliveryError`], [`TrafficClass`], [`Outcome`] |
//! | share values | [`Variable`](derive@Variable), [`VariableSpec`], [`VariableRef`], [`Transaction`] |
//! | set a component up | [`Parameters`](derive@Parameters), [`NodeBuilder::parameters_from`] |
//! | command actuators | [`ActuatorSpec`], [`Commander`] |
//! | know whether it is still connected | [`Node::condition`], [`Connected`], [`Condition`], [`Heartbeat`] |
//! | choose what to do by a tree | `trees::BehaviorTree`, [manual](manual::trees) |
//! | find the holder of a name | [`Node::claim`], [`ChildSpec::claim`], [`Claim`], [`NameWatch`] |
//! | run microcontrollers as components | [`DeviceSpec`], [manual](manual::devices) |
//! | run programs in any language as components | [`ProcessSpec`] |
//! | outlive a node | [`ServiceSpec`], [`Stateful`], [`ServiceRef`] |
//! | see faults | [`FaultKind`], [`Fault`], [`FaultEvents`], [`MonitorRow`] |
//! | recover | [`recovery::Plan`], [`RecoveryStrategy`] |
//! | connect nodes | [`Network`], [`Link`], [`medium::FrameMedium`] |
//!
//! The [prelude] has what an application usually needs. Tests are written with the crate
//! `blastema-testkit`.

//! # Cargo features
//!
//! | feature | brings |
//! | --- | --- |
//! | `ip`, `unix`, `serial`, `can`, `slcan` | one medium each; media of one's own need none |
//! | `unix` | [`NodeBuilder::inspection_socket`] too, at which `blastema monitor` looks |
//! | `device` | [small devices](manual::devices), and `serial`; with `ip` also those on UDP |
//! | `process` | [programs in any language](ProcessSpec) as components |
//! | `trees` | [behaviour trees](manual::trees) as components |
//! | `journal` | `journal` and `NodeBuilder::journal`, by SQLite |
//!
//! The default is all media, `device` and `process`. A robot of one process needs none of it. The
//! ciphers of networks (`ring`) and `journal` need a C compiler.
#![cfg_attr(test, allow(clippy::disallowed_methods, reason = "tests make queues and wait"))]

// The derives write `::blastema`, also where they are used within it.
#[cfg(test)]
extern crate self as blastema;

use std::panic::{AssertUnwindSafe, catch_unwind};

mod actuator;
mod arbiter;
mod component;
mod condition;
#[cfg(feature = "device")]
mod device;
mod directory;
mod fault_chain;
mod features;
mod host;
mod liveness;
mod messaging;
mod net;
mod node;
mod parameters;
mod port;
#[cfg(feature = "process")]
mod process;
mod registry;
mod runtime;
mod service;
mod settings;
mod sync;
mod topic;
mod variable;

#[cfg(feature = "journal")]
pub mod journal;
pub mod manual;
pub mod plain;
#[cfg(feature = "trees")]
pub mod trees;

/// For programs that make or show keys, as `blastema keys` does.
pub mod keys {
    pub use crate::platform::key_files::{folder_of, read_public, read_secret};
    pub use crate::platform::random_bytes;
}
pub mod platform;

#[cfg(panic = "abort")]
compile_error!(
    "Blastema recovers from panics and cannot do so with `panic = \"abort\"`: remove that line from \
     the profile in Cargo.toml, or set `panic = \"unwind\"`"
);

// Messages, and what they are made of.
pub use blastema_core::parameters::{
    ParameterError, ParameterField, ParameterType, ParameterValue, Parameters,
};
pub use blastema_core::{Blob, Contract, Described, Event, Request, Variable};
pub use blastema_macros::{Event, ParameterType, Parameters, Request, Structure, Variable};
pub use serde;

// Components.
pub use crate::arbiter::pool::ThreadKind;
pub use crate::component::context::Context;
pub use crate::component::incarnation::TimerId;
pub use crate::component::long_operation::LongOperation;
pub use crate::component::ports::{Ports, describe};
pub use crate::component::spec_error::SpecError;
pub use crate::liveness::threads::{ThreadRow, ThreadState};
pub use crate::messaging::injection::Injection;
pub use crate::messaging::queue::WhenFull;
pub use crate::port::OutPort;
pub use blastema_core::port::{ConnectError, PortConnection};
pub use component::{Component, Failure, Handle};
pub use host::spec::ChildSpec;
pub use platform::sleep;

// Sending, and what becomes of messages.
pub use crate::actuator::CommandTimeout::Hold;
pub use crate::actuator::{ActuatorRow, ActuatorSettings, ActuatorSpec, CommandTimeout, Commander};
pub use crate::host::reference::ActorRef;
pub use crate::messaging::dead_letters::DeadLetterLog;
pub use crate::messaging::death_watch::{Down, DownReason};
pub use crate::messaging::error::{Receiver, RequestError, SendError, Unavailable};
pub use crate::messaging::sender::{Repeatable, Sender};
pub use blastema_core::delivery::dead_letters::{DeadLetterCount, DeadReason};
pub use blastema_core::lease::{CommanderId, LeaseStatus};
pub use blastema_core::{
    DeliveryError, Incarnation, NodeName, ObjectAddress, ObjectName, Outcome, RetryPolicy,
    TrafficClass,
};
pub use service::{
    OnPartition, Role, ServiceRef, ServiceRow, ServiceSpec, ServiceState, StandbyKind, Stateful,
};
pub use settings::DEFAULT_DEADLINE;
pub use topic::ports::ListenPort;
pub use topic::{Publisher, TopicRow};
pub use variable::{
    Reading, RestoreDecision, RestorePolicy, Transaction, ValueState, VariableRef, VariableSpec,
    VariableWatch,
};

// Conditions.
pub use blastema_core::connection::ConditionState;
pub use condition::{
    Condition, ConditionChanges, ConditionError, ConditionStatus, Connected, Heartbeat,
};
pub use node::{
    AcknowledgeError, Heartbeats, LostCommunicationPolicy, LostCommunicationRow, PolicyPart, Rung,
};

// Microcontrollers.
#[cfg(feature = "device")]
pub use crate::device::{DeviceDescription, DeviceProxy, DeviceSpec};

// Programs in any language.
#[cfg(feature = "process")]
#[doc(hidden)]
pub use crate::platform::launcher::runtime_folder;
#[cfg(feature = "process")]
pub use crate::platform::processes::{launch_processes, launch_processes_by};
#[cfg(feature = "process")]
pub use crate::process::{ProcessSpec, SupervisedProcess};

// Names of the whole robot.
pub use crate::directory::{
    Claim, ClaimError, ClaimPolicy, ClaimRefused, ClaimRow, ClaimState, Holder, NameHeld,
    NameWatch, NodeRow,
};

// Nodes, their trees and their networks.
pub use crate::net::operator::{KeyStatus, NetworkSeal, OrderError};
pub use crate::net::{RosterRow, keys::KeysPermissions};
pub use crate::registry::access::AccessRefusal;
pub use blastema_contract::link::LinkRow;
pub use blastema_contract::session::SessionRow;
pub use blastema_contract::supervisor::SupervisionTree;
pub use blastema_contract::transport::{TransmitBacklog, TransportCounters};
pub use blastema_core::net::session::{SessionCounters, SessionState, SessionStatus};
pub use blastema_core::net::{ByteRate, LinkState, LinkTraffic, Refusals, Route};
pub use blastema_macros::main;
pub use blastema_transports::endpoint::EndpointError;
pub use node::{
    Cable, Direction, Impairment, IsolateError, Link, MediumKind, MemoryMedium, Network,
    NetworkRow, NotReady,
};
pub use node::{
    ComponentOrder, DegradedPart, FaultCounts, FaultEvents, LastRecovery, Node, NodeBuilder,
    NodeHealth, NodeState, OrderReply, OrderRow, OrderVerb, RemoveError, RestartError,
    RestartedChild, StartError, Subtree, SupervisorSpec,
};

// Faults: found, shown, recovered.
pub use crate::fault_chain::strategy::{RecoveryStrategy, StrategyContext};
pub use blastema_contract::detector::FaultEvent;
pub use blastema_core::detection::{
    CheckFailed, FaultRecord, FaultStatus, FaultTransition, Freshness, Invariant, MonitorRow,
    Opinion, Range, Rate,
};
pub use blastema_core::{Fault, FaultId, FaultKind, FaultLocation, Instant, Lifecycle, Severity};

/// Types to implement a medium of one's own, which is passed to [`Network::own`].
pub mod medium {
    pub use blastema_contract::transport::MediumAddress;
    pub use blastema_core::medium::lane::FrameLane;
    pub use blastema_transports::Reach;
    pub use blastema_transports::frame_medium::{
        FrameMedium, MediumEvent, OpenedMedium, QueueLimits, SendResult,
    };
    pub use bytes::Bytes;
}

/// Plans, ladders and rules of restarts, and the types of custom recovery strategies.
pub mod recovery {
    pub use blastema_core::recovery::{
        Backoff, Ladder, LadderStep, Plan, PlanError, RecoveryAction, RecoveryDone, RecoveryFailed,
        RecoveryOrder, Restart, Strategy, WhenExceeded,
    };
}

/// Types of monitoring: liveness, checks, the monitor's table and the record of faults.
pub mod detection {
    pub use blastema_core::detection::{
        CheckFailed, CurrentHandler, FaultEntry, FaultRecord, FaultStatus, FaultTransition,
        Freshness, Invariant, Liveness, MonitorRow, ObjectKind, Opinion, Pull, Push, QueueSample,
        Range, Rate, RegistrationError, RoundLateness,
    };
}

/// The state machines behind the facade: for development of the middleware, and for the code that
/// the derives generate.
pub use blastema_core as core;

/// The types that most applications need.
pub mod prelude {
    pub use crate::detection::Liveness;
    pub use crate::recovery::{Ladder, Plan, RecoveryAction, Restart, Strategy, WhenExceeded};
    pub use crate::{
        ActorRef, ChildSpec, Component, Context, DeliveryError, Event, Failure, FaultKind, Handle,
        Node, NodeState, Outcome, ParameterType, Parameters, Ports, Publisher, Request, Sender,
        StartError, Structure, SupervisorSpec, Variable, VariableRef, VariableSpec, WhenFull,
        sleep,
    };
}

/// Used by the code that [`main`](macro@main) generates and by `blastema-testkit`; not for direct
/// use.
#[doc(hidden)]
pub mod program {
    pub use crate::liveness::sampler::Running;
    pub use crate::platform::errors::{Fatal, ReportBoxed};

    /// Comes before everything else in `main`.
    pub fn begin() {
        #[cfg(feature = "process")]
        crate::launch_processes();
    }
}

/// Runs a future on this thread until it completes, in a runtime that nodes can start in.
///
/// `#[blastema::main]` does the same for a whole program. At its end this function waits until all
/// lines about faults are written, for a second at most. If the reader of the program's output has
/// closed the pipe, as `head` does, the program ends with status 141, and reports only that its
/// nodes were dropped.
pub fn run<F: Future>(future: F) -> F::Output {
    crate::platform::panics::install_hook();
    let running = AssertUnwindSafe(|| actix_rt::System::new().block_on(future));
    let ended = catch_unwind(running);
    crate::platform::finish_printing();
    ended.unwrap_or_else(|payload| crate::platform::panics::end_of_program(payload))
}
