//! A file that is replaced as a whole.

use crate::platform::file_lock::beside;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;
use std::process;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;

/// Makes names different that threads of one process write at a time.
static COUNT: AtomicU64 = AtomicU64::new(0);

/// Writes a file beside the old one, synchronises it to the disk, and renames it over the old one:
/// whatever ends the process, or the power, leaves the old file or the new one.
pub(crate) fn replace_file(path: &Path, bytes: &[u8]) -> io::Result<()> {
    // Processes may share the folder.
    let number = COUNT.fetch_add(1, Relaxed);
    let new = beside(path, &format!("{}-{number}.new", process::id()));
    let written = || {
        let mut file = File::create_new(&new)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&new, path)
    };
    written().inspect_err(|_| drop(fs::remove_file(&new)))?;
    // That it has its name now is the folder's content.
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}
