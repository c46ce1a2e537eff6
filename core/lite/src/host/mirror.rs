//! The last reports of a device.

use super::event::DeviceIdentity;
use crate::message::{self, DeviceState};
use crate::packet::OBJECTS_MAX;

/// Identity, states and fault count of a device, as it last reported them.
#[derive(Clone, Debug)]
pub(super) struct Mirror {
    identity: Option<DeviceIdentity>,
    reset_seen: bool,
    deadman_seen: bool,
    states: [Option<DeviceState>; OBJECTS_MAX],
    /// The fault count that the next PONG shows if no STATE event was lost.
    faults: u8,
}

impl Mirror {
    pub(super) fn new() -> Self {
        let states = [None; OBJECTS_MAX];
        Mirror { identity: None, reset_seen: false, deadman_seen: false, states, faults: 0 }
    }

    pub(super) fn identity(&self) -> Option<DeviceIdentity> {
        self.identity
    }

    pub(super) fn state(&self, object: u8) -> Option<DeviceState> {
        *self.states.get(usize::from(object).checked_sub(1)?)?
    }

    pub(super) fn note_state(&mut self, object: u8, state: u8) -> Option<DeviceState> {
        let known = self.states.get_mut(usize::from(object).checked_sub(1)?)?;
        *known = DeviceState::from_byte(state);
        *known
    }

    /// Takes a STATE event, which reports one fault.
    pub(super) fn handle_state(&mut self, object: u8, state: u8) -> Option<DeviceState> {
        let state = self.note_state(object, state)?;
        self.faults = (self.faults + 1) % 16;
        Some(state)
    }

    /// Takes what a PONG shows; returns whether a STATE event was lost, if all have been reported.
    pub(super) fn handle_pong(&mut self, boot: u8, flags: u8, all_reported: bool) -> bool {
        if let Some(identity) = self.identity {
            // A boot count that repeats, with a lost session, is a reset as well.
            let has_session = flags & message::FLAG_SESSION != 0;
            self.reset_seen |= !has_session || boot != identity.boot.to_le_bytes()[0];
        }
        self.deadman_seen |= flags & message::FLAG_DEADMAN != 0;
        all_reported && core::mem::replace(&mut self.faults, flags >> 4) != flags >> 4
    }

    /// Takes the reply to HELLO; returns the identity with what PONGs have shown.
    pub(super) fn handle_hello(
        &mut self,
        mut identity: DeviceIdentity,
        states: &[u8],
    ) -> DeviceIdentity {
        let rebooted = self.identity.is_some_and(|known| known.boot != identity.boot);
        identity.reset = core::mem::take(&mut self.reset_seen) || rebooted;
        identity.deadman = core::mem::take(&mut self.deadman_seen);
        self.identity = Some(identity);
        self.states = [None; OBJECTS_MAX];
        for (object, state) in (1..).zip(states) {
            self.note_state(object, *state);
        }
        identity
    }
}
