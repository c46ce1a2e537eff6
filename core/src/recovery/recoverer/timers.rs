//! When the recoverer acts by itself.

use super::{FaultLocation, Recoverer};
use crate::{FaultId, Instant};

impl Recoverer {
    /// Gives the next order for each place whose back-off is over; or goes on to the next attempt,
    /// because the strategy did not answer within the step's time.
    pub(super) fn act_on_cases(&mut self, now: Instant) {
        let due = self.cases.iter().filter(|(_, case)| case.due <= now);
        let due: Vec<FaultLocation> = due.map(|(place, _)| place.clone()).collect();
        for place in due {
            match self.cases[&place].is_acting {
                true => self.give_up_order(&place, now),
                false => self.give_order(&place, now),
            }
        }
    }

    fn give_up_order(&mut self, place: &FaultLocation, now: Instant) {
        let case = &self.cases[place];
        let step = &case.ladder.steps()[case.rung];
        let reason = format!("{} was not done within {:?}", step.action, step.within);
        // An answer that comes too late is not waited for: the next attempt finds the child well.
        self.climb(place, reason, now);
    }

    /// Treats each symptom that outlasts its root by itself.
    pub(super) fn treat_symptoms(&mut self, now: Instant) {
        let is_due = |due: Option<Instant>| due.is_some_and(|due| due <= now);
        let passed = self.symptoms.iter().filter(|(_, symptom)| is_due(symptom.due));
        let passed: Vec<FaultId> = passed.map(|(&id, _)| id).collect();
        for id in passed {
            let symptom = self.symptoms.remove(&id).expect("a symptom that was just looked at");
            self.treat(symptom.fault, now);
        }
    }
}
