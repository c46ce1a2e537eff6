//! `blastema device header` and `blastema device firmware`.

use crate::args::{DescribedDevice, DeviceJob};
use blastema::DeviceDescription;
use serde_json::Value;

/// Prints what is asked for.
///
/// # Errors
/// The file cannot be read, or is no description of a device.
pub(crate) fn run(job: &DeviceJob) -> Result<(), String> {
    let (DeviceJob::Header(of) | DeviceJob::Firmware(of)) = job;
    let device = described(of).map_err(|error| format!("{}: {error}", of.file.display()))?;
    crate::print(&match job {
        DeviceJob::Header(_) => device.header(),
        DeviceJob::Firmware(_) => device.firmware(),
    })
}

fn described(of: &DescribedDevice) -> Result<DeviceDescription, String> {
    let text = std::fs::read_to_string(&of.file).map_err(|error| error.to_string())?;
    let Some(name) = &of.of_type else { return DeviceDescription::from_json(&text) };
    let help = "write the file by `describe` of the robot's program";
    let all: Value = serde_json::from_str(&text).map_err(|error| format!("{error}: {help}"))?;
    match &all["types"][name]["device"] {
        Value::Null => Err(format!("it has no type of devices `{name}`: {help}")),
        // What its contract has that no device can.
        Value::String(why) => Err(why.clone()),
        device => DeviceDescription::from_json(&device.to_string()),
    }
}
