//! CAN interfaces of the system, by SocketCAN: classic and FD.
//!
//! * A bus has a speed. The kernel is given no more than a few frames; what waits, waits here,
//!   where it is bounded and counted.
//! * An interface that is down, or was removed, is said to be closed at once, and opened again
//!   within a second of its return.
//! * A controller that leaves the bus after too many errors (bus off) says so, and the interface is
//!   closed until it is back.
//! * The kernel sorts out what is for others; what other things on the bus say is not seen.

mod layout;

use crate::can_node::{CanNode, CanPort};
use crate::endpoint::CanConfig;
use crate::medium_timer::MediumTimer;
use blastema_core::Instant;
use blastema_core::medium::can::{CanFrame, Format};
use layout::{BUS_OFF, EXTENDED, REMOTE};
use socket2::SockRef;
use socketcan::{CanFdSocket, CanFilter, Socket, SocketOptions};
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{Interest, Ready};
use tokio::net::UnixDatagram;

/// A CAN interface as a medium.
///
/// ```no_run
/// use blastema_transports::{CanBus, CanConfig, FrameTransport};
/// # fn now() -> blastema_core::Instant { panic!() }
/// let mut config = CanConfig::new("can0");
/// config.node.address = 3;
/// let transport = FrameTransport::new(CanBus::new(config, now));
/// ```
pub type CanBus = CanNode<CanSocket>;

/// How large the kernel's send buffer is asked to be, in bytes: it makes of it the smallest that it
/// has, half a dozen frames. An interface's own queue has room for ten, so that this fills first,
/// and tells us when there is room again.
const SEND_BUFFER: usize = 1;
/// When a full queue of the interface, which other programs use too, is tried again: a few frames'
/// time.
const FULL_PAUSE: Duration = Duration::from_millis(1);
/// What an interface's MTU is that carries CAN FD.
const FD_MTU: u32 = 72;

const DATA: u32 = 0x00da_0000;
const ALL: u32 = 0x00db_ff00;

impl CanBus {
    /// The bus at this interface. The clock must be the one on which this arbiter's timers run.
    pub fn new(config: CanConfig, now: fn() -> Instant) -> Self {
        let format =
            if config.fd { Format::Fd { fast: config.bit_rate_switch } } else { Format::Classic };
        let node = config.node.clone();
        CanNode::over(
            CanSocket { config, socket: None, failing: None, pause: MediumTimer::default() },
            node,
            format,
            now,
        )
    }
}

/// A raw socket on a CAN interface.
pub struct CanSocket {
    config: CanConfig,
    socket: Option<Arc<UnixDatagram>>,
    /// Ready when the kernel has something to say of the interface: reading is not woken by it.
    failing: Option<Pin<Box<dyn Future<Output = io::Result<Ready>> + Send>>>,
    /// The interface's queue is full: the next attempt.
    pause: MediumTimer,
}

impl CanSocket {
    fn connect(&self) -> io::Result<UnixDatagram> {
        let CanConfig { interface, fd, node, .. } = &self.config;
        let socket = CanFdSocket::open(interface)?;
        socket.set_nonblocking(true)?;
        socket.set_filters(&filters(node.address))?;
        socket.set_error_filter(BUS_OFF)?;
        let options = SockRef::from(socket.as_raw_socket());
        options.set_send_buffer_size(SEND_BUFFER)?;
        // A socket of an interface that is down says so, once.
        options.take_error()?.map_or(Ok(()), Err)?;
        // The kernel tells the rest of the system that it is off the bus as if its cable were
        // pulled.
        let carrier = std::fs::read_to_string(format!("/sys/class/net/{interface}/carrier"));
        if carrier.is_ok_and(|carrier| carrier.trim() == "0") {
            return Err(self.bus_off());
        }
        let mtu = std::fs::read_to_string(format!("/sys/class/net/{interface}/mtu"));
        let mtu: Option<u32> = mtu.ok().and_then(|text| text.trim().parse().ok());
        if *fd && mtu.is_some_and(|mtu| mtu < FD_MTU) {
            return Err(io::Error::other(format!(
                "the interface carries classic frames only: `ip link set {interface} type can fd \
                 on`, or leave fd=true out"
            )));
        }
        // A socket is a socket: tokio has none of this kind, and needs to know only that it sends
        // and receives whole pieces. (socketcan's own asynchronous socket is not woken when there
        // is room.)
        UnixDatagram::from_std(socket.as_raw_socket().try_clone()?.into())
    }

    /// Ready when the interface goes down, or is removed.
    fn poll_failure(&mut self, task: &mut Context<'_>) -> Poll<io::Error> {
        loop {
            let Some(socket) = self.socket.clone() else { return Poll::Ready(closed()) };
            let failing = self.failing.get_or_insert_with(|| {
                Box::pin(async move { socket.ready(Interest::ERROR).await })
            });
            let failed = ready!(failing.as_mut().poll(task));
            self.failing = None;
            let Some(socket) = &self.socket else { return Poll::Ready(closed()) };
            match failed.and_then(|_| socket.take_error()) {
                Ok(Some(error)) | Err(error) => return Poll::Ready(error),
                // The receiver was told already. A ready bus is so until an attempt fails.
                Ok(None) => {
                    let nothing = || Err::<(), _>(io::ErrorKind::WouldBlock.into());
                    let _ = socket.try_io(Interest::ERROR, nothing);
                }
            }
        }
    }

    fn bus_off(&self) -> io::Error {
        let interface = &self.config.interface;
        io::Error::other(format!(
            "its controller is off the bus, after too many errors: check the wires, their \
             termination and the bit rate; `ip link set {interface} type can restart-ms 100` lets \
             it come back by itself"
        ))
    }

    fn explain(&self, error: io::Error) -> io::Error {
        use rustix::io::Errno;
        let interface = &self.config.interface;
        let advice = match error.raw_os_error().map(Errno::from_raw_os_error) {
            Some(Errno::NETDOWN) => {
                format!("it is down: `ip link set {interface} up type can bitrate 500000`")
            }
            Some(Errno::NODEV) => "there is no such interface: plug the adapter in".into(),
            Some(Errno::AFNOSUPPORT) => "this system has no CAN: load the module can_raw".into(),
            _ => return error,
        };
        io::Error::new(error.kind(), format!("{error}: {advice}"))
    }
}

impl CanPort for CanSocket {
    fn name(&self) -> String {
        format!("can {}", self.config.interface)
    }

    fn bitrate(&self) -> u32 {
        self.config.bitrate
    }

    fn open(&mut self, _: Instant) -> io::Result<()> {
        let socket = self.connect().map_err(|error| self.explain(error))?;
        self.socket = Some(Arc::new(socket));
        Ok(())
    }

    fn poll_write(
        &mut self,
        task: &mut Context<'_>,
        frame: &CanFrame,
        _: Instant,
    ) -> Poll<io::Result<()>> {
        let mut bytes = [0; layout::FD];
        let length = layout::write(frame, &mut bytes);
        loop {
            ready!(self.pause.poll(task));
            let Some(socket) = &self.socket else { return Poll::Ready(Err(closed())) };
            ready!(socket.poll_send_ready(task))?;
            match socket.try_send(&bytes[..length]) {
                Ok(_) => return Poll::Ready(Ok(())),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) if is_full(&error) => {
                    self.pause = MediumTimer::after(FULL_PAUSE);
                }
                Err(error) => return Poll::Ready(Err(self.explain(error))),
            }
        }
    }

    fn poll_read(&mut self, task: &mut Context<'_>) -> Poll<io::Result<Option<CanFrame>>> {
        if let Poll::Ready(error) = self.poll_failure(task) {
            return Poll::Ready(Err(self.explain(error)));
        }
        let Some(socket) = &self.socket else { return Poll::Ready(Err(closed())) };
        let mut bytes = [0; layout::FD];
        loop {
            ready!(socket.poll_recv_ready(task))?;
            match socket.try_recv(&mut bytes) {
                Ok(length) if layout::is_bus_off(&bytes[..length]) => {
                    return Poll::Ready(Err(self.bus_off()));
                }
                Ok(length) => return Poll::Ready(Ok(layout::read(&bytes[..length]))),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Poll::Ready(Err(self.explain(error))),
            }
        }
    }

    fn close(&mut self) {
        (self.socket, self.failing) = (None, None);
        self.pause = MediumTimer::default();
    }
}

fn closed() -> io::Error {
    io::ErrorKind::NotConnected.into()
}

/// The queue of the interface has no room; nothing wakes us when it has.
fn is_full(error: &io::Error) -> bool {
    let error = error.raw_os_error().map(rustix::io::Errno::from_raw_os_error);
    error == Some(rustix::io::Errno::NOBUFS)
}

/// Frames for this node, frames for all, and frames that another node sends under this address.
fn filters(own: u8) -> [CanFilter; 3] {
    let own = u32::from(own);
    // The priority, the uppermost three bits, is the speaker's business.
    let filter = |id, mask| CanFilter::new(EXTENDED | id, mask | EXTENDED | REMOTE);
    [
        filter(DATA | own << 8, 0x03ff_ff00),
        filter(ALL, 0x03ff_ff00),
        filter(DATA | own, 0x03ff_00ff),
    ]
}
