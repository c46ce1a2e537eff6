//! What the detector keeps of each slot.

use super::lateness::Lateness;
use super::{ActivityMark, ComponentRecord, ComponentSample, JudgedComponent};
use crate::Instant;
use std::time::Duration;

/// What is kept of one slot. Most components rest, and cost no more than this.
#[derive(Debug)]
pub(super) enum ComponentEntry {
    /// It has nothing in service, nothing is late, and no sign is expected of it. As long as it
    /// shows this mark and its arbiter has time, there is nothing to judge.
    Resting { judged: JudgedComponent, mark: ActivityMark },
    /// It is judged whenever activity records are shown.
    Awake(Box<ComponentRecord>),
}

impl ComponentEntry {
    pub(super) fn judged(&self) -> &JudgedComponent {
        match self {
            ComponentEntry::Resting { judged, .. } => judged,
            ComponentEntry::Awake(component) => &component.judged,
        }
    }

    pub(super) fn awake(&self) -> Option<&ComponentRecord> {
        match self {
            ComponentEntry::Resting { .. } => None,
            ComponentEntry::Awake(component) => Some(component),
        }
    }

    pub(super) fn awake_mut(&mut self) -> Option<&mut ComponentRecord> {
        match self {
            ComponentEntry::Resting { .. } => None,
            ComponentEntry::Awake(component) => Some(component),
        }
    }

    /// The component, to be judged: where it rests, as it was when it came to rest.
    pub(super) fn wake(
        &mut self,
        reading: ComponentSample,
        now: Instant,
        blind: Duration,
    ) -> &mut ComponentRecord {
        if let ComponentEntry::Resting { judged, mark } = self {
            let ActivityMark { turn, incarnation, expired } = *mark;
            let before = ComponentSample { turn, incarnation, expired, ..reading };
            let fresh = ComponentRecord::new(judged.clone(), now, 0);
            let lateness = Lateness::new(now, blind, &before);
            let component = ComponentRecord { reading: Some(before), lateness, ..fresh };
            *self = ComponentEntry::Awake(Box::new(component));
        }
        self.awake_mut().expect("it was just made so")
    }

    /// Lets the component rest if it does.
    pub(super) fn settle(&mut self, now: Instant) {
        let Some(component) = self.awake() else { return };
        let Some(reading) = component.reading.filter(|_| component.rests(now)) else { return };
        let (judged, mark) = (component.judged.clone(), reading.mark());
        *self = ComponentEntry::Resting { judged, mark };
    }
}
