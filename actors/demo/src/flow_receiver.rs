//! Counts the received messages of a numbered flow.

use super::machine_instant::MachineInstant;
use super::protocol::SinkState;
use std::collections::{BTreeSet, VecDeque};
use std::ops::Range;

/// Missing numbers that are stored, ten seconds of the fastest flow. Older ones count as lost.
const MISSING_LIMIT: usize = 2_000;

/// Arrivals remembered so that a watch may look back: two seconds of the fastest flow.
const RECENT_LIMIT: usize = 400;

/// The received messages of one flow. It is kept outside the receiving object, so that it survives
/// the restarts of that object.
#[derive(Debug)]
pub(crate) struct FlowReceiver {
    state: SinkState,
    missing: BTreeSet<u64>,
    given_up: u64,
    recent: VecDeque<Arrival>,
    watched: Option<MachineInstant>,
}

#[derive(Clone, Copy, Debug)]
struct Arrival {
    sent: MachineInstant,
    arrived: MachineInstant,
}

/// One message of a flow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Sample {
    /// The source's epoch.
    pub(crate) epoch: u64,
    /// Its number in it, from 1.
    pub(crate) number: u64,
    /// When it was first offered to the middleware.
    pub(crate) sent: MachineInstant,
}

impl FlowReceiver {
    /// Creates the receiver of a flow before its first message.
    pub(crate) fn new(flow: &str, process: u64) -> FlowReceiver {
        FlowReceiver {
            state: SinkState { flow: flow.into(), process, ..SinkState::default() },
            missing: BTreeSet::new(),
            given_up: 0,
            recent: VecDeque::with_capacity(RECENT_LIMIT),
            watched: None,
        }
    }

    /// Counts an arrival. If it is the first that was sent after the watched instant, that instant.
    pub(crate) fn handle_sample(
        &mut self,
        sample: Sample,
        now: MachineInstant,
    ) -> Option<MachineInstant> {
        if sample.epoch != self.state.epoch {
            self.begin_epoch(sample);
        }
        if sample.number > self.state.highest {
            self.skip(self.state.highest + 1..sample.number);
            self.state.highest = sample.number;
        } else if !self.missing.remove(&sample.number) {
            self.state.doubled += 1;
        }
        if self.recent.len() == RECENT_LIMIT {
            self.recent.pop_front();
        }
        self.recent.push_back(Arrival { sent: sample.sent, arrived: now });
        self.watched.take_if(|since| sample.sent >= *since)
    }

    /// Watches for the first message sent after `since`. If it has arrived already: when.
    pub(crate) fn watch(&mut self, since: MachineInstant) -> Option<MachineInstant> {
        let passed = self.recent.iter().find(|arrival| arrival.sent >= since);
        self.watched = if passed.is_some() { None } else { Some(since) };
        passed.map(|arrival| arrival.arrived)
    }

    /// Returns the counters.
    pub(crate) fn state(&self) -> SinkState {
        let missing = self.missing.len() as u64 + self.given_up;
        SinkState { missing, ..self.state.clone() }
    }

    fn skip(&mut self, numbers: Range<u64>) {
        let kept_from = numbers.end.saturating_sub(MISSING_LIMIT as u64).max(numbers.start);
        self.given_up += kept_from - numbers.start;
        self.missing.extend(kept_from..numbers.end);
        while self.missing.len() > MISSING_LIMIT {
            self.missing.pop_first();
            self.given_up += 1;
        }
    }

    fn begin_epoch(&mut self, sample: Sample) {
        self.state.missing_before += self.missing.len() as u64 + self.given_up;
        self.missing.clear();
        self.given_up = 0;
        self.state.epoch = sample.epoch;
        self.state.first = sample.number;
        self.state.highest = sample.number.saturating_sub(1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tally(samples: &[(u64, u64)]) -> SinkState {
        let mut tally = FlowReceiver::new("flow", 9);
        for &(epoch, number) in samples {
            tally.handle_sample(
                Sample { epoch, number, sent: MachineInstant::default() },
                MachineInstant::default(),
            );
        }
        tally.state()
    }

    #[test]
    fn what_is_late_was_neither_lost_nor_doubled() {
        let state = tally(&[(1, 1), (1, 4), (1, 2), (1, 3)]);

        assert_eq!((state.first, state.highest, state.missing, state.doubled), (1, 4, 0, 0));
    }

    #[test]
    fn what_is_missing_and_what_came_twice_is_counted() {
        let state = tally(&[(1, 1), (1, 4), (1, 4), (1, 3), (1, 3)]);

        assert_eq!((state.highest, state.missing, state.doubled), (4, 1, 2));
    }

    #[test]
    fn a_new_process_of_the_source_begins_a_new_count_and_the_old_gaps_stay_on_the_books() {
        let state = tally(&[(1, 1), (1, 3), (2, 1), (2, 2)]);

        assert_eq!((state.epoch, state.first, state.highest), (2, 1, 2));
        assert_eq!((state.missing, state.missing_before, state.doubled), (0, 1, 0));
    }

    #[test]
    fn a_long_gap_takes_no_more_room_than_the_limit_and_stays_counted() {
        let mut tally = FlowReceiver::new("flow", 9);
        for number in [1, 1_000_000_000_000] {
            let sample = Sample { epoch: 1, number, sent: MachineInstant::default() };
            tally.handle_sample(sample, MachineInstant::default());
        }

        assert_eq!(tally.state().missing, 999_999_999_998);
        assert_eq!(tally.missing.len(), MISSING_LIMIT);
    }

    #[test]
    fn a_watch_answers_once_from_the_past_or_from_the_future() {
        let at = MachineInstant::from_millis;
        let sample = |number, sent| Sample { epoch: 1, number, sent: at(sent) };
        let mut tally = FlowReceiver::new("flow", 9);
        tally.handle_sample(sample(1, 10), at(11));
        tally.handle_sample(sample(2, 20), at(21));

        assert_eq!(tally.watch(at(15)), Some(at(21)));
        assert_eq!(tally.watch(at(30)), None);
        assert_eq!(tally.handle_sample(sample(3, 25), at(31)), None);
        assert_eq!(tally.handle_sample(sample(4, 30), at(32)), Some(at(30)));
        assert_eq!(tally.handle_sample(sample(5, 40), at(41)), None);
    }
}
