//! The configuration of a host: the expected device, and how long the host waits for it.

use super::tries::Tries;
use crate::port::{Port, PortKind};
use core::time::Duration;

/// How the host of one device behaves.
///
/// `P` holds the table of ports: an array, a slice or a vector.
#[derive(Clone, Debug)]
pub struct HostConfig<P> {
    /// The device's address on a multi-drop line; `None` if it has the line, or the socket, to
    /// itself.
    pub address: Option<u8>,
    /// The type that the device must have.
    pub device_type: u32,
    /// The ports and variables that the device must have, at most 255. A device may have more. One
    /// of a slow multi-drop line whose last objects have no ports is found at the second attempt.
    pub ports: P,
    /// A random number. The sessions are numbered from here, so that a new host's session differs
    /// from those of its predecessors.
    pub session: u16,
    /// How often the device is asked for a sign of life. Shorter finds a silent device sooner and
    /// takes more of the line.
    pub interval: Duration,
    /// How many unanswered tries in a row declare the device lost.
    pub tries: Tries,
    /// After so long a silence of the host the device makes itself safe, at the latest after its
    /// own limit, which 0 stands for. Must be longer than a few intervals; rounded down to
    /// milliseconds.
    pub deadman: Duration,
    /// How long one byte is on the line: 10 bits divided by the baud rate. 0 for datagrams.
    pub byte_time: Duration,
    /// How long the device and both ends' drivers take for an answer at most, without its bytes:
    /// the longest hook, and a value that the device is just sending, included. Shorter repeats
    /// sooner after a loss. At least 1 ms is taken.
    pub turnaround: Duration,
}

impl<P> HostConfig<P> {
    /// How long a PING and its answer take at most: the slot of an idle device. The intervals of
    /// all devices of a multi-drop line must be longer than the sum of their slots.
    ///
    /// ```
    /// use blastema_lite::HostConfig;
    /// use core::time::Duration;
    /// let config = HostConfig {
    ///     address: Some(7),
    ///     device_type: 0,
    ///     ports: [blastema_lite::Port::output(1, 0, 4, 0)],
    ///     session: 1,
    ///     interval: Duration::from_millis(200),
    ///     tries: Default::default(),
    ///     deadman: Duration::from_secs(1),
    ///     byte_time: Duration::from_secs(10) / 115_200,
    ///     turnaround: Duration::from_millis(2),
    /// };
    /// assert_eq!(config.slot().as_micros(), 3649);
    /// assert_eq!((config.slot() * 32).as_millis(), 116);
    /// ```
    pub fn slot(&self) -> Duration {
        // Both have CRC-8, one byte less than others.
        self.exchange_time(1, 4) - 2 * self.byte_time
    }

    /// How long a request with so many bytes of data, and its reply, take at most.
    pub(crate) fn exchange_time(&self, out: usize, back: usize) -> Duration {
        // Header, two commands, CRC-16, code byte and delimiter.
        let around = 7 + usize::from(self.address.is_some());
        let bytes = (out + back + 2 * around) as u32;
        self.byte_time * bytes + self.turnaround.max(Duration::from_millis(1))
    }
}

impl<P: AsRef<[Port]>> HostConfig<P> {
    /// The number of objects that have ports, at least 1.
    pub(crate) fn objects(&self) -> u8 {
        self.ports.as_ref().iter().map(Port::object).max().unwrap_or(1)
    }

    /// The most events that wait for a POLL, a state of each object and a value of each out port,
    /// and the bytes of their frames.
    pub(crate) fn events(&self) -> (u8, usize) {
        // Address, header, commands, CRC and framing are 8 bytes; a state and its code 2.
        const AROUND: usize = 8;
        let outs = self.ports.as_ref().iter().filter(|port| port.kind() == PortKind::Out);
        let states = usize::from(self.objects());
        let (count, bytes) = outs.fold((states, states * (2 + AROUND)), |(count, bytes), port| {
            (count + 1, bytes + usize::from(port.size()) + AROUND)
        });
        (count.min(u8::MAX.into()) as u8, bytes)
    }
}
