//! The watchdogs of the process that a node is described with.

use crate::platform::ProcessWatchdog;
use crate::platform::systemd::Systemd;
use crate::platform::watchdog_device::WatchdogDevice;
use std::path::PathBuf;

/// What watches the process from outside.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct ProcessWatchdogs {
    /// The service manager that has started the process, if one has.
    pub(super) systemd: bool,
    /// The computer's own.
    pub(super) device: Option<PathBuf>,
}

/// What was opened.
type Opened = (Option<Systemd>, Vec<Box<dyn ProcessWatchdog>>);

impl ProcessWatchdogs {
    /// Opens them; a device is armed from here on.
    ///
    /// # Errors
    /// What stands in the way, and what to do.
    pub(super) fn open(&self) -> Result<Opened, String> {
        let manager = if self.systemd { Systemd::of_this_process()? } else { None };
        let mut watchdogs: Vec<Box<dyn ProcessWatchdog>> = Vec::new();
        if let Some(manager) = &manager {
            watchdogs.extend(manager.watchdog()?);
        }
        // Last, since it is armed by that.
        if let Some(path) = &self.device {
            watchdogs.push(Box::new(WatchdogDevice::open(path)?));
        }
        Ok((manager, watchdogs))
    }
}
