//! How two nodes meet on a new connection.
//!
//! ```text
//! dialer                         listener
//!   ├── connect ───────────────────►│
//!   ├── preamble (my port) ────────►│ knows who it is; may refuse by closing
//!   │◄──────────── preamble (port) ─┤ has kept the connection
//!   ├── frames ─ ─ ─ ─ ─ ─ ─ frames ┤
//! ```

use super::TcpConfig;
use crate::bound_address::confine;
use crate::stream::framing::{PreambleKind, encode_preamble, read_preamble, say_preamble};
use socket2::SockRef;
use std::io;
use std::net::SocketAddr;
use std::time::Duration;
use tokio::net::{TcpSocket, TcpStream};
use tokio::time::timeout;

/// Connects to a listening peer, and is done when that has kept the connection.
pub(super) async fn dial(
    local: SocketAddr,
    peer: SocketAddr,
    config: TcpConfig,
) -> io::Result<TcpStream> {
    timeout(config.limits.connect_timeout, async {
        let socket = if peer.is_ipv4() { TcpSocket::new_v4()? } else { TcpSocket::new_v6()? };
        confine(&SockRef::from(&socket), config.interface.as_deref())?;
        if !local.ip().is_unspecified() {
            // The peer knows us by the address that the connection comes from.
            socket.bind(SocketAddr::new(local.ip(), 0))?;
        }
        let mut stream = socket.connect(peer).await?;
        prepare(&stream, config.user_timeout)?;
        introduce(&stream, local.port())?;
        if read_preamble(&mut stream, PreambleKind::Port).await? != peer.port() {
            return Err(io::Error::other("another node listens there"));
        }
        Ok(stream)
    })
    .await?
}

/// Learns on which port a node that has connected listens.
pub(super) async fn greet(
    mut stream: TcpStream,
    config: TcpConfig,
) -> io::Result<(TcpStream, u16)> {
    prepare(&stream, config.user_timeout)?;
    let port = timeout(config.limits.hello_timeout, read_preamble(&mut stream, PreambleKind::Port))
        .await??;
    Ok((stream, port))
}

/// Says on which port we listen.
pub(super) fn introduce(stream: &TcpStream, port: u16) -> io::Result<()> {
    say_preamble(SockRef::from(stream), &encode_preamble(port))
}

fn prepare(stream: &TcpStream, user_timeout: Duration) -> io::Result<()> {
    // Frames are whole: there is nothing to wait for before one is sent.
    stream.set_nodelay(true)?;
    SockRef::from(stream).set_tcp_user_timeout(Some(user_timeout))
}
