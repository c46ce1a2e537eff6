//! When the recoverer acts by itself.

use super::{FaultLocation, Recoverer};
use crate::timer::Timers;
use crate::{FaultId, Instant};

/// The timers of the recoverer.
#[derive(Clone, Copy, Debug)]
pub(crate) enum RecovererTimer {
    /// Gives the next order for a place, after its step's back-off; or goes on to the next attempt,
    /// because the strategy did not answer within the step's time.
    CaseDue,
    /// Treats a symptom by itself: it outlasts its root.
    SymptomGrace,
}

impl Timers for Recoverer {
    type Timer = RecovererTimer;

    const TIMERS: &'static [RecovererTimer] =
        &[RecovererTimer::CaseDue, RecovererTimer::SymptomGrace];

    fn due(&self, timer: RecovererTimer) -> Option<Instant> {
        match timer {
            RecovererTimer::CaseDue => self.cases.values().map(|case| case.due).min(),
            RecovererTimer::SymptomGrace => {
                self.symptoms.values().filter_map(|symptom| symptom.due).min()
            }
        }
    }

    fn fire(&mut self, timer: RecovererTimer, now: Instant) {
        match timer {
            RecovererTimer::CaseDue => {
                let due = self.cases.iter().filter(|(_, case)| case.due <= now);
                let due: Vec<FaultLocation> = due.map(|(place, _)| place.clone()).collect();
                for place in due {
                    match self.cases[&place].is_acting {
                        true => self.give_up_order(&place, now),
                        false => self.give_order(&place, now),
                    }
                }
            }
            RecovererTimer::SymptomGrace => self.treat_symptoms(now),
        }
    }
}

impl Recoverer {
    fn give_up_order(&mut self, place: &FaultLocation, now: Instant) {
        let case = &self.cases[place];
        let step = &case.ladder.steps()[case.rung];
        let reason = format!("{} was not done within {:?}", step.action, step.within);
        // An answer that comes too late is not waited for: the next attempt finds the child well.
        self.climb(place, reason, now);
    }

    fn treat_symptoms(&mut self, now: Instant) {
        let is_due = |due: Option<Instant>| due.is_some_and(|due| due <= now);
        let passed = self.symptoms.iter().filter(|(_, symptom)| is_due(symptom.due));
        let passed: Vec<FaultId> = passed.map(|(&id, _)| id).collect();
        for id in passed {
            let symptom = self.symptoms.remove(&id).expect("a symptom that was just looked at");
            self.treat(symptom.fault, now);
            if !self.is_open(id) {
                self.release_symptoms(&[id], now);
            }
        }
    }
}
