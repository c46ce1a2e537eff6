//! The status of a session, for display.

use super::SessionCounters;
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
