//! One message on its way in.
//!
//! ```text
//!        first                   "go on" taken               last frame
//! Idle ─────────► Answering ───────────────────► Receiving ─────────────► Idle
//!                     ▲                              │ end of block
//!                     └──────────────────────────────┘
//! ```

use super::config::{IsoTpConfig, TIMEOUT};
use super::pdu::{FlowControl, FlowStatus, PduWriter};
use super::transmission::TargetType;
use crate::Instant;
use crate::medium::can::CanFrame;
use bytes::{Bytes, BytesMut};

/// Why a message did not come in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ReceptionError {
    /// The sender began another message before this one was whole.
    #[error("the sender began another message before this one was whole")]
    Interrupted,
    /// A frame is missing, or came twice.
    #[error("frame {expected} of the message is due, {found} came")]
    Sequence {
        /// Counted in 16s.
        expected: u8,
        /// Counted in 16s.
        found: u8,
    },
    /// The next frame did not come.
    #[error("the sender fell silent before the message was whole")]
    Silent,
    /// More is announced than the limit allows.
    #[error("a message of {length} bytes is too long")]
    TooLong {
        /// The announced length, in bytes.
        length: u32,
    },
    /// Too many messages are under way to us.
    #[error("too many messages arrive at one time")]
    TooMany,
    /// The bus did not take our word on how to go on.
    #[error("the bus takes no frames")]
    BusStuck,
    /// A frame that is not the first, of a message that did not begin, or out of turn.
    #[error("a frame of no message")]
    Unexpected,
    /// A frame that is shorter than those before it, and not the last.
    #[error("a frame that is too short")]
    ShortFrame,
}

/// What a frame led to.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct FrameResult {
    /// A message that will not come in any more, or a frame that belongs to none.
    pub(super) failed: Option<ReceptionError>,
    /// A message that is whole.
    pub(super) message: Option<Bytes>,
}

impl FrameResult {
    fn failure(error: ReceptionError) -> Self {
        FrameResult { failed: Some(error), message: None }
    }
}

/// What bears on a reception.
#[derive(Clone, Copy)]
pub(super) struct ReceptionContext<'a> {
    pub(super) config: &'a IsoTpConfig,
    pub(super) now: Instant,
}

/// What comes from one source.
#[derive(Debug)]
pub(super) struct Reception {
    target: TargetType,
    state: State,
}

#[derive(Debug)]
enum State {
    /// No message is on its way.
    Idle,
    /// Our word is to go out.
    Answering { partial: Partial, until: Instant },
    /// A refusal is to go out.
    Refusing { until: Instant },
    /// The next part of the message is to come.
    Receiving { partial: Partial, left_in_block: Option<u8>, until: Instant },
}

/// What is there of a message.
#[derive(Debug)]
struct Partial {
    bytes: BytesMut,
    length: usize,
    /// How long its frames are.
    frame: usize,
    sequence: u8,
}

impl Reception {
    pub(super) fn new(target: TargetType) -> Self {
        Reception { target, state: State::Idle }
    }

    /// Whether nothing is under way.
    pub(super) fn is_idle(&self) -> bool {
        matches!(self.state, State::Idle)
    }

    /// A whole message.
    pub(super) fn handle_single(&mut self, data: &[u8]) -> FrameResult {
        let failed = self.interrupt();
        FrameResult { failed, message: Some(Bytes::copy_from_slice(data)) }
    }

    /// The beginning of a message. `admitted` is whether there is a place for it.
    pub(super) fn handle_first(
        &mut self,
        length: u32,
        data: &[u8],
        admitted: bool,
        context: ReceptionContext<'_>,
    ) -> FrameResult {
        let ReceptionContext { config, now } = context;
        let interrupted = self.interrupt();
        let whole = length as usize;
        if whole > config.message_max || !admitted {
            if self.target == TargetType::One {
                self.state = State::Refusing { until: now + TIMEOUT };
            }
            let long = whole > config.message_max;
            let error =
                if long { ReceptionError::TooLong { length } } else { ReceptionError::TooMany };
            return FrameResult::failure(error);
        }
        let mut bytes = BytesMut::with_capacity(whole);
        bytes.extend_from_slice(data);
        // The header of a first frame is two bytes, or six where the length needs them.
        let header = if whole > super::pdu::SHORT_LENGTH_MAX { 6 } else { 2 };
        let partial = Partial { bytes, length: whole, frame: data.len() + header, sequence: 1 };
        self.state = match self.target {
            TargetType::One => answer(partial, context),
            TargetType::All => {
                let until = now + TIMEOUT;
                State::Receiving { partial, left_in_block: None, until }
            }
        };
        FrameResult { failed: interrupted, message: None }
    }

    /// More of a message.
    pub(super) fn handle_consecutive(
        &mut self,
        sequence: u8,
        data: &[u8],
        context: ReceptionContext<'_>,
    ) -> FrameResult {
        let (mut partial, left_in_block) = match std::mem::replace(&mut self.state, State::Idle) {
            State::Receiving { partial, left_in_block, .. } => (partial, left_in_block),
            // No sender was told to go on. What is under way goes on when he is.
            other => {
                self.state = other;
                return FrameResult::failure(ReceptionError::Unexpected);
            }
        };
        let expected = partial.sequence;
        if sequence != expected {
            return FrameResult::failure(ReceptionError::Sequence { expected, found: sequence });
        }
        let missing = partial.length - partial.bytes.len();
        if data.len() < missing && data.len() + 1 < partial.frame {
            return FrameResult::failure(ReceptionError::ShortFrame);
        }
        partial.bytes.extend_from_slice(&data[..data.len().min(missing)]);
        partial.sequence = (expected + 1) & 0x0f;
        if partial.bytes.len() == partial.length {
            return FrameResult { failed: None, message: Some(partial.bytes.freeze()) };
        }
        let left_in_block = left_in_block.map(|left| left - 1);
        self.state = if left_in_block == Some(0) {
            answer(partial, context)
        } else {
            State::Receiving { partial, left_in_block, until: context.now + TIMEOUT }
        };
        FrameResult::default()
    }

    /// Whether a frame is to go out.
    pub(super) fn is_ready(&self) -> bool {
        matches!(self.state, State::Answering { .. } | State::Refusing { .. })
    }

    /// Our word to the sender, if one is to go out now. It counts as sent.
    pub(super) fn poll_frame(
        &mut self,
        writer: &PduWriter,
        context: ReceptionContext<'_>,
    ) -> Option<CanFrame> {
        let ReceptionContext { config, now } = context;
        let (status, next) = match std::mem::replace(&mut self.state, State::Idle) {
            State::Refusing { .. } => (FlowStatus::Overflow, State::Idle),
            State::Answering { partial, .. } => {
                let left_in_block = (config.block_size != 0).then_some(config.block_size);
                let until = now + TIMEOUT;
                (FlowStatus::Continue, State::Receiving { partial, left_in_block, until })
            }
            other => {
                self.state = other;
                return None;
            }
        };
        self.state = next;
        Some(writer.flow(FlowControl::ours(status, config)))
    }

    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        match &self.state {
            State::Idle => None,
            State::Answering { until, .. }
            | State::Refusing { until }
            | State::Receiving { until, .. } => Some(*until),
        }
    }

    /// Gives up what takes too long.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> Option<ReceptionError> {
        if self.poll_timeout().is_none_or(|due| due > now) {
            return None;
        }
        match std::mem::replace(&mut self.state, State::Idle) {
            State::Idle => None,
            State::Answering { .. } | State::Refusing { .. } => Some(ReceptionError::BusStuck),
            State::Receiving { .. } => Some(ReceptionError::Silent),
        }
    }

    fn interrupt(&mut self) -> Option<ReceptionError> {
        match std::mem::replace(&mut self.state, State::Idle) {
            State::Idle | State::Refusing { .. } => None,
            State::Answering { .. } | State::Receiving { .. } => Some(ReceptionError::Interrupted),
        }
    }
}

fn answer(partial: Partial, context: ReceptionContext<'_>) -> State {
    State::Answering { partial, until: context.now + TIMEOUT }
}

#[cfg(test)]
mod tests;
