//! The times and numbers of PINGs.

use crate::message;
use core::time::Duration;

/// The schedule of one device's pings.
#[derive(Clone, Copy, Debug)]
pub(super) struct PingSchedule {
    number: u8,
    next: Duration,
    forced: Duration,
}

/// A busy line hides a lost STATE event for so many intervals at most: only a PONG shows it.
const FORCED_AFTER: u32 = 10;

impl PingSchedule {
    pub(super) fn new(now: Duration) -> Self {
        PingSchedule { number: 0, next: now, forced: now }
    }

    /// When the next PING is due, if the line is free.
    pub(super) fn due(&self) -> Duration {
        self.next
    }

    /// Whether a PING goes before commands.
    pub(super) fn is_forced(&self, now: Duration) -> bool {
        now >= self.forced
    }

    /// The number of a PING that is sent now; the next one follows after the pause. A device that
    /// the host does not serve is probed.
    pub(super) fn send(&mut self, serves: bool, now: Duration, pause: Duration) -> u8 {
        self.next = now + pause;
        self.number = (self.number + 1) % message::PING_PROBE;
        self.number | if serves { 0 } else { message::PING_PROBE }
    }

    pub(super) fn handle_pong(&mut self, now: Duration, interval: Duration) {
        self.forced = now + interval * FORCED_AFTER;
    }
}
