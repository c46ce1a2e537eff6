//! Opening a medium again when it could not be opened or was lost.

use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::task::{self, Poll};
use std::time::Duration;
use tokio::time::Sleep;

/// The first pause: a port that a dying process still holds is free after some milliseconds.
const SHORTEST: Duration = Duration::from_millis(20);
/// The longest pause: how late a freed port may be noticed.
const LONGEST: Duration = Duration::from_secs(1);
/// So often the port of the last life is wanted back where any port would do: peers know it.
const LOYALTY: u32 = 8;

/// Counts attempts and waits between them, twice as long each time.
#[derive(Default)]
pub(crate) struct Reopening {
    attempts: u32,
    pause: Option<Pin<Box<Sleep>>>,
    last: Option<SocketAddr>,
}

impl Reopening {
    /// Begins the pause after a failed attempt.
    pub(crate) fn failed(&mut self) {
        let pause = SHORTEST.saturating_mul(1 << self.attempts.min(16)).min(LONGEST);
        self.attempts += 1;
        self.pause = Some(Box::pin(tokio::time::sleep(pause)));
    }

    /// Ready when the next attempt is due.
    pub(crate) fn poll_due(&mut self, task: &mut task::Context<'_>) -> Poll<()> {
        match &mut self.pause {
            Some(pause) => pause.as_mut().poll(task),
            None => Poll::Ready(()),
        }
    }

    /// Forgets the failures: it is open now, or a new life begins.
    pub(crate) fn reset(&mut self) {
        (self.attempts, self.pause) = (0, None);
    }

    /// Remembers the address that was really taken.
    pub(crate) fn opened(&mut self, local: SocketAddr) {
        self.reset();
        self.last = Some(local);
    }

    /// The address that was taken last.
    pub(crate) fn last(&self) -> Option<SocketAddr> {
        self.last
    }

    /// The address to try next: where any port would do, the one taken last, for a while.
    pub(crate) fn wanted(&self, bind: SocketAddr) -> SocketAddr {
        match self.last {
            Some(last) if bind.port() == 0 && self.attempts < LOYALTY => {
                SocketAddr::new(bind.ip(), last.port())
            }
            _ => bind,
        }
    }
}

/// What a person may do about a socket that does not open.
pub(crate) fn explain(medium: &str, address: SocketAddr, error: &io::Error) -> String {
    let advice = match error.kind() {
        io::ErrorKind::AddrInUse => {
            "another process has taken this port: end it, or choose another port (0 takes a free one)"
        }
        io::ErrorKind::AddrNotAvailable => {
            "no interface of this machine has this address: check it, or connect the interface"
        }
        io::ErrorKind::PermissionDenied => {
            "the system forbids it: ports below 1024 need privileges, choose a larger one"
        }
        _ => "check the address and the machine's limits",
    };
    format!("{medium} {address} cannot be opened ({error}): {advice}; trying again")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_port_is_wanted_back_for_a_while_and_then_any() {
        let any: SocketAddr = "127.0.0.1:0".parse().unwrap();
        let last: SocketAddr = "127.0.0.1:7400".parse().unwrap();

        let mut reopening = Reopening::default();
        assert_eq!(reopening.wanted(any), any);
        reopening.opened(last);
        assert_eq!(reopening.wanted(any), last);
        reopening.attempts = LOYALTY;
        assert_eq!(reopening.wanted(any), any);
        let fixed: SocketAddr = "127.0.0.1:80".parse().unwrap();
        assert_eq!(reopening.wanted(fixed), fixed);
    }

    #[test]
    fn a_taken_port_is_explained() {
        let error = io::Error::from(io::ErrorKind::AddrInUse);

        let text = explain("udp", "127.0.0.1:7400".parse().unwrap(), &error);

        assert!(text.contains("127.0.0.1:7400") && text.contains("choose another port"), "{text}");
    }
}
