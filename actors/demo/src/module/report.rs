//! Converts fault events and the monitor's table for the control channel.

use crate::machine_instant::MachineInstant;
use crate::protocol::{CableState, FaultNote, ModuleEvent, ObjectOpinion, ObjectState};
use crate::robot::Flow;
use blastema::core::delivery::dead_letters::DeadLetterCount;
use blastema::core::detection::{self, FaultTransition, MonitorRow, ObjectKind};
use blastema::{DeadReason, FaultEvent, FaultLocation, Lifecycle};

/// Returns the event of a fault that the director receives.
pub(super) fn event_of(step: FaultEvent) -> Option<ModuleEvent> {
    let FaultEvent { fault, at, turn } = step;
    let id = fault.id.0;
    Some(match turn {
        FaultTransition::Found => ModuleEvent::Found(FaultNote {
            id,
            kind: fault.kind,
            location: fault.location,
            found_at: fault.found_at.into(),
            detail: fault.detail,
            symptom_of: fault.symptom_of.map(|root| root.0),
        }),
        FaultTransition::Repeated => ModuleEvent::Repeated { id, count: fault.count },
        FaultTransition::Explained => {
            ModuleEvent::Explained { id, symptom_of: fault.symptom_of.map_or(id, |r| r.0) }
        }
        FaultTransition::Decided { action } => ModuleEvent::Decided { id, action },
        FaultTransition::Recovered => ModuleEvent::Recovered { id, at: MachineInstant::from(at) },
        FaultTransition::GaveUp { reason } => ModuleEvent::GaveUp { id, reason },
        FaultTransition::Cleared => ModuleEvent::Cleared { id },
        _ => return None,
    })
}

/// Returns the components of the table.
pub(super) fn objects_of(table: &[MonitorRow]) -> Vec<ObjectState> {
    let object = |row: &MonitorRow| match (&row.location, row.kind) {
        (FaultLocation::Object(address), ObjectKind::Component) => Some(ObjectState {
            name: address.object.to_string(),
            state: row.state.unwrap_or(Lifecycle::Created),
            opinion: opinion_of(row.opinion),
            incarnation: row.incarnation.0,
        }),
        _ => None,
    };
    table.iter().filter_map(object).collect()
}

/// Returns the cables of the table.
pub(super) fn links_of(table: &[MonitorRow]) -> Vec<CableState> {
    let link = |row: &MonitorRow| match &row.location {
        FaultLocation::Link { link, .. } => Some(CableState {
            cable: link.to_string(),
            // A degraded link is suspected, and still carries messages.
            up: row.opinion != detection::Opinion::Failed,
        }),
        _ => None,
    };
    table.iter().filter_map(link).collect()
}

/// Returns how many messages of a flow became dead letters here, without those that perished with
/// the receiver's process.
pub(super) fn returned_of(flow: &str, dead_letters: &[DeadLetterCount]) -> u64 {
    let Some(flow) = Flow::from_name(flow) else { return 0 };
    let is_returned = |dead: &&DeadLetterCount| {
        dead.reason != DeadReason::PeerDied
            && dead.object.as_str() == flow.sink
            && dead.node.as_ref().is_some_and(|node| node.as_str() == flow.to.name())
    };
    dead_letters.iter().filter(is_returned).map(|dead| dead.count).sum()
}

fn opinion_of(opinion: detection::Opinion) -> ObjectOpinion {
    match opinion {
        detection::Opinion::Trusted => ObjectOpinion::Trusted,
        detection::Opinion::Failed => ObjectOpinion::Failed,
        _ => ObjectOpinion::Suspect,
    }
}
