//! One node writes one journal: the locks beside the file.
//!
//! ```text
//! faults.db.lock  held from before the file is opened: one node writes it
//! faults.db.run   held once the earlier runs are marked as ended: the last run goes on
//! ```
//!
//! The kernel gives both back when the process ends, however that happens. So a reader sees from
//! the second one whether the node that wrote last still runs: a process that has not opened the
//! journal yet does not hold it, and the faults of the run before are not taken for open ones.

use blastema_core::NodeName;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// What the name of the second lock ends in.
const RUN: &str = "run";

/// Why a journal cannot be locked.
#[derive(Debug)]
pub(crate) enum LockError {
    /// Another node writes this journal.
    InUse {
        /// Which node, and which process it is.
        by: String,
    },
    /// The operating system refuses it.
    Io(io::Error),
}

/// While it lives, no other node writes the journal.
#[derive(Debug)]
pub(crate) struct JournalLock {
    path: PathBuf,
    /// Locked for as long as it is open.
    _file: File,
    /// The same, of the run.
    run: OnceLock<File>,
}

impl JournalLock {
    /// Locks the journal at `path` for `node`.
    pub(crate) fn acquire(path: &Path, node: &NodeName) -> Result<Self, LockError> {
        let name = beside(path, "lock");
        let mut options = OpenOptions::new();
        let opened = options.read(true).write(true).create(true).truncate(false).open(name);
        let mut file = opened.map_err(LockError::Io)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut by = String::new();
                // What the holder is writing at this moment may not be there yet.
                let _ = file.read_to_string(&mut by);
                return Err(LockError::InUse { by: by.trim().to_owned() });
            }
            Err(TryLockError::Error(error)) => return Err(LockError::Io(error)),
        }
        // For people; the lock itself says what counts. A full disk therefore stops nothing.
        let _ = file.set_len(0);
        let _ = writeln!(file, "node {node}, process {}", std::process::id());
        Ok(JournalLock { path: path.to_owned(), _file: file, run: OnceLock::new() })
    }

    /// The last run in the journal is that of the holder: all others are marked as ended.
    pub(super) fn begin_run(&self) -> io::Result<()> {
        if self.run.get().is_some() {
            return Ok(());
        }
        let mut options = OpenOptions::new();
        let opened = options.read(true).write(true).create(true).truncate(false);
        let file = opened.open(beside(&self.path, RUN))?;
        // Only readers hold it beside the node, for an instant each.
        file.lock()?;
        // This is the only thread that writes the journal.
        let _ = self.run.set(file);
        Ok(())
    }
}

/// Whether the last run in the journal at `path` goes on.
pub(super) fn is_running(path: &Path) -> bool {
    let Ok(file) = File::open(beside(path, RUN)) else { return false };
    matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
}

/// A path beside the journal's, with one more ending.
pub(super) fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(ending);
    name.into()
}
