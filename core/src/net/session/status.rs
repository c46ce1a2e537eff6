//! The status of a session, for display.

use super::{Session, SessionCounters, State};
use crate::Incarnation;
use crate::net::wire::Refusals;
use std::fmt;
use std::time::Duration;

/// Where the dealings with a peer stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SessionState {
    /// No session is open, and none can be: no path leads to the peer.
    Away,
    /// A path leads there, and each says who it is.
    Opening,
    /// Messages go to and fro. Where the path has gone meanwhile, the session waits for another for
    /// two seconds.
    Open,
    /// This node ends in order; what was sent is still being delivered.
    Closing,
    /// This node has ended in order, and opens no more.
    Closed,
}

impl fmt::Display for SessionState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            SessionState::Away => "away",
            SessionState::Opening => "opening",
            SessionState::Open => "open",
            SessionState::Closing => "closing",
            SessionState::Closed => "closed",
        })
    }
}

/// A session at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionStatus {
    /// Where it stands.
    pub state: SessionState,
    /// Which of the peer's incarnations it is with; `None` while there is none open.
    pub incarnation: Option<Incarnation>,
    /// The smoothed round trip.
    pub round_trip: Option<Duration>,
    /// Messages of the ordered streams that the peer has not acknowledged, sent or waiting.
    pub unacknowledged: usize,
    /// Parts of messages that are on their way and not believed lost.
    pub in_flight: usize,
    /// How many bytes may be on their way at present: fewer while they stand in queues and after a
    /// loss, more while all goes well.
    pub window: usize,
    /// How long what is sent waits in queues on its way, as far as is known.
    pub queueing: Option<Duration>,
    /// What it did so far.
    pub counters: SessionCounters,
    /// What was refused so far.
    pub refusals: Refusals,
}

impl Session {
    /// The peer's incarnation that the present session is with.
    pub fn peer(&self) -> Option<Incarnation> {
        match self.state {
            State::Open { peer } | State::Closing { peer, .. } => Some(peer.incarnation),
            _ => None,
        }
    }

    /// We ended in order; nothing is left to do.
    pub fn is_closed(&self) -> bool {
        self.state == State::Closed
    }

    /// The smoothed round trip to the peer.
    pub fn round_trip(&self) -> Option<Duration> {
        self.streams.iter().find_map(|stream| stream.rtt.smoothed())
    }

    /// What it did so far.
    pub fn counters(&self) -> SessionCounters {
        let unfinished = self.pieces.given_up + self.datagrams.inbound.unfinished();
        SessionCounters {
            incomplete: self.counters.incomplete + unfinished,
            replaced: self.counters.replaced + self.datagrams.outbound.replaced,
            ..self.counters
        }
    }

    /// What was refused so far.
    pub fn refusals(&self) -> Refusals {
        self.refusals
    }

    /// How it stands now.
    pub fn status(&self) -> SessionStatus {
        let state = match self.state {
            State::Idle => SessionState::Away,
            State::Opening { .. } if self.path.mtu.is_none() => SessionState::Away,
            State::Opening { .. } => SessionState::Opening,
            State::Open { .. } => SessionState::Open,
            State::Closing { .. } => SessionState::Closing,
            State::Closed => SessionState::Closed,
        };
        let held = self.streams.iter().map(|stream| stream.outbound.messages());
        let parts = self.streams.iter().map(|stream| stream.outbound.flying());
        SessionStatus {
            state,
            incarnation: self.peer(),
            round_trip: self.round_trip(),
            unacknowledged: held.sum(),
            in_flight: parts.sum::<usize>() + self.datagrams.outbound.flying().0,
            window: self.path.congestion.window(),
            queueing: self.path.congestion.queueing(),
            counters: self.counters(),
            refusals: self.refusals(),
        }
    }
}
