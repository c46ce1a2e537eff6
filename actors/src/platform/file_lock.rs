//! One node uses one file: a lock beside it, `<file>.lock`.
//!
//! The kernel gives it back when the process ends, however that happens. A node that starts waits
//! for one of its own process that ends at this moment: see [`HeldHere`].

use super::{lock, sleep};
use blastema_core::NodeName;
use blastema_core::sorted::SortedMap;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};
use std::time::Duration;

/// A process that is just being started by another thread holds what that one has open, for a
/// moment. A node holds a file for good.
const ATTEMPTS: u32 = 20;
const PAUSE: Duration = Duration::from_millis(10);
/// How long a node that starts waits for one of its own process that ends: the last writes to a
/// slow disk.
pub(crate) const PREDECESSOR_TIMEOUT: Duration = Duration::from_secs(5);
/// As many links as Linux follows.
const LINKS_MAX: u32 = 40;

/// Why a file cannot be locked.
#[derive(Debug, thiserror::Error)]
pub(crate) enum LockError {
    /// Another node uses it.
    #[error(
        "another process uses the file ({by}): end that process, or give this node another file"
    )]
    InUse {
        /// Which node, and which process it is.
        by: String,
    },
    /// The operating system refuses it.
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// While it lives, no other node uses the file.
#[derive(Debug)]
pub(crate) struct FileLock {
    /// Locked for as long as it is open; closed before the path counts as free.
    _file: File,
    held: HeldHere,
}

impl FileLock {
    /// Locks the file at `path`, or where a link leads that is there, for `node`.
    pub(crate) fn acquire(path: &Path, node: &NodeName) -> Result<Self, LockError> {
        let path = without_links(path);
        let mut options = OpenOptions::new();
        let opened = options.read(true).write(true).create(true).truncate(false);
        let mut file = opened.open(beside(&path, "lock"))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut by = String::new();
                // What the holder is writing at this moment may not be there yet.
                let _ = file.read_to_string(&mut by);
                return Err(LockError::InUse { by: by.trim().to_owned() });
            }
            Err(TryLockError::Error(error)) => return Err(error.into()),
        }
        // For people; the lock itself says what counts. A full disk therefore stops nothing.
        let _ = file.set_len(0);
        let _ = writeln!(file, "node {node}, process {}", std::process::id());
        Ok(FileLock { _file: file, held: HeldHere::new(path) })
    }

    /// The same, once a node of this process that ends has given it back.
    pub(crate) async fn acquire_after_predecessor(
        path: &Path,
        node: &NodeName,
    ) -> Result<Self, LockError> {
        released_here(&without_links(path), PREDECESSOR_TIMEOUT).await;
        let mut attempts = 1;
        loop {
            match FileLock::acquire(path, node) {
                Err(LockError::InUse { .. }) if attempts < ATTEMPTS => attempts += 1,
                answer => return answer,
            }
            sleep(PAUSE).await;
        }
    }

    /// The file itself, whatever links lead to it.
    pub(crate) fn path(&self) -> &Path {
        &self.held.0
    }
}

/// What nodes of this process hold, each with how often.
static HELD: Mutex<SortedMap<PathBuf, usize>> = Mutex::new(SortedMap::new());

fn held() -> MutexGuard<'static, SortedMap<PathBuf, usize>> {
    lock(&HELD)
}

/// While it lives, a node of this process holds what is at the path: a file, or a socket.
#[derive(Debug)]
pub(crate) struct HeldHere(PathBuf);

impl HeldHere {
    pub(crate) fn new(path: PathBuf) -> Self {
        *held().entry(path.clone()).or_default() += 1;
        HeldHere(path)
    }
}

impl Drop for HeldHere {
    fn drop(&mut self) {
        let mut held = held();
        match held.get_mut(&self.0) {
            Some(count) if *count > 1 => *count -= 1,
            _ => drop(held.remove(&self.0)),
        }
    }
}

/// Waits until no node of this process holds what is at the path, for so long at most.
pub(crate) async fn released_here(path: &Path, within: Duration) {
    let free = async {
        while held().contains_key(path) {
            sleep(PAUSE).await;
        }
    };
    // A holder that is still there refuses the path when it is used.
    let _ = tokio::time::timeout(within, free).await;
}

/// The file that is meant, also if it is not there yet.
pub(crate) fn without_links(path: &Path) -> PathBuf {
    let mut path = path.to_owned();
    for _ in 0..LINKS_MAX {
        let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else { break };
        let folder = fs::canonicalize(folder).unwrap_or_else(|_| folder.to_owned());
        path = folder.join(name);
        match fs::read_link(&path) {
            Ok(target) => path = folder.join(target),
            Err(_) => break,
        }
    }
    path
}

/// A path beside the file's, with one more ending.
pub(crate) fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(ending);
    name.into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    #[test]
    fn a_file_is_locked_by_whichever_link_it_is_reached() {
        let folder = tempfile::tempdir().unwrap();
        let [file, link, other] = ["file", "link", "other"].map(|name| folder.path().join(name));
        symlink("file", &link).unwrap();
        symlink(folder.path(), &other).unwrap();
        let (first, second) = (NodeName::new("a").unwrap(), NodeName::new("b").unwrap());
        let lock = FileLock::acquire(&link, &first).unwrap();
        assert_eq!(lock.path(), without_links(&file));

        for _ in 0..2 {
            for path in [&file, &link, &other.join("link")] {
                let Err(LockError::InUse { by }) = FileLock::acquire(path, &second) else {
                    panic!("{path:?} is locked")
                };
                assert!(by.starts_with("node a, process "), "{by}");
            }
            fs::write(&file, "now it is there").unwrap();
        }
        drop(lock);
        assert!(FileLock::acquire(&file, &second).is_ok());
    }
}
