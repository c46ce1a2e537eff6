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
use crate::stream::framing::{FramingError, PREAMBLE, decode_preamble, encode_preamble};
use socket2::SockRef;
use std::io;
use std::net::SocketAddr;
use std::time::Duration;
use tokio::io::AsyncReadExt;
use tokio::net::{TcpSocket, TcpStream};
use tokio::time::timeout;

/// Connects to a listening peer, and is done when that has kept the connection.
pub(super) async fn dial(
    local: SocketAddr,
    peer: SocketAddr,
    config: TcpConfig,
) -> io::Result<TcpStream> {
    timeout(config.connect_timeout, async {
        let socket = if peer.is_ipv4() { TcpSocket::new_v4()? } else { TcpSocket::new_v6()? };
        confine(&SockRef::from(&socket), config.interface.as_deref())?;
        if !local.ip().is_unspecified() {
            // The peer knows us by the address that the connection comes from.
            socket.bind(SocketAddr::new(local.ip(), 0))?;
        }
        let mut stream = socket.connect(peer).await?;
        prepare(&stream, config.user_timeout)?;
        introduce(&stream, local.port())?;
        if read_preamble(&mut stream).await? != peer.port() {
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
    let port = timeout(config.hello_timeout, read_preamble(&mut stream)).await??;
    Ok((stream, port))
}

/// Says on which port we listen. It is the first word on a new connection, whose empty buffer takes
/// it whole.
pub(super) fn introduce(stream: &TcpStream, port: u16) -> io::Result<()> {
    match SockRef::from(stream).send(&encode_preamble(port))? {
        PREAMBLE => Ok(()),
        _ => Err(io::ErrorKind::WriteZero.into()),
    }
}

async fn read_preamble(stream: &mut TcpStream) -> io::Result<u16> {
    let mut preamble = [0; PREAMBLE];
    stream.read_exact(&mut preamble).await?;
    decode_preamble(preamble)
        .map_err(|error: FramingError| io::Error::new(io::ErrorKind::InvalidData, error))
}

fn prepare(stream: &TcpStream, user_timeout: Duration) -> io::Result<()> {
    // Frames are whole: there is nothing to wait for before one is sent.
    stream.set_nodelay(true)?;
    SockRef::from(stream).set_tcp_user_timeout(Some(user_timeout))
}
