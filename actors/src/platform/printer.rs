//! Lines for people, written by a thread of their own: a reader that stands still, such as a paused
//! terminal, holds up nothing else.

use super::start_thread;
use std::io::{self, Write};
use std::sync::OnceLock;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::mpsc::{SendError, Sender, channel};
use std::time::Duration;

/// Lines of programs that wait for the reader. Further ones are left out, and counted.
const LINES_WAITING: usize = 1_024;
/// With as many that tell of faults, which a flood of the others does not displace.
const ALL_WAITING: usize = 2 * LINES_WAITING;
static WAITING: AtomicUsize = AtomicUsize::new(0);
static LEFT_OUT: AtomicUsize = AtomicUsize::new(0);
/// How long the end of a program waits for its reader.
const FINISHED_WITHIN: Duration = Duration::from_secs(1);

static PRINTER: OnceLock<Sender<Box<dyn FnOnce() + Send>>> = OnceLock::new();

/// Prints on standard output. A reader that has closed its end, as `head` does, has seen enough.
///
/// # Errors
/// It cannot be written, for a reason that the text says.
pub fn print(text: &str) -> Result<(), String> {
    match io::stdout().write_all(text.as_bytes()).and_then(|()| io::stdout().flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(format!("standard output cannot be written: {error}"))
        }
        _ => Ok(()),
    }
}

/// Has a line of a program written to standard output.
pub fn print_line(line: String) {
    enqueue(LINES_WAITING, move || drop(writeln!(io::stdout(), "{line}")));
}

/// Has a line of a program written to standard error.
pub fn print_error_line(line: String) {
    enqueue(LINES_WAITING, move || drop(writeln!(io::stderr(), "{line}")));
}

/// Has written to standard error what a user must know without reading the log.
pub(crate) fn tell_person(line: String) {
    enqueue(ALL_WAITING, move || drop(writeln!(io::stderr(), "{line}")));
}

/// Waits until all lines are written, for a second at most.
pub(crate) fn finish_printing() {
    let Some(printer) = PRINTER.get() else { return };
    let (printed, all_printed) = channel::<()>();
    let _ = printer.send(Box::new(move || drop(printed)));
    let _ = all_printed.recv_timeout(FINISHED_WITHIN);
}

/// A reader that has gone is no fault of the robot.
fn enqueue(waiting_most: usize, write: impl FnOnce() + Send + 'static) {
    let printer = PRINTER.get_or_init(|| {
        let (lines, waiting) = channel::<Box<dyn FnOnce() + Send>>();
        let _ = start_thread("output", move || waiting.iter().for_each(|write| write()));
        lines
    });
    if WAITING.fetch_add(1, SeqCst) >= waiting_most {
        WAITING.fetch_sub(1, SeqCst);
        LEFT_OUT.fetch_add(1, SeqCst);
        return;
    }
    let printed = move || {
        write();
        WAITING.fetch_sub(1, SeqCst);
        match LEFT_OUT.swap(0, SeqCst) {
            0 => {}
            count => drop(writeln!(io::stderr(), "blastema: {count} lines were left out")),
        }
    };
    if let Err(SendError(write)) = printer.send(Box::new(printed)) {
        // There was no thread to be had.
        write();
    }
}
