//! Serial ports: which are USB devices that need no line, and why one cannot be opened.

use std::io;
use std::path::{Path, PathBuf};
use tokio_serial::ErrorKind;

/// Whether a port is one of USB CDC-ACM, at either end, where often no line follows. Such a port's
/// driver also counts whole packets, where others count bytes that wait.
pub(crate) fn is_usb_device(path: &Path) -> bool {
    let Ok(device) = path.canonicalize() else { return false };
    let Some(name) = device.file_name() else { return false };
    let driver = Path::new("/sys/class/tty").join(name).join("device/driver");
    let is_acm = |driver: PathBuf| driver.file_name().is_some_and(|name| name == "cdc_acm");
    name.as_encoded_bytes().starts_with(b"ttyGS") || driver.read_link().is_ok_and(is_acm)
}

/// Why a serial port cannot be opened, and what helps.
pub(crate) fn unopened(path: &Path, error: &tokio_serial::Error) -> io::Error {
    let advice = match error.kind() {
        ErrorKind::Io(io::ErrorKind::PermissionDenied) => {
            "the system forbids it: let this user use the port, often by the group dialout"
        }
        _ if !path.exists() => "there is no such port: plug the device in, or check the path",
        ErrorKind::NoDevice => "another program uses this port: end it, or choose another port",
        _ => "check that it is a serial port, and that it can what is asked of it",
    };
    io::Error::other(format!("{error}: {advice}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pty_a_file_and_nothing_are_no_usb_devices() {
        let cable = blastema_ptys::Cable::new();
        for path in [cable.left(), "/dev/null".into(), "/dev/serial/by-id/nothing".into()] {
            assert!(!is_usb_device(&path), "{}", path.display());
        }
    }
}
