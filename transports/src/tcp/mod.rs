//! Connections over IP: frames with their length before them, in a stream for each peer.
//!
//! A transport listens and connects in one. A peer is known by the address at which *it* listens,
//! whoever of the two made the connection: whoever connects says so first ([`framing`]). The first
//! frame to a peer makes the connection; frames wait for it, within bounds, and are dropped in the
//! pause after it failed or broke.
//!
//! * **One connection per peer.** When two nodes dial each other at the same time, the call of the
//!   smaller address counts. A peer that dials while we believe to be connected has lost the
//!   connection, or was restarted: the new one replaces the old.
//! * **Strangers**, who have connected and said nothing yet, have places of their own, of which the
//!   oldest is given up when all are taken. So those who never say anything keep nobody out.
//! * A peer cannot claim another host's address: the address is where the connection comes from, only
//!   the port is claimed. (So there must be no address translation on the way.)

pub mod framing;
mod handshake;
mod outgoing;
mod peer;

use self::handshake::{Underway, dial, greet, introduce};
use self::peer::{Broken, Peer, State};
use crate::binding::{Binding, confine, explain};
use crate::medium::{Medium, transport};
use crate::outlet::Outlet;
use crate::reopening::Reopening;
use actix::Context;
use blastema_contract::transport::{MediumAddress, Transmit, TransportReport};
use socket2::{Domain, Protocol, Socket, Type};
use std::collections::VecDeque;
use std::future::Future;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::pin::Pin;
use std::task::{self, Poll};
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Sleep;

/// So many connections the kernel holds until we take them.
const BACKLOG: i32 = 128;
/// So many connections are taken in one turn.
const ACCEPTS: usize = 16;
/// How long no connection is taken after one could not be, for want of file descriptors mostly.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Where a [`Tcp`] listens, and how much it holds.
///
/// ```
/// use blastema_transports::TcpConfig;
/// let mut config = TcpConfig::default();
/// config.bind = "127.0.0.1:7400".parse()?;
/// # Ok::<(), std::net::AddrParseError>(())
/// ```
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct TcpConfig {
    /// Our own address; port 0 takes a free one. The default is loopback: nobody outside this
    /// machine can connect to a node that does not say otherwise.
    pub bind: SocketAddr,
    /// Only over this interface of the system, such as `eth0`. `None` leaves the choice to the system's
    /// routes.
    pub interface: Option<String>,
    /// The largest frame, in bytes. Larger frames keep others waiting longer behind them, and raise
    /// what each connection may hold.
    pub mtu: usize,
    /// How many peers have a place; beyond, they are refused.
    pub peers: usize,
    /// How many connections may be open on which nobody has said who he is.
    pub strangers: usize,
    /// How many bytes wait for each peer; beyond, frames are dropped.
    pub queue_bytes: usize,
    /// How long making a connection may take.
    pub connect_timeout: Duration,
    /// How long a stranger may say nothing.
    pub hello_timeout: Duration,
    /// How long sent bytes may stay unconfirmed until the kernel gives the connection up
    /// (`TCP_USER_TIMEOUT`, RFC 5482; its own patience is a quarter of an hour).
    pub user_timeout: Duration,
}

impl Default for TcpConfig {
    fn default() -> Self {
        TcpConfig {
            bind: (Ipv4Addr::LOCALHOST, 0).into(),
            interface: None,
            mtu: 64 * 1024,
            peers: 64,
            strangers: 32,
            queue_bytes: 1 << 20,
            connect_timeout: Duration::from_secs(1),
            hello_timeout: Duration::from_secs(2),
            user_timeout: Duration::from_millis(500),
        }
    }
}

/// TCP connections as a transport.
///
/// It lives until it is sent [`Close`](blastema_contract::transport::Close).
pub struct Tcp {
    config: TcpConfig,
    outlet: Outlet,
    binding: Binding,
    reopening: Reopening,
    listener: Option<Listener>,
    strangers: VecDeque<Stranger>,
    peers: Vec<Peer>,
    /// Whose turn to read is first: the one before whom the outlet was full.
    first: usize,
}

struct Listener {
    socket: TcpListener,
    local: SocketAddr,
    pause: Option<Pin<Box<Sleep>>>,
}

/// Somebody who has connected, and is to say on which port he listens.
struct Stranger {
    ip: IpAddr,
    greeting: Underway<(TcpStream, u16)>,
}

impl Tcp {
    /// A transport that opens when it is started.
    pub fn new(config: TcpConfig) -> Self {
        Tcp {
            binding: Binding::new(config.bind),
            config,
            outlet: Outlet::default(),
            reopening: Reopening::default(),
            listener: None,
            strangers: VecDeque::new(),
            peers: Vec::new(),
            first: 0,
        }
    }

    fn try_open(&mut self) {
        let address = self.binding.next_attempt();
        match listen(address, &self.config).and_then(|socket| Ok((socket.local_addr()?, socket))) {
            Ok((local, socket)) => {
                self.binding.taken(local);
                self.reopening.reset();
                self.listener = Some(Listener { socket, local, pause: None });
                let (local, mtu) = (MediumAddress::Ip(local), self.config.mtu);
                self.outlet.announce(TransportReport::Opened { local, mtu });
            }
            Err(error) => {
                self.reopening.failed();
                self.outlet.announce_closed(explain(
                    "tcp",
                    address,
                    self.config.interface.as_deref(),
                    &error,
                ));
            }
        }
    }

    /// Takes new connections; each is a stranger at first.
    fn accept(&mut self, task: &mut task::Context<'_>) {
        let Some(Listener { socket, pause, .. }) = &mut self.listener else { return };
        if let Some(sleep) = pause {
            if sleep.as_mut().poll(task).is_pending() {
                return;
            }
            *pause = None;
        }
        for _ in 0..ACCEPTS {
            match socket.poll_accept(task) {
                Poll::Ready(Ok((stream, from))) => {
                    if self.strangers.len() >= self.config.strangers {
                        self.strangers.pop_front();
                        self.outlet.counters.refused += 1;
                    }
                    let greeting = Box::pin(greet(stream, self.config.clone()));
                    self.strangers.push_back(Stranger { ip: from.ip(), greeting });
                }
                Poll::Ready(Err(error)) if error.kind() == io::ErrorKind::ConnectionAborted => {}
                Poll::Ready(Err(_)) => {
                    self.outlet.counters.errors += 1;
                    *pause = Some(Box::pin(tokio::time::sleep(ACCEPT_PAUSE)));
                    break;
                }
                Poll::Pending => return,
            }
        }
        task.waker().wake_by_ref();
    }

    /// Hears what strangers say, and gives them a peer's place.
    fn meet(&mut self, task: &mut task::Context<'_>) {
        let mut met = Vec::new();
        let counters = &mut self.outlet.counters;
        self.strangers.retain_mut(|stranger| match stranger.greeting.as_mut().poll(task) {
            Poll::Ready(Ok((stream, port))) => {
                met.push((SocketAddr::new(stranger.ip, port), stream));
                false
            }
            Poll::Ready(Err(error)) => {
                tracing::debug!(%error, from = %stranger.ip, "a connection came to nothing");
                match error.kind() {
                    // Who hangs up has thought better of it: he was called meanwhile, perhaps.
                    io::ErrorKind::UnexpectedEof | io::ErrorKind::ConnectionReset => {
                        counters.errors += 1;
                    }
                    _ => counters.refused += 1,
                }
                false
            }
            Poll::Pending => true,
        });
        for (address, stream) in met {
            if !self.admit(address, stream) {
                self.outlet.counters.refused += 1;
            }
        }
    }

    /// Says whether the connection is a good one, whether or not it is needed.
    fn admit(&mut self, address: SocketAddr, stream: TcpStream) -> bool {
        let (Some(listener), Ok(end)) = (&self.listener, stream.local_addr()) else { return false };
        // Ourselves, as the peer knows us.
        let local = SocketAddr::new(end.ip(), listener.local.port());
        if address == local {
            return false;
        }
        let Some(index) = self.place(address) else { return false };
        let peer = &mut self.peers[index];
        if matches!(peer.state, State::Dialing(_)) && local < address {
            // Both dial at once; our call counts, and the peer's transport thinks so too.
            return true;
        }
        if introduce(&stream, local.port()).is_err() {
            return false;
        }
        if peer.is_connected() {
            self.outlet.report(TransportReport::PeerLost { peer: MediumAddress::Ip(address) });
        }
        peer.adopt(stream);
        true
    }

    /// The peer's place among the peers; there may be none left.
    fn place(&mut self, address: SocketAddr) -> Option<usize> {
        if let Some(index) = self.peers.iter().position(|peer| peer.address == address) {
            return Some(index);
        }
        if self.peers.len() < self.config.peers {
            self.peers.push(Peer::new(address));
            return Some(self.peers.len() - 1);
        }
        let index = self.peers.iter().position(Peer::is_dispensable)?;
        self.peers[index] = Peer::new(address);
        Some(index)
    }

    /// Ends what broke, and looks after what has come about.
    fn carry_on(&mut self, task: &mut task::Context<'_>) {
        for index in 0..self.peers.len() {
            let peer = &mut self.peers[index];
            if let Err(error) = peer.poll_progress(task) {
                tracing::debug!(%error, peer = %peer.address, "a peer cannot be reached");
                self.outlet.counters.errors += 1;
                self.outlet.counters.dropped += peer.rest();
                task.waker().wake_by_ref();
            } else if let Err(broken) = peer.write(task, &mut self.outlet) {
                self.lose(index, broken, task);
            }
        }
    }

    fn read(&mut self, task: &mut task::Context<'_>) {
        for offset in 0..self.peers.len() {
            let index = (self.first + offset) % self.peers.len();
            match self.peers[index].read(task, self.config.mtu, &mut self.outlet) {
                Ok(false) => {}
                Ok(true) => {
                    self.first = index;
                    return;
                }
                Err(broken) => self.lose(index, broken, task),
            }
        }
    }

    fn lose(&mut self, index: usize, broken: Broken, task: &mut task::Context<'_>) {
        let peer = &mut self.peers[index];
        match broken {
            Broken::Lost => self.outlet.counters.errors += 1,
            Broken::Refused => self.outlet.counters.refused += 1,
        }
        self.outlet.counters.dropped += peer.rest();
        self.outlet.report(TransportReport::PeerLost { peer: MediumAddress::Ip(peer.address) });
        // The pause that has begun was not polled yet.
        task.waker().wake_by_ref();
    }
}

fn listen(address: SocketAddr, config: &TcpConfig) -> io::Result<TcpListener> {
    let socket = Socket::new(Domain::for_address(address), Type::STREAM, Some(Protocol::TCP))?;
    socket.set_nonblocking(true)?;
    if address.is_ipv6() {
        // One address, one spelling: IPv4 peers would show as `::ffff:…` otherwise.
        socket.set_only_v6(true)?;
    }
    // Connections of an earlier process that are still dying away do not keep the port from us; a
    // process that listens on it does.
    socket.set_reuse_address(true)?;
    confine(&socket, config.interface.as_deref())?;
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    TcpListener::from_std(socket.into())
}

impl Medium for Tcp {
    fn outlet(&mut self) -> &mut Outlet {
        &mut self.outlet
    }

    fn open(&mut self, _: &mut Context<Self>) {
        self.reopening.reset();
        self.try_open();
    }

    fn transmit(&mut self, message: Transmit) {
        let Transmit { to, frame } = message;
        let MediumAddress::Ip(to) = to else {
            self.outlet.counters.refused += 1;
            return;
        };
        if frame.len() > self.config.mtu {
            self.outlet.counters.refused += 1;
            return;
        }
        let local = self.listener.as_ref().map(|listener| listener.local);
        let (Some(local), Some(index)) = (local.filter(|local| *local != to), self.place(to))
        else {
            self.outlet.counters.dropped += 1;
            return;
        };
        let peer = &mut self.peers[index];
        if matches!(peer.state, State::Absent) {
            peer.state = State::Dialing(Box::pin(dial(local, to, self.config.clone())));
        }
        let resting = matches!(peer.state, State::Resting(_));
        if resting || !peer.outgoing.push(frame, self.config.queue_bytes) {
            self.outlet.counters.dropped += 1;
        }
    }

    fn pump(&mut self, task: &mut task::Context<'_>) {
        while self.listener.is_none() {
            if self.reopening.poll_due(task).is_pending() {
                return;
            }
            self.try_open();
        }
        self.accept(task);
        self.meet(task);
        self.carry_on(task);
        self.read(task);
    }

    fn shut(&mut self) {
        self.listener = None;
        self.strangers.clear();
        for mut peer in self.peers.drain(..) {
            self.outlet.counters.dropped += peer.outgoing.clear();
        }
        self.first = 0;
    }
}

transport!(Tcp);
