//! Lines for people, written by a thread of their own: a reader that stands still, such as a paused
//! terminal, holds up nothing else.

use super::start_thread;
use std::io::{self, Write};
use std::sync::LazyLock;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::time::Duration;

/// Lines that wait for the reader. Further ones are left out, and counted.
const LINES_WAITING: usize = 1_024;
static LEFT_OUT: AtomicU64 = AtomicU64::new(0);
/// A reader that has not taken a line by then stands still, until it has taken all.
const PRINTED_WITHIN: Duration = Duration::from_millis(100);
static STANDS_STILL: AtomicBool = AtomicBool::new(false);
/// How long the end of a program waits for its reader.
const FINISHED_WITHIN: Duration = Duration::from_secs(1);

/// Has a line written to standard output.
pub fn print_line(line: String) {
    print(line, |line| drop(writeln!(io::stdout(), "{line}")));
}

/// Writes to standard error what a user must know without reading the log. Returns when it is
/// written, or when the reader stands still.
pub(crate) fn tell_person(line: String) {
    let printed = print(line, |line| drop(writeln!(io::stderr(), "{line}")));
    if !STANDS_STILL.load(SeqCst) {
        let found = printed.recv_timeout(PRINTED_WITHIN);
        STANDS_STILL.store(found == Err(RecvTimeoutError::Timeout), SeqCst);
    }
}

/// Waits until all lines are written, for a second at most.
pub fn finish_printing() {
    let _ = print(String::new(), |_| {}).recv_timeout(FINISHED_WITHIN);
}

struct Line {
    text: String,
    /// A reader that has gone is no fault of the robot.
    write: fn(&str),
    printed: SyncSender<()>,
}

/// What is returned receives when the line is written, and is closed where it is left out.
fn print(text: String, write: fn(&str)) -> Receiver<()> {
    static LINES: LazyLock<SyncSender<Line>> = LazyLock::new(|| {
        let (lines, waiting) = sync_channel(LINES_WAITING);
        let _ = start_thread("output", move || print_all(&waiting));
        lines
    });
    let (printed, receiver) = sync_channel(1);
    match LINES.try_send(Line { text, write, printed }) {
        Ok(()) => {}
        Err(TrySendError::Full(_)) => drop(LEFT_OUT.fetch_add(1, SeqCst)),
        // There was no thread to be had.
        Err(TrySendError::Disconnected(line)) => write(&line.text),
    }
    receiver
}

fn print_all(waiting: &Receiver<Line>) {
    let next = || {
        waiting.try_recv().or_else(|_| {
            STANDS_STILL.store(false, SeqCst);
            waiting.recv()
        })
    };
    while let Ok(Line { text, write, printed }) = next() {
        write(&text);
        let _ = printed.try_send(());
        match LEFT_OUT.swap(0, SeqCst) {
            0 => {}
            count => drop(writeln!(io::stderr(), "blastema: {count} lines were left out")),
        }
    }
}
