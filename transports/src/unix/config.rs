//! Where a Unix-domain socket lies, and how much it holds.

use crate::stream::StreamLimits;
use std::path::PathBuf;

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
