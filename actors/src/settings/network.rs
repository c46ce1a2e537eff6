//! The settings of a node's networks.

use super::{HOUR, Setting};
use blastema_core::net::session::IDLE_TIMEOUT;
use blastema_core::net::{HELLO_INTERVAL_RANGE, PEER_TIMEOUT};
use std::time::Duration;

/// A link is declared down after 175 ms, and what a session holds for a peer that does not come
/// back within an hour is of no use to it.
pub(crate) const SESSION_TIMEOUT: Setting<Duration> = Setting {
    name: "session_timeout",
    default: IDLE_TIMEOUT,
    range: Duration::from_millis(200)..=HOUR,
    cure: "write 200 ms to an hour, or leave it out for 2 s",
};

/// More hellos are taken for an attack by the neighbour, and a link must be known to be down
/// within a minute.
pub(crate) const HELLO_INTERVAL: Setting<Duration> = Setting {
    name: "hello_every",
    default: blastema_core::net::HELLO_INTERVAL,
    range: HELLO_INTERVAL_RANGE,
    cure: "write 1 ms to 15 s",
};

/// A neighbour that has not come by then is a fault; [`Duration::MAX`] is for one that need not.
pub(crate) const EXPECTED_WITHIN: Setting<Duration> = Setting {
    name: "expected_within",
    default: PEER_TIMEOUT,
    range: Duration::ZERO..=Duration::MAX,
    cure: "give it the time of some hellos, or no end if it need not come",
};
