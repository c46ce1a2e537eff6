//! `blastema device header` and `blastema device firmware`.

use crate::args::DeviceJob;
use blastema::DeviceDescription;
use std::io::{self, Write};

/// Prints what is asked for.
///
/// # Errors
/// The file cannot be read, or is no description of a device.
pub(crate) fn run(job: &DeviceJob) -> Result<(), String> {
    let (DeviceJob::Header { file } | DeviceJob::Firmware { file }) = job;
    let text = std::fs::read_to_string(file).map_err(|error| error.to_string());
    let device = text.and_then(|text| DeviceDescription::from_json(&text));
    let device = device.map_err(|error| format!("{}: {error}", file.display()))?;
    let text = match job {
        DeviceJob::Header { .. } => device.header(),
        DeviceJob::Firmware { .. } => device.firmware(),
    };
    let written = io::stdout().write_all(text.as_bytes());
    written.map_err(|error| format!("standard output cannot be written: {error}"))
}
