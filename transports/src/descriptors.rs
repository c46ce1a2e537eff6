//! A process that may open no more files.

use std::io;
#[cfg(any(feature = "tcp", feature = "unix"))]
use {std::fmt::Display, std::time::Duration, tokio::time::Instant};

/// `EMFILE` and `ENFILE`, which have no kind of their own: the process may open no more files, the
/// system may not.
const TOO_MANY_FILES: [i32; 2] = [24, 23];
/// What a user may do then.
pub(crate) const MORE_DESCRIPTORS: &str = "this process may open no more files: raise its limit \
     (`ulimit -n`, or `LimitNOFILE=` of a systemd service)";
/// A node that wants for files tries over and over.
#[cfg(any(feature = "tcp", feature = "unix"))]
const BETWEEN_WARNINGS: Duration = Duration::from_secs(60);

/// Whether the process may open no more files.
pub(crate) fn are_used_up(error: &io::Error) -> bool {
    error.raw_os_error().is_some_and(|number| TOO_MANY_FILES.contains(&number))
}

/// Warns of it, once a minute at most.
#[cfg(any(feature = "tcp", feature = "unix"))]
#[derive(Default)]
pub(crate) struct DescriptorWarning {
    last: Option<Instant>,
}

#[cfg(any(feature = "tcp", feature = "unix"))]
impl DescriptorWarning {
    /// Warns of an error, if it is of this kind: `what` did not come about. The answer is whether
    /// it was logged.
    pub(crate) fn warn(&mut self, what: impl Display, error: &io::Error) -> bool {
        let due = self.last.is_none_or(|last| last.elapsed() >= BETWEEN_WARNINGS);
        let warns = due && are_used_up(error);
        if warns {
            self.last = Some(Instant::now());
            tracing::warn!("{what} ({error}): {MORE_DESCRIPTORS}");
        }
        warns
    }
}

#[cfg(all(test, any(feature = "tcp", feature = "unix")))]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn want_of_files_is_warned_of_once_a_minute_and_nothing_else_is() {
        let [process, system] = TOO_MANY_FILES.map(io::Error::from_raw_os_error);
        let other = io::Error::from(io::ErrorKind::ConnectionRefused);
        let mut warning = DescriptorWarning::default();

        assert!(!warning.warn("no connection", &other));
        assert!(warning.warn("no connection", &process));
        assert!(!warning.warn("no connection", &system));
        tokio::time::advance(BETWEEN_WARNINGS).await;
        assert!(!warning.warn("no connection", &other));
        assert!(warning.warn("no connection", &system));
    }
}
