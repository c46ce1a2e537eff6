//! A condition: several channels, of which enough must be connected.

use super::judge::{ChannelReading, ConditionState, ConnectionJudge};
use crate::Instant;

/// Which channels a condition needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Combination {
    /// The channel of this number.
    Channel(usize),
    /// At least so many of these.
    AtLeast {
        /// How many: all of them, or one, or some.
        least: usize,
        /// Of which.
        of: Vec<Combination>,
    },
}

/// Judges the channels of one condition.
#[derive(Debug)]
pub struct ConnectionCondition {
    judges: Vec<ConnectionJudge>,
    combination: Combination,
    state: ConditionState,
}

impl ConnectionCondition {
    /// A condition over these channels, which the combination names by their places.
    pub fn new(judges: Vec<ConnectionJudge>, combination: Combination) -> Self {
        ConnectionCondition { judges, combination, state: ConditionState::Lost }
    }

    /// How the condition is.
    pub fn state(&self) -> ConditionState {
        self.state
    }

    /// Judges the channels by a reading of each, in their order. Returns whether the state is
    /// another.
    pub fn handle_readings(&mut self, readings: &[ChannelReading], now: Instant) -> bool {
        for (judge, reading) in self.judges.iter_mut().zip(readings) {
            judge.handle_reading(reading, now);
        }
        let state = self.state_of(&self.combination);
        std::mem::replace(&mut self.state, state) != state
    }

    /// When a channel is lost unless it is heard before.
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.judges.iter().filter_map(ConnectionJudge::poll_timeout).min()
    }

    /// Why the condition is as it is: the channels that are not connected, or all of them where it
    /// is connected, with their figures.
    pub fn cause(&self) -> String {
        self.cause_of(&self.combination)
    }

    fn state_of(&self, combination: &Combination) -> ConditionState {
        match combination {
            Combination::Channel(place) => {
                self.judges.get(*place).map_or(ConditionState::Lost, ConnectionJudge::state)
            }
            Combination::AtLeast { least, of } => {
                let mut states: Vec<_> = of.iter().map(|part| self.state_of(part)).collect();
                states.sort_unstable_by(|a, b| b.cmp(a));
                // The state that at least so many have reached.
                let last = least.checked_sub(1).and_then(|place| states.get(place));
                last.copied().unwrap_or(ConditionState::Lost)
            }
        }
    }

    fn cause_of(&self, combination: &Combination) -> String {
        match combination {
            Combination::Channel(place) => {
                self.judges.get(*place).map_or(String::new(), |judge| judge.cause().to_owned())
            }
            Combination::AtLeast { least, of } => {
                let is_well =
                    |part: &&Combination| self.state_of(part) == ConditionState::Connected;
                let well = of.iter().filter(is_well).count();
                let told = of.iter().filter(|part| well >= *least || !is_well(part));
                let causes: Vec<_> = told.map(|part| self.cause_of(part)).collect();
                let causes = causes.join("; ");
                match of.len() {
                    1 => causes,
                    all => format!("{well} of {all} connected, {least} needed: {causes}"),
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::connection::{ConnectionLimits, ConnectionRules, Presence};
    use std::time::Duration;

    #[test]
    fn a_condition_is_as_good_as_the_worst_channel_that_it_needs() {
        use ConditionState::{Connected, Degraded, Lost};
        let of = |states: [ConditionState; 3], least: usize| {
            let limits =
                ConnectionLimits { loss_permille: Some(10), ..ConnectionLimits::default() };
            let presence = Presence::Heard { timeout: Duration::from_secs(1) };
            let rules = ConnectionRules { presence, limits };
            let judges = ["a", "b", "c"].map(|name| ConnectionJudge::new(name.into(), rules));
            let parts = (0..3).map(Combination::Channel).collect();
            let combination = Combination::AtLeast { least, of: parts };
            let mut condition = ConnectionCondition::new(judges.into(), combination);
            let readings = states.map(|state| ChannelReading {
                heard_at: (state != Lost).then_some(Instant::ORIGIN),
                loss_permille: Some(if state == Connected { 0 } else { 100 }),
                ..ChannelReading::default()
            });
            let changed = condition.handle_readings(&readings, Instant::from_millis(1));
            assert_eq!(changed, condition.state() != Lost);
            assert!(!condition.handle_readings(&readings, Instant::from_millis(2)));
            (condition.state(), condition.cause())
        };
        let mixed = [Connected, Degraded, Lost];
        assert_eq!(of(mixed, 1).0, Connected);
        assert_eq!(of(mixed, 2).0, Degraded);
        assert_eq!(
            of(mixed, 3),
            (Lost, "1 of 3 connected, 3 needed: b: loss 10 %, limit 1 %; c: never heard".into())
        );
        assert_eq!(of([Connected; 3], 3).0, Connected);
    }
}
