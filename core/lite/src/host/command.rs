//! Commands: carried out once, and answered.

use crate::message::{self, LifecycleChange};
use crate::packet::DATA_MAX;
use crate::port::{Port, PortKind};

/// A command to a device. Ports are indices of [`HostConfig::ports`](crate::HostConfig::ports), objects count from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceCommand<'a> {
    /// Changes the life-cycle state. The reply's payload is the new state.
    Change(u8, LifecycleChange),
    /// Starts the context of the device, in which `on_execute` runs.
    Start(u8),
    /// Stops the context.
    Stop(u8),
    /// Sets the context's period in milliseconds.
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
    /// The device is not serving; the command can be given after [`HostEvent::Serving`](crate::HostEvent::Serving).
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

/// A command that waits for its reply; its data are kept beside it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Outstanding {
    pub(super) object: u8,
    pub(super) message: u8,
    /// Bytes of its data.
    pub(super) length: usize,
    /// The fewest and most bytes of the reply's payload if all is well.
    pub(super) reply: (usize, usize),
    /// How often it was sent in vain.
    pub(super) misses: u32,
    pub(super) sent: bool,
}

impl DeviceCommand<'_> {
    /// Writes the command's data.
    pub(super) fn encode(
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
