//! The signals by which a person or a service manager asks a process to end.

use super::start_thread;
use std::{fs, io};
use tokio::signal::unix::{Signal, SignalKind, signal};

/// A signal by which a person or a service manager asks a process to end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Termination {
    /// SIGTERM: from a service manager, or `kill`.
    Terminate,
    /// SIGINT: Ctrl-C at a terminal.
    Interrupt,
    /// SIGHUP: the terminal was closed, or the connection to it was lost.
    HangUp,
}

impl Termination {
    /// The name of the signal, such as `SIGTERM`.
    pub fn name(self) -> &'static str {
        match self {
            Termination::Terminate => "SIGTERM",
            Termination::Interrupt => "SIGINT",
            Termination::HangUp => "SIGHUP",
        }
    }

    /// What a process that ends by it is known by: 128 and the signal's number, as a shell says it.
    pub fn exit_code(self) -> i32 {
        128 + match self {
            Termination::Terminate => SignalKind::terminate(),
            Termination::Interrupt => SignalKind::interrupt(),
            Termination::HangUp => SignalKind::hangup(),
        }
        .as_raw_value()
    }
}

/// All [signals](Termination) of that kind, from now on: the process does not end by itself any more.
#[derive(Debug)]
pub struct Terminations {
    terminate: Signal,
    interrupt: Signal,
    /// `None` where the process was started to outlive its terminal.
    hang_up: Option<Signal>,
}

impl Terminations {
    /// Listens for them on this thread's runtime.
    ///
    /// # Errors
    /// The system refuses it.
    pub fn listen() -> io::Result<Self> {
        Ok(Terminations {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            hang_up: ends_with_terminal().then(|| signal(SignalKind::hangup())).transpose()?,
        })
    }

    /// The next one.
    pub async fn next(&mut self) -> Termination {
        tokio::select! {
            _ = self.terminate.recv() => Termination::Terminate,
            _ = self.interrupt.recv() => Termination::Interrupt,
            Some(_) = next_of(&mut self.hang_up) => Termination::HangUp,
        }
    }
}

async fn next_of(signal: &mut Option<Signal>) -> Option<()> {
    signal.as_mut()?.recv().await
}

/// Whether the process is to end with its terminal. One that was started by `nohup` is not: it has
/// inherited that SIGHUP is ignored, and keeps it so.
///
/// The first of the signals in the mask `SigIgn` of proc_pid_status(5).
fn ends_with_terminal() -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_none_or(|mask| mask & 1 == 0)
}

/// Calls `handle` for each of them, on a thread of its own: whatever the others do.
///
/// # Errors
/// The operating system has no thread left, or refuses to say.
pub(crate) fn on_termination(
    mut handle: impl FnMut(Termination) + Send + 'static,
) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build()?;
    let mut terminations = {
        let _entered = runtime.enter();
        Terminations::listen()?
    };
    let wait = async move {
        loop {
            handle(terminations.next().await);
        }
    };
    start_thread("signals", move || runtime.block_on(wait)).map(|_| ())
}
