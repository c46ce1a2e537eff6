//! CAN adapters on a serial port that speak SLCAN, after Lawicel's CAN232.
//!
//! * The adapter is brought onto the bus step by step, whether it answers or not; one that an ended
//!   program left open is closed first.
//! * It is given frames no faster than the bus carries them, so that its memory, whose size is not
//!   known, does not overflow; nor faster than its own line does, so that little waits in the
//!   system.
//! * Unplugged, the port is closed at once and opened again by its path, with back-off.

use crate::can_node::{CanNode, CanPort};
use crate::endpoint::SlcanConfig;
use crate::medium_timer::MediumTimer;
use crate::usb_device::{is_usb_device, unopened};
use blastema_core::Instant;
use blastema_core::medium::can::slcan::{
    AdapterCommand, AdapterControl, AdapterReply, BitRate, DataRate, ReplyParser,
};
use blastema_core::medium::can::{CanFrame, Format};
use std::collections::VecDeque;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_serial::{SerialPort, SerialStream};

/// So many bytes are read at once: what the system holds of a terminal.
const CHUNK: usize = 4096;
/// So many bytes may wait in the system before an adapter whose line is slower than the bus: what
/// is urgent waits behind them.
const HELD_MAX: u32 = 128;
/// How soon it is looked again whether they have gone.
const LOOK: Duration = Duration::from_millis(1);

/// A CAN adapter as a medium.
///
/// ```no_run
/// use blastema_transports::{FrameTransport, SlcanBus, SlcanConfig};
/// # fn now() -> blastema_core::Instant { panic!() }
/// let mut config = SlcanConfig::new("/dev/ttyACM0");
/// (config.bitrate, config.node.address) = (250_000, 3);
/// let transport = FrameTransport::new(SlcanBus::new(config, now));
/// ```
pub type SlcanBus = CanNode<SlcanAdapter>;

impl SlcanBus {
    /// The bus at this adapter. The clock must be the one on which this arbiter's timers run.
    pub fn new(config: SlcanConfig, now: fn() -> Instant) -> Self {
        let node = config.node.clone();
        let format =
            if config.fd { Format::Fd { fast: config.bit_rate_switch } } else { Format::Classic };
        CanNode::over(SlcanAdapter { config, line: None }, node, format, now)
    }
}

/// An adapter at a serial port.
pub struct SlcanAdapter {
    config: SlcanConfig,
    line: Option<Line>,
}

/// A port that is open, and what is known of the adapter there.
struct Line {
    port: SerialStream,
    control: AdapterControl,
    listener: ReplyParser,
    chunk: Vec<u8>,
    unread: VecDeque<u8>,
    /// What is on its way to the adapter.
    outgoing: VecDeque<u8>,
    /// How many lines, and frames, had been refused when that was last looked at.
    refused: u64,
    timer: MediumTimer,
    /// Whether the system says how many bytes wait for the line.
    counts: bool,
    /// Until it is looked again.
    look: MediumTimer,
}

impl CanPort for SlcanAdapter {
    fn name(&self) -> String {
        format!("slcan {}", self.config.path.display())
    }

    fn bitrate(&self) -> u32 {
        self.config.bitrate
    }

    fn open(&mut self, _: Instant) -> io::Result<()> {
        let hz = self.config.bitrate;
        let rate = BitRate::of(hz).ok_or_else(|| {
            let text = format!("adapters know no bus of {hz} bit/s: choose 10, 20, 50, 100, 125, 250, 500, 800 or 1000 kbit/s");
            io::Error::other(text)
        })?;
        let data_rate = match (self.config.fd, self.config.data_bitrate) {
            (false, _) => None,
            (true, 2_000_000) => Some(DataRate::TwoMegabit),
            (true, 5_000_000) => Some(DataRate::FiveMegabit),
            (true, hz) => {
                let text = format!(
                    "adapters know no CAN FD at {hz} bit/s for its data: choose 2 or 5 Mbit/s, or \
                     leave fd out"
                );
                return Err(io::Error::other(text));
            }
        };
        let builder = tokio_serial::new(self.config.path.to_string_lossy(), self.config.baud);
        let port = SerialStream::open(&builder);
        let port = port.map_err(|error| unopened(&self.config.path, &error))?;
        self.line = Some(Line {
            port,
            control: AdapterControl::new(rate, data_rate),
            listener: ReplyParser::default(),
            chunk: vec![0; CHUNK],
            unread: VecDeque::new(),
            // Whatever an ended program left half said comes to its end.
            outgoing: b"\r\r\r".iter().copied().collect(),
            refused: 0,
            timer: MediumTimer::default(),
            counts: !is_usb_device(&self.config.path),
            look: MediumTimer::default(),
        });
        Ok(())
    }

    fn poll_ready(&mut self, task: &mut Context<'_>, now: Instant) -> Poll<io::Result<()>> {
        let Some(line) = &mut self.line else { return Poll::Ready(Err(unplugged())) };
        loop {
            // What others say on the bus before we are on it is not for us.
            while line.receive()?.is_some() {}
            if line.carry_on(task, now)? {
                return Poll::Ready(Ok(()));
            }
            ready!(line.poll_read(task))?;
        }
    }

    fn poll_write(
        &mut self,
        task: &mut Context<'_>,
        frame: &CanFrame,
        now: Instant,
    ) -> Poll<io::Result<()>> {
        let Some(line) = &mut self.line else { return Poll::Ready(Err(unplugged())) };
        ready!(line.poll_flush(task))?;
        ready!(line.poll_drained(task));
        match line.control.takes(now) {
            Ok(()) => {}
            Err(Some(then)) => {
                ready!(line.timer.poll_at(then, now, task));
            }
            Err(None) => return Poll::Ready(Err(unplugged())),
        }
        line.say(&AdapterCommand::Send(*frame));
        line.control.handle_sent(frame, now);
        // The frame is taken: what the port has no room for now goes out before the next.
        match line.poll_flush(task) {
            Poll::Ready(Err(error)) => Poll::Ready(Err(error)),
            Poll::Ready(Ok(())) | Poll::Pending => Poll::Ready(Ok(())),
        }
    }

    fn poll_read(&mut self, task: &mut Context<'_>) -> Poll<io::Result<Option<CanFrame>>> {
        let Some(line) = &mut self.line else { return Poll::Ready(Err(unplugged())) };
        // What the port had no room for a while ago.
        if let Poll::Ready(flushed) = line.poll_flush(task) {
            flushed?;
        }
        loop {
            if let Some(found) = line.receive()? {
                return Poll::Ready(Ok(found));
            }
            ready!(line.poll_read(task))?;
        }
    }

    fn close(&mut self) {
        if let Some(mut line) = self.line.take() {
            // The adapter leaves the bus, if it can be told so without waiting.
            line.outgoing.clear();
            line.say(&AdapterCommand::Close);
            let (bytes, _) = line.outgoing.as_slices();
            let _ = line.port.try_write(bytes);
        }
    }
}

impl Line {
    fn say(&mut self, command: &AdapterCommand) {
        let mut text = Vec::new();
        command.encode(&mut text);
        self.outgoing.extend(text);
    }

    fn poll_flush(&mut self, task: &mut Context<'_>) -> Poll<io::Result<()>> {
        while !self.outgoing.is_empty() {
            let bytes = self.outgoing.make_contiguous();
            match ready!(Pin::new(&mut self.port).poll_write(task, bytes))? {
                0 => return Poll::Ready(Err(unplugged())),
                written => drop(self.outgoing.drain(..written)),
            }
        }
        Poll::Ready(Ok(()))
    }

    /// Ready when little waits in the system.
    fn poll_drained(&mut self, task: &mut Context<'_>) -> Poll<()> {
        loop {
            ready!(self.look.poll(task));
            // A port that cannot say shows by its errors soon enough what it is like.
            let held = || self.port.bytes_to_write().unwrap_or(0);
            if !self.counts || held() <= HELD_MAX {
                return Poll::Ready(());
            }
            self.look = MediumTimer::after(LOOK);
        }
    }

    /// Reads what the port has.
    fn poll_read(&mut self, task: &mut Context<'_>) -> Poll<io::Result<()>> {
        let mut buffer = ReadBuf::new(&mut self.chunk);
        ready!(Pin::new(&mut self.port).poll_read(task, &mut buffer))?;
        if buffer.filled().is_empty() {
            // A port that was unplugged reads so for ever.
            return Poll::Ready(Err(unplugged()));
        }
        self.unread.extend(buffer.filled());
        Poll::Ready(Ok(()))
    }

    /// Says what brings the adapter onto the bus, and keeps the time of its answers. The answer is
    /// whether it is there.
    fn carry_on(&mut self, task: &mut Context<'_>, now: Instant) -> io::Result<bool> {
        while !self.control.is_open() {
            if let Some(command) = self.control.poll_command(now) {
                self.say(&command);
            }
            if let Poll::Ready(flushed) = self.poll_flush(task) {
                flushed?;
            }
            let due = self.control.poll_timeout().unwrap_or(now);
            if self.timer.poll_at(due, now, task).is_pending() {
                return Ok(false);
            }
            self.control.handle_timeout(due);
        }
        Ok(true)
    }

    /// Understands what was read: a frame, or something that is none; nothing when more must come.
    fn receive(&mut self) -> io::Result<Option<Option<CanFrame>>> {
        while let Some(byte) = self.unread.pop_front() {
            match self.listener.handle_byte(byte) {
                Some(AdapterReply::Frame(frame)) => return Ok(Some(Some(frame))),
                Some(reply) => self.control.handle_reply(&reply),
                None => {}
            }
            if let Some(error) = self.control.failure() {
                return Err(io::Error::other(error));
            }
            let refused = self.listener.refused() + self.control.refused();
            if std::mem::replace(&mut self.refused, refused) != refused {
                return Ok(Some(None));
            }
        }
        Ok(None)
    }
}

fn unplugged() -> io::Error {
    let text = "the adapter was unplugged: plug it in again";
    io::Error::new(io::ErrorKind::UnexpectedEof, text)
}
