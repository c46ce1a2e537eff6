//! When the recoverer acts by itself.

use super::{Case, Engaged, FaultLocation, Progress, Recoverer, RecovererOutput};
use crate::timer::Timers;
use crate::{FaultId, Instant};

/// The timers of the recoverer.
#[derive(Clone, Copy, Debug)]
pub(crate) enum RecovererTimer {
    /// Gives the next order for a fault, after its step's back-off.
    BackOff,
    /// Goes on to the next attempt: the strategy did not answer within the step's time.
    ActionTimeout,
    /// Treats a symptom by itself: it outlasts its root.
    SymptomGrace,
    /// Releases a strategy that has had no order for `idle`.
    StrategyIdle,
}

impl Timers for Recoverer {
    type Timer = RecovererTimer;

    const TIMERS: &'static [RecovererTimer] = {
        use RecovererTimer::*;
        &[BackOff, ActionTimeout, SymptomGrace, StrategyIdle]
    };

    fn due(&self, timer: RecovererTimer) -> Option<Instant> {
        match timer {
            RecovererTimer::BackOff => self.cases.values().filter_map(begins_at).min(),
            RecovererTimer::ActionTimeout => self.cases.values().filter_map(times_out_at).min(),
            RecovererTimer::SymptomGrace => {
                self.symptoms.values().filter_map(|symptom| symptom.due).min()
            }
            RecovererTimer::StrategyIdle => {
                self.engaged.values().filter_map(|engaged| self.idle_at(engaged)).min()
            }
        }
    }

    fn fire(&mut self, timer: RecovererTimer, now: Instant) {
        match timer {
            RecovererTimer::BackOff => {
                for place in self.cases_due(begins_at, now) {
                    self.give_order(&place, now);
                }
            }
            RecovererTimer::ActionTimeout => {
                for place in self.cases_due(times_out_at, now) {
                    self.give_up_order(&place, now);
                }
            }
            RecovererTimer::SymptomGrace => self.treat_symptoms(now),
            RecovererTimer::StrategyIdle => self.release_strategies(now),
        }
    }
}

fn begins_at(case: &Case) -> Option<Instant> {
    match case.progress {
        Progress::Waiting { due } => Some(due),
        Progress::Acting { .. } => None,
    }
}

fn times_out_at(case: &Case) -> Option<Instant> {
    match case.progress {
        Progress::Acting { due } => Some(due),
        Progress::Waiting { .. } => None,
    }
}

impl Recoverer {
    fn idle_at(&self, engaged: &Engaged) -> Option<Instant> {
        (engaged.orders == 0).then(|| engaged.idle_since + self.limits.idle)
    }

    fn cases_due(&self, at: fn(&Case) -> Option<Instant>, now: Instant) -> Vec<FaultLocation> {
        let due = self.cases.iter().filter(|(_, case)| at(case).is_some_and(|due| due <= now));
        due.map(|(place, _)| place.clone()).collect()
    }

    fn give_up_order(&mut self, place: &FaultLocation, now: Instant) {
        let case = &self.cases[place];
        let step = &case.ladder.steps()[case.rung];
        let reason = format!("{} was not done within {:?}", step.action, step.within);
        // An answer that comes too late is not waited for: the next attempt finds the child well.
        let number = case.order;
        self.close_order(number, now);
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

    fn release_strategies(&mut self, now: Instant) {
        let is_idle = |engaged| self.idle_at(engaged).is_some_and(|due| due <= now);
        let idle = self.engaged.iter().filter(|(_, engaged)| is_idle(engaged));
        let idle: Vec<_> = idle.map(|(action, _)| action.clone()).collect();
        for action in idle {
            self.engaged.remove(&action);
            self.outputs.push_back(RecovererOutput::Release { action });
        }
    }
}
