//! How the module's monitor and detector see it, in the words of the control channel.

use crate::demo::machine_instant::MachineInstant;
use crate::demo::protocol::{CableState, FaultNote, ModuleEvent, ObjectOpinion, ObjectState};
use blastema::core::detection::{self, ObjectKind, Row, Turn};
use blastema::{FaultEvent, Lifecycle, Place};

/// One step in the history of a fault, if it is one that is told.
pub(super) fn event_of(step: FaultEvent) -> Option<ModuleEvent> {
    let FaultEvent { fault, at, turn } = step;
    let id = fault.id.0;
    Some(match turn {
        Turn::Found => ModuleEvent::Found(FaultNote {
            id,
            kind: fault.kind,
            place: fault.place,
            found_at: fault.found_at.into(),
            detail: fault.detail,
            symptom_of: fault.symptom_of.map(|root| root.0),
        }),
        Turn::Repeated => ModuleEvent::Repeated { id, count: fault.count },
        Turn::Explained => {
            ModuleEvent::Explained { id, symptom_of: fault.symptom_of.map_or(id, |r| r.0) }
        }
        Turn::Decided { measure } => ModuleEvent::Decided { id, measure },
        Turn::Recovered => ModuleEvent::Recovered { id, at: MachineInstant::from(at) },
        Turn::GaveUp { reason } => ModuleEvent::GaveUp { id, reason },
        Turn::Cleared => ModuleEvent::Cleared { id },
        _ => return None,
    })
}

/// The objects of the table that are shown.
pub(super) fn objects_of(table: &[Row]) -> Vec<ObjectState> {
    let object = |row: &Row| match (&row.place, row.kind) {
        (Place::Object(address), ObjectKind::Component) => Some(ObjectState {
            name: address.object.to_string(),
            state: row.state.unwrap_or(Lifecycle::Created),
            opinion: opinion_of(row.opinion),
            life: row.incarnation.0,
        }),
        _ => None,
    };
    table.iter().filter_map(object).collect()
}

/// The cables of the table.
pub(super) fn links_of(table: &[Row]) -> Vec<CableState> {
    let link = |row: &Row| match &row.place {
        Place::Link { link, .. } => Some(CableState {
            cable: link.to_string(),
            up: row.opinion == detection::Opinion::Trusted,
        }),
        _ => None,
    };
    table.iter().filter_map(link).collect()
}

fn opinion_of(opinion: detection::Opinion) -> ObjectOpinion {
    match opinion {
        detection::Opinion::Trusted => ObjectOpinion::Trusted,
        detection::Opinion::Failed => ObjectOpinion::Failed,
        _ => ObjectOpinion::Suspect,
    }
}
