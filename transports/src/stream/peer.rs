//! One peer, and how the connection with it stands.

use super::connection::{Connection, DisconnectReason, ReadEnd, ReadStep};
use super::outgoing::StreamSendQueue;
use super::{HandshakeFuture, StreamFamily};
use crate::medium::PollBudget;
use crate::medium_timer::MediumTimer;
use crate::upstream::Upstream;
use blastema_core::recovery::Backoff;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::task::{self, Poll};
use std::time::Duration;

/// The limit is how late a peer that is back, and does not dial us itself, may be noticed. With
/// jitter, so that many who lost the same peer do not come back as one.
const BACKOFF: Backoff = Backoff {
    first: Duration::from_millis(20),
    factor: 2,
    limit: Duration::from_secs(1),
    jitter_percent: 10,
};

/// A peer, known by the address at which it listens.
pub(super) struct StreamPeer<F: StreamFamily> {
    pub(super) address: F::Address,
    pub(super) state: ConnectionState<F::Stream>,
    pub(super) outgoing: StreamSendQueue,
    failures: u32,
}

/// ```text
///          frame             kept                broken
/// Absent ─────────► Dialing ───────► Connected ─────────┐
///    ▲                 │ failed                         ▼
///    └─────────────────┴────────── pause over ─────── Backoff
/// ```
/// A connection that the peer makes leads to `Connected` from anywhere.
pub(super) enum ConnectionState<S> {
    /// The next frame dials.
    Absent,
    /// A connection is being made; frames wait for it.
    Dialing(HandshakeFuture<S>),
    /// The connection is open and carries frames.
    Connected(Connection<S>),
    /// It failed or broke a moment ago; frames are dropped.
    Backoff(MediumTimer),
}

impl<F: StreamFamily> StreamPeer<F> {
    pub(super) fn new(address: F::Address) -> Self {
        StreamPeer {
            address,
            state: ConnectionState::Absent,
            outgoing: StreamSendQueue::default(),
            failures: 0,
        }
    }

    pub(super) fn is_connected(&self) -> bool {
        matches!(self.state, ConnectionState::Connected(_))
    }

    /// Whether frames flow over the connection that the receiver knew under this number.
    pub(super) fn has_adopted(&self, number: u32) -> bool {
        matches!(&self.state, ConnectionState::Connected(own) if own.number == Some(number))
    }

    /// Whether nothing is lost when its place is given to another.
    pub(super) fn is_dispensable(&self) -> bool {
        matches!(self.state, ConnectionState::Absent | ConnectionState::Backoff(_))
    }

    /// Frames flow over this connection from now on, beginning with a whole one.
    pub(super) fn connect(&mut self, stream: F::Stream) {
        self.outgoing.rewind();
        self.use_connection(Connection::new(stream, None));
    }

    /// Frames flow over this connection from now on, after those that wait for it already.
    pub(super) fn adopt(&mut self, connection: Connection<F::Stream>, waiting: StreamSendQueue) {
        self.outgoing.follow(waiting);
        self.use_connection(connection);
    }

    fn use_connection(&mut self, connection: Connection<F::Stream>) {
        self.failures = 0;
        self.state = ConnectionState::Connected(connection);
    }

    /// The connection failed or broke: a pause begins, twice as long after each failure. The answer
    /// is how many frames are lost with it.
    pub(super) fn rest(&mut self) -> u64 {
        self.failures = self.failures.saturating_add(1);
        // It differs between peers.
        let mut seed = DefaultHasher::new();
        self.address.hash(&mut seed);
        let pause = BACKOFF.delay(self.failures.saturating_add(1), seed.finish());
        self.state = ConnectionState::Backoff(MediumTimer::after(pause));
        self.outgoing.clear()
    }

    /// Looks whether a connection is made, or a pause is over.
    pub(super) fn poll_progress(&mut self, task: &mut task::Context<'_>) -> io::Result<()> {
        match &mut self.state {
            ConnectionState::Dialing(dial) => match dial.as_mut().poll(task) {
                Poll::Ready(stream) => {
                    self.connect(stream?);
                    Ok(())
                }
                Poll::Pending => Ok(()),
            },
            ConnectionState::Backoff(pause) => {
                if pause.poll(task).is_ready() {
                    self.state = ConnectionState::Absent;
                }
                Ok(())
            }
            ConnectionState::Absent | ConnectionState::Connected(_) => Ok(()),
        }
    }

    /// Writes what waits, as far as the kernel takes it.
    pub(super) fn write(
        &mut self,
        task: &mut task::Context<'_>,
        upstream: &mut Upstream,
    ) -> Result<(), DisconnectReason> {
        if let ConnectionState::Connected(connection) = &mut self.state {
            upstream.counters.sent += connection.write(&mut self.outgoing, task)?;
        }
        Ok(())
    }

    /// Reads frames, up to the budget.
    pub(super) fn read(
        &mut self,
        task: &mut task::Context<'_>,
        limit: usize,
        upstream: &mut Upstream,
    ) -> Result<ReadEnd, DisconnectReason> {
        let ConnectionState::Connected(connection) = &mut self.state else {
            return Ok(ReadEnd::Done);
        };
        let mut budget = PollBudget::default();
        while budget.next() {
            if upstream.poll_capacity(task).is_pending() {
                return Ok(ReadEnd::Full);
            }
            match connection.read(limit, task)? {
                ReadStep::Nothing => return Ok(ReadEnd::Done),
                ReadStep::Part => {}
                ReadStep::Frame(frame) => {
                    budget.spend(frame.len());
                    upstream.deliver(self.address.clone().into(), frame);
                }
            }
        }
        Ok(ReadEnd::Budget)
    }
}
