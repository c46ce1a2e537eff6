//! How an adapter is brought onto the bus, and how fast it is given frames.
//!
//! ```text
//!           a pause               done, or no answer          done, or no answer
//! Closing ───────────► Setting ────────────────────► Opening ─────────────────► Open
//!                         │ refused                     │ refused
//!                         └──────────► Failed ◄─────────┘
//! ```
//!
//! Many an adapter answers nothing at all: silence is no failure. One that is open already, by a program
//! that died, is closed first, which an adapter that is closed refuses: whatever is heard in the pause
//! after that says nothing.

use super::{BitRate, Command, Reply};
use crate::Instant;
use crate::can::CanFrame;
use std::time::Duration;

/// How long an adapter may take for an answer. Those that answer do so within a few milliseconds.
const PATIENCE: Duration = Duration::from_millis(200);
/// How long whatever an adapter says after it was closed counts for nothing: what a serial line of 9,600
/// bit/s and a dozen bytes take.
const PAUSE: Duration = Duration::from_millis(20);
/// Frames may be so far ahead of the bus: a dozen of them at 500 kbit/s, which every adapter's memory
/// holds. More would only wait there, before what is more urgent.
const AHEAD: Duration = Duration::from_millis(3);

/// Why an adapter is of no use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AdapterError {
    /// It does not know the bus's bit rate, or the program that it has does not let it be set.
    #[error("the adapter refuses {hz} bit/s: choose the bus's bit rate among those it knows")]
    BitRate {
        /// As configured.
        hz: u32,
    },
    /// It does not go onto the bus.
    #[error("the adapter refuses to open: check the bus's wires, or plug it in again")]
    Open,
}

/// The machine of one adapter's state.
#[derive(Debug)]
pub struct Dialogue {
    rate: BitRate,
    state: State,
    /// When all that was sent will be on the bus.
    free: Instant,
    refused: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// The command is to be written.
    Saying(Step),
    /// Its answer is to come.
    Waiting {
        step: Step,
        until: Instant,
    },
    Open,
    Failed(AdapterError),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    Close,
    BitRate,
    Open,
}

impl Dialogue {
    /// An adapter that was just found.
    pub fn new(rate: BitRate) -> Self {
        let (state, free) = (State::Saying(Step::Close), Instant::ORIGIN);
        Dialogue { rate, state, free, refused: 0 }
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
    pub fn poll_command(&mut self, now: Instant) -> Option<Command> {
        let State::Saying(step) = self.state else { return None };
        let patience = if step == Step::Close { PAUSE } else { PATIENCE };
        self.state = State::Waiting { step, until: now + patience };
        Some(match step {
            Step::Close => Command::Close,
            Step::BitRate => Command::BitRate(self.rate),
            Step::Open => Command::Open,
        })
    }

    /// The adapter has said something other than a frame.
    pub fn handle_reply(&mut self, reply: &Reply) {
        let refused = match reply {
            Reply::Refused => true,
            Reply::Done | Reply::Sent => false,
            Reply::Frame { .. } | Reply::Answer(_) => return,
        };
        match self.state {
            State::Waiting { step: Step::Close, .. } => {}
            State::Waiting { step, .. } => {
                self.state = match step {
                    Step::BitRate if refused => {
                        State::Failed(AdapterError::BitRate { hz: self.rate.hz() })
                    }
                    Step::Open if refused => State::Failed(AdapterError::Open),
                    _ => after(step),
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

    /// When the adapter's answer is given up.
    pub fn poll_timeout(&self) -> Option<Instant> {
        match self.state {
            State::Waiting { until, .. } => Some(until),
            _ => None,
        }
    }

    /// Goes on without an answer.
    pub fn handle_timeout(&mut self, now: Instant) {
        if let State::Waiting { step, until } = self.state
            && until <= now
        {
            self.state = after(step);
        }
    }
}

fn after(step: Step) -> State {
    match step {
        Step::Close => State::Saying(Step::BitRate),
        Step::BitRate => State::Saying(Step::Open),
        Step::Open => State::Open,
    }
}

/// How long a frame takes on the bus, stuffed bits included: every fifth at worst, a tenth as a rule. A
/// faster rate for FD's data is not counted on.
fn time_on_bus(frame: &CanFrame, rate: BitRate) -> Duration {
    // Start, control, checksum, confirmation, end and pause (ISO 11898-1).
    let fixed = if frame.id().is_extended() { 67 } else { 47 };
    let bits = (fixed + 8 * frame.length() as u64) * 11 / 10;
    Duration::from_nanos(bits * 1_000_000_000 / u64::from(rate.hz()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::{CanId, Format};

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn rate() -> BitRate {
        BitRate::of(500_000).unwrap()
    }

    /// One in each of its states, entered at 0 ms.
    fn all() -> [(&'static str, Dialogue); 8] {
        let with = |state| Dialogue { state, ..Dialogue::new(rate()) };
        let waiting = |step| with(State::Waiting { step, until: at(200) });
        [
            ("saying close", with(State::Saying(Step::Close))),
            ("waiting for close", waiting(Step::Close)),
            ("saying the rate", with(State::Saying(Step::BitRate))),
            ("waiting for the rate", waiting(Step::BitRate)),
            ("saying open", with(State::Saying(Step::Open))),
            ("waiting for open", waiting(Step::Open)),
            ("open", with(State::Open)),
            ("failed", with(State::Failed(AdapterError::Open))),
        ]
    }

    /// The states that each of the eight is in after an input.
    fn check(input: impl Fn(&mut Dialogue), expected: [State; 8]) {
        for ((name, mut dialogue), expected) in all().into_iter().zip(expected) {
            input(&mut dialogue);
            assert_eq!(dialogue.state, expected, "{name}");
        }
    }

    fn before() -> [State; 8] {
        all().map(|(_, dialogue)| dialogue.state)
    }

    #[test]
    fn an_adapter_that_answers_is_open_after_three_commands() {
        let mut dialogue = Dialogue::new(rate());
        let mut said = vec![];

        while !dialogue.is_open() {
            said.extend(dialogue.poll_command(at(1)));
            assert_eq!(dialogue.poll_command(at(1)), None, "one at a time");
            dialogue.handle_reply(&Reply::Done);
            dialogue.handle_timeout(at(21));
        }

        assert_eq!(said, [Command::Close, Command::BitRate(rate()), Command::Open]);
    }

    #[test]
    fn every_reply_in_every_state() {
        let [close, pause, set, _, join, _, open, failed] = before();
        for reply in [Reply::Done, Reply::Sent] {
            let expected = [close, pause, set, join, join, open, open, failed];
            check(|dialogue| dialogue.handle_reply(&reply), expected);
        }
        let rate_refused = State::Failed(AdapterError::BitRate { hz: 500_000 });
        let open_refused = State::Failed(AdapterError::Open);
        let expected = [close, pause, set, rate_refused, join, open_refused, open, failed];
        check(|dialogue| dialogue.handle_reply(&Reply::Refused), expected);
        let frame = CanFrame::remote(CanId::standard(1).unwrap(), 0).unwrap();
        for reply in [Reply::Frame { frame, time_ms: None }, Reply::Answer("V1013".into())] {
            check(|dialogue| dialogue.handle_reply(&reply), before());
        }
    }

    #[test]
    fn silence_is_no_failure() {
        check(|dialogue| dialogue.handle_timeout(at(199)), before());
        let [close, _, set, _, join, _, open, failed] = before();
        let expected = [close, set, set, join, join, open, open, failed];
        check(|dialogue| dialogue.handle_timeout(at(200)), expected);
        for (name, dialogue) in all() {
            let due = name.starts_with("waiting").then_some(at(200));
            assert_eq!(dialogue.poll_timeout(), due, "{name}");
        }
    }

    #[test]
    fn frames_are_taken_only_when_open_and_only_as_fast_as_the_bus() {
        for (name, dialogue) in all() {
            assert_eq!(dialogue.takes(at(1)).is_ok(), name == "open", "{name}");
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
        for (name, mut dialogue) in all() {
            dialogue.handle_reply(&Reply::Refused);
            dialogue.handle_reply(&Reply::Sent);
            assert_eq!(dialogue.refused(), u64::from(name == "open"), "{name}");
        }
    }
}
