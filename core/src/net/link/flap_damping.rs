//! When a link that was down or suspect is used again, and for which traffic.

use super::{Link, LinkState};
use crate::Instant;
use crate::net::wire::hello_state::HelloState;

impl Link {
    /// Whether the hellos of a suspect link are received again, and it is not trusted yet because
    /// of how often they were late.
    pub fn is_proving(&self) -> bool {
        self.state == LinkState::Suspect && self.proving
    }

    /// Whether it has failed so often lately that it carries only what has no other path.
    pub fn is_distrusted(&self) -> bool {
        self.state == LinkState::Suspect && self.damped
    }

    /// Raises the state after a hello, if it has proved enough.
    pub(super) fn rise(&mut self, now: Instant) {
        let Some(record) = &self.neighbour else { return };
        match self.state {
            LinkState::Up => {}
            LinkState::Suspect => {
                let late = self.silent_at(self.config.suspect_after_percent);
                if late.is_some_and(|due| due <= now) {
                    return;
                }
                self.damped &= !self.is_trusted();
                // Twice as many for each time: traffic must not come and go with every lost hello.
                if self.calm >= 1 << self.suspicions.saturating_sub(1) && !self.damped {
                    self.change(LinkState::Up, "the neighbour is heard again");
                } else if !std::mem::replace(&mut self.proving, true) {
                    self.change(LinkState::Suspect, "heard again, and not yet trusted");
                }
            }
            LinkState::Connecting | LinkState::Down => {
                if now - self.down_at > Self::FLAP_MEMORY {
                    self.flaps = 0;
                }
                if !self.has_proved() || record.stance != HelloState::Ready {
                    return;
                }
                self.damped &= !self.is_trusted();
                if self.damped {
                    self.proving = true;
                    self.change(LinkState::Suspect, "heard again, and not yet trusted");
                } else {
                    self.change(LinkState::Up, "the neighbour is heard and hears");
                }
            }
        }
    }

    /// Whether enough hellos were received in both directions.
    pub(super) fn has_proved(&self) -> bool {
        self.neighbour
            .as_ref()
            .is_some_and(|record| record.hellos_received >= self.config.up_after_hellos)
    }

    /// Whether that is so for as long as its recent failures demand.
    fn is_trusted(&self) -> bool {
        let needed = self.config.up_after_hellos << self.flaps;
        self.neighbour.as_ref().is_some_and(|record| record.hellos_received >= needed)
    }

    pub(super) fn stance(&self) -> HelloState {
        match self.state {
            LinkState::Up | LinkState::Suspect => HelloState::Ready,
            LinkState::Connecting | LinkState::Down if self.has_proved() => HelloState::Ready,
            LinkState::Connecting => HelloState::Unproved,
            LinkState::Down => HelloState::Down,
        }
    }
}
