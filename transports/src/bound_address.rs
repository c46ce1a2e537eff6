//! At which address of this machine a socket opens.

use crate::descriptors::{MORE_DESCRIPTORS, are_used_up};
use socket2::Socket;
use std::io;
use std::net::SocketAddr;

/// So often the port taken last is wanted back where any port would do: peers know it.
const LOYALTY: u32 = 8;
/// `ENODEV` as Linux numbers it.
const NO_SUCH_DEVICE: i32 = 19;

/// The address as configured, and the one that was really taken.
pub(crate) struct BoundAddress {
    configured: SocketAddr,
    last: Option<SocketAddr>,
    attempts: u32,
}

impl BoundAddress {
    pub(crate) fn new(configured: SocketAddr) -> Self {
        BoundAddress { configured, last: None, attempts: 0 }
    }

    /// The address for the next attempt.
    pub(crate) fn next_attempt(&mut self) -> SocketAddr {
        self.attempts = self.attempts.saturating_add(1);
        match self.last {
            Some(last) if self.configured.port() == 0 && self.attempts <= LOYALTY => {
                SocketAddr::new(self.configured.ip(), last.port())
            }
            _ => self.configured,
        }
    }

    /// Whether this is the address that was taken last.
    #[cfg(feature = "udp")]
    pub(crate) fn is_at(&self, address: SocketAddr) -> bool {
        self.last == Some(address)
    }

    /// This address was taken.
    pub(crate) fn taken(&mut self, local: SocketAddr) {
        self.last = Some(local);
        self.attempts = 0;
    }
}

/// Lets the socket use this interface only (`SO_BINDTODEVICE`).
#[cfg(target_os = "linux")]
pub(crate) fn confine(socket: &Socket, interface: Option<&str>) -> io::Result<()> {
    let Some(interface) = interface else { return Ok(()) };
    socket.bind_device(Some(interface.as_bytes()))
}

/// Other systems have no such option that a string of ours could be given to.
#[cfg(not(target_os = "linux"))]
pub(crate) fn confine(_: &Socket, interface: Option<&str>) -> io::Result<()> {
    match interface {
        None => Ok(()),
        Some(_) => Err(io::ErrorKind::Unsupported.into()),
    }
}

/// What a person may do about a socket that does not open.
pub(crate) fn explain(
    medium: &str,
    address: SocketAddr,
    interface: Option<&str>,
    error: &io::Error,
) -> String {
    let place = match interface {
        Some(interface) => format!("{address} on {interface}"),
        None => address.to_string(),
    };
    let advice = match error.kind() {
        // `ENODEV` has no kind of its own.
        _ if error.raw_os_error() == Some(NO_SUCH_DEVICE) => {
            "this machine has no such interface: check its name, or connect it"
        }
        _ if are_used_up(error) => MORE_DESCRIPTORS,
        io::ErrorKind::Unsupported => "this system cannot bind to an interface: leave it out",
        io::ErrorKind::AddrInUse => {
            "another process uses this port: end that process, or choose another port (0 takes a free \
             one)"
        }
        io::ErrorKind::AddrNotAvailable => {
            "no interface of this machine has this address: check it, or connect the interface"
        }
        io::ErrorKind::PermissionDenied => {
            "the system forbids it: ports below 1024 need privileges, choose a larger one"
        }
        _ => "check the address and the machine's limits",
    };
    format!("{medium} {place} cannot be opened ({error}): {advice}; trying again")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> SocketAddr {
        text.parse().unwrap()
    }

    #[test]
    fn where_any_port_would_do_the_last_is_wanted_back_for_a_while() {
        let (any, last) = (address("127.0.0.1:0"), address("127.0.0.1:7400"));
        let mut binding = BoundAddress::new(any);

        assert_eq!(binding.next_attempt(), any);
        binding.taken(last);
        assert!((0..LOYALTY).all(|_| binding.next_attempt() == last));
        assert_eq!(binding.next_attempt(), any);
    }

    #[test]
    fn a_configured_port_is_insisted_on() {
        let fixed = address("127.0.0.1:80");
        let mut binding = BoundAddress::new(fixed);

        assert!((0..100).all(|_| binding.next_attempt() == fixed));
    }

    #[test]
    fn a_taken_port_is_explained() {
        let error = io::Error::from(io::ErrorKind::AddrInUse);

        let text = explain("udp", address("127.0.0.1:7400"), None, &error);

        assert!(text.contains("127.0.0.1:7400") && text.contains("choose another port"), "{text}");
    }

    #[test]
    fn want_of_files_is_explained() {
        let error = io::Error::from_raw_os_error(24);

        let text = explain("tcp", address("127.0.0.1:7400"), None, &error);

        assert!(text.contains("ulimit -n") && text.contains("LimitNOFILE="), "{text}");
    }

    #[test]
    fn an_interface_that_is_not_there_is_named() {
        let error = io::Error::from_raw_os_error(NO_SUCH_DEVICE);

        let text = explain("udp", address("0.0.0.0:7400"), Some("firewire0"), &error);

        assert!(text.contains("on firewire0") && text.contains("no such interface"), "{text}");
    }
}
