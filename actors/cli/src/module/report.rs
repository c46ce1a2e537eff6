//! How the module's monitor and detector see it, in the words of the control channel.

use crate::demo::machine_instant::Moment;
use crate::demo::protocol::{Event, FaultNote, LinkState, ObjectState, Opinion};
use blastema::core::detection::{self, ObjectKind, Row, Turn};
use blastema::{FaultEvent, Lifecycle, Place};

/// One step in the history of a fault, if it is one that is told.
pub(super) fn event_of(step: FaultEvent) -> Option<Event> {
    let FaultEvent { fault, at, turn } = step;
    let id = fault.id.0;
    Some(match turn {
        Turn::Found => Event::Found(FaultNote {
            id,
            kind: fault.kind,
            place: fault.place,
            found_at: fault.found_at.into(),
            detail: fault.detail,
            symptom_of: fault.symptom_of.map(|root| root.0),
        }),
        Turn::Repeated => Event::Repeated { id, count: fault.count },
        Turn::Explained => {
            Event::Explained { id, symptom_of: fault.symptom_of.map_or(id, |r| r.0) }
        }
        Turn::Decided { measure } => Event::Decided { id, measure },
        Turn::Recovered => Event::Recovered { id, at: Moment::from(at) },
        Turn::GaveUp { reason } => Event::GaveUp { id, reason },
        Turn::Cleared => Event::Cleared { id },
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
pub(super) fn links_of(table: &[Row]) -> Vec<LinkState> {
    let link = |row: &Row| match &row.place {
        Place::Link { link, .. } => Some(LinkState {
            cable: link.to_string(),
            up: row.opinion == detection::Opinion::Trusted,
        }),
        _ => None,
    };
    table.iter().filter_map(link).collect()
}

fn opinion_of(opinion: detection::Opinion) -> Opinion {
    match opinion {
        detection::Opinion::Trusted => Opinion::Trusted,
        detection::Opinion::Failed => Opinion::Failed,
        _ => Opinion::Suspect,
    }
}
