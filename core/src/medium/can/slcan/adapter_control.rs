//! How an adapter is brought onto the bus, and how fast it is given frames.
//!
//! ```text
//!           a pause               done, or no answer          done, or no answer
//! Closing ───────────► Setting ────────────────────► Opening ─────────────────► Open
//!                         │ refused                     │ refused
//!                         └──────────► Failed ◄─────────┘
//! ```
//!
//! Setting is of one bit rate, or of two where the bus has CAN FD.
//!
//! Many an adapter answers nothing at all: silence is no failure. One that is open already, by a
//! program that died, is closed first, which an adapter that is closed refuses: whatever is heard
//! in the pause after that says nothing.

use super::{AdapterCommand, AdapterReply, BitRate, DataRate};
use crate::Instant;
use crate::medium::can::{CanFrame, bits_on_bus};
use std::time::Duration;

/// How long an adapter may take for an answer. Those that answer do so within a few milliseconds.
const REPLY_TIMEOUT: Duration = Duration::from_millis(200);
/// How long whatever an adapter says after it was closed counts for nothing: what a serial line of
/// 9,600 bit/s and a dozen bytes take.
const RETRY_DELAY: Duration = Duration::from_millis(20);
/// Frames may be so far ahead of the bus: a dozen of them at 500 kbit/s, which every adapter's
/// memory holds. More would only wait there, before what is more urgent.
const AHEAD: Duration = Duration::from_millis(3);

/// Why an adapter is of no use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AdapterError {
    /// It does not know the bus's bit rate, or the program that it has does not let it be set.
    #[error("the adapter refuses {hz} bit/s: choose the bus's bit rate among those it knows")]
    BitRate {
        /// The configured bit rate, in bit/s.
        hz: u32,
    },
    /// It does not know CAN FD, or not this rate.
    #[error("the adapter refuses CAN FD at this data rate: choose another, or leave fd out")]
    DataRate,
    /// It does not go onto the bus.
    #[error("the adapter refuses to open: check the bus's wires, or plug it in again")]
    Open,
}

/// The machine of one adapter's state.
#[derive(Debug)]
pub struct AdapterControl {
    rate: BitRate,
    /// Where the bus has CAN FD.
    data_rate: Option<DataRate>,
    state: State,
    /// When all that was sent will be on the bus.
    free: Instant,
    refused: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// The command is to be written.
    Saying(SetupStep),
    /// Its answer is to come.
    Waiting { step: SetupStep, until: Instant },
    /// The adapter carries frames.
    Open,
    /// The adapter cannot be used.
    Failed(AdapterError),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SetupStep {
    Close,
    BitRate,
    DataRate,
    Open,
}

impl AdapterControl {
    /// An adapter that was just found, on a bus of this rate, and of that rate for the data of CAN
    /// FD.
    pub fn new(rate: BitRate, data_rate: Option<DataRate>) -> Self {
        AdapterControl {
            rate,
            data_rate,
            state: State::Saying(SetupStep::Close),
            free: Instant::ORIGIN,
            refused: 0,
        }
    }

    /// How many frames it refused.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Whether it is on the bus.
    pub fn is_open(&self) -> bool {
        self.state == State::Open
    }

    /// Why it is of no use, if it is not.
    pub fn failure(&self) -> Option<AdapterError> {
        match self.state {
            State::Failed(error) => Some(error),
            _ => None,
        }
    }

    /// The command that is to be written next, if any; it counts as written.
    pub fn poll_command(&mut self, now: Instant) -> Option<AdapterCommand> {
        let State::Saying(step) = self.state else { return None };
        let timeout = if step == SetupStep::Close { RETRY_DELAY } else { REPLY_TIMEOUT };
        self.state = State::Waiting { step, until: now + timeout };
        Some(match step {
            SetupStep::Close => AdapterCommand::Close,
            SetupStep::BitRate => AdapterCommand::BitRate(self.rate),
            // Without one there is no such step.
            SetupStep::DataRate => {
                AdapterCommand::DataRate(self.data_rate.unwrap_or(DataRate::TwoMegabit))
            }
            SetupStep::Open => AdapterCommand::Open,
        })
    }

    /// The adapter has said something other than a frame.
    pub fn handle_reply(&mut self, reply: &AdapterReply) {
        let refused = match reply {
            AdapterReply::Refused => true,
            AdapterReply::Done | AdapterReply::Sent => false,
            AdapterReply::Answer | AdapterReply::Frame(_) => return,
        };
        match self.state {
            State::Waiting { step: SetupStep::Close, .. } => {}
            State::Waiting { step, .. } => {
                self.state = match step {
                    SetupStep::BitRate if refused => {
                        State::Failed(AdapterError::BitRate { hz: self.rate.hz() })
                    }
                    SetupStep::DataRate if refused => State::Failed(AdapterError::DataRate),
                    SetupStep::Open if refused => State::Failed(AdapterError::Open),
                    _ => self.after(step),
                };
            }
            State::Open => self.refused += u64::from(refused),
            State::Saying(_) | State::Failed(_) => {}
        }
    }

    /// Whether the adapter takes a frame now; if not, when it does, if that is a matter of time.
    pub fn takes(&self, now: Instant) -> Result<(), Option<Instant>> {
        match self.state {
            State::Open if self.free - now <= AHEAD => Ok(()),
            State::Open => Err(Some(now + (self.free - now - AHEAD))),
            _ => Err(None),
        }
    }

    /// A frame was written to the adapter.
    pub fn handle_sent(&mut self, frame: &CanFrame, now: Instant) {
        self.free = self.free.max(now) + time_on_bus(frame, self.rate);
    }

    fn after(&self, step: SetupStep) -> State {
        match step {
            SetupStep::Close => State::Saying(SetupStep::BitRate),
            SetupStep::BitRate if self.data_rate.is_some() => State::Saying(SetupStep::DataRate),
            SetupStep::BitRate | SetupStep::DataRate => State::Saying(SetupStep::Open),
            SetupStep::Open => State::Open,
        }
    }

    /// When the adapter's answer is given up.
    pub fn poll_timeout(&self) -> Option<Instant> {
        match self.state {
            State::Waiting { until, .. } => Some(until),
            State::Saying(_) | State::Open | State::Failed(_) => None,
        }
    }

    /// Goes on without an answer.
    pub fn handle_timeout(&mut self, now: Instant) {
        if let State::Waiting { step, until } = self.state
            && until <= now
        {
            self.state = self.after(step);
        }
    }
}

/// How long a frame takes on the bus.
fn time_on_bus(frame: &CanFrame, rate: BitRate) -> Duration {
    let bits = bits_on_bus(frame.id().is_extended(), frame.length());
    Duration::from_nanos(bits * 1_000_000_000 / u64::from(rate.hz()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::medium::can::{CanId, Format};
    use crate::testing::at;

    fn rate() -> BitRate {
        BitRate::of(500_000).unwrap()
    }

    /// One in each of its states, entered at 0 ms.
    fn all() -> [(&'static str, AdapterControl); 8] {
        let with = |state| AdapterControl { state, ..AdapterControl::new(rate(), None) };
        let waiting = |step| with(State::Waiting { step, until: at(200) });
        [
            ("saying close", with(State::Saying(SetupStep::Close))),
            ("waiting for close", waiting(SetupStep::Close)),
            ("saying the rate", with(State::Saying(SetupStep::BitRate))),
            ("waiting for the rate", waiting(SetupStep::BitRate)),
            ("saying open", with(State::Saying(SetupStep::Open))),
            ("waiting for open", waiting(SetupStep::Open)),
            ("open", with(State::Open)),
            ("failed", with(State::Failed(AdapterError::Open))),
        ]
    }

    /// The states that each of the eight is in after an input.
    fn check(input: impl Fn(&mut AdapterControl), expected: [State; 8]) {
        for ((name, mut control), expected) in all().into_iter().zip(expected) {
            input(&mut control);
            assert_eq!(control.state, expected, "{name}");
        }
    }

    fn before() -> [State; 8] {
        all().map(|(_, control)| control.state)
    }

    #[test]
    fn an_adapter_that_answers_is_open_after_three_commands() {
        let mut control = AdapterControl::new(rate(), None);
        let mut sent = vec![];

        while !control.is_open() {
            sent.extend(control.poll_command(at(1)));
            assert_eq!(control.poll_command(at(1)), None, "one at a time");
            control.handle_reply(&AdapterReply::Done);
            control.handle_timeout(at(21));
        }

        assert_eq!(
            sent,
            [AdapterCommand::Close, AdapterCommand::BitRate(rate()), AdapterCommand::Open]
        );
    }

    #[test]
    fn every_reply_in_every_state() {
        let [close, pause, set, _, join, _, open, failed] = before();
        for reply in [AdapterReply::Done, AdapterReply::Sent] {
            let expected = [close, pause, set, join, join, open, open, failed];
            check(|control| control.handle_reply(&reply), expected);
        }
        let rate_refused = State::Failed(AdapterError::BitRate { hz: 500_000 });
        let open_refused = State::Failed(AdapterError::Open);
        let expected = [close, pause, set, rate_refused, join, open_refused, open, failed];
        check(|control| control.handle_reply(&AdapterReply::Refused), expected);
        let frame = CanFrame::new(CanId::standard(1).unwrap(), Format::Classic, b"").unwrap();
        for reply in [AdapterReply::Frame(frame), AdapterReply::Answer] {
            check(|control| control.handle_reply(&reply), before());
        }
    }

    #[test]
    fn silence_is_no_failure() {
        check(|control| control.handle_timeout(at(199)), before());
        let [close, _, set, _, join, _, open, failed] = before();
        let expected = [close, set, set, join, join, open, open, failed];
        check(|control| control.handle_timeout(at(200)), expected);
        for (name, control) in all() {
            let due = name.starts_with("waiting").then_some(at(200));
            assert_eq!(control.poll_timeout(), due, "{name}");
        }
    }

    #[test]
    fn frames_are_taken_only_when_open_and_only_as_fast_as_the_bus() {
        for (name, control) in all() {
            assert_eq!(control.takes(at(1)).is_ok(), name == "open", "{name}");
        }
        let (_, mut open) = all().into_iter().nth(6).unwrap();
        let id = CanId::extended(1).unwrap();
        let frame = CanFrame::new(id, Format::Classic, &[0; 8]).unwrap();
        let mut now = at(1);
        let mut sent = 0;
        while now < at(1001) {
            match open.takes(now) {
                Ok(()) => {
                    open.handle_sent(&frame, now);
                    sent += 1;
                }
                Err(then) => now = then.unwrap(),
            }
        }
        // 144 bits each, and what may be ahead.
        assert!((3_450..=3_500).contains(&sent), "{sent}");
    }

    #[test]
    fn frames_that_are_refused_are_counted_and_commands_are_not() {
        for (name, mut control) in all() {
            control.handle_reply(&AdapterReply::Refused);
            control.handle_reply(&AdapterReply::Sent);
            assert_eq!(control.refused(), u64::from(name == "open"), "{name}");
        }
    }

    #[test]
    fn an_adapter_on_a_bus_with_can_fd_is_told_both_rates_and_may_refuse() {
        for (refuses, expected) in
            [(false, State::Open), (true, State::Failed(AdapterError::DataRate))]
        {
            let mut control = AdapterControl::new(rate(), Some(DataRate::FiveMegabit));
            let mut sent = vec![];
            for round in 0..4 {
                sent.extend(control.poll_command(at(round)));
                let refused = refuses
                    && sent.last() == Some(&AdapterCommand::DataRate(DataRate::FiveMegabit));
                control.handle_reply(if refused {
                    &AdapterReply::Refused
                } else {
                    &AdapterReply::Done
                });
                control.handle_timeout(at(30));
            }

            assert_eq!(sent[2], AdapterCommand::DataRate(DataRate::FiveMegabit));
            assert_eq!(control.state, expected);
        }
    }
}
