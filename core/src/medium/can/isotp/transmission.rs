//! One message on its way out.
//!
//! ```text
//!                    frame taken, more to come        pause over
//!          ┌────────────────────────────────► Paced ──────────────┐
//!          │                                                      ▼
//!  new ► Ready ── first frame or end of block taken ──► Asking ─► Ready … Ended
//!                                                  │ "go on"
//!                                     "wait" ◄─────┘
//! ```

use super::config::{IsoTpConfig, TIMEOUT};
use super::pdu::{FlowControl, FlowStatus, PduWriter, SeparationTime};
use crate::Instant;
use crate::medium::can::CanFrame;
use bytes::Bytes;
use std::time::Duration;

/// The least time between frames to all nodes, which do not say how fast they are: more than a
/// classic frame takes on a bus of 250 kbit/s, so that no receiver's buffer overflows.
const SEPARATION_TO_ALL: Duration = Duration::from_micros(500);
/// How often in a row a receiver may let us wait (N_WFTmax): no sender waits for ever.
const WAITS_MAX: u8 = 10;

/// Why a message did not go out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TransmissionError {
    /// The receiver did not say how to go on: it is not there, or hangs.
    #[error("the receiver does not answer")]
    Unanswered,
    /// The receiver has no room for so long a message. Send less, or raise its limit.
    #[error("the receiver takes no message of this length")]
    Overflow,
    /// The receiver has told us to wait too often.
    #[error("the receiver tells us to wait for ever")]
    WaitedTooLong,
    /// The bus took no frame for too long: no other node is on it, or it is off.
    #[error("the bus takes no frames")]
    BusStuck,
}

/// Whether the receiver controls the flow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum TargetType {
    /// One receiver, who does.
    One,
    /// All nodes, of whom none may.
    All,
}

/// A message that is being sent.
#[derive(Debug)]
pub(super) struct Transmission {
    message: Bytes,
    sent: usize,
    sequence: u8,
    target: TargetType,
    /// How many frames may go out until the next word; `None` for any number.
    left_in_block: Option<u8>,
    separation: Duration,
    state: State,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// A frame is to go out, as soon as the bus takes it.
    Ready { until: Instant },
    /// The next frame is not due yet.
    Paced { at: Instant },
    /// The receiver is to say how to go on.
    Asking { until: Instant, waits: u8 },
    /// It is over.
    Ended(Result<(), TransmissionError>),
}

impl Transmission {
    pub(super) fn new(message: Bytes, target: TargetType, now: Instant) -> Self {
        Transmission {
            message,
            sent: 0,
            sequence: 0,
            target,
            left_in_block: None,
            separation: SEPARATION_TO_ALL,
            state: State::Ready { until: now + TIMEOUT },
        }
    }

    /// How it ended, once it has.
    pub(super) fn ended(&self) -> Option<Result<(), TransmissionError>> {
        match self.state {
            State::Ended(result) => Some(result),
            _ => None,
        }
    }

    /// The receiver says how to go on. The answer is whether it was asked.
    pub(super) fn handle_flow(&mut self, flow: FlowControl, now: Instant) -> bool {
        let State::Asking { waits, .. } = self.state else { return false };
        self.state = match flow.status {
            FlowStatus::Continue => {
                self.left_in_block = (flow.block_size != 0).then_some(flow.block_size);
                self.separation = flow.separation.span();
                State::Ready { until: now + TIMEOUT }
            }
            FlowStatus::Wait if waits >= WAITS_MAX => {
                State::Ended(Err(TransmissionError::WaitedTooLong))
            }
            FlowStatus::Wait => State::Asking { until: now + TIMEOUT, waits: waits + 1 },
            FlowStatus::Overflow => State::Ended(Err(TransmissionError::Overflow)),
        };
        true
    }

    /// Whether a frame is to go out now.
    pub(super) fn is_ready(&self) -> bool {
        matches!(self.state, State::Ready { .. })
    }

    /// The next frame, if one is to go out now. It counts as sent.
    pub(super) fn poll_frame(&mut self, writer: &PduWriter, now: Instant) -> Option<CanFrame> {
        if !self.is_ready() {
            return None;
        }
        let rest = &self.message[self.sent..];
        let begins = self.sent == 0;
        let (frame, taken) = if !begins {
            writer.consecutive(self.sequence, rest)
        } else if rest.len() <= writer.single_max() {
            (writer.single(rest), rest.len())
        } else {
            writer.first(rest)
        };
        self.sent += taken;
        self.sequence = (self.sequence + 1) & 0x0f;
        if let Some(left) = self.left_in_block.as_mut().filter(|_| !begins) {
            *left -= 1;
        }
        let asks = begins && self.target == TargetType::One || self.left_in_block == Some(0);
        self.state = if self.sent == self.message.len() {
            State::Ended(Ok(()))
        } else if asks {
            State::Asking { until: now + TIMEOUT, waits: 0 }
        } else if self.separation.is_zero() {
            State::Ready { until: now + TIMEOUT }
        } else {
            State::Paced { at: now + self.separation }
        };
        Some(frame)
    }

    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        match self.state {
            State::Ready { until } | State::Asking { until, .. } => Some(until),
            State::Paced { at } => Some(at),
            State::Ended(_) => None,
        }
    }

    pub(super) fn handle_timeout(&mut self, now: Instant) {
        match self.state {
            State::Ready { until } if until <= now => {
                self.state = State::Ended(Err(TransmissionError::BusStuck));
            }
            State::Asking { until, .. } if until <= now => {
                self.state = State::Ended(Err(TransmissionError::Unanswered));
            }
            State::Paced { at } if at <= now => {
                self.state = State::Ready { until: now + TIMEOUT };
            }
            _ => {}
        }
    }
}

impl FlowControl {
    /// The word of this kind, with what we ask for.
    pub(super) fn ours(status: FlowStatus, config: &IsoTpConfig) -> Self {
        match status {
            FlowStatus::Continue => {
                FlowControl { status, block_size: config.block_size, separation: config.separation }
            }
            _ => FlowControl { status, block_size: 0, separation: SeparationTime(0) },
        }
    }
}

#[cfg(test)]
mod tests;
