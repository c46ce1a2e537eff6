//! Serial lines with a node at each end: RS-232, RS-422, RS-485, and USB devices that look like
//! one.
//!
//! * **Frames** are found again after any garbage ([`framing`]); a wrong speed at the other end is
//!   nothing but garbage.
//! * **A slow line** is given no more than it carries (its pace), so that what waits, waits here,
//!   where it is bounded in time and counted, and not in the system's buffers, where hellos would
//!   wait behind it: they wait for the one frame that is going out.
//! * **Unplugged**, a port reads as an end, or its writes fail: it is closed at once, which lets a
//!   USB adapter have its old name again, and opened again by its path, with back-off.
//!
//! On two wires of RS-485 the adapter must turn the line by itself, or the port's driver, which is
//! asked to by [`Rs485`]; two nodes that speak at once spoil each other's frames, which the session
//! repeats.

mod config;
mod line_pacer;

pub mod framing;

pub use self::config::{Parity, Rs485, SerialConfig, StopBits};
pub use tokio_serial::SerialStream;

use self::framing::{Deframer, encode, encoded_length};
use self::line_pacer::{DriverBacklog, LinePacer, PIECE};
use crate::frame_medium::{FrameMedium, MediumEvent, OpenedMedium, QueueLimits, SendResult};
use crate::medium_timer::MediumTimer;
use crate::usb_device::{is_usb_device, unopened};
use blastema_contract::transport::MediumAddress;
use blastema_core::Instant;
use blastema_core::medium::lane::FrameLane;
use bytes::Bytes;
use std::io;
use std::path::Path;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_serial::{ClearBuffer, DataBits, FlowControl, SerialPort};

/// A line that carries so many bytes in a second is not slow: hellos are nothing to it.
const FAST: u64 = 1_000_000;
/// So many bytes are read at once: what the system holds of a terminal.
const CHUNK: usize = 4096;
/// So many frames may wait at least: as many as a session has on its way that does not know yet how
/// slow the line is.
const LEAST_FRAMES: usize = 8;
/// The fewest bytes that are written at once: a hello, on the slowest lines.
const LEAST_PIECE: usize = 32;
/// So many bytes are written at once to a USB device that is not held to a speed.
const DEVICE_PIECE: usize = 1024;

/// A serial line as a medium.
pub struct SerialLine {
    config: SerialConfig,
    /// The clock on which this arbiter's timers run.
    now: fn() -> Instant,
    port: Option<SerialStream>,
    deframer: Deframer,
    chunk: Vec<u8>,
    /// Which part of the chunk was not looked at yet.
    unread: std::ops::Range<usize>,
    /// The frame that goes out, as it goes out, and how much of it has.
    outgoing: Vec<u8>,
    written: usize,
    pace: LinePacer,
    /// Ends when the line may have taken what was written.
    timer: MediumTimer,
}

impl SerialLine {
    /// The line at this port. The clock must be the one on which this arbiter's timers run.
    pub fn new(config: SerialConfig, now: fn() -> Instant) -> Self {
        SerialLine {
            now,
            port: None,
            deframer: Deframer::new(config.mtu()),
            chunk: vec![0; CHUNK],
            unread: 0..0,
            outgoing: Vec::new(),
            written: 0,
            pace: LinePacer::default(),
            timer: MediumTimer::default(),
            config,
        }
    }

    /// So many bytes are written at once.
    fn piece(&self) -> usize {
        match self.pace.is_free() {
            true => DEVICE_PIECE,
            false => self.config.bytes_in(PIECE).max(LEAST_PIECE),
        }
    }

    /// Ready when the line has taken nearly all that was written.
    fn poll_line(&mut self, task: &mut Context<'_>) -> Poll<()> {
        loop {
            ready!(self.timer.poll(task));
            // A port that cannot say shows by its errors soon enough what it is like.
            let queued = self.port.as_ref().and_then(|port| port.bytes_to_write().ok());
            let held = match queued.unwrap_or(0) as usize {
                0 => DriverBacklog::Nothing,
                queued if queued <= self.piece() => DriverBacklog::Little,
                _ => DriverBacklog::Much,
            };
            let now = (self.now)();
            let Some(due) = self.pace.due(held, now) else { return Poll::Ready(()) };
            self.timer = MediumTimer::after(due - now);
        }
    }
}

/// Opens the port for bytes alone, without frames: for a device that speaks a protocol of its own.
/// What the port had received before is dropped. At its end, a read returns an error or no bytes.
///
/// # Errors
/// The system refuses it; the text says what helps.
pub fn open_bytes(config: &SerialConfig) -> io::Result<SerialStream> {
    let port = open_port(config)?;
    // A pty cannot always do so, and has nothing to drop.
    let _ = port.clear(ClearBuffer::All);
    Ok(port)
}

fn open_port(config: &SerialConfig) -> io::Result<SerialStream> {
    let SerialConfig { path, parity, stop_bits, hardware_flow, rs485, .. } = config;
    let flow = if *hardware_flow { FlowControl::Hardware } else { FlowControl::None };
    let builder = tokio_serial::new(path.to_string_lossy(), config.baud())
        .data_bits(DataBits::Eight)
        .parity(*parity)
        .stop_bits(*stop_bits)
        .flow_control(flow);
    if let Some(how) = rs485 {
        turn_by_driver(path, how)?;
    }
    // The lines DTR and RTS are left as the driver sets them: a pty has none, and many a device
    // takes a change of them for a reset.
    SerialStream::open(&builder).map_err(|error| unopened(path, &error))
}

impl FrameMedium for SerialLine {
    fn name(&self) -> String {
        format!("serial {}", self.config.path.display())
    }

    fn queue(&self) -> QueueLimits {
        let least = LEAST_FRAMES * encoded_length(self.config.mtu());
        let bytes = self.config.bytes_in(self.config.queue_time).max(least);
        // Each frame costs as much as a small one, so that empty frames have a bound too.
        QueueLimits { frames: bytes.div_ceil(16), bytes }
    }

    fn bytes_per_second(&self) -> Option<u64> {
        let one_way = self.config.bytes_in(Duration::from_secs(1)) as u64;
        Some(2 * one_way).filter(|rate| *rate < FAST)
    }

    fn open(&mut self) -> io::Result<OpenedMedium> {
        self.close();
        self.port = Some(open_port(&self.config)?);
        if self.config.baud.is_none() && is_usb_device(&self.config.path) {
            self.pace = LinePacer::of_device();
        }
        Ok(OpenedMedium { local: MediumAddress::Line, mtu: self.config.mtu() })
    }

    fn knows(&self, address: &MediumAddress) -> bool {
        *address == MediumAddress::Line
    }

    fn poll_capacity(&mut self, task: &mut Context<'_>) -> Poll<()> {
        self.poll_line(task)
    }

    fn poll_send(
        &mut self,
        task: &mut Context<'_>,
        _: &MediumAddress,
        frame: &Bytes,
        _: FrameLane,
    ) -> Poll<io::Result<SendResult>> {
        if self.outgoing.is_empty() {
            encode(frame, &mut self.outgoing);
            self.written = 0;
        }
        let piece = self.piece();
        while self.written < self.outgoing.len() {
            ready!(self.poll_line(task));
            let Some(port) = &mut self.port else { return Poll::Ready(Err(unplugged())) };
            let end = self.outgoing.len().min(self.written + piece);
            let rest = &self.outgoing[self.written..end];
            match ready!(Pin::new(port).poll_write(task, rest)).map_err(lost)? {
                0 => return Poll::Ready(Err(unplugged())),
                written => {
                    self.written += written;
                    self.pace.spend(self.config.time_of(written), (self.now)());
                }
            }
        }
        self.outgoing.clear();
        Poll::Ready(Ok(SendResult::Sent))
    }

    fn poll_receive(&mut self, task: &mut Context<'_>) -> Poll<io::Result<MediumEvent>> {
        loop {
            let mut unread = &self.chunk[self.unread.clone()];
            let found = self.deframer.push(&mut unread);
            self.unread.start = self.unread.end - unread.len();
            match found {
                Some(Ok(frame)) => {
                    let from = MediumAddress::Line;
                    return Poll::Ready(Ok(MediumEvent::Frame { from, frame }));
                }
                Some(Err(_)) => return Poll::Ready(Ok(MediumEvent::Refused)),
                None => {}
            }
            let Some(port) = &mut self.port else { return Poll::Ready(Err(unplugged())) };
            let mut buffer = ReadBuf::new(&mut self.chunk);
            ready!(Pin::new(port).poll_read(task, &mut buffer)).map_err(lost)?;
            self.unread = 0..buffer.filled().len();
            if self.unread.is_empty() {
                // A port that was unplugged reads so for ever.
                return Poll::Ready(Err(unplugged()));
            }
        }
    }

    fn close(&mut self) {
        if let Some(port) = self.port.take()
            && self.config.hardware_flow
        {
            // The system would wait half a minute for a peer that has stopped us to take the rest.
            let _ = port.clear(ClearBuffer::Output);
        }
        self.deframer = Deframer::new(self.config.mtu());
        self.unread = 0..0;
        self.outgoing.clear();
        (self.pace, self.timer) = (LinePacer::default(), MediumTimer::default());
    }
}

/// Lets the port's driver turn the line for as long as something goes out. It keeps that when the
/// port is closed, so that it can be said before the port is opened as a line.
#[cfg(target_os = "linux")]
fn turn_by_driver(path: &Path, rs485: &Rs485) -> io::Result<()> {
    if ![rs485.before, rs485.after].into_iter().all(Rs485::is_whole) {
        return Err(io::Error::other(Rs485::WHOLE));
    }
    // Whatever keeps it from being opened is told when it is opened as a line.
    let Ok(port) = serial2::SerialPort::open(path, serial2::KeepSettings) else { return Ok(()) };
    let mut mode = serial2::rs4xx::Rs485Config::new();
    mode.set_invert_rts(rs485.rts_low);
    mode.set_delay_before_send(rs485.before);
    mode.set_delay_after_send(rs485.after);
    port.set_rs4xx_mode(mode).map_err(|error| {
        io::Error::other(format!(
            "{error}: the port's driver does not turn the line of RS-485 (rs485=true): leave that out, and \
             use an adapter that turns by itself"
        ))
    })
}

#[cfg(not(target_os = "linux"))]
fn turn_by_driver(_: &Path, _: &Rs485) -> io::Result<()> {
    Err(io::Error::other(
        "only Linux lets a driver turn the line of RS-485 (rs485=true): leave that out, and use an adapter \
         that turns by itself",
    ))
}

/// What helps when a port reads or writes no more.
const CURE: &str = "it was unplugged, or the other program at its end is gone: plug it in again";

fn unplugged() -> io::Error {
    io::Error::new(io::ErrorKind::UnexpectedEof, CURE)
}

fn lost(error: io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{error}: {CURE}"))
}
