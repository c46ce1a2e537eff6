//! Why a component cannot be declared as it is.

use crate::registry::NameTaken;
use crate::settings::SettingError;
use blastema_core::detection::dependencies::DependencyError;
use blastema_core::parameters::ParameterError;
use blastema_core::{DeliveryError, NameError, ObjectName};
use std::path::PathBuf;

/// Why a component cannot be added to a node.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SpecError {
    /// Its name does not parse.
    #[error("the name of a component, or one that it claims: {0}")]
    Name(#[from] NameError),
    /// The name of a supervisor does not parse.
    #[error("the name of a supervisor: {0}")]
    Supervisor(NameError),
    /// The name is in use by another component, a supervisor (such as `root`), or an object of the
    /// middleware.
    #[error(transparent)]
    Taken(#[from] NameTaken),
    /// Its name is one of those that the middleware keeps for its own objects, which the text lists.
    #[error("the name {name} is reserved: the middleware's own are, or begin with, {RESERVED}")]
    Reserved {
        /// The reserved name.
        name: ObjectName,
    },
    /// The component listens to a topic that carries another contract of the same name.
    #[error("{name} cannot listen to a topic: {why}")]
    Topic {
        /// The component that listens.
        name: ObjectName,
        /// How the two contracts differ.
        why: DeliveryError,
    },
    /// A variable is invalid: its default is larger than its contract allows, or its own check
    /// refuses it.
    #[error("a variable of {name} cannot be: {why}")]
    Variable {
        /// The component that declares the variable.
        name: ObjectName,
        /// What is wrong.
        why: DeliveryError,
    },
    /// Its parameters are given a value that they do not take.
    #[error("parameters of {name}{}: {error}", in_file(.file.as_ref()))]
    Parameters {
        /// The component whose parameters these are.
        name: ObjectName,
        /// The file that the value stands in, where it is from one.
        file: Option<PathBuf>,
        /// What is wrong.
        error: ParameterError,
    },
    /// An actuator is invalid: its safe command is larger than its contract allows.
    #[error("an actuator of {name} cannot be: {why}")]
    Actuator {
        /// The component that declares the actuator.
        name: ObjectName,
        /// What is wrong.
        why: DeliveryError,
    },
    /// Settings of an actuator cannot be applied: there is no such actuator, or its safe command has
    /// no such field or another unit.
    #[error("actuator {contract} of {name}: {why}")]
    ActuatorSettings {
        /// The component that the settings are for.
        name: ObjectName,
        /// The contract of the actuator's commands, as the settings name it.
        contract: String,
        /// The field of the safe command that is wrong, where it is one.
        field: Option<String>,
        /// What is wrong, and what to write.
        why: String,
    },
    /// The component was added to a running node, and depends on an object that does not exist
    /// there, or, directly or through others, on itself.
    #[error(transparent)]
    Dependency(#[from] DependencyError),
    /// Its supervisor did not take it: it is ending, or has ended.
    #[error("the supervisor of {name} does not take it now: it is ending, or has ended")]
    Refused {
        /// The component or supervisor.
        name: ObjectName,
    },
    /// It was to be added to a supervisor that this node does not have.
    #[error("this node has no supervisor {name}{}", did_you_mean(nearest.as_ref()))]
    NoSupervisor {
        /// The name that no supervisor of this node has.
        name: String,
        /// The supervisor whose name is spelt most like it.
        nearest: Option<ObjectName>,
    },
    /// It was added to a running node, and could not be started: the addition is undone.
    #[error("{name} could not be started, and is not added: {reason}")]
    NotStarted {
        /// The component or supervisor.
        name: ObjectName,
        /// Which component, and what it said.
        reason: String,
    },
    /// Its [`Component::ports`](crate::Component::ports), or what that calls, panicked.
    #[error("{name} cannot say what its ports are: {panicked}")]
    Ports {
        /// The component whose `ports` panicked.
        name: ObjectName,
        /// Where, and the panic's text.
        panicked: String,
    },
    /// A device cannot be as it is declared.
    #[cfg(feature = "device")]
    #[error("the device {name} cannot be: {why}")]
    Device {
        /// The name of the device's component.
        name: ObjectName,
        /// The setting of its [`DeviceSpec`](crate::DeviceSpec) that is wrong.
        setting: &'static str,
        /// What is wrong, and what to write.
        why: String,
    },
    /// A process cannot be as it is described.
    #[cfg(feature = "process")]
    #[error("the process {name} cannot be: {why}")]
    Process {
        /// The name of the process's component.
        name: ObjectName,
        /// The setting of its [`ProcessSpec`](crate::ProcessSpec) that is wrong.
        setting: &'static str,
        /// What is wrong, and what to write.
        why: String,
    },
    /// A setting makes no sense.
    #[error("{setting} of {name} is {value}: {cure}")]
    Setting {
        /// The component or supervisor that has the setting.
        name: String,
        /// The name of the setting, such as `max_block`.
        setting: &'static str,
        /// The value that was given.
        value: String,
        /// What to write instead.
        cure: &'static str,
    },
    /// It listens twice to one topic, and would get each event twice.
    #[error(
        "{name} listens twice to the topic {topic:?}: write one `listen`, with every condition in its \
         `only_if`, or name another topic by `.on(\"…\")`"
    )]
    ListenTwice {
        /// The component that listens twice.
        name: ObjectName,
        /// The topic that it listens to.
        topic: String,
    },
    /// A port has a name that cannot be, or that another port has.
    #[error("the port `{port}` of {name}: {why}")]
    Port {
        /// The component that declares the port.
        name: ObjectName,
        /// The name of the port, as it is declared.
        port: String,
        /// What is wrong, and what to write.
        why: String,
    },
    /// Two ports have contracts of one name, so only one of them could be reached.
    #[error("{name} has two ports for {contract:?}, {ports}: leave one of them out")]
    PortTwice {
        /// The component that declares both ports.
        name: ObjectName,
        /// The contract's name.
        contract: &'static str,
        /// Which ports they are.
        ports: &'static str,
    },
}

impl From<SpecError> for Vec<SpecError> {
    fn from(error: SpecError) -> Self {
        vec![error]
    }
}

/// A hint at the name that may have been meant.
pub(crate) fn did_you_mean(nearest: Option<&ObjectName>) -> String {
    nearest.map_or_else(String::new, |name| format!(": did you mean `{name}`?"))
}

/// The names of the middleware's own objects; of those that end in a slash, the beginnings.
const RESERVED: &str = "beacons/, cable/, chain/, conditions, conditions/, controller, inspection, \
    leases, net/, safe-outputs, transport/, variables, variables/";

impl SpecError {
    /// Takes a name for an object of the application.
    pub(crate) fn check_name(name: ObjectName) -> Result<ObjectName, Self> {
        let is_reserved = RESERVED.split(", ").any(|kept| match kept.ends_with('/') {
            true => name.as_str().starts_with(kept),
            false => name.as_str() == kept,
        });
        if is_reserved { Err(SpecError::Reserved { name }) } else { Ok(name) }
    }

    /// A setting of the component or supervisor called so that makes no sense.
    pub(crate) fn setting(name: &str, SettingError { setting, value, cure }: SettingError) -> Self {
        SpecError::Setting { name: name.to_owned(), setting, value, cure }
    }
}

/// Returns the words that name the file of parameters, where they have one.
pub(crate) fn in_file(file: Option<&PathBuf>) -> String {
    file.map(|file| format!(" in {}", file.display())).unwrap_or_default()
}
