//! The protocol between the director and its modules: one JSON document in each line.
//!
//! ```text
//! module   ── Hello ──────────────►  director     the process is the one that was launched
//! module   ◄───────────── Start ──                where the cables' ends are
//! module   ── Ready ──────────────►               or StartFailed
//! module   ◄──────────── Strike ──                order 7: panic in skin/17
//! module   ── CarriedOut, Found, Recovered, Served ──►
//! module   ── Snapshot ───────────►               ten times a second, and when asked
//! ```

use super::machine_instant::MachineInstant;
use super::timings::Timings;
use super::wiring::CableAddresses;
use blastema::core::{FaultKind, FaultLocation, Lifecycle, ObjectName};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Raised with every change here: parent and child are the same executable unless it was replaced
/// while the demonstration ran.
pub(crate) const VERSION: u32 = 2;

/// The longest line in bytes. A snapshot takes about 10 kB.
pub(crate) const LINE_LIMIT: usize = 256 * 1024;

/// The director's number of an order; answers carry it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub(crate) struct OrderId(pub(crate) u64);

/// A command of the director to a module.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "command", rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum DirectorCommand {
    /// Start the node.
    Start {
        /// The ends of all cables.
        wiring: CableAddresses,
    },
    /// Inject a fault into an object.
    Strike {
        /// Answered by `CarriedOut` when the fault is there, and by `Served` when it is over.
        order: OrderId,
        /// The object.
        object: ObjectName,
        /// The harm.
        fault: ObjectFault,
    },
    /// Block these cables at this end.
    Cut {
        /// Answered by `CarriedOut`.
        order: OrderId,
        /// The cables' names.
        cables: Vec<String>,
    },
    /// Unblock these cables at this end.
    Restore {
        /// Answered by `CarriedOut`.
        order: OrderId,
        /// The cables' names.
        cables: Vec<String>,
    },
    /// Make the router panic.
    PanicRouter {
        /// Answered by `CarriedOut`.
        order: OrderId,
    },
    /// Tell for each flow that ends here when the first message sent after this instant arrived.
    Watch {
        /// The instant.
        since: MachineInstant,
    },
    /// Send a snapshot at once.
    Status,
    /// Shut down.
    Shutdown,
}

/// A fault that can be injected into an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum ObjectFault {
    /// Panic while serving a message.
    Panic,
    /// Block the thread.
    Hang {
        /// The duration; the thread returns long after it was abandoned.
        millis: u64,
    },
    /// Report an error from the next execution.
    ErrorState,
    /// Fail the next initialisation; the object is restarted for that.
    FailInitialization,
    /// Stop the signs of life.
    Silence,
    /// Receive more messages than the queue holds.
    Flood {
        /// The number of messages.
        messages: u32,
    },
}

/// An event of a module.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum ModuleEvent {
    /// The first line.
    Hello {
        /// The module's name.
        name: String,
        /// The protocol's version.
        version: u32,
    },
    /// The node is started; all its components are active.
    Ready,
    /// The node could not be started.
    StartFailed {
        /// Why.
        reason: String,
        /// Another process took one of the addresses meanwhile: other ports would help.
        address_taken: bool,
    },
    /// An order was carried out.
    CarriedOut {
        /// Which.
        order: OrderId,
        /// When: for a fault, the clock of its row starts here.
        at: MachineInstant,
    },
    /// An order could not be carried out.
    Refused {
        /// Which.
        order: OrderId,
        /// Why.
        reason: String,
    },
    /// The object that an order struck answers again.
    Served {
        /// Which order.
        order: OrderId,
        /// When the answer came.
        at: MachineInstant,
        /// The incarnation that answered.
        incarnation: u64,
    },
    /// A fault was found.
    Found(FaultNote),
    /// An active fault was found again.
    Repeated {
        /// Its number.
        id: u64,
        /// How often by now.
        count: u32,
    },
    /// A fault was explained as a consequence of another.
    Explained {
        /// Its number.
        id: u64,
        /// The other's.
        symptom_of: u64,
    },
    /// A recovery action was chosen.
    Decided {
        /// The fault's number.
        id: u64,
        /// The recovery action.
        action: String,
    },
    /// A fault was recovered.
    Recovered {
        /// Its number.
        id: u64,
        /// When.
        at: MachineInstant,
    },
    /// A fault could not be recovered.
    GaveUp {
        /// Its number.
        id: u64,
        /// Why.
        reason: String,
    },
    /// A fault was cleared.
    Cleared {
        /// Its number.
        id: u64,
    },
    /// The first message of a flow that was sent after the watched instant arrived.
    Passed {
        /// The flow.
        flow: String,
        /// The watched instant.
        since: MachineInstant,
        /// When it arrived.
        at: MachineInstant,
    },
    /// The state of the module.
    Snapshot(Box<Snapshot>),
}

/// A fault as reported by the module that found it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FaultNote {
    /// Its number in the finder's record.
    pub(crate) id: u64,
    /// Its kind.
    pub(crate) kind: FaultKind,
    /// Its place.
    pub(crate) location: FaultLocation,
    /// When it was found.
    pub(crate) found_at: MachineInstant,
    /// The particulars.
    pub(crate) detail: String,
    /// The fault that it is a consequence of.
    pub(crate) symptom_of: Option<u64>,
}

impl FaultNote {
    /// Returns whether it is a warning: on a busy machine hellos arrive late and rounds are missed,
    /// which is not a fault of the robot.
    pub(crate) fn is_warning(&self) -> bool {
        matches!(self.kind, FaultKind::LinkDegraded | FaultKind::Overload)
    }
}

/// The state of a module.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Snapshot {
    /// When it was taken.
    pub(crate) at: MachineInstant,
    /// The monitor's table.
    pub(crate) objects: Vec<ObjectState>,
    /// The cables that end here.
    pub(crate) links: Vec<CableState>,
    /// The flows that begin here.
    pub(crate) sources: Vec<SourceState>,
    /// The flows that end here.
    pub(crate) sinks: Vec<SinkState>,
    /// ResponseTimes times of other modules, by module.
    pub(crate) responses: Vec<(String, Timings)>,
    /// How long an event takes from its publisher to a listener without a condition.
    pub(crate) unfiltered: Timings,
    /// The same to a listener with a condition.
    pub(crate) filtered: Timings,
}

/// The monitor's opinion of an object.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum ObjectOpinion {
    /// All is well.
    #[default]
    Trusted,
    /// A sign of life is late; the object stays in service.
    Suspect,
    /// It is out of service.
    Failed,
}

/// A row of the monitor's table.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ObjectState {
    /// Its name.
    pub(crate) name: String,
    /// Its lifecycle state.
    pub(crate) state: Lifecycle,
    /// The monitor's opinion.
    pub(crate) opinion: ObjectOpinion,
    /// Its incarnation.
    pub(crate) incarnation: u64,
}

/// A cable, seen from one end.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CableState {
    /// The cable's name.
    pub(crate) cable: String,
    /// Whether the link is in service.
    pub(crate) up: bool,
}

/// A flow where it begins.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SourceState {
    /// The flow's name.
    pub(crate) flow: String,
    /// Tells this process of the source from an earlier one.
    pub(crate) epoch: u64,
    /// The last number that the middleware has accepted; the first is 1.
    pub(crate) sent: u64,
    /// Accepted messages that became dead letters of the source's node, without those that perished
    /// with the sink's process. Some of them may have arrived.
    pub(crate) returned: u64,
}

/// A flow where it ends.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SinkState {
    /// The flow's name.
    pub(crate) flow: String,
    /// Tells this process of the sink from an earlier one.
    pub(crate) process: u64,
    /// The source's epoch.
    pub(crate) epoch: u64,
    /// The first number that came in this epoch.
    pub(crate) first: u64,
    /// The highest number that came in this epoch.
    pub(crate) highest: u64,
    /// Numbers between them that did not come.
    pub(crate) missing: u64,
    /// Messages that came more than once, in all epochs of this process.
    pub(crate) doubled: u64,
    /// Numbers that did not come in epochs that are over.
    pub(crate) missing_before: u64,
}

/// A line that cannot be decoded.
#[derive(Debug, thiserror::Error)]
#[error("a line of the control channel cannot be decoded: {0}")]
pub(crate) struct LineError(#[from] serde_json::Error);

/// One line, with its end.
pub(crate) fn encode<T: Serialize>(message: &T) -> String {
    let mut line = serde_json::to_string(message)
        .expect("the protocol's types have text keys and no failing serializers");
    line.push('\n');
    line
}

/// The message in one line.
///
/// # Errors
/// [`LineError`] says which part is wrong.
pub(crate) fn decode<T: DeserializeOwned>(line: &str) -> Result<T, LineError> {
    Ok(serde_json::from_str(line.trim_end())?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::{Module, address};
    use std::fmt::Debug;

    fn round_trip<T: Serialize + DeserializeOwned + PartialEq + Debug>(message: T) {
        let line = encode(&message);

        assert!(line.ends_with('\n') && line.trim_end().lines().count() == 1, "{line}");
        assert_eq!(decode::<T>(&line).expect("what was encoded"), message);
    }

    #[test]
    fn every_command_comes_back_as_it_went() {
        let order = OrderId(7);
        let object = ObjectName::new("skin/17").expect("a name");
        round_trip(DirectorCommand::Start { wiring: CableAddresses::default() });
        for fault in [
            ObjectFault::Panic,
            ObjectFault::Hang { millis: 5_000 },
            ObjectFault::ErrorState,
            ObjectFault::FailInitialization,
            ObjectFault::Silence,
            ObjectFault::Flood { messages: 100_000 },
        ] {
            round_trip(DirectorCommand::Strike { order, object: object.clone(), fault });
        }
        round_trip(DirectorCommand::Cut { order, cables: vec!["ethernet".into()] });
        round_trip(DirectorCommand::Restore { order, cables: vec![] });
        round_trip(DirectorCommand::PanicRouter { order });
        round_trip(DirectorCommand::Watch { since: MachineInstant::from_nanos(u64::MAX) });
        round_trip(DirectorCommand::Status);
        round_trip(DirectorCommand::Shutdown);
    }

    #[test]
    fn every_event_comes_back_as_it_went() {
        let order = OrderId(7);
        let at = MachineInstant::from_millis(12);
        round_trip(ModuleEvent::Hello { name: "module1".into(), version: VERSION });
        round_trip(ModuleEvent::Ready);
        round_trip(ModuleEvent::StartFailed { reason: "port\ntaken".into(), address_taken: true });
        round_trip(ModuleEvent::CarriedOut { order, at });
        round_trip(ModuleEvent::Refused { order, reason: "no \"such\" object".into() });
        round_trip(ModuleEvent::Served { order, at, incarnation: 2 });
        round_trip(ModuleEvent::Found(FaultNote {
            id: 1,
            kind: FaultKind::Custom("R01".into()),
            location: FaultLocation::Object(address(Module::Module1, "skin/17")),
            found_at: at,
            detail: "as asked".into(),
            symptom_of: Some(0),
        }));
        round_trip(ModuleEvent::Repeated { id: 1, count: 3 });
        round_trip(ModuleEvent::Explained { id: 2, symptom_of: 1 });
        round_trip(ModuleEvent::Decided { id: 1, action: "restart".into() });
        round_trip(ModuleEvent::Recovered { id: 1, at });
        round_trip(ModuleEvent::GaveUp { id: 1, reason: "too often".into() });
        round_trip(ModuleEvent::Cleared { id: 1 });
        round_trip(ModuleEvent::Passed { flow: "flow/2-3".into(), since: at, at });
        let mut responses = Timings::default();
        responses.record(std::time::Duration::from_micros(17));
        round_trip(ModuleEvent::Snapshot(Box::new(Snapshot {
            at,
            objects: vec![ObjectState {
                name: "laser".into(),
                state: Lifecycle::Active,
                opinion: ObjectOpinion::Suspect,
                incarnation: 4,
            }],
            links: vec![CableState { cable: "ethernet".into(), up: true }],
            sources: vec![SourceState::default()],
            sinks: vec![SinkState::default()],
            responses: vec![("module2".into(), responses)],
            unfiltered: Timings::default(),
            filtered: Timings::default(),
        })));
    }

    #[test]
    fn a_line_of_another_program_is_an_error_and_no_guess() {
        for line in ["", "{}", "null", r#"{"command":"fly"}"#, r#"{"command":"watch"}"#] {
            assert!(decode::<DirectorCommand>(line).is_err(), "{line}");
        }
        assert!(decode::<ModuleEvent>(r#"{"event":"cleared","id":-1}"#).is_err());
    }
}
