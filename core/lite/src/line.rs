//! The devices of one serial line: the host gives the turns.
//!
//! ```text
//! host ─► device 1 ─► host ─► device 2 ─► host ─► …        time ─►
//!   PING 1      PONG     command      reply
//! ```
//!
//! A device of a multi-drop line speaks only in answer to its address. One exchange is a turn; a
//! missing answer costs its slot only. A device with the line to itself also speaks by itself.

use crate::cobs::{self, CobsDecoder, FRAME_MAX};
use crate::host::{Host, HostEvent};
use crate::packet::PACKET_MAX;
use crate::port::Port;
use core::time::Duration;

/// Drives the hosts of one serial line.
///
/// The driver owns the hosts and gives them to each call, always in the same order: one host
/// without an address, or several with different addresses. When the line has failed, the driver
/// calls [`Host::handle_line_closed`] of each, and opens it again with a new `HostLine`.
///
/// # Examples
///
/// The whole driver of a line. `read` waits for a millisecond at most. `clock` is monotonic.
///
/// ```no_run
/// use blastema_lite::{CommandOutcome, DeviceCommand, FRAME_MAX, Host, HostEvent, HostLine, Port};
/// use std::io::{Read, Write};
/// use std::time::Duration;
///
/// /// `values` are the newest structs of in ports, by host and port.
/// fn drive(
///     hosts: &mut [Host<Vec<Port>>],
///     values: &[Vec<Vec<u8>>],
///     mut serial: impl Read + Write,
///     clock: impl Fn() -> Duration,
/// ) -> std::io::Result<()> {
///     let (mut line, mut buffer, mut frame) = (HostLine::default(), [0; 256], [0; FRAME_MAX]);
///     loop {
///         let count = serial.read(&mut buffer)?;
///         let mut bytes = &buffer[..count];
///         while !bytes.is_empty() {
///             line.handle_bytes(hosts, &mut bytes, clock());
///             take_events(&mut line, hosts);
///         }
///         line.handle_timeout(hosts, clock());
///         take_events(&mut line, hosts);
///         // Here the application gives commands, and announces values by `handle_publish`.
///         let value = |host: usize, port: usize, value: &mut [u8]| {
///             value.copy_from_slice(&values[host][port]);
///         };
///         while let Some(frame) = line.poll_frame(hosts, clock(), value, &mut frame) {
///             serial.write_all(frame)?;
///         }
///     }
/// }
///
/// fn take_events(line: &mut HostLine, hosts: &mut [Host<Vec<Port>>]) {
///     while let Some((host, event)) = line.poll_event(hosts) {
///         match event {
///             HostEvent::Data { port } => println!("{port}: {:?}", hosts[host].payload()),
///             HostEvent::Done(CommandOutcome::Replied(status)) => println!("{status:?}"),
///             HostEvent::State { object, code, .. } => {
///                 let command = DeviceCommand::Text(object, code);
///                 let _ = hosts[host].handle_command(command); // unless another is outstanding
///             }
///             other => println!("{other:?}"),
///         }
///     }
/// }
/// ```
#[derive(Clone, Debug, Default)]
pub struct HostLine {
    decoder: CobsDecoder,
    /// The host that had the last turn.
    turn: usize,
    /// When the line has carried all frames.
    free: Duration,
}

impl HostLine {
    /// Takes received bytes up to the end of the first packet, and leaves the others in `bytes`.
    /// The driver calls it, and takes all events, until no bytes are left.
    pub fn handle_bytes<P: AsRef<[Port]>>(
        &mut self,
        hosts: &mut [Host<P>],
        bytes: &mut &[u8],
        now: Duration,
    ) {
        while let [byte, rest @ ..] = *bytes {
            *bytes = rest;
            let Some(packet) = self.decoder.push(*byte) else { continue };
            // Without an address the line has one host.
            let addressee = |host: &Host<P>| {
                host.config().address.is_none_or(|address| packet.first() == Some(&address))
            };
            let Some(at) = hosts.iter().position(addressee) else { continue };
            return hosts[at].handle_packet(packet, now);
        }
    }

    /// Lets the hosts act on everything that is due.
    pub fn handle_timeout<P: AsRef<[Port]>>(&mut self, hosts: &mut [Host<P>], now: Duration) {
        hosts.iter_mut().for_each(|host| host.handle_timeout(now));
    }

    /// When `handle_timeout`, and a poll for a frame, are due at the latest.
    pub fn poll_timeout<P: AsRef<[Port]>>(&self, hosts: &[Host<P>]) -> Option<Duration> {
        // While one device has the turn, the others wait.
        let waiting = hosts.iter().find(|host| host.is_waiting());
        let waiting = waiting.map(Host::poll_timeout);
        waiting.or_else(|| hosts.iter().map(Host::poll_timeout).min())
    }

    /// The next event, with the index of its host.
    pub fn poll_event<P: AsRef<[Port]>>(
        &mut self,
        hosts: &mut [Host<P>],
    ) -> Option<(usize, HostEvent)> {
        hosts.iter_mut().enumerate().find_map(|(at, host)| Some((at, host.poll_event()?)))
    }

    /// Writes the next frame into `frame` and returns it; `None` when there is none to send now.
    /// `values` writes the newest struct of an in port of a host into the slice. A driver whose
    /// line is full does not poll: the newest values wait in the host.
    pub fn poll_frame<'f, P: AsRef<[Port]>>(
        &mut self,
        hosts: &mut [Host<P>],
        now: Duration,
        mut values: impl FnMut(usize, usize, &mut [u8]),
        frame: &'f mut [u8; FRAME_MAX],
    ) -> Option<&'f [u8]> {
        let taken = |host: &Host<P>| host.config().address.is_some() && host.is_waiting();
        if hosts.iter().any(taken) {
            return None;
        }
        let mut bytes = [0; PACKET_MAX];
        for step in 1..=hosts.len() {
            let at = (self.turn + step) % hosts.len();
            let value = |port, value: &mut [u8]| values(at, port, value);
            // A request behind other frames waits for its answer from when it leaves. A line that
            // carries less than is sent does not delay the detection of silence without a bound.
            let start = self.free.min(now + hosts[at].config().interval).max(now);
            if let Some(packet) = hosts[at].poll_packet(start, value, &mut bytes) {
                let frame = cobs::encode(packet, frame);
                self.turn = at;
                self.free = start + hosts[at].config().byte_time * frame.len() as u32;
                return Some(frame);
            }
        }
        None
    }
}
