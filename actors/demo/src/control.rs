//! The channel between the director and its modules: a Unix socket in a private folder.
//!
//! The folder, which holds the modules' keys too, exists only until all modules are ready, so that
//! nothing is left behind even if the director is killed while the robot runs. Both sides check
//! that the other one belongs to the same user, the director also that it is the process that it
//! started.

use super::protocol::{LINE_LIMIT, decode, encode};
use super::robot::Module;
use crate::run_keys::RunKeys;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::{fs, io};
use tempfile::TempDir;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{UnixListener, UnixStream};

/// How the folders' names begin; then follow the director's process id and a random part.
const PREFIX: &str = "blastema-demo-";
/// The longest path of a Unix socket on Linux, without the closing zero.
const PATH_LIMIT: usize = 107;

/// An error of the control channel.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ControlError {
    /// The folder for the socket could not be made. Set `TMPDIR` to a folder that can be written.
    #[error("no folder for the control socket in {}: {source}; set TMPDIR to another folder", .path.display())]
    Folder {
        /// In which folder.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// `TMPDIR` is too deep.
    #[error("the path {} is too long for a Unix socket; set TMPDIR to a shorter one", .path.display())]
    PathTooLong {
        /// The socket's path.
        path: PathBuf,
    },
    /// The other side belongs to another user, or is not the process that was started.
    #[error(
        "the other side of the control channel is process {process:?} of user {user}, which was not expected"
    )]
    Stranger {
        /// Its process.
        process: Option<i32>,
        /// Its user.
        user: u32,
    },
    /// The keys of the modules could not be made or written.
    #[error("no keys for the modules: {0}")]
    Keys(String),
    /// The socket failed.
    #[error("the control channel failed: {0}")]
    Socket(#[from] io::Error),
}

/// The socket on which the director accepts its modules, in a folder with their keys.
#[derive(Debug)]
pub(crate) struct ControlListener {
    listener: UnixListener,
    path: PathBuf,
    // Removed when it is dropped.
    folder: TempDir,
}

impl ControlListener {
    /// Creates the folder, writes the modules' keys there, and listens.
    ///
    /// # Errors
    /// See [`ControlError`].
    pub(crate) fn open(keys: &RunKeys) -> Result<ControlListener, ControlError> {
        let base = std::env::temp_dir();
        sweep(&base);
        let prefix = format!("{PREFIX}{}-", std::process::id());
        let private = fs::Permissions::from_mode(0o700);
        let folder = tempfile::Builder::new().prefix(&prefix).permissions(private).tempdir();
        let folder = folder.map_err(|source| ControlError::Folder { path: base, source })?;
        let path = folder.path().join("control");
        if path.as_os_str().len() > PATH_LIMIT {
            return Err(ControlError::PathTooLong { path });
        }
        keys.write(folder.path()).map_err(|error| ControlError::Keys(error.to_string()))?;
        let listener = UnixListener::bind(&path)?;
        Ok(ControlListener { listener, path, folder })
    }

    /// Returns the path of the socket.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the file of a module's key.
    pub(crate) fn key_of(&self, module: Module) -> PathBuf {
        RunKeys::file_of(self.folder.path(), module.name())
    }

    /// Accepts the next process of the same user and returns its id. Others are refused.
    ///
    /// # Errors
    /// The socket failed.
    pub(crate) async fn admit(&self) -> io::Result<(i32, LineReader, LineWriter)> {
        loop {
            let (stream, _) = self.listener.accept().await?;
            if let Ok(Some(process)) = check_user(&stream) {
                let (reader, writer) = split(stream);
                return Ok((process, reader, writer));
            }
        }
    }
}

/// Connects a module to its director.
///
/// # Errors
/// No process listens, or it is not the process `parent` of the same user.
pub(crate) async fn enter(
    path: &Path,
    parent: u32,
) -> Result<(LineReader, LineWriter), ControlError> {
    let stream = UnixStream::connect(path).await?;
    let process = check_user(&stream)?;
    if process.and_then(|process| u32::try_from(process).ok()) != Some(parent) {
        let user = stream.peer_cred()?.uid();
        return Err(ControlError::Stranger { process, user });
    }
    Ok(split(stream))
}

/// Receives lines.
#[derive(Debug)]
pub(crate) struct LineReader(BufReader<OwnedReadHalf>);

/// Sends lines.
#[derive(Debug)]
pub(crate) struct LineWriter(OwnedWriteHalf);

impl LineReader {
    /// Returns the next message, or `None` when the other side has closed the channel.
    ///
    /// # Errors
    /// The socket failed, a line was too long, or it was no message.
    pub(crate) async fn next<T: DeserializeOwned>(&mut self) -> io::Result<Option<T>> {
        let mut line = String::new();
        let limit = LINE_LIMIT as u64;
        let length = (&mut self.0).take(limit).read_line(&mut line).await?;
        match (length, line.ends_with('\n')) {
            (0, _) => Ok(None),
            (_, true) => decode(&line).map(Some).map_err(io::Error::other),
            // The other side ended in the middle of a line.
            (length, false) if length < LINE_LIMIT => Ok(None),
            (_, false) => Err(io::Error::other("a line of the control channel is too long")),
        }
    }
}

impl LineWriter {
    /// Sends a message.
    ///
    /// # Errors
    /// The other side has closed the channel.
    pub(crate) async fn send<T: Serialize>(&mut self, message: &T) -> io::Result<()> {
        self.0.write_all(encode(message).as_bytes()).await
    }
}

fn split(stream: UnixStream) -> (LineReader, LineWriter) {
    let (reader, writer) = stream.into_split();
    (LineReader(BufReader::new(reader)), LineWriter(writer))
}

/// Returns the peer's process if it belongs to the same user.
fn check_user(stream: &UnixStream) -> Result<Option<i32>, ControlError> {
    let peer = stream.peer_cred()?;
    let (process, user) = (peer.pid(), peer.uid());
    if user == rustix::process::getuid().as_raw() {
        Ok(process)
    } else {
        Err(ControlError::Stranger { process, user })
    }
}

/// Removes the folders of directors that were killed before their modules had connected.
fn sweep(base: &Path) {
    let Ok(entries) = fs::read_dir(base) else { return };
    for entry in entries.flatten() {
        let name = entry.file_name();
        let owner = name.to_str().and_then(owner_of);
        if owner.is_some_and(|owner| !Path::new("/proc").join(owner).exists()) {
            // Another user's folder stays, as it should.
            let _ = fs::remove_dir_all(entry.path());
        }
    }
}

fn owner_of(name: &str) -> Option<&str> {
    let (owner, _) = name.strip_prefix(PREFIX)?.split_once('-')?;
    let is_number = !owner.is_empty() && owner.bytes().all(|byte| byte.is_ascii_digit());
    is_number.then_some(owner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::{DirectorCommand, ModuleEvent};

    fn open() -> ControlListener {
        let keys = RunKeys::new("robot", &["module1"]).expect("there is chance");
        ControlListener::open(&keys).expect("a folder can be made")
    }

    #[tokio::test]
    async fn both_sides_know_each_other_and_talk_in_lines() {
        let listener = open();
        let path = listener.path().to_owned();
        let own = std::process::id();

        let (inside, outside) = tokio::join!(listener.admit(), enter(&path, own));
        let (process, mut from_module, mut to_module) = inside.expect("a module has connected");
        let (mut from_director, mut to_director) = outside.expect("the listener is open");
        to_module.send(&DirectorCommand::Status).await.expect("the module is there");
        to_director.send(&ModuleEvent::Ready).await.expect("the director is there");
        drop(to_director);
        drop(from_director.next::<DirectorCommand>().await);
        drop(from_director);

        assert_eq!(u32::try_from(process).ok(), Some(own));
        assert_eq!(from_module.next().await.expect("a line"), Some(ModuleEvent::Ready));
        assert_eq!(from_module.next::<ModuleEvent>().await.expect("the end"), None);
    }

    #[tokio::test]
    async fn a_module_does_not_obey_a_process_that_did_not_start_it() {
        let listener = open();
        let path = listener.path().to_owned();

        let (_, outside) = tokio::join!(listener.admit(), enter(&path, 1));

        assert!(matches!(outside, Err(ControlError::Stranger { .. })), "{outside:?}");
    }

    #[tokio::test]
    async fn the_folder_is_private_and_goes_with_the_door() {
        let listener = open();
        let folder = listener.path().parent().expect("the socket is in a folder").to_owned();
        let mode = fs::metadata(&folder).expect("it exists").permissions().mode();
        drop(listener);

        assert_eq!(mode & 0o777, 0o700);
        assert!(!folder.exists());
    }

    #[tokio::test]
    async fn a_line_without_an_end_is_refused() {
        let (left, right) = UnixStream::pair().expect("a pair of sockets");
        let (_, mut writer) = split(left);
        let (mut reader, _) = split(right);
        let flood = async move {
            // The reader gives up before all of it is written.
            let _ = writer.0.write_all(&vec![b'x'; 2 * LINE_LIMIT]).await;
        };

        let (_, read) = tokio::join!(flood, async move { reader.next::<ModuleEvent>().await });

        assert!(read.is_err_and(|error| error.to_string().contains("too long")));
    }

    #[test]
    fn only_our_own_folders_of_dead_directors_are_swept() {
        let base = tempfile::tempdir().expect("a folder can be made");
        let dead = base.path().join(format!("{PREFIX}999999999-abc"));
        let living = base.path().join(format!("{PREFIX}{}-abc", std::process::id()));
        let foreign = base.path().join("other-999999999-abc");
        for folder in [&dead, &living, &foreign] {
            fs::create_dir(folder).expect("a folder can be made");
        }

        sweep(base.path());

        assert_eq!((dead.exists(), living.exists(), foreign.exists()), (false, true, true));
    }
}
