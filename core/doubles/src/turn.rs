//! The turns of tests on real threads, and their watchdog.

use std::io::{Write, stderr};
use std::panic::Location;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Held by the test whose turn it is.
static TURN: Mutex<()> = Mutex::new(());

/// A test that takes longer than this waits for an event that does not come.
const LONGEST: Duration = Duration::from_secs(300);

/// The turn of a test on real threads. It ends when this value is dropped.
#[derive(Debug)]
#[must_use = "the turn ends when it is dropped"]
pub struct Turn {
    _held: MutexGuard<'static, ()>,
    /// Tells the watchdog that the test has ended.
    _over: Sender<()>,
}

/// Waits until no other test of this process has a turn, and takes one. Tests on real threads,
/// sockets or clocks would slow each other down and fail by chance.
///
/// If the turn lasts longer than five minutes, the test hangs: its name is written to the standard
/// error, as `test NAME ... HANGS`, and the process ends with status 101.
#[track_caller]
pub fn turn() -> Turn {
    turn_within(LONGEST)
}

/// The same, with another limit.
#[track_caller]
pub fn turn_within(limit: Duration) -> Turn {
    let place = Location::caller().to_string();
    // libtest names the thread of a test after the test, unless it has one thread for all.
    let name = match std::thread::current().name() {
        Some(name) if name != "main" => name.to_owned(),
        _ => place,
    };
    // A test that failed has poisoned it; the next one has its own state.
    let held = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let (over, ended) = channel();
    std::thread::spawn(move || {
        if ended.recv_timeout(limit) == Err(RecvTimeoutError::Timeout) {
            // Past the harness, which keeps what a test prints until the test has ended. If the
            // standard error is closed, the exit status still tells of the failure.
            let _ = writeln!(stderr(), "\ntest {name} ... HANGS, after {} s", limit.as_secs());
            std::process::exit(101);
        }
    });
    Turn { _held: held, _over: over }
}

/// The same, for one of the cases of a long list that are left to the night: there is none without
/// `BLASTEMA_LONG=1`.
#[track_caller]
pub fn turn_if_long() -> Option<Turn> {
    if long() { Some(turn()) } else { None }
}

/// Whether long lists of cases are run whole, as at night: `BLASTEMA_LONG=1`. Otherwise a few of
/// them are.
pub fn long() -> bool {
    std::env::var_os("BLASTEMA_LONG").is_some()
}
