//! A process that may open no more files.

use std::io;
#[cfg(any(feature = "tcp", feature = "unix"))]
use {
    crate::medium_timer::MediumTimer,
    std::{fmt::Display, task, time::Duration},
};

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
    pause: MediumTimer,
}

#[cfg(any(feature = "tcp", feature = "unix"))]
impl DescriptorWarning {
    /// Warns of an error, if it is of this kind: `what` did not come about. The answer is whether
    /// it was logged.
    pub(crate) fn warn(
        &mut self,
        what: impl Display,
        error: &io::Error,
        task: &mut task::Context<'_>,
    ) -> bool {
        if !are_used_up(error) {
            return false;
        }
        let warned_lately = self.pause.poll(task).is_pending();
        if !warned_lately {
            self.pause = MediumTimer::after(BETWEEN_WARNINGS);
            tracing::warn!("{what} ({error}): {MORE_DESCRIPTORS}");
        }
        !warned_lately
    }
}

#[cfg(all(test, any(feature = "tcp", feature = "unix")))]
mod tests {
    use super::*;
    use blastema_doubles::advance;
    use std::task::Waker;

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn want_of_files_is_warned_of_once_a_minute_and_nothing_else_is() {
        let [process, system] = TOO_MANY_FILES.map(io::Error::from_raw_os_error);
        let other = io::Error::from(io::ErrorKind::ConnectionRefused);
        let mut warning = DescriptorWarning::default();
        let mut warns = |error: &io::Error| {
            let mut task = task::Context::from_waker(Waker::noop());
            warning.warn("no connection", error, &mut task)
        };

        assert!(!warns(&other));
        assert!(warns(&process));
        assert!(!warns(&system));
        advance(BETWEEN_WARNINGS).await;
        assert!(!warns(&other));
        assert!(warns(&system));
    }
}
