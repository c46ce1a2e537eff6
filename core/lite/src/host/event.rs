//! Events that a host reports.

use super::matching::Mismatch;
use crate::message::{DeviceState, ResetCause, Status};

/// An event that the host reports to its driver, the proxy of the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HostEvent {
    /// The device has entered a session. The states of its objects can be read.
    Greeted(DeviceIdentity),
    /// The contract is the expected one: commands, values and pings flow. The proxy restores
    /// variables, period and life cycle of a new incarnation.
    Serving,
    /// The device is not the expected one. No data flow until it starts again.
    Refused(Mismatch),
    /// The device did not answer, or the line is closed. Values of the device are stale. Reported
    /// once until the next [`Greeted`](HostEvent::Greeted).
    Lost,
    /// The outstanding command has ended. The data of a reply are in
    /// [`payload`](crate::Host::payload).
    Done(CommandOutcome),
    /// An object went into Error by itself, for the reason of this code.
    State {
        /// The object, from 1.
        object: u8,
        /// Its new state; on a multi-drop line that of now, which a RESET may have changed.
        state: DeviceState,
        /// The firmware's code, or one of the `CODE_` constants of [`message`](crate::message).
        code: u8,
    },
    /// An out port has a new value; it is in [`payload`](crate::Host::payload).
    Data {
        /// The index of the port.
        port: usize,
    },
    /// The device had another sequence: a reply before this one was accepted wrongly. A new
    /// session is opened.
    OutOfStep,
}

/// How a command ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CommandOutcome {
    /// The device has answered: the command was carried out exactly once, or refused for the
    /// reason of the status.
    Replied(Status),
    /// It never left the host.
    NotSent,
    /// The device was reset, was lost, or fell out of step while the command was outstanding: it
    /// was carried out once or not at all. The host never repeats it in another session.
    Unknown,
}

/// What a device reports when it enters a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceIdentity {
    /// How often the chip has started; 0 or a random number if it cannot count.
    pub boot: u16,
    /// Why it started.
    pub cause: ResetCause,
    /// The device's type, as its firmware declares it.
    pub device_type: u32,
    /// The most data bytes of its packets.
    pub data_max: u8,
    /// The number of its objects.
    pub objects: u8,
    /// Whether the chip was reset since this host knew it: it is a new incarnation.
    pub reset: bool,
    /// Whether the dead-man has expired since the last session: objects that were Active are in Error.
    /// Their [`State`](HostEvent::State) events are lost, unless they waited for a POLL.
    pub deadman: bool,
}

impl DeviceIdentity {
    /// Reads the reply to HELLO behind its first byte; returns the states as well.
    pub(super) fn from_reply(reply: &[u8]) -> Option<(Self, &[u8])> {
        let &[b0, b1, cause, t0, t1, t2, t3, data_max, objects, ref states @ ..] = reply else {
            return None;
        };
        let identity = DeviceIdentity {
            boot: u16::from_le_bytes([b0, b1]),
            cause: ResetCause::from_byte(cause).unwrap_or(ResetCause::Unknown),
            device_type: u32::from_le_bytes([t0, t1, t2, t3]),
            data_max,
            objects,
            reset: false,
            deadman: false,
        };
        (states.len() == usize::from(objects)).then_some((identity, states))
    }
}

/// The events that the driver has not taken yet.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct EventQueue([Option<HostEvent>; EVENTS_MAX]);

/// One input causes at most two events, such as a loss and the outcome of a command.
const EVENTS_MAX: usize = 4;

impl EventQueue {
    pub(super) fn push(&mut self, event: HostEvent) {
        let free = self.0.iter_mut().find(|place| place.is_none());
        debug_assert!(free.is_some(), "the driver takes all events after each input");
        if let Some(place) = free {
            *place = Some(event);
        }
    }

    pub(super) fn pop(&mut self) -> Option<HostEvent> {
        let first = self.0[0].take();
        self.0.rotate_left(1);
        first
    }
}
