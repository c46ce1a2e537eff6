//! Where a Unix-domain socket lies, and how much it holds.

use std::path::PathBuf;
use std::time::Duration;

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
    /// The largest frame, in bytes.
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

impl UnixConfig {
    /// A socket at this path.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        UnixConfig {
            path: path.into(),
            mode: 0o600,
            users: Vec::new(),
            mtu: 64 * 1024,
            peers: 64,
            strangers: 32,
            queue_bytes: 1 << 20,
            connect_timeout: Duration::from_secs(1),
            hello_timeout: Duration::from_secs(2),
        }
    }
}
