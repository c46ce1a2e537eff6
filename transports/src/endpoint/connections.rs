//! What the endpoint strings of media with connections say: TCP and Unix-domain sockets.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

/// How much a transport of connections holds, and how long it waits for peers.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct StreamLimits {
    /// The largest frame, in bytes. Larger frames keep others waiting longer behind them, and raise
    /// what each connection may hold.
    pub mtu: usize,
    /// How many peers have a place; beyond, they are refused.
    pub peers: usize,
    /// How many connections may be open on which the peer has not said who it is or, with keys, has
    /// not proven it.
    pub strangers: usize,
    /// How many bytes wait for each peer; beyond, frames are dropped.
    pub queue_bytes: usize,
    /// How long making a connection may take.
    pub connect_timeout: Duration,
    /// How long a stranger may say nothing and, with keys, then take to prove who it is.
    pub hello_timeout: Duration,
}

impl Default for StreamLimits {
    fn default() -> Self {
        StreamLimits {
            mtu: 64 * 1024,
            peers: 64,
            strangers: 32,
            queue_bytes: 1 << 20,
            connect_timeout: Duration::from_secs(1),
            hello_timeout: Duration::from_secs(2),
        }
    }
}

/// Where a [`Tcp`](crate::Tcp) listens, and how much it holds.
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
    /// Our own address; port 0 takes a free one. The default is loopback: no node outside this
    /// machine can connect to a node that does not say otherwise.
    pub bind: SocketAddr,
    /// Only over this interface of the system, such as `eth0`. `None` leaves the choice to the
    /// system's routes.
    pub interface: Option<String>,
    /// How much it holds, and how long it waits for peers.
    pub limits: StreamLimits,
    /// How long sent bytes may stay unconfirmed until the kernel gives the connection up
    /// (`TCP_USER_TIMEOUT`, RFC 5482; its own patience is a quarter of an hour).
    pub user_timeout: Duration,
}

impl Default for TcpConfig {
    fn default() -> Self {
        TcpConfig {
            bind: (Ipv4Addr::LOCALHOST, 0).into(),
            interface: None,
            limits: StreamLimits::default(),
            user_timeout: Duration::from_millis(500),
        }
    }
}

/// Where a Unix-domain socket listens, and how much it holds.
///
/// ```
/// use blastema_transports::UnixConfig;
/// let mut config = UnixConfig::new("/run/robot/module1.sock");
/// config.mode = 0o660; // the group may speak, too
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct UnixConfig {
    /// Our own socket file. Its folder must exist, and let us create it there.
    pub path: PathBuf,
    /// Who may connect: the file's permissions. By default our own user only.
    pub mode: u32,
    /// The numbers of other users whose processes may be peers, as the system tells of each
    /// connection (`SO_PEERCRED`). Processes of our own user always may. The file's permissions
    /// must let these users connect besides: see `mode`.
    pub users: Vec<u32>,
    /// How much it holds, and how long it waits for peers.
    pub limits: StreamLimits,
}

impl UnixConfig {
    /// A socket at this path.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        UnixConfig {
            path: path.into(),
            mode: 0o600,
            users: Vec::new(),
            limits: StreamLimits::default(),
        }
    }
}
