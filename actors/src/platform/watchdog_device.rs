//! The computer's watchdog: a timer in hardware that restarts the computer unless it is written to
//! (kernel documentation, watchdog/watchdog-api).

use super::ProcessWatchdog;
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Drivers fire after a few seconds at the earliest.
const STROKE_INTERVAL: Duration = Duration::from_secs(1);
/// What disarms it when it is closed.
const MAGIC: &[u8] = b"V";

/// An open watchdog: from here on it fires unless it is stroked.
pub(crate) struct WatchdogDevice {
    file: File,
    path: PathBuf,
}

impl WatchdogDevice {
    /// Opens it, which arms it.
    ///
    /// # Errors
    /// What stands in the way, and what to do.
    pub(crate) fn open(path: &Path) -> Result<Self, String> {
        check(path)?;
        match OpenOptions::new().write(true).open(path) {
            Ok(file) => Ok(WatchdogDevice { file, path: path.to_owned() }),
            Err(error) => Err(explain(path, &error)),
        }
    }
}

/// Refuses a device of another kind, such as `/dev/null`, which would take the strokes and never
/// restart the computer. A regular file or a pipe takes the place of a watchdog in a test.
fn check(path: &Path) -> Result<(), String> {
    // The attempt to open it reports what cannot be read here.
    let Ok(metadata) = std::fs::metadata(path) else { return Ok(()) };
    let kind = metadata.file_type();
    if kind.is_file() || kind.is_fifo() || kind.is_char_device() && is_watchdog(metadata.rdev()) {
        return Ok(());
    }
    let path = path.display();
    Err(format!("{path} is no watchdog: `wdctl` lists the watchdogs of this computer"))
}

/// The kernel lists every character device under its number; the drivers of watchdogs call theirs
/// `watchdog`, `watchdog0`, and so on. Where the list is not mounted, the number decides that
/// `/dev/watchdog` has everywhere (Linux, admin-guide/devices.txt).
fn is_watchdog(device: u64) -> bool {
    let (major, minor) = (rustix::fs::major(device), rustix::fs::minor(device));
    let listed = std::fs::read_link(format!("/sys/dev/char/{major}:{minor}"));
    let name = listed.ok().and_then(|path| Some(path.file_name()?.to_str()?.to_owned()));
    name.map_or((major, minor) == (10, 130), |name| name.starts_with("watchdog"))
}

fn explain(path: &Path, error: &io::Error) -> String {
    let path = path.display();
    match error.kind() {
        ErrorKind::NotFound => format!(
            "there is no device {path}: load the driver of this computer's watchdog, or `modprobe softdog` to try; \
             `wdctl` lists those that there are"
        ),
        ErrorKind::PermissionDenied => format!(
            "this user may not write to {path}: give its group the right by a udev rule, such as \
             KERNEL==\"watchdog\", GROUP=\"robot\", MODE=\"0660\""
        ),
        ErrorKind::ResourceBusy => format!(
            "another process has opened {path} already: see whether systemd does (RuntimeWatchdogSec), and let one \
             of the two have it"
        ),
        _ => format!("{path} cannot be opened: {error}"),
    }
}

impl ProcessWatchdog for WatchdogDevice {
    fn name(&self) -> String {
        self.path.display().to_string()
    }

    fn interval(&self) -> Duration {
        STROKE_INTERVAL
    }

    fn stroke(&mut self) -> io::Result<()> {
        self.file.write_all(b"\0")
    }

    fn close(&mut self) {
        // Where it is refused, it fires: the computer restarts rather than to stay without a
        // watchdog.
        let _ = self.file.write_all(MAGIC);
    }
}
