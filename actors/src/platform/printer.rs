//! Lines for people, written by a thread of their own: a reader that stands still, such as a paused
//! terminal, holds up nothing else.

use std::io::{self, Write};
use std::sync::LazyLock;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::thread;
use std::time::Duration;

/// Lines that wait for the reader. Further ones are left out, and counted.
const LINES_WAITING: usize = 1_024;
static LEFT_OUT: AtomicU64 = AtomicU64::new(0);
/// A reader that has not taken a line by then stands still, until it has.
const PRINTED_WITHIN: Duration = Duration::from_millis(100);
static STANDS_STILL: AtomicBool = AtomicBool::new(false);

/// Writes a line to standard output. Returns when it is written, or when its reader stands still.
pub fn print_line(line: String) {
    print(line, |line| drop(writeln!(io::stdout(), "{line}")));
}

/// Writes to standard error what a user must know without reading the log, as [`print_line`] does.
pub(crate) fn tell_person(line: String) {
    print(line, |line| drop(writeln!(io::stderr(), "{line}")));
}

struct Line {
    text: String,
    /// A reader that has gone is no fault of the robot.
    write: fn(&str),
    printed: SyncSender<()>,
}

fn print(text: String, write: fn(&str)) {
    static LINES: LazyLock<SyncSender<Line>> = LazyLock::new(start);
    let (printed, is_printed) = sync_channel(1);
    match LINES.try_send(Line { text, write, printed }) {
        Ok(()) if STANDS_STILL.load(Relaxed) => {}
        Ok(()) => {
            STANDS_STILL.store(is_printed.recv_timeout(PRINTED_WITHIN).is_err(), Relaxed);
        }
        Err(TrySendError::Full(_)) => drop(LEFT_OUT.fetch_add(1, Relaxed)),
        // There was no thread to be had.
        Err(TrySendError::Disconnected(line)) => write(&line.text),
    }
}

fn start() -> SyncSender<Line> {
    let (lines, waiting) = sync_channel::<Line>(LINES_WAITING);
    let _ = thread::Builder::new().name("output".to_owned()).spawn(move || {
        for Line { text, write, printed } in waiting {
            write(&text);
            match LEFT_OUT.swap(0, Relaxed) {
                0 => {}
                count => write(&format!("({count} lines were left out)")),
            }
            STANDS_STILL.store(false, Relaxed);
            let _ = printed.try_send(());
        }
    });
    lines
}
