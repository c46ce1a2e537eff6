//! One node writes one journal: the lock beside the file.
//!
//! The kernel gives the lock back when the process ends, however that happens. So a reader sees
//! from it whether the node that wrote last still runs.

use blastema_core::NodeName;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

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
    /// Locked for as long as it is open.
    _file: File,
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
        Ok(JournalLock { _file: file })
    }
}

/// Whether a node writes the journal at `path` now.
pub(super) fn is_held(path: &Path) -> bool {
    let Ok(file) = File::open(beside(path, "lock")) else { return false };
    matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
}

/// A path beside the journal's, with one more ending.
pub(super) fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(ending);
    name.into()
}
