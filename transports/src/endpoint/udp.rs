//! What the endpoint strings of UDP say.

use std::net::{Ipv4Addr, SocketAddr};

/// Where a [`Udp`](crate::Udp) listens, and how much it holds.
///
/// ```
/// use blastema_transports::UdpConfig;
/// let mut config = UdpConfig::default();
/// config.bind = "127.0.0.1:7400".parse()?;
/// # Ok::<(), std::net::AddrParseError>(())
/// ```
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct UdpConfig {
    /// Our own address; port 0 takes a free one. The default is loopback: no node outside this
    /// machine can send to a node that does not say otherwise.
    pub bind: SocketAddr,
    /// Only over this interface of the system, such as `eth0`, or `firewire0` for IP over IEEE 1394
    /// (RFC 2734). `None` leaves the choice to the system's routes.
    pub interface: Option<String>,
    /// A multicast group to hear as well; what is sent to its address reaches all who hear it.
    /// Several transports of one machine may hear the same.
    pub group: Option<SocketAddr>,
    /// Over how many routers frames to the group may go, less one: 1 is this network only.
    pub hops: u32,
    /// The largest frame, in bytes. By default what fits: 65,507 on loopback, elsewhere what an
    /// Ethernet frame carries (1,472 over IPv4, 1,452 over IPv6). No frame is cut up by IP off
    /// loopback: links find by probes what a path carries, from 1,200 bytes up to this.
    pub mtu: Option<usize>,
    /// The kernel's receive buffer, in bytes (Linux halves it for its own use and caps it at
    /// `net.core.rmem_max`). Larger bridges a longer stall of the arbiter, before frames are lost.
    pub receive_buffer: usize,
    /// The kernel's send buffer, in bytes.
    pub send_buffer: usize,
    /// How many frames wait when the kernel's send buffer is full; beyond, they are dropped.
    pub queue_frames: usize,
}

impl Default for UdpConfig {
    fn default() -> Self {
        UdpConfig {
            bind: (Ipv4Addr::LOCALHOST, 0).into(),
            interface: None,
            group: None,
            hops: 1,
            mtu: None,
            receive_buffer: 1 << 20,
            send_buffer: 1 << 18,
            queue_frames: 256,
        }
    }
}
