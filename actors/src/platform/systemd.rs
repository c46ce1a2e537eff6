//! The service manager that has started this process, as systemd is: sd_notify(3), without its
//! library.

use super::ProcessWatchdog;
use std::ffi::OsString;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::sync::Arc;
use std::time::Duration;
use std::{env, io};

/// Where the service manager listens.
const SOCKET: &str = "NOTIFY_SOCKET";
/// After so many microseconds without a stroke it ends the process, and starts it again.
const TIMEOUT: &str = "WATCHDOG_USEC";
/// Which process is meant by that.
const PROCESS: &str = "WATCHDOG_PID";

/// A way to tell the service manager how the process is. Clones share it.
#[derive(Clone)]
pub(crate) struct Systemd(Arc<Socket>);

struct Socket {
    socket: UnixDatagram,
    address: SocketAddr,
    path: OsString,
}

impl Systemd {
    /// The service manager of this process; `None` where it was not started by one.
    ///
    /// # Errors
    /// What is wrong with its socket, and what to do.
    pub(crate) fn of_this_process() -> Result<Option<Self>, String> {
        let Some(path) = env::var_os(SOCKET).filter(|path| !path.is_empty()) else {
            return Ok(None);
        };
        let address = match path.as_bytes() {
            [b'@', name @ ..] => SocketAddr::from_abstract_name(name),
            _ => SocketAddr::from_pathname(&path),
        };
        let open = |address| {
            let socket = UnixDatagram::unbound()?;
            // A manager that does not read must not block who watches the fault chain.
            socket.set_nonblocking(true)?;
            io::Result::Ok(Socket { socket, address, path: path.clone() })
        };
        let socket = address.and_then(open).map_err(|error| explain(&path, &error))?;
        Ok(Some(Systemd(Arc::new(socket))))
    }

    /// Tells it this, such as `READY=1`.
    ///
    /// # Errors
    /// What is wrong with its socket, and what to do.
    pub(crate) fn tell(&self, state: &str) -> Result<(), String> {
        self.send(state).map_err(|error| explain(&self.0.path, &error))
    }

    fn send(&self, state: &str) -> io::Result<()> {
        self.0.socket.send_to_addr(state.as_bytes(), &self.0.address).map(|_| ())
    }

    /// Its watchdog, if it has one for this process.
    ///
    /// # Errors
    /// What it has said of it cannot be understood.
    pub(crate) fn watchdog(&self) -> Result<Option<Box<dyn ProcessWatchdog>>, String> {
        let meant = env::var(PROCESS).ok();
        if meant.is_some_and(|process| process != std::process::id().to_string()) {
            return Ok(None);
        }
        let Ok(timeout) = env::var(TIMEOUT) else { return Ok(None) };
        match timeout.parse() {
            Ok(micros) if micros > 0 => {
                let timeout = Duration::from_micros(micros);
                Ok(Some(Box::new(SystemdWatchdog { manager: self.clone(), timeout })))
            }
            _ => Err(format!(
                "{TIMEOUT} is {timeout:?}, which is no number of microseconds: unset it"
            )),
        }
    }
}

fn explain(path: &OsString, error: &io::Error) -> String {
    format!(
        "the service manager's socket {SOCKET}={} cannot be reached: {error}; start the program as a service of \
         Type=notify, or unset {SOCKET}",
        path.display()
    )
}

struct SystemdWatchdog {
    manager: Systemd,
    timeout: Duration,
}

impl ProcessWatchdog for SystemdWatchdog {
    fn name(&self) -> String {
        format!("{SOCKET}={}", self.manager.0.path.display())
    }

    fn interval(&self) -> Duration {
        // sd_watchdog_enabled(3) recommends half; so one stroke may be lost as well.
        self.timeout / 4
    }

    fn stroke(&mut self) -> io::Result<()> {
        self.manager.send("WATCHDOG=1")
    }
}
