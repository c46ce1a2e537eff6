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

use crate::platform::file_lock::{FileLock, beside, without_links};
use std::fs::{File, OpenOptions, TryLockError};
use std::io;
use std::path::Path;
use std::sync::OnceLock;

/// What the name of the second lock ends in.
const RUN: &str = "run";

/// While it lives, no other node writes the journal.
#[derive(Debug)]
pub(crate) struct JournalLock {
    /// Locked for as long as it is open, if it is.
    run: OnceLock<File>,
    lock: FileLock,
}

impl JournalLock {
    /// The journal under this lock, before its run has begun.
    pub(crate) fn new(lock: FileLock) -> Self {
        JournalLock { run: OnceLock::new(), lock }
    }

    /// The journal itself, whatever links lead to it.
    pub(crate) fn path(&self) -> &Path {
        self.lock.path()
    }

    /// The last run in the journal is that of the holder: all others are marked as ended.
    pub(super) fn begin_run(&self) -> io::Result<()> {
        if self.run.get().is_some() {
            return Ok(());
        }
        let mut options = OpenOptions::new();
        let opened = options.read(true).write(true).create(true).truncate(false);
        let file = opened.open(beside(self.path(), RUN))?;
        // Only readers hold it beside the node, for an instant each.
        file.lock()?;
        // This is the only thread that writes the journal.
        let _ = self.run.set(file);
        Ok(())
    }
}

/// Whether the last run in the journal at `path` goes on.
pub(super) fn is_running(path: &Path) -> bool {
    let Ok(file) = File::open(beside(&without_links(path), RUN)) else { return false };
    matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
}
