//! Connections over IP: frames in a TCP stream for each peer (the module `stream`).
//!
//! A peer cannot claim another host's address: the address is where the connection comes from, only
//! the port is claimed. (So there must be no address translation on the way.)

mod handshake;

pub use crate::endpoint::{StreamLimits, TcpConfig};
pub use crate::stream::framing;

use self::handshake::{dial, greet, introduce};
use crate::bound_address::{BoundAddress, confine, explain};
use crate::stream::{BACKLOG, HandshakeFuture, StreamFamily, Streams};
use blastema_contract::transport::MediumAddress;
use socket2::{Domain, Protocol, Socket, Type};
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::task::{self, Poll};
use tokio::net::{TcpListener, TcpStream};

/// TCP connections as a transport.
///
/// It lives until it is sent [`Close`](blastema_contract::transport::Close).
pub type Tcp = Streams<OverIp>;

impl Tcp {
    /// A transport that opens when it is started.
    pub fn new(config: TcpConfig) -> Self {
        let limits = config.limits.clone();
        Streams::over(OverIp { binding: BoundAddress::new(config.bind), config }, limits)
    }
}

/// Streams over IP.
pub struct OverIp {
    config: TcpConfig,
    binding: BoundAddress,
}

impl StreamFamily for OverIp {
    type Stream = TcpStream;
    type Listener = TcpListener;
    type Address = SocketAddr;
    type Origin = IpAddr;

    fn listen(&mut self) -> Result<(TcpListener, SocketAddr), String> {
        let address = self.binding.next_attempt();
        let opened = listen(address, &self.config)
            .and_then(|socket| socket.local_addr().map(|local| (socket, local)));
        let interface = self.config.interface.as_deref();
        let (socket, local) = opened.map_err(|error| explain("tcp", address, interface, &error))?;
        self.binding.taken(local);
        Ok((socket, local))
    }

    fn poll_accept(
        listener: &TcpListener,
        task: &mut task::Context<'_>,
    ) -> Poll<io::Result<(TcpStream, IpAddr)>> {
        listener.poll_accept(task).map_ok(|(stream, from)| (stream, from.ip()))
    }

    fn dial(&self, local: &SocketAddr, peer: &SocketAddr) -> HandshakeFuture<TcpStream> {
        Box::pin(dial(*local, *peer, self.config.clone()))
    }

    fn greet(
        &self,
        stream: TcpStream,
        origin: &IpAddr,
    ) -> HandshakeFuture<(TcpStream, SocketAddr)> {
        let (config, ip) = (self.config.clone(), *origin);
        Box::pin(async move {
            let (stream, port) = greet(stream, config).await?;
            Ok((stream, SocketAddr::new(ip, port)))
        })
    }

    fn introduce(stream: &TcpStream, local: &SocketAddr) -> io::Result<()> {
        introduce(stream, local.port())
    }

    fn ourselves(stream: &TcpStream, local: &SocketAddr) -> io::Result<SocketAddr> {
        Ok(SocketAddr::new(stream.local_addr()?.ip(), local.port()))
    }

    fn address(address: MediumAddress) -> Option<SocketAddr> {
        match address {
            MediumAddress::Ip(address) => Some(address),
            _ => None,
        }
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
