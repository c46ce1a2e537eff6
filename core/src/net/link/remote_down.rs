//! The neighbour's word, by another way, that it has given the link up.
//!
//! It is an accelerator: its interface has lost its carrier and ours has not, where a switch stands
//! between. A neighbour that has declared a link down sends that, or nothing, on the link itself.
//! So hellos that come all the same and say that it is ready show that the word was a mistake, or a
//! lie.

use super::{Link, LinkState};
use crate::Instant;
use crate::net::wire::hello_state::HelloState;

/// So many hellos: one may have been on its way.
const CONTRADICTIONS: u32 = 2;

#[derive(Debug, Default)]
pub(super) struct RemoteDownNotice {
    /// How many hellos have contradicted it since; `None` where it does not count, or was never
    /// said.
    pub(super) since: Option<u32>,
    /// It was contradicted lately: until then it does not count.
    disbelieved_until: Instant,
}

impl Link {
    /// The neighbour is said to have given the link up. It is suspect until hellos say the
    /// contrary, or are missing for so long that it is down.
    pub fn handle_given_up(&mut self, now: Instant) {
        if self.carries() && !self.is_given_up() && self.given_up.disbelieved_until <= now {
            self.given_up.since = Some(0);
            self.proving = false;
            self.change(LinkState::Suspect, "the neighbour says by another way that it gave it up");
        }
    }

    /// Whether the neighbour's word counts at present. Such a link is the last that should be used.
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
