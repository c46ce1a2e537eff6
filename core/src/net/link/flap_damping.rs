//! What a link that has failed must prove before it is trusted again.

use crate::Instant;
use std::time::Duration;

/// A failure so long ago is forgotten.
const MEMORY: Duration = Duration::from_secs(10);
/// The longest hold-down, in hellos, so that a repaired link comes back within seconds.
const HOLD_DOWN_MAX: u32 = 48;

/// The hold-down of a link, twice as long after each failure (route flap damping, RFC 2439): it
/// carries only what has no other path meanwhile.
#[derive(Debug, Default)]
pub(super) struct FlapDamping {
    /// So many hellos must come after a failure.
    hold_down: u32,
    failed_at: Instant,
    /// Hellos since then, less two for each that was missing.
    calm: u32,
    /// It is suspect although hellos are received again.
    pub(super) proving: bool,
}

impl FlapDamping {
    /// A hello is late, or the link goes down. Both without a hello in between are one failure. So
    /// many hellos must come at least.
    pub(super) fn handle_failure(&mut self, least: u32, now: Instant) {
        let before = if now - self.failed_at > MEMORY { 0 } else { self.hold_down };
        let longer = if self.calm == 0 { before } else { before * 2 };
        self.hold_down = longer.min(HOLD_DOWN_MAX).max(least);
        (self.failed_at, self.calm, self.proving) = (now, 0, false);
    }

    pub(super) fn handle_hello(&mut self, missed: u32) {
        self.calm = super::after(self.calm, missed);
    }

    /// The link has failed because an incarnation ended, which says nothing of the medium.
    pub(super) fn forget(&mut self) {
        self.hold_down = 0;
    }

    /// Whether enough hellos came since the last failure.
    pub(super) fn is_over(&self, now: Instant) -> bool {
        self.calm >= self.hold_down || now - self.failed_at > MEMORY
    }
}
