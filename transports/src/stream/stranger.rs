//! A connection that another node has made, and that is no peer's yet.

use super::connection::{Connection, DisconnectReason, ReadEnd, ReadStep};
use super::outgoing::{StreamSendQueue, WaitingFrame};
use super::{HandshakeFuture, StreamFamily};
use crate::medium::PollBudget;
use crate::upstream::Upstream;
use blastema_contract::transport::MediumAddress;
use std::pin::Pin;
use std::sync::Arc;
use std::task;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::Sleep;

/// The largest frame of a handshake, in bytes.
const FRAME_LIMIT: usize = 128;
/// So many frames are read before the receiver must know who sends them.
const FRAMES: u8 = 16;
/// So much waits to go out in each lane: the receiver's part of a handshake.
const QUEUE_BYTES: usize = 4 * 1024;

/// ```text
///              said where             adopted
/// Greeting ───────────────► Unproven ─────────► a peer's
///     └──────── too late, or not ours ───┴────► closed
/// ```
pub(super) enum Stranger<F: StreamFamily> {
    /// It is to say where it listens.
    Greeting(Greeting<F>),
    /// It is to prove to the receiver who it is.
    Unproven(UnprovenConnection<F::Stream>),
}

/// A connection whose other end is to say where it listens.
pub(super) struct Greeting<F: StreamFamily> {
    pub(super) origin: F::Origin,
    pub(super) said: HandshakeFuture<(F::Stream, F::Address)>,
}

/// A connection whose other end has said where it listens, which proves nothing.
///
/// Beyond its first frames, and beyond a frame that is larger than those of a handshake, nothing is
/// read: a peer that has proven itself to the receiver may send what it likes, before the receiver
/// has told us whom it knows there.
pub(super) struct UnprovenConnection<S> {
    number: u32,
    address: MediumAddress,
    connection: Connection<S>,
    outgoing: StreamSendQueue,
    frames_left: u8,
    timeout: Pin<Box<Sleep>>,
}

impl<F: StreamFamily> Stranger<F> {
    /// Gives the connection up; the answer is how many frames wait to go out on it.
    pub(super) fn abandon(self) -> u64 {
        match self {
            Stranger::Greeting(_) => 0,
            Stranger::Unproven(mut unproven) => unproven.clear(),
        }
    }

    /// The connection, if it is unproven and has this number.
    pub(super) fn numbered(&mut self, number: u32) -> Option<&mut UnprovenConnection<F::Stream>> {
        match self {
            Stranger::Unproven(unproven) if unproven.number == number => Some(unproven),
            _ => None,
        }
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> UnprovenConnection<S> {
    pub(super) fn new(number: u32, claimed: MediumAddress, stream: S, timeout: Duration) -> Self {
        UnprovenConnection {
            number,
            address: MediumAddress::Connection { number, claimed: Arc::new(claimed) },
            connection: Connection::new(stream, Some(number)),
            outgoing: StreamSendQueue::default(),
            frames_left: FRAMES,
            timeout: Box::pin(tokio::time::sleep(timeout)),
        }
    }

    /// The connection, and what waits to go out on it.
    pub(super) fn into_parts(self) -> (Connection<S>, StreamSendQueue) {
        (self.connection, self.outgoing)
    }

    /// Throws away what waits to go out; the answer is how many frames that were.
    pub(super) fn clear(&mut self) -> u64 {
        self.outgoing.clear()
    }

    /// Takes a frame, unless too much waits.
    pub(super) fn push(&mut self, waiting: WaitingFrame) -> bool {
        self.outgoing.push(waiting, QUEUE_BYTES)
    }

    /// Writes what waits, and looks whether it has taken too long.
    pub(super) fn poll(
        &mut self,
        task: &mut task::Context<'_>,
        upstream: &mut Upstream,
    ) -> Result<(), DisconnectReason> {
        if self.timeout.as_mut().poll(task).is_ready() {
            return Err(DisconnectReason::Refused);
        }
        upstream.counters.sent += self.connection.write(&mut self.outgoing, task)?;
        Ok(())
    }

    /// Reads frames, up to the budget that all unproven connections share.
    pub(super) fn read(
        &mut self,
        task: &mut task::Context<'_>,
        mtu: usize,
        budget: &mut PollBudget,
        upstream: &mut Upstream,
    ) -> Result<ReadEnd, DisconnectReason> {
        while self.frames_left > 0 {
            match self.connection.announced() {
                Some(length) if length > mtu => return Err(DisconnectReason::Refused),
                Some(length) if length > FRAME_LIMIT => break,
                Some(_) | None => {}
            }
            if budget.is_spent() {
                return Ok(ReadEnd::Budget);
            }
            if upstream.poll_capacity(task).is_pending() {
                return Ok(ReadEnd::Full);
            }
            match self.connection.read(FRAME_LIMIT, task)? {
                ReadStep::Nothing => break,
                ReadStep::Part => {}
                ReadStep::Frame(frame) => {
                    self.frames_left -= 1;
                    upstream.deliver(self.address.clone(), frame);
                }
            }
            // One that says nothing uses nothing up: it keeps none from being heard.
            budget.next();
        }
        Ok(ReadEnd::Done)
    }
}
