//! Whether a link that was down, or late, is used again, and how far it is relied on.

use super::{Link, LinkState};
use crate::Instant;
use crate::net::wire::hello_state::HelloState;

impl Link {
    /// Whether a link that is suspect is heard again, and only for how often it was not is not
    /// trusted.
    pub fn is_proving(&self) -> bool {
        self.state == LinkState::Suspect && self.proving
    }

    /// Whether it has failed too often lately to be more than the last resort.
    pub fn is_distrusted(&self) -> bool {
        self.state == LinkState::Suspect && self.damped
    }

    /// A hello was heard: does it lift the state?
    pub(super) fn rise(&mut self, now: Instant) {
        let Some(heard) = &self.neighbour else { return };
        match self.state {
            LinkState::Up => {}
            LinkState::Suspect => {
                let late = self.silent_at(self.config.suspect_after_percent);
                if self.is_given_up() || late.is_some_and(|due| due <= now) {
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
                if now - self.last_down > Self::FLAP_MEMORY {
                    self.flaps = 0;
                }
                if !self.has_proved() || heard.stance != HelloState::Ready {
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

    /// It carries both ways.
    pub(super) fn has_proved(&self) -> bool {
        self.neighbour
            .as_ref()
            .is_some_and(|heard| heard.hellos_received >= self.config.up_after_hellos)
    }

    /// For as long as is asked of one that has failed so often lately.
    fn is_trusted(&self) -> bool {
        let needed = self.config.up_after_hellos << self.flaps;
        self.neighbour.as_ref().is_some_and(|heard| heard.hellos_received >= needed)
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
