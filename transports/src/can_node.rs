//! A node of a CAN bus: what sockets and adapters share.
//!
//! ```text
//! frame ─► frame, CRC-32C ─► ISO 15765-2 ─► CAN frames ─► socket or adapter ─► bus
//! ```
//!
//! ISO 15765-2 checks no message as a whole, only each of its CAN frames: after a loss, parts of
//! two messages can come to look like one. So each frame is followed by its checksum. It also gives
//! an empty frame some bytes, without which the standard cannot send it.
//!
//! A frame to [`BusAddress::ALL`] goes to all nodes, once, and is not confirmed.
//!
//! No two nodes may have one address: a frame that comes under this node's own is reported.

use crate::endpoint::CanNodeConfig;
use crate::frame_medium::{FrameMedium, MediumEvent, OpenedMedium, QueueLimits, SendResult};
use crate::medium_timer::MediumTimer;
use blastema_contract::transport::MediumAddress;
use blastema_core::medium::can::isotp::SeparationTime;
use blastema_core::medium::can::{
    BusAddress, CanFrame, Format, IsoTp, IsoTpConfig, IsoTpOutput, bits_on_bus,
};
use blastema_core::medium::lane::FrameLane;
use blastema_core::{Instant, Machine};
use bytes::{BufMut, Bytes, BytesMut};
use crc::{CRC_32_ISCSI, Crc};
use std::collections::VecDeque;
use std::io;
use std::task::{Context, Poll};
use std::time::Duration;

static CHECK: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);
/// How long the checksum is, in bytes.
const CHECK_LENGTH: usize = 4;
/// So many CAN frames are moved in one turn, before others of the arbiter have theirs: as many as a
/// message has.
const TURN: usize = 160;
/// How often it is reported that another node sends under this node's address.
const CLASH_INTERVAL: Duration = Duration::from_secs(10);

/// What moves CAN frames: a socket, or an adapter on a serial line.
pub trait CanPort: Send + 'static {
    /// How people call it; it stands at the beginning of errors.
    fn name(&self) -> String;

    /// How fast the bus is, in bits a second.
    fn bitrate(&self) -> u32;

    /// Opens it, or opens it again after it was closed.
    ///
    /// # Errors
    /// It cannot be opened; the text says what the user may do.
    fn open(&mut self, now: Instant) -> io::Result<()>;

    /// Ready when what was opened is on the bus.
    ///
    /// # Errors
    /// It cannot be used; the text says what the user may do.
    fn poll_ready(&mut self, _: &mut Context<'_>, _: Instant) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    /// Gives one frame to the bus. Where the answer is `Pending`, the task is woken when it is
    /// worth another attempt, and the frame is offered again.
    ///
    /// # Errors
    /// It is lost: it is closed, and opened again.
    fn poll_write(
        &mut self,
        task: &mut Context<'_>,
        frame: &CanFrame,
        now: Instant,
    ) -> Poll<io::Result<()>>;

    /// Takes what came: a frame, or `None` for something that is none.
    ///
    /// # Errors
    /// It is lost: it is closed, and opened again.
    fn poll_read(&mut self, task: &mut Context<'_>) -> Poll<io::Result<Option<CanFrame>>>;

    /// Lets go of it.
    fn close(&mut self);
}

/// Which node we are, as a medium that moves frames of any length.
pub struct CanNode<P> {
    port: P,
    config: CanNodeConfig,
    format: Format,
    /// The clock on which this arbiter's timers run.
    now: fn() -> Instant,
    machine: Option<IsoTp>,
    /// When it was reported last that another node sends under this node's address.
    clash_reported_at: Option<Instant>,
    /// A frame that the bus has not taken yet.
    ready: Option<CanFrame>,
    arrivals: VecDeque<MediumEvent>,
    timer: MediumTimer,
}

impl<P: CanPort> CanNode<P> {
    pub(crate) fn over(
        port: P,
        config: CanNodeConfig,
        format: Format,
        now: fn() -> Instant,
    ) -> Self {
        CanNode {
            port,
            config,
            format,
            now,
            machine: None,
            clash_reported_at: None,
            ready: None,
            arrivals: VecDeque::new(),
            timer: MediumTimer::default(),
        }
    }

    fn build(&self) -> io::Result<IsoTp> {
        let CanNodeConfig { mtu, queue_frames, block_size, separation, .. } = self.config;
        let mut config = IsoTpConfig::default();
        config.format = self.format;
        config.message_max = mtu + CHECK_LENGTH;
        config.queue_messages = queue_frames;
        config.block_size = block_size;
        config.separation = SeparationTime::at_least(separation);
        IsoTp::new(BusAddress(self.config.address), config).ok_or_else(|| {
            io::Error::other("no node can have the address 255: choose one from 0 to 254")
        })
    }

    /// Looks at what the machine has to say.
    fn settle(&mut self) {
        let Some(machine) = &mut self.machine else { return };
        let mut address_taken = false;
        while let Some(output) = machine.poll_output() {
            let arrival = match output {
                IsoTpOutput::Received { from, message } => {
                    let from = MediumAddress::Can(from.0);
                    let frame = unseal(message);
                    frame.map_or(MediumEvent::Refused, |frame| MediumEvent::Frame { from, frame })
                }
                IsoTpOutput::Sent { .. } => continue,
                IsoTpOutput::NotSent { to, error, with_it } => {
                    tracing::debug!(%to, %error, "a frame was not sent over CAN");
                    MediumEvent::Lost { frames: 1 + with_it }
                }
                IsoTpOutput::NotReceived { from, error } => {
                    tracing::debug!(%from, %error, "a frame did not come in over CAN");
                    MediumEvent::Refused
                }
                IsoTpOutput::AddressTaken => {
                    address_taken = true;
                    MediumEvent::Refused
                }
                IsoTpOutput::Refused => MediumEvent::Refused,
            };
            self.arrivals.push_back(arrival);
        }
        if address_taken {
            self.report_clash();
        }
    }

    fn report_clash(&mut self) {
        let now = (self.now)();
        if self.clash_reported_at.is_some_and(|at| now < at + CLASH_INTERVAL) {
            return;
        }
        self.clash_reported_at = Some(now);
        let text = format!(
            "another node sends under this node's address {}, or the adapter hands back what this \
             node sends: give each node an address of its own, and let its neighbours know",
            self.config.address
        );
        self.arrivals.push_back(MediumEvent::Clash { text });
    }

    /// Moves what can be moved, within a turn. Says whether there may be more.
    fn carry_on(&mut self, task: &mut Context<'_>) -> io::Result<bool> {
        let more = self.write(task)?;
        self.settle();
        let more = self.read(task)? | more;
        let more = self.keep_time(task) | more;
        Ok(more)
    }

    /// Gives the bus what it takes, up to a turn's worth. Says whether there may be more.
    fn write(&mut self, task: &mut Context<'_>) -> io::Result<bool> {
        for _ in 0..TURN {
            let now = (self.now)();
            let next = self.ready.take().or_else(|| self.machine.as_mut()?.poll_frame(now));
            let Some(frame) = next else { return Ok(false) };
            match self.port.poll_write(task, &frame, now) {
                Poll::Ready(result) => result?,
                Poll::Pending => {
                    self.ready = Some(frame);
                    return Ok(false);
                }
            }
        }
        Ok(true)
    }

    /// Takes what the bus has, until there is something to tell, up to a turn's worth. Says whether
    /// there may be more.
    fn read(&mut self, task: &mut Context<'_>) -> io::Result<bool> {
        for _ in 0..TURN {
            if !self.arrivals.is_empty() {
                return Ok(true);
            }
            let now = (self.now)();
            match self.port.poll_read(task) {
                Poll::Pending => return Ok(false),
                Poll::Ready(frame) => match (frame?, &mut self.machine) {
                    (Some(frame), Some(machine)) => {
                        machine.handle_frame(&frame, now);
                        self.settle();
                        // What it asks for goes out before more is taken in: a sender waits for it.
                        self.write(task)?;
                        self.settle();
                    }
                    _ => self.arrivals.push_back(MediumEvent::Refused),
                },
            }
        }
        Ok(true)
    }

    /// Lets the machine act on what is due, and leaves a timer for what will be. Says whether
    /// anything was due.
    fn keep_time(&mut self, task: &mut Context<'_>) -> bool {
        let Some(machine) = &mut self.machine else { return false };
        let now = (self.now)();
        let Some(due) = machine.poll_timeout() else {
            self.timer = MediumTimer::default();
            return false;
        };
        if due <= now {
            machine.handle_timeout(now);
            self.settle();
            return true;
        }
        self.timer.poll_at(due, now, task).is_ready()
    }
}

impl<P: CanPort> FrameMedium for CanNode<P> {
    fn name(&self) -> String {
        self.port.name()
    }

    fn queue(&self) -> QueueLimits {
        // Frames wait in the machine, for each target on its own, so that one which is not there
        // makes no other frame wait.
        QueueLimits { frames: self.config.queue_frames, ..QueueLimits::default() }
    }

    fn bytes_per_second(&self) -> Option<u64> {
        // Of each part of a message all but one byte is the message's. A faster rate for the data
        // of CAN FD is not counted on.
        let part = self.format.capacity();
        let bits = bits_on_bus(true, part);
        Some((part as u64 - 1) * u64::from(self.port.bitrate()) / bits)
    }

    fn open(&mut self) -> io::Result<OpenedMedium> {
        self.close();
        let machine = self.build()?;
        self.port.open((self.now)())?;
        self.machine = Some(machine);
        let local = MediumAddress::Can(self.config.address);
        Ok(OpenedMedium { local, mtu: self.config.mtu })
    }

    fn poll_ready(&mut self, task: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.port.poll_ready(task, (self.now)())
    }

    fn knows(&self, address: &MediumAddress) -> bool {
        matches!(address, MediumAddress::Can(_))
    }

    fn poll_send(
        &mut self,
        task: &mut Context<'_>,
        to: &MediumAddress,
        frame: &Bytes,
        lane: FrameLane,
    ) -> Poll<io::Result<SendResult>> {
        let (MediumAddress::Can(to), Some(machine)) = (to, &mut self.machine) else {
            return Poll::Ready(Ok(SendResult::Dropped));
        };
        let taken = machine.handle_message(BusAddress(*to), seal(frame), lane, (self.now)());
        if let Err(error) = taken {
            tracing::trace!(%error, "a frame was not taken for CAN");
            return Poll::Ready(Ok(SendResult::Dropped));
        }
        if self.write(task)? {
            task.waker().wake_by_ref();
        }
        self.settle();
        Poll::Ready(Ok(SendResult::Sent))
    }

    fn poll_receive(&mut self, task: &mut Context<'_>) -> Poll<io::Result<MediumEvent>> {
        // What the bus took just now may end a message, and a timer may let the next frame go.
        for _ in 0..TURN {
            if let Some(arrival) = self.arrivals.pop_front() {
                return Poll::Ready(Ok(arrival));
            }
            if !self.carry_on(task)? && self.arrivals.is_empty() {
                return Poll::Pending;
            }
        }
        task.waker().wake_by_ref();
        Poll::Pending
    }

    fn close(&mut self) {
        self.port.close();
        self.machine = None;
        self.ready = None;
        self.arrivals.clear();
        self.timer = MediumTimer::default();
    }
}

/// A frame with its checksum.
fn seal(frame: &[u8]) -> Bytes {
    let mut message = BytesMut::with_capacity(frame.len() + CHECK_LENGTH);
    message.put_slice(frame);
    message.put_u32_le(CHECK.checksum(frame));
    message.freeze()
}

/// A frame without its checksum, if that is the frame's.
fn unseal(message: Bytes) -> Option<Bytes> {
    let (frame, check) = message.split_last_chunk::<CHECK_LENGTH>()?;
    let whole = CHECK.checksum(frame).to_le_bytes() == *check;
    whole.then(|| message.slice(..frame.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_told_from_parts_of_two() {
        for length in [0, 1, 7, 100] {
            let frame: Bytes = (0..length).collect();
            assert_eq!(unseal(seal(&frame)), Some(frame));
        }
        let (a, b) = (seal(&[1; 20]), seal(&[2; 20]));
        assert_eq!(unseal([&a[..13], &b[13..]].concat().into()), None);
        assert_eq!(unseal(Bytes::from_static(b"abc")), None);
    }
}
