//! Unix-domain sockets, between processes of one machine: frames in a stream for each peer
//! (the module `stream`).
//!
//! * **A peer** is known by the path of its socket, which all must spell alike.
//! * **Which processes may be peers** is decided by the permissions of the socket file and of its
//!   folder, and by their user ([`users`]): at both ends a process of another user is refused
//!   unless its user is listed. A process of an accepted user could claim any path.
//! * **A file that a dead process has left behind** is taken over: a lock beside it, which dies
//!   with its process, tells whether a process still listens there. What is no socket is never
//!   removed.
//! * **A peer that dies** is noticed at once, for the system closes its connections.

mod socket;
pub mod users;

pub use self::socket::{PathListener, explain};
pub use self::users::{AllowedUsers, PeerRole};
pub use crate::endpoint::{StreamLimits, UnixConfig};
pub use crate::stream::framing;

use self::socket::{dial, greet, introduce};
use crate::stream::{HandshakeFuture, StreamFamily, Streams};
use blastema_contract::transport::MediumAddress;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::task::{self, Poll};
use tokio::net::UnixStream;

/// Unix-domain sockets as a transport.
///
/// It lives until it is sent [`Close`](blastema_contract::transport::Close).
pub type Unix = Streams<OverPaths>;

impl Unix {
    /// A transport that opens when it is started.
    pub fn new(config: UnixConfig) -> Self {
        let (users, limits) = (AllowedUsers::new(&config.users), config.limits.clone());
        Streams::over(OverPaths { config, users }, limits)
    }
}

/// Streams between sockets with paths.
pub struct OverPaths {
    config: UnixConfig,
    users: AllowedUsers,
}

impl StreamFamily for OverPaths {
    type Stream = UnixStream;
    type Listener = PathListener;
    type Address = Arc<Path>;
    /// A peer that connects has no address of its own.
    type Origin = ();

    fn listen(&mut self) -> Result<(PathListener, Arc<Path>), String> {
        let path: Arc<Path> = self.config.path.as_path().into();
        let listener = PathListener::open(&path, self.config.mode);
        let listener =
            listener.map_err(|error| format!("{}; trying again", explain(&path, &error)))?;
        Ok((listener, path))
    }

    fn poll_accept(
        listener: &PathListener,
        task: &mut task::Context<'_>,
    ) -> Poll<io::Result<(UnixStream, ())>> {
        listener.socket.poll_accept(task).map_ok(|(stream, _)| (stream, ()))
    }

    fn dial(&self, local: &Arc<Path>, peer: &Arc<Path>) -> HandshakeFuture<UnixStream> {
        let (local, peer, users) = (local.clone(), peer.clone(), self.users.clone());
        Box::pin(dial(local, peer, users, self.config.limits.connect_timeout))
    }

    fn greet(&self, stream: UnixStream, _: &()) -> HandshakeFuture<(UnixStream, Arc<Path>)> {
        let allowed = self.users.check(&stream, &self.config.path, PeerRole::Client);
        let greeting = greet(stream, self.config.limits.hello_timeout);
        Box::pin(async move {
            allowed?;
            greeting.await
        })
    }

    fn introduce(stream: &UnixStream, local: &Arc<Path>) -> io::Result<()> {
        introduce(stream, local)
    }

    fn ourselves(_: &UnixStream, local: &Arc<Path>) -> io::Result<Arc<Path>> {
        Ok(local.clone())
    }

    fn address(address: MediumAddress) -> Option<Arc<Path>> {
        match address {
            MediumAddress::Unix(path) => Some(path),
            _ => None,
        }
    }
}
