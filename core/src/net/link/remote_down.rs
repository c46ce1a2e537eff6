//! The neighbour's report, received over another link, that it has declared this link down.
//!
//! It is an accelerator: behind a switch, the neighbour's interface may lose its carrier while ours
//! keeps it. A neighbour that has declared a link down sends no hellos on it, or hellos with state
//! `Down`. Two hellos with state `Ready` therefore refute the report.

use super::{Link, LinkState};
use crate::Instant;
use crate::net::wire::hello_state::HelloState;

/// So many hellos: one may have been in flight.
const CONTRADICTIONS: u32 = 2;

#[derive(Debug, Default)]
pub(super) struct RemoteDownNotice {
    /// How many hellos have contradicted it since; `None` where it does not count, or was not
    /// received.
    pub(super) since: Option<u32>,
    /// It was refuted lately: until then it does not count.
    disbelieved_until: Instant,
}

impl Link {
    /// The neighbour reports that it has declared the link down. The link is suspect until hellos
    /// refute that, or are missing for so long that it is down.
    pub fn handle_given_up(&mut self, now: Instant) {
        if self.carries() && !self.is_given_up() && self.given_up.disbelieved_until <= now {
            self.given_up.since = Some(0);
            self.proving = false;
            self.change(LinkState::Suspect, "the neighbour says by another way that it gave it up");
        }
    }

    /// Whether the neighbour's report counts at present. Such a link carries only what has no other
    /// path.
    pub fn is_given_up(&self) -> bool {
        self.given_up.since.is_some()
    }

    pub(super) fn hear_out(&mut self, stance: HelloState, now: Instant) {
        let Some(since) = &mut self.given_up.since else { return };
        *since += u32::from(stance == HelloState::Ready);
        if *since >= CONTRADICTIONS {
            self.given_up.since = None;
            self.given_up.disbelieved_until = now + Self::FLAP_MEMORY;
        }
    }
}
