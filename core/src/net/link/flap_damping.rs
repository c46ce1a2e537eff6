//! How often a link has failed lately, and what it must prove before it is trusted again.

use crate::Instant;
use std::time::Duration;

/// A link that stayed up for so long has proved itself; earlier failures are forgotten.
const MEMORY: Duration = Duration::from_secs(10);
/// 16 times the usual proof at most, so that a repaired link comes back within seconds.
const FLAPS_MAX: u32 = 4;

/// The recent failures of a link.
#[derive(Debug, Default)]
pub(super) struct FlapDamping {
    flaps: RecentCount,
    suspicions: RecentCount,
    /// Hellos since the last suspicion, less two for each that was missing.
    calm: u32,
    /// It is suspect although hellos are received again.
    pub(super) proving: bool,
    /// It has failed since it was trusted last. It carries only what has no other path until it has
    /// proved itself as often as it has failed lately.
    pub(super) damped: bool,
}

/// How often something happened without a pause of [`MEMORY`], and when last.
#[derive(Debug, Default)]
struct RecentCount {
    count: u32,
    last_at: Instant,
}

impl RecentCount {
    fn add(&mut self, max: u32, now: Instant) {
        self.expire(now);
        *self = RecentCount { count: (self.count + 1).min(max), last_at: now };
    }

    fn expire(&mut self, now: Instant) {
        if now - self.last_at > MEMORY {
            self.count = 0;
        }
    }
}

impl FlapDamping {
    /// The link goes down.
    pub(super) fn handle_down(&mut self, now: Instant) {
        self.flaps.add(FLAPS_MAX, now);
        self.damped = true;
    }

    /// A hello is late.
    pub(super) fn handle_suspicion(&mut self, now: Instant) {
        self.suspicions.add(FLAPS_MAX + 1, now);
        (self.calm, self.proving) = (0, false);
    }

    pub(super) fn handle_hello(&mut self, missed: u32) {
        self.calm = super::after(self.calm, missed);
    }

    /// Forgets how often the link went down, once that was long ago.
    pub(super) fn expire_flaps(&mut self, now: Instant) {
        self.flaps.expire(now);
    }

    /// The link went down because an incarnation ended, which is no flap of the medium.
    pub(super) fn forget_flaps(&mut self) {
        self.flaps.count = 0;
    }

    /// So many hellos were received in both directions, of which `usual` bring a new link up.
    /// Returns whether the link is still damped.
    pub(super) fn judge(&mut self, hellos_received: u32, usual: u32) -> bool {
        self.damped &= hellos_received < usual << self.flaps.count;
        self.damped
    }

    /// Whether enough hellos came since the last suspicion: twice as many for each time, so that
    /// traffic does not come and go with every lost hello.
    pub(super) fn is_calm(&self) -> bool {
        self.calm >= 1 << self.suspicions.count.saturating_sub(1)
    }
}
