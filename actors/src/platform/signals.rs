//! The signals by which a person or a service manager asks a process to end.

use super::start_thread;
use std::io;
use tokio::signal::unix::{Signal, SignalKind, signal};

/// One of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Termination {
    /// SIGTERM: from a service manager, or `kill`.
    Terminate,
    /// SIGINT: Ctrl-C at a terminal.
    Interrupt,
}

impl Termination {
    /// Its name.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Termination::Terminate => "SIGTERM",
            Termination::Interrupt => "SIGINT",
        }
    }

    /// What a process that ends by it is known by: 128 and the signal's number, as a shell says it.
    pub(crate) fn exit_code(self) -> i32 {
        128 + match self {
            Termination::Terminate => SignalKind::terminate(),
            Termination::Interrupt => SignalKind::interrupt(),
        }
        .as_raw_value()
    }
}

/// Both of them, from now on: the process does not end by itself any more.
pub(crate) struct Terminations {
    terminate: Signal,
    interrupt: Signal,
}

impl Terminations {
    /// Listens for them on this thread's runtime.
    ///
    /// # Errors
    /// The system refuses it.
    pub(crate) fn listen() -> io::Result<Self> {
        let terminate = signal(SignalKind::terminate())?;
        Ok(Terminations { terminate, interrupt: signal(SignalKind::interrupt())? })
    }

    /// The next one.
    pub(crate) async fn next(&mut self) -> Termination {
        tokio::select! {
            _ = self.terminate.recv() => Termination::Terminate,
            _ = self.interrupt.recv() => Termination::Interrupt,
        }
    }
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
