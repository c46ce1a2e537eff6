//! The port or socket behind which devices are.

use blastema_lite::FRAME_MAX;
#[cfg(feature = "ip")]
use blastema_lite::{
    PACKET_MAX,
    cobs::{self, CobsDecoder},
};
use blastema_transports::Endpoint;
use blastema_transports::serial::{SerialConfig, SerialStream, open_bytes};
use std::future::poll_fn;
use std::io;
#[cfg(feature = "ip")]
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
#[cfg(feature = "ip")]
use tokio::net::UdpSocket;

/// Where a device is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum DeviceMedium {
    Serial(SerialConfig),
    /// A device at this address, which answers datagrams.
    #[cfg(feature = "ip")]
    Datagrams(SocketAddr),
}

impl DeviceMedium {
    /// Reads an endpoint.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        #[cfg_attr(not(feature = "ip"), expect(unused_variables))]
        let (endpoint, insecure) = Endpoint::parse(text).map_err(|error| error.to_string())?;
        match endpoint {
            Endpoint::Serial(config) => Ok(DeviceMedium::Serial(config)),
            #[cfg(feature = "ip")]
            Endpoint::Udp(config) => {
                let (device, settings) = (config.bind, text.split_once('?'));
                if device.ip().is_multicast() || settings.is_some_and(|(_, it)| it != "insecure") {
                    return Err(format!(
                        "{text}: the endpoint of a device on UDP is its own address, without \
                         settings but `insecure`"
                    ));
                }
                match device.ip().is_loopback() || insecure {
                    true => Ok(DeviceMedium::Datagrams(device)),
                    false => Err(format!(
                        "{text}: datagrams to a device are not authenticated, and every station on \
                         the network can command it: use a network of the robot's own, and write \
                         `?insecure`"
                    )),
                }
            }
            other => Err(format!(
                "{text}: devices are reached over `serial` or `udp`, and not over `{}`",
                other.medium()
            )),
        }
    }

    /// How long one byte takes; nothing for datagrams.
    pub(super) fn byte_time(&self) -> Duration {
        match self {
            DeviceMedium::Serial(config) => config.time_of(1),
            #[cfg(feature = "ip")]
            DeviceMedium::Datagrams(_) => Duration::ZERO,
        }
    }

    /// Whether packets can overtake each other.
    pub(super) fn reorders(&self) -> bool {
        !matches!(self, DeviceMedium::Serial(_))
    }

    pub(super) async fn open(&self) -> io::Result<OpenLine> {
        Ok(match self {
            DeviceMedium::Serial(config) => OpenLine::Bytes(open_bytes(config)?),
            #[cfg(feature = "ip")]
            DeviceMedium::Datagrams(device) => {
                let own: SocketAddr = match device {
                    SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
                    SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
                };
                let socket = UdpSocket::bind(own).await?;
                socket.connect(device).await?;
                OpenLine::Datagrams(socket)
            }
        })
    }
}

/// An open port or socket. It carries frames; a datagram is one without its framing.
pub(super) enum OpenLine {
    Bytes(SerialStream),
    #[cfg(feature = "ip")]
    Datagrams(UdpSocket),
}

impl OpenLine {
    /// Sends the frame that is unsent, and waits for bytes; 0 when all is sent. Nothing is lost
    /// when the future is dropped.
    pub(super) async fn exchange(
        &mut self,
        unsent: &mut Vec<u8>,
        buffer: &mut [u8; FRAME_MAX],
    ) -> io::Result<usize> {
        match self {
            OpenLine::Bytes(port) => poll_fn(|cx| poll_bytes(port, unsent, buffer, cx)).await,
            #[cfg(feature = "ip")]
            OpenLine::Datagrams(socket) if !unsent.is_empty() => {
                let mut decoder = CobsDecoder::default();
                for byte in unsent.iter() {
                    if let Some(packet) = decoder.push(*byte) {
                        socket.send(packet).await?;
                    }
                }
                unsent.clear();
                Ok(0)
            }
            #[cfg(feature = "ip")]
            OpenLine::Datagrams(socket) => {
                // One byte more than a packet has, so that a longer one is known for what it is.
                let mut packet = [0; PACKET_MAX + 1];
                let count = socket.recv(&mut packet).await?;
                let packet = packet.get(..count).filter(|packet| packet.len() <= PACKET_MAX);
                Ok(packet.map_or(0, |packet| cobs::encode(packet, buffer).len()))
            }
        }
    }
}

fn poll_bytes(
    port: &mut SerialStream,
    unsent: &mut Vec<u8>,
    buffer: &mut [u8],
    cx: &mut Context<'_>,
) -> Poll<io::Result<usize>> {
    let had = !unsent.is_empty();
    while !unsent.is_empty()
        && let Poll::Ready(written) = Pin::new(&mut *port).poll_write(cx, unsent)
    {
        unsent.drain(..written?);
    }
    if had && unsent.is_empty() {
        return Poll::Ready(Ok(0));
    }
    let mut received = ReadBuf::new(buffer);
    ready!(Pin::new(port).poll_read(cx, &mut received))?;
    let ended = || io::Error::new(io::ErrorKind::UnexpectedEof, "the port has ended");
    let count = received.filled().len();
    Poll::Ready((count > 0).then_some(count).ok_or_else(ended))
}
