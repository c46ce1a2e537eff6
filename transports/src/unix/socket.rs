//! Sockets with paths: how one is opened, whatever lies there, and how two nodes meet on it.
//!
//! ```text
//! dialer                          listener
//!   ├── connect ────────────────────►│
//!   ├── preamble (my path) ─────────►│ knows who it is; may refuse by closing
//!   │◄───────────── preamble (path) ─┤ has kept the connection
//!   ├── frames ─ ─ ─ ─ ─ ─ ─ ─ frames┤
//! ```

use crate::descriptors::{MORE_DESCRIPTORS, are_used_up};
use crate::stream::BACKLOG;
use crate::stream::framing::{
    LONGEST_PATH, PreambleKind, encode_path_preamble, read_preamble, say_preamble,
};
use crate::unix::users::{AllowedUsers, PeerRole};
use socket2::{Domain, SockAddr, SockRef, Socket, Type};
use std::ffi::OsString;
use std::fs::{self, File, OpenOptions, Permissions, TryLockError};
use std::io;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::os::unix::fs::{FileTypeExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::io::AsyncReadExt;
use tokio::net::{UnixListener, UnixStream};
use tokio::time::timeout;

/// A socket that listens at a path, whatever a dead process has left there. The file goes when this
/// does.
#[derive(Debug)]
pub struct PathListener {
    pub(super) socket: UnixListener,
    path: Arc<Path>,
    /// Which file it is: device and number.
    file: (u64, u64),
    /// Held for as long as we listen; the system gives it back when we die.
    _lock: File,
}

impl PathListener {
    /// Listens there, for whom the file's permissions let in.
    ///
    /// # Errors
    /// Another process listens, something else is there, or the system refuses it; [`explain`] says
    /// what helps.
    ///
    /// # Panics
    /// Outside of a tokio runtime with IO.
    pub fn open(path: &Arc<Path>, mode: u32) -> io::Result<Self> {
        let address = SockAddr::unix(path)?;
        // Before a lock is left beside what is no socket.
        find_socket(path)?;
        let lock = lock(path)?;
        clear(path, &address)?;
        let socket = Socket::new(Domain::UNIX, Type::STREAM, None)?;
        socket.set_nonblocking(true)?;
        socket.bind(&address)?;
        // No process can connect before it listens, and so none does that may not.
        let opened = fs::set_permissions(path, Permissions::from_mode(mode))
            .and_then(|()| socket.listen(BACKLOG))
            .and_then(|()| Ok((UnixListener::from_std(socket.into())?, file_at(path)?)));
        match opened {
            Ok((socket, file)) => {
                Ok(PathListener { socket, path: path.clone(), file, _lock: lock })
            }
            Err(error) => {
                // What is left would look like a dead process's.
                let _ = fs::remove_file(path);
                Err(error)
            }
        }
    }
}

impl PathListener {
    /// The next one who connects.
    ///
    /// # Errors
    /// As the system says; the next one may succeed.
    pub async fn accept(&self) -> io::Result<UnixStream> {
        self.socket.accept().await.map(|(stream, _)| stream)
    }

    /// Whether its file is still there, so that a peer can connect: the system says nothing when
    /// one is removed.
    pub fn stands(&self) -> bool {
        file_at(&self.path).is_ok_and(|file| file == self.file)
    }
}

impl Drop for PathListener {
    fn drop(&mut self) {
        // The folder may be gone already, and the file with it, or be another's by now.
        if self.stands() {
            let _ = fs::remove_file(&self.path);
        }
    }
}

fn file_at(path: &Path) -> io::Result<(u64, u64)> {
    fs::symlink_metadata(path).map(|file| (file.dev(), file.ino()))
}

/// Takes the lock beside the socket. Its file stays behind: who removes it may take it from under
/// another who is about to lock it.
fn lock(path: &Path) -> io::Result<File> {
    let mut name = path.as_os_str().to_owned();
    name.push(".lock");
    let lock = OpenOptions::new()
        .create(true)
        .truncate(false)
        .write(true)
        .mode(0o600)
        .open(PathBuf::from(name))?;
    match lock.try_lock() {
        Ok(()) => Ok(lock),
        Err(TryLockError::WouldBlock) => Err(io::ErrorKind::AddrInUse.into()),
        Err(TryLockError::Error(error)) => Err(error),
    }
}

/// Whether a socket lies there. Anything else is in the way.
fn find_socket(path: &Path) -> io::Result<bool> {
    match fs::symlink_metadata(path) {
        Ok(found) if found.file_type().is_socket() => Ok(true),
        Ok(_) => Err(io::ErrorKind::AlreadyExists.into()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// Removes the socket that a dead process has left, and nothing else.
fn clear(path: &Path, address: &SockAddr) -> io::Result<()> {
    if !find_socket(path)? {
        return Ok(());
    }
    // A program of another kind, which knows nothing of the lock, may listen there.
    let probe = Socket::new(Domain::UNIX, Type::STREAM, None)?;
    probe.set_nonblocking(true)?;
    match probe.connect(address) {
        Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => fs::remove_file(path),
        _ => Err(io::ErrorKind::AddrInUse.into()),
    }
}

/// What a person may do about a socket that does not open.
pub fn explain(path: &Path, error: &io::Error) -> String {
    let advice = match error.kind() {
        _ if are_used_up(error) => MORE_DESCRIPTORS,
        io::ErrorKind::AddrInUse => {
            "another process uses the socket: end that process, or choose another path"
        }
        io::ErrorKind::AlreadyExists if path.is_dir() => {
            "there is a folder: choose the path of a file in it"
        }
        io::ErrorKind::AlreadyExists => {
            "there is a file that is no socket: remove it, or choose another path"
        }
        io::ErrorKind::NotFound => "its folder does not exist: create it",
        io::ErrorKind::NotADirectory => "what should be its folder is none: choose another path",
        io::ErrorKind::ReadOnlyFilesystem => "nothing can be written there: choose another path",
        io::ErrorKind::PermissionDenied => {
            "the system forbids it: let this user write to the folder, or choose another"
        }
        io::ErrorKind::InvalidInput => {
            let path = path.display();
            return format!(
                "unix {path} cannot be opened: the path has more than {LONGEST_PATH} bytes: choose \
                 a shorter one"
            );
        }
        _ => "check the path and the machine's limits",
    };
    format!("unix {} cannot be opened ({error}): {advice}", path.display())
}

/// Connects to a listening peer, and is done when that has kept the connection.
pub(super) async fn dial(
    local: Arc<Path>,
    peer: Arc<Path>,
    users: AllowedUsers,
    hello_timeout: Duration,
) -> io::Result<UnixStream> {
    timeout(hello_timeout, async {
        let mut stream = UnixStream::connect(&peer).await?;
        users.check(&stream, &peer, PeerRole::Listener)?;
        introduce(&stream, &local)?;
        if read_path(&mut stream).await? != peer {
            return Err(io::Error::other("another node listens there"));
        }
        Ok(stream)
    })
    .await?
}

/// Learns at which path a node that has connected listens.
pub(super) async fn greet(
    mut stream: UnixStream,
    hello_timeout: Duration,
) -> io::Result<(UnixStream, Arc<Path>)> {
    let path = timeout(hello_timeout, read_path(&mut stream)).await??;
    Ok((stream, path))
}

/// Says at which path we listen.
pub(super) fn introduce(stream: &UnixStream, path: &Path) -> io::Result<()> {
    say_preamble(SockRef::from(stream), &encode_path_preamble(path.as_os_str().as_bytes()))
}

async fn read_path(stream: &mut UnixStream) -> io::Result<Arc<Path>> {
    let length = read_preamble(stream, PreambleKind::Path).await?;
    let mut path = vec![0; length.into()];
    stream.read_exact(&mut path).await?;
    Ok(PathBuf::from(OsString::from_vec(path)).into())
}
