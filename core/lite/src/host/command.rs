//! Commands: carried out once, and answered.

use super::event::CommandOutcome;
use crate::message::{self, LifecycleChange, Status};
use crate::packet::{DATA_MAX, DevicePacket};
use crate::port::{Port, PortKind};

/// A command to a device. Ports are indices of [`HostConfig::ports`](crate::HostConfig::ports),
/// objects count from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceCommand<'a> {
    /// Changes the life-cycle state. The reply's payload is the new state.
    Change(u8, LifecycleChange),
    /// Starts the context of the device, in which `on_execute` runs.
    Start(u8),
    /// Stops the context.
    Stop(u8),
    /// Sets the context's period in milliseconds. The device takes 0 for 1, and more than
    /// [`PERIOD_MAX_MS`](message::PERIOD_MAX_MS) for that.
    Rate(u8, u16),
    /// Asks an object for the text of a code. The payload is UTF-8, unless the chip's is not.
    Text(u8, u8),
    /// Sets an in port or a variable to this struct.
    Write(usize, &'a [u8]),
    /// Reads an out port or a variable. The payload is the struct.
    Read(usize),
    /// Calls an operation with these arguments. The payload is the result.
    Call(usize, &'a [u8]),
}

/// Why a command was not accepted. It was not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CommandError {
    /// The device is not serving; the command can be given after
    /// [`HostEvent::Serving`](crate::HostEvent::Serving).
    NotServing,
    /// Another command is outstanding; wait for its [`HostEvent::Done`](crate::HostEvent::Done).
    Busy,
    /// No port has this index, or it does not take this command.
    NoSuchPort,
    /// The struct has another size than the port.
    WrongLength,
}

impl core::fmt::Display for CommandError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            CommandError::NotServing => "the device does not serve",
            CommandError::Busy => "another command of this device is outstanding",
            CommandError::NoSuchPort => "the port does not take this command",
            CommandError::WrongLength => "the struct has another size than the port",
        })
    }
}

impl core::error::Error for CommandError {}

/// The place of the outstanding command.
#[derive(Clone, Debug)]
pub(super) struct CommandSlot {
    /// The sequence of the last command.
    sequence: u8,
    outstanding: Option<Outstanding>,
    data: [u8; DATA_MAX],
}

#[derive(Clone, Copy, Debug)]
struct Outstanding {
    object: u8,
    message: u8,
    /// Bytes of its data.
    length: usize,
    /// The fewest and most bytes of the reply's payload if all is well.
    reply: (usize, usize),
    /// How often it was sent without a reply.
    misses: u32,
    sent: bool,
}

impl CommandSlot {
    pub(super) fn new() -> Self {
        CommandSlot { sequence: 0, outstanding: None, data: [0; DATA_MAX] }
    }

    pub(super) fn is_taken(&self) -> bool {
        self.outstanding.is_some()
    }

    pub(super) fn accept(
        &mut self,
        command: DeviceCommand<'_>,
        ports: &[Port],
    ) -> Result<(), CommandError> {
        if self.is_taken() {
            return Err(CommandError::Busy);
        }
        self.outstanding = Some(command.encode(ports, &mut self.data)?);
        self.sequence = (self.sequence + 1) % 8;
        Ok(())
    }

    /// The command as a packet from the host, and the most bytes of its reply's data.
    pub(super) fn send(&mut self, address: Option<u8>) -> Option<(DevicePacket<'_>, usize)> {
        let command = self.outstanding.as_mut()?;
        command.sent = true;
        let packet = DevicePacket {
            sequence: Some(self.sequence),
            object: command.object,
            message: command.message,
            data: &self.data[..command.length],
            ..DevicePacket::to_device(address)
        };
        Some((packet, 1 + command.reply.1))
    }

    /// Notes that no reply came; returns how often by now.
    pub(super) fn miss(&mut self) -> u32 {
        self.outstanding.as_mut().map_or(0, |command| {
            command.misses += 1;
            command.misses
        })
    }

    /// Takes a reply apart, if it is the command's and exactly as long as it must be.
    pub(super) fn reply<'r>(&self, packet: &DevicePacket<'r>) -> Option<(Status, &'r [u8])> {
        let command = self.outstanding?;
        let (status, payload) = packet.data.split_first()?;
        let status = Status::from_byte(*status)?;
        let is_change = (message::LIFECYCLE..message::START).contains(&command.message);
        let (least, most) = match status {
            Status::Well => command.reply,
            Status::WrongState | Status::HookFailed if is_change => (1, 1),
            _ => (0, 0),
        };
        let names = (packet.sequence, packet.object, packet.message);
        let is_own = names == (Some(self.sequence), command.object, command.message);
        (is_own && (least..=most).contains(&payload.len())).then_some((status, payload))
    }

    /// Ends the command after its reply.
    pub(super) fn finish(&mut self) {
        self.outstanding = None;
    }

    /// Ends the session; returns the outcome of a command that was outstanding.
    pub(super) fn end_session(&mut self) -> Option<CommandOutcome> {
        self.sequence = 0;
        let sent = self.outstanding.take()?.sent;
        Some(if sent { CommandOutcome::Unknown } else { CommandOutcome::NotSent })
    }
}

impl DeviceCommand<'_> {
    /// Writes the command's data.
    fn encode(
        &self,
        ports: &[Port],
        data: &mut [u8; DATA_MAX],
    ) -> Result<Outstanding, CommandError> {
        let named = |index: usize, kinds: &[PortKind]| {
            let port = ports.get(index).filter(|port| kinds.contains(&port.kind()));
            port.copied().ok_or(CommandError::NoSuchPort)
        };
        let rate;
        let (object, message, bytes, reply) = match self {
            DeviceCommand::Change(object, change) => {
                (*object, message::LIFECYCLE + *change as u8, &[][..], (1, 1))
            }
            DeviceCommand::Start(object) => (*object, message::START, &[][..], (0, 0)),
            DeviceCommand::Stop(object) => (*object, message::STOP, &[][..], (0, 0)),
            DeviceCommand::Rate(object, period_ms) => {
                rate = period_ms.to_le_bytes();
                (*object, message::RATE, &rate[..], (0, 0))
            }
            DeviceCommand::Text(object, code) => {
                (*object, message::TEXT, core::slice::from_ref(code), (0, message::TEXT_MAX))
            }
            DeviceCommand::Write(index, bytes) => {
                let port = named(*index, &[PortKind::In, PortKind::Variable])?;
                (port.object(), port.id(), sized(bytes, port)?, (0, 0))
            }
            DeviceCommand::Call(index, bytes) => {
                let port = named(*index, &[PortKind::Call])?;
                let result = usize::from(port.reply());
                (port.object(), port.id(), sized(bytes, port)?, (result, result))
            }
            DeviceCommand::Read(index) => {
                let port = named(*index, &[PortKind::Out, PortKind::Variable])?;
                // Bit 5 is set in the ids of out ports already.
                let size = usize::from(port.size());
                (port.object(), port.id() | message::GET_BIT, &[][..], (size, size))
            }
        };
        data[..bytes.len()].copy_from_slice(bytes);
        Ok(Outstanding { object, message, length: bytes.len(), reply, misses: 0, sent: false })
    }
}

fn sized(bytes: &[u8], port: Port) -> Result<&[u8], CommandError> {
    let fits = bytes.len() == usize::from(port.size());
    if fits { Ok(bytes) } else { Err(CommandError::WrongLength) }
}
