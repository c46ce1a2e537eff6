//! Why a node does not start.

use crate::component::spec_error::{SpecError, in_file};
use crate::service::ServiceRefused;
use crate::settings::SettingError;
use blastema_core::NameError;
use blastema_core::NodeName;
use blastema_core::detection::RegistrationError;
use blastema_core::detection::dependencies::DependencyError;
use blastema_core::port::ConnectError;
use blastema_core::recovery::PlanError;
use blastema_transports::EndpointError;
use std::path::{Path, PathBuf};
use std::{fmt, io};

/// Why a node did not start. Parts that had started are stopped again.
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// A name that the description holds does not parse.
    #[error("{of}: {error}")]
    Name {
        /// Whose name: the node's, a neighbour's, a service's.
        of: String,
        /// What is wrong with it.
        error: NameError,
    },
    /// A component's or supervisor's spec is wrong.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The plan does not answer every fault, or answers one by what does not exist.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// Two ports cannot be connected.
    #[error("{from} cannot be connected to {to}: {why}")]
    Connection {
        /// Where the connection begins.
        from: String,
        /// Where it ends.
        to: String,
        /// What is wrong, and what to write.
        why: Box<ConnectError>,
    },
    /// The liveness settings of an object are invalid.
    #[error(transparent)]
    Watch(#[from] RegistrationError),
    /// A component depends on what does not exist, or on itself, perhaps by way of others.
    #[error(transparent)]
    Dependency(#[from] DependencyError),
    /// A policy for lost communication cannot work.
    #[error("the policy {policy:?} for lost communication: {reason}")]
    LostCommunication {
        /// The name of the policy.
        policy: String,
        /// The part that is wrong.
        part: PolicyPart,
        /// What is wrong, and what to write.
        reason: String,
    },
    /// The text of a network's endpoint, or of a neighbour's address there, is wrong.
    #[error("network {network}: {error}")]
    Endpoint {
        /// The name of the network.
        network: String,
        /// The neighbour whose address is wrong; `None` where the endpoint is.
        neighbour: Option<NodeName>,
        /// What is wrong, and where.
        error: EndpointError,
    },
    /// A setting of a link makes no sense.
    #[error("network {network}: {setting} of the link to {neighbour} is {value}: {cure}")]
    Link {
        /// The name of the network.
        network: String,
        /// The node at the other end of the link.
        neighbour: String,
        /// The name of the setting, such as `hello_every`.
        setting: &'static str,
        /// The value that was given.
        value: String,
        /// What to write instead.
        cure: &'static str,
    },
    /// The networks cannot be used together.
    #[error("{0}")]
    Network(String),
    /// The keys of the node cannot be used: the file of its key or the roster beside it is missing,
    /// wrong, another's, or open to others.
    #[error("{0}")]
    Keys(String),
    /// A network leaves this computer, the node has no keys, and the network was not declared
    /// insecure.
    #[error(
        "network {network} leaves this computer ({medium}), and the node has no keys: make them with \
         `blastema keys new ROBOT NODE…` and write `.keys(\"FILE\")` at the node; or write \
         `.insecure()` at the network, or `?insecure` in its endpoint, if every station on it may \
         command this robot"
    )]
    Insecure {
        /// The name of the network.
        network: String,
        /// The medium of the network and its address, as text.
        medium: String,
    },
    /// A service has a mistake in its nodes, or its component cannot be built.
    #[error("service {name}: {reason}")]
    Service {
        /// The name of the service.
        name: String,
        /// What is wrong, and what to write.
        reason: String,
    },
    /// A setting of the node makes no sense, or a file or socket that it names cannot be used.
    #[error("{setting} of the node is {value}: {cure}")]
    Setting {
        /// The name of the setting, such as `grace`.
        setting: &'static str,
        /// The value that was given.
        value: String,
        /// What to write instead, or what stands in the way.
        cure: String,
    },
    /// The configuration of parameters cannot be read, or gives them to a component that takes
    /// none.
    #[error("parameters{}: {reason}", in_file(.file.as_ref()))]
    Parameters {
        /// The file, where it is one.
        file: Option<PathBuf>,
        /// What is wrong, and where.
        reason: String,
    },
    /// A watchdog of the process cannot be used.
    #[error("the process cannot be watched: {0}")]
    ProcessWatchdog(String),
    /// The node was started outside of Blastema's runtime, as by `#[tokio::main]`.
    #[error(
        "a node starts only in Blastema's runtime: write `#[blastema::main]` in place of \
         `#[tokio::main]`, or run the program by `blastema::run(async {{ .. }})`"
    )]
    Runtime,
    /// The operating system has no thread left.
    #[error("a thread could not be started: {0}")]
    Thread(#[from] io::Error),
    /// The root supervisor gave up while it was starting its children.
    #[error("the node did not come up: {reason}")]
    GaveUp {
        /// Which component, and what it said.
        reason: String,
    },
    /// The node was to end while it started:
    /// [`NodeBuilder::run_until`](crate::NodeBuilder::run_until). All components that had started
    /// ended in reverse order.
    #[error("{by} ended the node while it started: the start is undone")]
    Interrupted {
        /// The signal, or the program.
        by: String,
    },
}

/// A part of a [`LostCommunicationPolicy`](crate::LostCommunicationPolicy), by places that count from 0.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PolicyPart {
    /// The policy as a whole.
    Whole,
    /// The node whose commanders are lost.
    Commander,
    /// How many channels must be connected.
    AtLeast,
    /// A channel that must be connected, and a setting of it, such as `max_loss`; empty for the
    /// channel itself.
    Need(usize, &'static str),
    /// When a rung begins.
    RungTime(usize),
    /// What a rung does.
    Rung(usize),
    /// A command of a rung.
    Command {
        /// The place of the rung in the ladder.
        rung: usize,
        /// Which of its commands.
        command: usize,
        /// A field of it; `None` for the actuator.
        field: Option<String>,
    },
}

/// Prints the text of `Display`: a `main` that returns this error, and `unwrap`, print by `Debug`.
impl fmt::Debug for StartError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl StartError {
    /// The file or socket that this setting names cannot be used.
    pub(super) fn of_path(setting: &'static str, path: &Path, reason: String) -> StartError {
        StartError::Setting { setting, value: path.display().to_string(), cure: reason }
    }

    /// What to make of a name that does not parse.
    pub(crate) fn name_of(of: impl fmt::Display) -> impl FnOnce(NameError) -> StartError {
        let of = of.to_string();
        move |error| StartError::Name { of, error }
    }
}

impl From<StartError> for Vec<StartError> {
    fn from(error: StartError) -> Self {
        vec![error]
    }
}

impl From<SettingError> for StartError {
    fn from(SettingError { setting, value, cure }: SettingError) -> Self {
        StartError::Setting { setting, value, cure: cure.to_owned() }
    }
}

impl From<ServiceRefused> for StartError {
    fn from(ServiceRefused { name, reason }: ServiceRefused) -> Self {
        StartError::Service { name, reason }
    }
}
