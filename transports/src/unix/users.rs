//! Which users' processes may be at the other end of a Unix socket.
//!
//! The system reports the user of a peer's process for each connection (`SO_PEERCRED`, unix(7)): of
//! the process that connected, and of the one that listened when it began to listen. A process
//! cannot forge it. The process id is not compared, because the system reuses it.

use std::io;
use std::path::Path;
use tokio::net::UnixStream;

/// The users whose processes are accepted: our own and those that are listed.
#[derive(Clone, Debug)]
pub struct AllowedUsers {
    own: u32,
    listed: Vec<u32>,
}

/// Which end of a connection the peer is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PeerRole {
    /// It listens at the path.
    Listener,
    /// It has connected to the path.
    Client,
}

impl AllowedUsers {
    /// The user that this process runs as, and these.
    pub fn new(listed: &[u32]) -> Self {
        AllowedUsers { own: rustix::process::geteuid().as_raw(), listed: listed.to_vec() }
    }

    /// Checks the peer of a connection to the socket at `path`.
    ///
    /// # Errors
    /// `PermissionDenied` if its process runs as another user; the text says what to write. Or the
    /// system does not report the user.
    pub fn check(&self, stream: &UnixStream, path: &Path, peer: PeerRole) -> io::Result<()> {
        let user = stream.peer_cred()?.uid();
        match self.refusal(user, path, peer) {
            None => Ok(()),
            Some(text) => Err(io::Error::new(io::ErrorKind::PermissionDenied, text)),
        }
    }

    fn refusal(&self, user: u32, path: &Path, peer: PeerRole) -> Option<String> {
        if user == self.own || self.listed.contains(&user) {
            return None;
        }
        let process = match peer {
            PeerRole::Listener => "the process there",
            PeerRole::Client => "a process that connected",
        };
        let taken: Vec<String> =
            std::iter::once(&self.own).chain(&self.listed).map(u32::to_string).collect();
        let taken = taken.join(", ");
        Some(format!(
            "unix:{}: {process} runs as uid {user}, and this node takes {taken} only: add users={user}",
            path.display()
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn our_own_user_and_the_listed_ones_are_accepted_and_others_are_told_what_to_write() {
        let allowed = |listed: &[u32]| AllowedUsers { own: 1000, listed: listed.to_vec() };
        let path = Path::new("/run/arm.sock");

        assert_eq!(allowed(&[]).refusal(1000, path, PeerRole::Listener), None);
        assert_eq!(allowed(&[1002]).refusal(1002, path, PeerRole::Client), None);
        assert_eq!(
            allowed(&[]).refusal(1002, path, PeerRole::Listener).as_deref(),
            Some(
                "unix:/run/arm.sock: the process there runs as uid 1002, and this node takes 1000 \
                 only: add users=1002"
            )
        );
        // Root is a user like any other here: what it may do besides, it does without this socket.
        assert_eq!(
            allowed(&[1002, 7]).refusal(0, path, PeerRole::Client).as_deref(),
            Some(
                "unix:/run/arm.sock: a process that connected runs as uid 0, and this node takes \
                 1000, 1002, 7 only: add users=0"
            )
        );
    }
}
