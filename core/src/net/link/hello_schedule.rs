//! When a link sends its hellos, and under which numbers.

use super::HELLO_INTERVAL_RANGE;
use crate::Instant;
use crate::net::wire::frame::Hello;
use std::collections::VecDeque;
use std::time::Duration;

/// The hellos of this end.
#[derive(Debug)]
pub(super) struct HelloSchedule {
    /// As configured, or as long as the medium and its other links need.
    pub(super) interval: Duration,
    pub(super) due: Instant,
    /// How late this node was run when a timer fired last.
    pub(super) late: Duration,
    /// The latest ones, for the round trip: number and time.
    sent: VecDeque<(u32, Instant)>,
}

impl HelloSchedule {
    /// Remembered hellos: enough for round trips of so many intervals.
    const SENT_MAX: usize = 64;

    pub(super) fn new(configured: Duration, now: Instant) -> Self {
        let interval = configured.max(*HELLO_INTERVAL_RANGE.start());
        let (late, sent) = (Duration::ZERO, VecDeque::with_capacity(Self::SENT_MAX));
        HelloSchedule { interval, due: now, late, sent }
    }

    /// Returns whether that changes the interval. Hellos are numbered by it: echoes of the old
    /// numbers say nothing then.
    pub(super) fn set_interval(&mut self, interval: Duration) -> bool {
        let changed = std::mem::replace(&mut self.interval, interval) != interval;
        if changed {
            self.sent.clear();
        }
        changed
    }

    /// The number of the hello that is sent now, by an absolute schedule, so that a late one does
    /// not shift the later ones. Numbers are counted from the clock's origin, so that they also
    /// rise when this machine is rebuilt in a running process.
    pub(super) fn advance(&mut self, now: Instant) -> u32 {
        let nanos = self.interval.as_nanos() as u64;
        let number = now.as_nanos() / nanos;
        self.due = Instant::from_nanos((number + 1).saturating_mul(nanos));
        number as u32
    }

    pub(super) fn handle_sent(&mut self, sequence: u32, now: Instant) {
        if self.sent.len() == Self::SENT_MAX {
            self.sent.pop_front();
        }
        self.sent.push_back((sequence, now));
    }

    pub(super) fn sent_at(&self, sequence: u32) -> Option<Instant> {
        self.sent.iter().find(|(sent, _)| *sent == sequence).map(|(_, at)| *at)
    }

    /// How many hellos between the last one and this one were not sent.
    pub(super) fn skipped(&self, sequence: u32) -> u8 {
        let last = self.sent.back().map_or(sequence, |(last, _)| *last);
        let skipped = sequence.wrapping_sub(last).saturating_sub(1);
        skipped.min(Hello::SKIPPED_MAX.into()) as u8
    }
}
