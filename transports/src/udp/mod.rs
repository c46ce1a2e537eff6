//! Datagrams over IP: one frame is one datagram, to one peer or to all who hear a group.

mod multicast;

pub use crate::endpoint::UdpConfig;

use crate::bound_address::{BoundAddress, confine, explain};
use crate::frame_medium::QueueLimits;
use crate::frame_split::part_frame;
use crate::medium::{MediumActor, PollBudget, transport};
use crate::reopen_backoff::ReopenBackoff;
use crate::transmit_queues::TransmitQueues;
use crate::upstream::Upstream;
use actix::Context;
use blastema_contract::transport::{MediumAddress, Transmit, TransmitBacklog, TransportReport};
use blastema_core::GatherBuffer;
use bytes::{BufMut, BytesMut};
use socket2::{Domain, Protocol, SockRef, Socket, Type};
use std::io::{self, IoSlice};
use std::net::SocketAddr;
use std::task::{self, Poll};
use tokio::io::Interest;
use tokio::net::UdpSocket;

/// What a datagram carries at most over IPv4: 65,535 less the headers of IP (20) and UDP (8).
const LARGEST: usize = 65_507;
/// So many failed reads in a row, and the socket is opened again: single ones are news of other
/// hosts.
const ERRORS_IN_A_ROW: u32 = 100;
/// Memory is taken in pieces of at least this size, and shared by the frames in it.
const CHUNK: usize = 64 * 1024;

impl UdpConfig {
    fn mtu(&self) -> usize {
        let fitting = match self.bind {
            _ if !self.leaves_the_computer() => LARGEST,
            SocketAddr::V4(_) => 1_472,
            SocketAddr::V6(_) => 1_452,
        };
        self.mtu.unwrap_or(fitting).min(LARGEST)
    }

    fn leaves_the_computer(&self) -> bool {
        !self.bind.ip().is_loopback()
    }
}

/// A UDP socket as a transport, with no fixed peer.
///
/// It lives until it is sent [`Close`](blastema_contract::transport::Close).
pub struct Udp {
    config: UdpConfig,
    upstream: Upstream,
    binding: BoundAddress,
    reopening: ReopenBackoff,
    socket: Option<UdpSocket>,
    /// Hears the group, if there is one, beside our own socket.
    ear: Option<UdpSocket>,
    queue: TransmitQueues<(SocketAddr, GatherBuffer)>,
    /// The one that the kernel had no room for.
    going: Option<(SocketAddr, GatherBuffer)>,
    buffer: BytesMut,
    errors_in_a_row: u32,
}

impl Udp {
    /// A transport that opens when it is started.
    pub fn new(config: UdpConfig) -> Self {
        Udp {
            binding: BoundAddress::new(config.bind),
            config,
            upstream: Upstream::default(),
            reopening: ReopenBackoff::default(),
            socket: None,
            ear: None,
            queue: TransmitQueues::default(),
            going: None,
            buffer: BytesMut::new(),
            errors_in_a_row: 0,
        }
    }

    fn try_open(&mut self) {
        let address = self.binding.next_attempt();
        match open(address, &self.config) {
            Ok((local, socket, ear)) => {
                self.binding.taken(local);
                self.reopening.reset();
                (self.socket, self.ear) = (Some(socket), ear);
                let (local, mtu) = (MediumAddress::Ip(local), self.config.mtu());
                let is_probed = self.config.leaves_the_computer();
                self.upstream.announce(TransportReport::Opened { local, mtu, is_probed });
            }
            Err(error) => {
                self.lose(explain("udp", address, self.config.interface.as_deref(), &error))
            }
        }
    }

    fn lose(&mut self, reason: String) {
        self.shut();
        self.reopening.failed();
        self.upstream.announce_closed(reason);
    }

    /// Sends one datagram, or gives it back when the kernel has no room for it.
    fn send(&mut self, to: SocketAddr, frame: GatherBuffer) -> Option<GatherBuffer> {
        let Some(socket) = &self.socket else {
            self.upstream.counters.dropped += 1;
            return None;
        };
        match try_send(socket, &frame, to) {
            Ok(_) => self.upstream.counters.sent += 1,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Some(frame),
            Err(error) => {
                tracing::trace!(%error, %to, "a datagram was not sent");
                self.upstream.counters.dropped += 1;
                self.upstream.counters.errors += 1;
            }
        }
        None
    }

    /// Sends what waits, until the kernel has no more room.
    fn write(&mut self, task: &mut task::Context<'_>) {
        while let Some((to, frame)) = self.going.take().or_else(|| Some(self.queue.pop()?.1)) {
            let Some(frame) = self.send(to, frame) else { continue };
            self.going = Some((to, frame));
            let ready = self.socket.as_ref().map(|socket| socket.poll_send_ready(task));
            let Some(Poll::Ready(Ok(()))) = ready else { return };
        }
    }

    /// Takes what has arrived, up to the budget.
    fn read(&mut self, task: &mut task::Context<'_>) {
        // Both sockets share the budget, and neither keeps the other from its turn.
        let own = self.socket.take().map_or(Turn::Empty, |socket| {
            let turn = self.read_from(&socket, task);
            self.socket = Some(socket);
            turn
        });
        let ear = self.ear.take().map_or(Turn::Empty, |ear| {
            let turn = self.read_from(&ear, task);
            self.ear = Some(ear);
            turn
        });
        for turn in [own, ear] {
            match turn {
                Turn::Empty => {}
                Turn::More => task.waker().wake_by_ref(),
                Turn::Broken(reason) => {
                    self.lose(reason);
                    task.waker().wake_by_ref();
                }
            }
        }
    }

    fn read_from(&mut self, socket: &UdpSocket, task: &mut task::Context<'_>) -> Turn {
        let mtu = self.config.mtu();
        // One byte more than the largest frame: a datagram that fills it is too large.
        let capacity = mtu + 1;
        let chunk = capacity.max(CHUNK);
        let mut budget = PollBudget::default();
        while budget.next() {
            if self.upstream.poll_capacity(task).is_pending() {
                return Turn::Empty;
            }
            if self.buffer.capacity() < capacity {
                self.buffer.reserve(chunk);
            }
            match socket.try_recv_buf_from(&mut (&mut self.buffer).limit(capacity)) {
                // What we have said to the group ourselves comes back from it.
                Ok((_, from)) if self.config.group.is_some() && self.binding.is_at(from) => {
                    self.buffer.clear();
                }
                Ok((length, _)) if length > mtu => {
                    self.buffer.clear();
                    self.upstream.counters.refused += 1;
                }
                Ok((length, from)) => {
                    self.errors_in_a_row = 0;
                    budget.spend(length);
                    let frame = part_frame(&mut self.buffer, length, chunk);
                    self.upstream.deliver(MediumAddress::Ip(from), frame);
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    if socket.poll_recv_ready(task).is_pending() {
                        return Turn::Empty;
                    }
                }
                // An ICMP message about an earlier datagram comes back as an error of the socket.
                // It is news of one peer, and no reason to give up the others.
                Err(error) => {
                    self.upstream.counters.errors += 1;
                    self.errors_in_a_row += 1;
                    if self.errors_in_a_row >= ERRORS_IN_A_ROW {
                        let local = socket.local_addr().unwrap_or(self.config.bind);
                        let interface = self.config.interface.as_deref();
                        return Turn::Broken(explain("udp", local, interface, &error));
                    }
                }
            }
        }
        Turn::More
    }
}

/// Gives the kernel one datagram, as it lies.
fn try_send(socket: &UdpSocket, frame: &GatherBuffer, to: SocketAddr) -> io::Result<usize> {
    let pieces = frame.pieces().map(IoSlice::new);
    let send = || SockRef::from(socket).send_to_vectored(&pieces, &to.into());
    socket.try_io(Interest::WRITABLE, send)
}

/// What a turn of reading leaves.
enum Turn {
    /// Nothing to read, or no receiver attached; the task is woken when that changes.
    Empty,
    /// There may be more.
    More,
    /// The socket does not read any more, and why.
    Broken(String),
}

impl MediumActor for Udp {
    fn upstream(&mut self) -> &mut Upstream {
        &mut self.upstream
    }

    fn open(&mut self, _: &mut Context<Self>) {
        self.reopening.reset();
        self.try_open();
    }

    fn transmit(&mut self, message: Transmit) {
        let Transmit { to, frame, lane } = message;
        let MediumAddress::Ip(to) = to else {
            self.upstream.counters.refused += 1;
            return;
        };
        if frame.len() > self.config.mtu() {
            self.upstream.counters.refused += 1;
            return;
        }
        // Nothing overtakes what waits already, but for the urgent.
        let waits = self.going.is_some() || !self.queue.is_empty();
        let Some(frame) = (if waits { Some(frame) } else { self.send(to, frame) }) else { return };
        let limits = QueueLimits { frames: self.config.queue_frames, bytes: usize::MAX };
        let bytes = frame.len();
        if !self.queue.push(lane, (to, frame), self.upstream.now(), bytes, limits) {
            self.upstream.counters.dropped += 1;
        }
    }

    fn backlog(&self) -> TransmitBacklog {
        self.queue.backlog(self.going.is_some(), self.upstream.now())
    }

    fn pump(&mut self, task: &mut task::Context<'_>) {
        while self.socket.is_none() {
            if self.reopening.poll_due(task).is_pending() {
                return;
            }
            self.try_open();
        }
        self.write(task);
        self.read(task);
    }

    fn shut(&mut self) {
        (self.socket, self.ear) = (None, None);
        self.upstream.counters.dropped += self.queue.clear();
        self.upstream.counters.dropped += u64::from(self.going.take().is_some());
        self.buffer = BytesMut::new();
        self.errors_in_a_row = 0;
    }
}

transport!(Udp);

/// Our own socket with its address, and the one that hears the group.
fn open(
    address: SocketAddr,
    config: &UdpConfig,
) -> io::Result<(SocketAddr, UdpSocket, Option<UdpSocket>)> {
    let Some(group) = config.group else {
        let socket = bind(address, config)?;
        return Ok((socket.local_addr()?, socket, None));
    };
    let own = multicast::own_address(address, group, config.interface.as_deref())?;
    let socket = bind(own, config)?;
    multicast::speak(&socket, config)?;
    let ear = multicast::listen(group, own.ip(), config)?;
    Ok((socket.local_addr()?, socket, Some(ear)))
}

fn bind(address: SocketAddr, config: &UdpConfig) -> io::Result<UdpSocket> {
    let socket = Socket::new(Domain::for_address(address), Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_nonblocking(true)?;
    if address.is_ipv6() {
        // One address, one spelling: IPv4 peers would show as `::ffff:…` otherwise.
        socket.set_only_v6(true)?;
    }
    socket.set_recv_buffer_size(config.receive_buffer)?;
    socket.set_send_buffer_size(config.send_buffer)?;
    confine(&socket, config.interface.as_deref())?;
    if config.leaves_the_computer() {
        forbid_fragments(&socket, address)?;
    }
    socket.bind(&address.into())?;
    UdpSocket::from_std(socket.into())
}

/// A datagram that is too large for a network on its path is lost, not cut up, whatever routers
/// have said of the path: their messages may be forged, and links probe it (RFC 8899, 4.1).
#[cfg(target_os = "linux")]
fn forbid_fragments(socket: &Socket, address: SocketAddr) -> io::Result<()> {
    use rustix::net::sockopt::{
        Ipv4PathMtuDiscovery, Ipv6PathMtuDiscovery, set_ip_mtu_discover, set_ipv6_mtu_discover,
    };
    match address {
        SocketAddr::V4(_) => set_ip_mtu_discover(socket, Ipv4PathMtuDiscovery::PROBE)?,
        SocketAddr::V6(_) => set_ipv6_mtu_discover(socket, Ipv6PathMtuDiscovery::PROBE)?,
    }
    Ok(())
}

#[cfg(not(target_os = "linux"))]
fn forbid_fragments(_: &Socket, _: SocketAddr) -> io::Result<()> {
    Ok(())
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use rustix::net::sockopt::{ip_mtu_discover, ipv6_mtu_discover};

    #[test]
    fn no_datagram_is_cut_up_that_leaves_the_computer() {
        use rustix::net::sockopt::{Ipv4PathMtuDiscovery, Ipv6PathMtuDiscovery};
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().unwrap();
        let _entered = runtime.enter();
        let socket = |address: &str| {
            let config = UdpConfig { bind: address.parse().unwrap(), ..UdpConfig::default() };
            bind(config.bind, &config).unwrap()
        };

        let discovery = |address| ip_mtu_discover(socket(address)).unwrap();
        assert_eq!(discovery("0.0.0.0:0"), Ipv4PathMtuDiscovery::PROBE);
        assert_ne!(discovery("127.0.0.1:0"), Ipv4PathMtuDiscovery::PROBE);
        if std::net::UdpSocket::bind("[::]:0").is_ok() {
            let discovery = ipv6_mtu_discover(socket("[::]:0")).unwrap();
            assert_eq!(discovery, Ipv6PathMtuDiscovery::PROBE);
        }
    }
}
