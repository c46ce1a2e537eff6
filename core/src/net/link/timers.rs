//! When a link acts by itself.

use super::{Link, LinkState, NeighbourRecord};
use crate::Instant;
use crate::timer::Timers;

/// The timers of a link.
#[derive(Clone, Copy, Debug)]
pub(crate) enum LinkTimer {
    /// Sends the next hello, at each multiple of the hello interval (BFD and OSPF: hello timer).
    HelloTransmit,
    /// Reports once that no neighbour has proved to be there: `peer_timeout` and five hello
    /// intervals after the start.
    PeerMissing,
    /// Takes down a link whose neighbour is silent or does not receive, 2.5 hello intervals past
    /// the expected hello and its last frame; one that is not up loses its proof (BFD: detection
    /// time).
    DownDetection,
    /// Suspects a monitored link, a hello interval past the expected hello and the last
    /// frame (NFD-E: freshness point).
    SuspectDetection,
}

impl Timers for Link {
    type Timer = LinkTimer;

    const TIMERS: &'static [LinkTimer] = {
        use LinkTimer::*;
        &[HelloTransmit, PeerMissing, DownDetection, SuspectDetection]
    };

    fn due(&self, timer: LinkTimer) -> Option<Instant> {
        match timer {
            LinkTimer::HelloTransmit => Some(self.hellos.due),
            LinkTimer::PeerMissing => {
                let by = self.expected_by.filter(|_| self.state == LinkState::Connecting)?;
                // A slow medium needs its time.
                Some(by + self.hellos.interval.saturating_mul(Self::ABSENT_HELLOS))
            }
            LinkTimer::DownDetection => {
                let has_proof = |record: &NeighbourRecord| record.echoed.is_some();
                let runs = self.carries() || self.neighbour.as_ref().is_some_and(has_proof);
                self.silent_at(self.down_after_percent()).filter(|_| runs)
            }
            LinkTimer::SuspectDetection => {
                let monitored = self.state == LinkState::Up || self.is_proving();
                self.silent_at(Self::SUSPECT_AFTER_PERCENT).filter(|_| monitored)
            }
        }
    }

    fn fire(&mut self, timer: LinkTimer, now: Instant) {
        match timer {
            LinkTimer::HelloTransmit => self.say_hello(now),
            LinkTimer::PeerMissing => self.report_absence(),
            LinkTimer::DownDetection => {
                self.handle_no_carrier("the neighbour is not heard, or does not hear", now);
            }
            LinkTimer::SuspectDetection => self.suspect(now),
        }
    }
}
