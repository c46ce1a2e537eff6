//! A condition: several channels, of which enough must be connected.

use super::judge::{ConditionState, ConnectionJudge};
use crate::Instant;

/// Which channels a condition needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Combination<C> {
    /// The channel that is needed.
    Channel(C),
    /// At least so many of these.
    AtLeast {
        /// How many: all of them, or one, or some.
        least: usize,
        /// What is counted: channels, or combinations of them.
        of: Vec<Combination<C>>,
    },
}

impl<C> Combination<C> {
    /// Shows each channel, in order.
    pub fn for_each(&mut self, show: &mut impl FnMut(&mut C)) {
        match self {
            Combination::Channel(channel) => show(channel),
            Combination::AtLeast { of, .. } => of.iter_mut().for_each(|part| part.for_each(show)),
        }
    }

    /// Makes another one with these channels in their places, in order.
    ///
    /// # Errors
    /// The first error of `make`, and what `refuse` makes of a number that is not one of those that
    /// there are, and of how many these are.
    pub fn try_map<D, E>(
        &self,
        make: &mut impl FnMut(&C) -> Result<D, E>,
        refuse: &impl Fn(usize, usize) -> E,
    ) -> Result<Combination<D>, E> {
        match self {
            Combination::Channel(channel) => make(channel).map(Combination::Channel),
            Combination::AtLeast { least, of } if !(1..=of.len()).contains(least) => {
                Err(refuse(*least, of.len()))
            }
            Combination::AtLeast { least, of } => {
                let of =
                    of.iter().map(|part| part.try_map(make, refuse)).collect::<Result<_, _>>()?;
                Ok(Combination::AtLeast { least: *least, of })
            }
        }
    }
}

impl Combination<ConnectionJudge> {
    /// How the condition is.
    pub fn state(&self) -> ConditionState {
        match self {
            Combination::Channel(judge) => judge.state(),
            Combination::AtLeast { least, of } => {
                let mut states: Vec<_> = of.iter().map(Self::state).collect();
                states.sort_unstable_by(|a, b| b.cmp(a));
                // The state that at least so many have reached.
                let last = least.checked_sub(1).and_then(|place| states.get(place));
                last.copied().unwrap_or(ConditionState::Lost)
            }
        }
    }

    /// When a channel is lost unless it is heard before.
    pub fn poll_timeout(&self) -> Option<Instant> {
        match self {
            Combination::Channel(judge) => judge.poll_timeout(),
            Combination::AtLeast { of, .. } => of.iter().filter_map(Self::poll_timeout).min(),
        }
    }

    /// Why the condition is as it is: the channels that are not connected, or all of them where it
    /// is connected, with their figures.
    pub fn cause(&self) -> String {
        match self {
            Combination::Channel(judge) => judge.cause().to_owned(),
            Combination::AtLeast { least, of } => {
                let is_well = |part: &&Self| part.state() == ConditionState::Connected;
                let well = of.iter().filter(is_well).count();
                let shown = of.iter().filter(|part| well >= *least || !is_well(part));
                let causes = shown.map(Self::cause).collect::<Vec<_>>().join("; ");
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
    use crate::connection::{ChannelReading, ConnectionLimits, ConnectionRules};
    use std::time::Duration;

    #[test]
    fn a_condition_is_as_good_as_the_worst_channel_that_it_needs() {
        use ConditionState::{Connected, Degraded, Lost};
        let of = |states: [ConditionState; 3], least: usize| {
            let limits =
                ConnectionLimits { loss_permille: Some(10), ..ConnectionLimits::default() };
            let rules = ConnectionRules { timeout: Duration::from_secs(1), rate: None, limits };
            let judges = ["a", "b", "c"].map(|name| ConnectionJudge::new(name.into(), rules));
            let of = judges.map(Combination::Channel).into();
            let mut condition = Combination::AtLeast { least, of };
            let mut states = states.into_iter();
            condition.for_each(&mut |judge| {
                let state = states.next().expect("one for each");
                let reading = ChannelReading {
                    heard_at: (state != Lost).then_some(Instant::ORIGIN),
                    loss_permille: Some(if state == Connected { 0 } else { 100 }),
                    ..ChannelReading::default()
                };
                judge.handle_reading(&reading, Instant::from_millis(1));
            });
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
