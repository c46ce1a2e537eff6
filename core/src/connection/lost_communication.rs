//! What a robot does alone: a ladder in time after the loss of communication.
//!
//! ```text
//!            lost                    after 1 s       after 10 s        after 60 s
//!  Commanded ────► Lost { since } ──► rung 0 ──────► rung 1 ─────────► rung 2
//!      ▲                                 │ connected: no further rung is entered
//!      └── connected for a while, or acknowledged ◄──┘
//! ```

use super::ConditionState;
use crate::{Instant, Machine};
use std::collections::VecDeque;
use std::time::Duration;

/// What ends the ladder once communication is back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LostCommunicationEnd {
    /// For how long it must be back without a break. A break before that belongs to the first loss.
    pub stable: Duration,
    /// A person must acknowledge it, at any time after it is back, and nothing else ends it.
    pub is_acknowledged: bool,
}

/// What the ladder wants done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LostCommunicationOutput {
    /// Leave the present rung, if there is one, and carry this one out.
    Enter(usize),
    /// Leave the present rung: others command again.
    End,
}

/// A ladder that is climbed while communication is lost.
#[derive(Debug)]
pub struct LostCommunication {
    /// When each rung is entered, counted from the loss.
    rungs: Vec<Duration>,
    end: LostCommunicationEnd,
    state: State,
    outputs: VecDeque<LostCommunicationOutput>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Communication was never there.
    New,
    /// It was not lost since it is there, or is back for good.
    Commanded,
    /// Communication is lost since `since`; `next` is the rung to be entered next.
    Lost { since: Instant, next: usize },
    /// Communication is back since `at`; the ladder stays where it is.
    Back { since: Instant, next: usize, at: Instant },
}

impl LostCommunication {
    /// A ladder of rungs at these times after the loss, in rising order.
    pub fn new(rungs: Vec<Duration>, end: LostCommunicationEnd) -> Self {
        LostCommunication { rungs, end, state: State::New, outputs: VecDeque::new() }
    }

    /// The rung that is carried out.
    pub fn rung(&self) -> Option<usize> {
        match self.state {
            State::New | State::Commanded => None,
            State::Lost { next, .. } | State::Back { next, .. } => next.checked_sub(1),
        }
    }

    /// Whether communication is back, and the ladder waits for its end.
    pub fn is_back(&self) -> bool {
        matches!(self.state, State::Back { .. })
    }

    /// Acts on how communication is, and on the time. One that was lost and is there again, but not
    /// within its limits, is lost. Where it was back and not yet stable, the time goes on from the
    /// first loss; else the rungs that are left count from this one.
    pub fn handle(&mut self, is: ConditionState, now: Instant) {
        use ConditionState::{Connected, Lost};
        self.state = match self.state {
            State::New if is != Lost => State::Commanded,
            State::Commanded if is == Lost => State::Lost { since: now, next: 0 },
            // No rung was due: nothing is to be ended.
            State::Lost { next: 0, .. } if is == Connected => State::Commanded,
            State::Lost { since, next } if is == Connected => State::Back { since, next, at: now },
            State::Back { next, at, .. } if is != Connected && now - at >= self.end.stable => {
                State::Lost { since: now, next }
            }
            State::Back { since, next, .. } if is != Connected => State::Lost { since, next },
            other => other,
        };
        self.handle_timeout(now);
    }

    /// A person says that the robot may be commanded again. Returns whether there was something to
    /// acknowledge: communication is back, and the ladder still holds.
    pub fn handle_acknowledged(&mut self) -> bool {
        let is_back = self.is_back();
        if is_back {
            self.finish();
        }
        is_back
    }

    fn finish(&mut self) {
        self.state = State::Commanded;
        self.outputs.push_back(LostCommunicationOutput::End);
    }
}

impl Machine for LostCommunication {
    type Output = LostCommunicationOutput;

    fn poll_output(&mut self) -> Option<LostCommunicationOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        match self.state {
            State::Lost { since, next } => self.rungs.get(next).map(|after| since + *after),
            State::Back { at, .. } if !self.end.is_acknowledged => Some(at + self.end.stable),
            State::Back { .. } | State::New | State::Commanded => None,
        }
    }

    fn handle_timeout(&mut self, now: Instant) {
        if self.poll_timeout().is_none_or(|due| now < due) {
            return;
        }
        match &mut self.state {
            State::Lost { since, next } => {
                // Of several rungs that are due at once the last counts.
                let is_due = |after: &&Duration| now >= *since + **after;
                *next += self.rungs[*next..].iter().take_while(is_due).count();
                let entered = next.saturating_sub(1);
                self.outputs.push_back(LostCommunicationOutput::Enter(entered));
            }
            State::Back { .. } => self.finish(),
            State::New | State::Commanded => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ConditionState::{Connected, Degraded, Lost};
    use LostCommunicationOutput::{End, Enter};

    fn at(seconds: u64) -> Instant {
        Instant::from_millis(seconds * 1000)
    }

    fn ladder(is_acknowledged: bool) -> LostCommunication {
        let end = LostCommunicationEnd { stable: Duration::from_secs(5), is_acknowledged };
        let mut ladder = LostCommunication::new([1, 10, 60].map(Duration::from_secs).into(), end);
        ladder.handle(Lost, at(0));
        assert_eq!(ladder.poll_timeout(), None, "it was never there");
        ladder.handle(Degraded, at(0));
        ladder
    }

    fn outputs(ladder: &mut LostCommunication) -> Vec<LostCommunicationOutput> {
        std::iter::from_fn(|| ladder.poll_output()).collect()
    }

    #[test]
    fn rungs_come_in_their_time_and_a_short_loss_is_none() {
        let mut ladder = ladder(false);
        ladder.handle(Lost, at(100));
        ladder.handle(Connected, Instant::from_millis(100_900));
        assert_eq!((outputs(&mut ladder), ladder.poll_timeout()), (vec![], None));

        ladder.handle(Lost, at(200));
        for due in [201, 210, 260] {
            assert_eq!(ladder.poll_timeout(), Some(at(due)));
            ladder.handle_timeout(at(due));
        }
        assert_eq!(outputs(&mut ladder), [Enter(0), Enter(1), Enter(2)]);
        assert_eq!((ladder.poll_timeout(), ladder.rung()), (None, Some(2)));
    }

    #[test]
    fn the_ladder_ends_when_communication_is_stable_and_else_goes_on_from_the_first_loss() {
        let mut ladder = ladder(false);
        ladder.handle(Lost, at(0));
        ladder.handle_timeout(at(1));
        ladder.handle(Connected, at(7));
        ladder.handle_timeout(at(11));
        assert_eq!((outputs(&mut ladder), ladder.rung()), (vec![Enter(0)], Some(0)));
        assert!(ladder.is_back(), "and does not climb while it is");

        ladder.handle(Degraded, at(11));
        assert_eq!(outputs(&mut ladder), [Enter(1)], "eleven seconds after the first loss");
        ladder.handle(Connected, at(12));
        ladder.handle_timeout(at(17));
        assert_eq!((outputs(&mut ladder), ladder.rung()), (vec![End], None));
    }

    #[test]
    fn a_ladder_that_a_person_ends_waits_for_that_and_takes_no_word_while_it_is_lost() {
        let mut ladder = ladder(true);
        assert!(!ladder.handle_acknowledged(), "nothing was lost");
        ladder.handle(Lost, at(0));
        ladder.handle_timeout(at(70));
        assert_eq!(outputs(&mut ladder), [Enter(2)], "the last of those that are due");
        assert!(!ladder.handle_acknowledged());
        ladder.handle(Connected, at(80));
        assert_eq!(ladder.poll_timeout(), None);
        assert!(ladder.handle_acknowledged());
        assert_eq!(outputs(&mut ladder), [End]);
    }

    #[test]
    fn a_break_after_hours_counts_from_itself_and_skips_no_rung() {
        let mut ladder = ladder(true);
        ladder.handle(Lost, at(0));
        ladder.handle_timeout(at(1));
        ladder.handle(Connected, at(2));
        ladder.handle(Lost, at(4));
        assert_eq!(ladder.poll_timeout(), Some(at(10)), "it was not stable");
        ladder.handle(Connected, at(5));

        ladder.handle(Lost, at(7_200));
        assert_eq!(outputs(&mut ladder), [Enter(0)]);
        assert_eq!((ladder.poll_timeout(), ladder.rung()), (Some(at(7_210)), Some(0)));
        ladder.handle(Connected, at(7_201));
        assert!(ladder.handle_acknowledged());
        assert_eq!(outputs(&mut ladder), [End]);
    }
}
