//! Ends a test that a component has brought to a standstill, and says which.

use blastema::program::Running;
use std::convert::Infallible;
use std::io::Write;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::Duration;

/// How often the guard looks, in real time.
const LOOK: Duration = Duration::from_millis(100);
/// One handler that runs for so many looks, 5 s, does not return: a busy machine is slow, not this
/// slow.
const LIMIT: u32 = 50;
/// The status of a test program that has failed.
const FAILED: i32 = 101;

/// Looks after the components of one node while it lives. A handler that never returns keeps the
/// thread of its test, and the virtual clock with it: nothing on that thread can end the test any
/// more.
pub(crate) struct Guard {
    /// Its end is the guard's.
    _alive: Sender<Infallible>,
}

impl Guard {
    #[expect(clippy::disallowed_methods, reason = "nothing is sent: its end is the message")]
    pub(crate) fn of(running: Running) -> Self {
        let (alive, ended) = channel();
        let test = thread::current().name().map(str::to_owned);
        let look_after = move || watch(&ended, &running, test.as_deref().unwrap_or("a test"));
        // Where there is no thread left, a test that hangs is not named; all others are as they
        // were.
        let _ = thread::Builder::new().name("test guard".into()).spawn(look_after);
        Guard { _alive: alive }
    }
}

fn watch(ended: &Receiver<Infallible>, running: &Running, test: &str) {
    let (mut seen, mut looks) = (running.components(), 0);
    while ended.recv_timeout(LOOK) == Err(RecvTimeoutError::Timeout) {
        let now = running.components();
        match now.iter().find(|component| seen.contains(component)) {
            Some((object, during, _)) if looks >= LIMIT => end(test, object, during),
            Some(_) => looks += 1,
            None => (seen, looks) = (now, 0),
        }
    }
}

/// Writes past `eprintln!`, whose text the test program captures, and never shows when it ends so.
fn end(test: &str, object: &blastema::ObjectName, during: &str) -> ! {
    let _ = writeln!(
        std::io::stderr(),
        "test {test} hangs: {object} has kept its thread in {during} for {:?}; in virtual time nothing \
         can take the thread from it",
        LOOK * LIMIT
    );
    std::process::exit(FAILED)
}
