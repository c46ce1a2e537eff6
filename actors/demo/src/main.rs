//! The demonstration: a robot of three processes that is killed, hung and unplugged, and recovers.
//!
//! ```text
//!   robot.xml      the robot: three nodes, four cables, a hundred and some components
//!   faults.rs      the ten faults, and how each is judged
//!
//!   director ──────── node `director`: three processes as its children ─────────┐
//!     │ scenario, trial: what is next, and were the promises kept?              │
//!     │                                                                         ▼
//!     │   Strike, ReadModule         agent ── node of the robot      in each module's process
//!     ├──────────────────────────►   `Node::inject`, `Node::faults`
//!     │    Unix sockets, never cut
//!     └──► a line for each step, at the end the tables
//! ```

mod args;
mod director;
mod faults;
mod flow_account;
#[cfg(test)]
mod golden;
mod messages;
mod module;
mod report;
mod robot;
mod robot_state;
mod run_folder;
mod scenario;
mod table;
mod trial;

use args::{DemoArguments, DemoPart};
use clap::Parser;
use std::error::Error;
use std::io::{self, Write};
use std::process::ExitCode;

/// The demonstration could not be run, or was not run to its end.
const NOT_RUN: u8 = 2;
/// A fault stayed unrecovered, or a promise was broken.
const PROMISE_BROKEN: u8 = 1;
/// The width of the tables where standard output is no terminal.
const PAGE: u16 = 140;

fn main() -> ExitCode {
    // The modules are children of the director's node.
    blastema::launch_processes();
    // What the nodes find is shown by the demonstration; the log would say it again.
    let _ = tracing::subscriber::set_global_default(tracing::subscriber::NoSubscriber::new());
    let arguments = DemoArguments::parse();
    let outcome = match arguments.part {
        Some(DemoPart::Module(options)) => module::run(&options).map(|()| true),
        None => run(arguments.json),
    };
    match outcome {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(PROMISE_BROKEN),
        Err(reason) => {
            // With standard error closed, there is no place left for the reason.
            let _ = writeln!(io::stderr(), "blastema-demo: {reason}");
            ExitCode::from(NOT_RUN)
        }
    }
}

/// Runs the demonstration. Returns whether every promise was kept.
///
/// # Errors
/// The demonstration cannot be run to its end.
fn run(json: bool) -> Result<bool, Box<dyn Error>> {
    let (report, outcome) = blastema::run(director::run(!json));
    let end = match (&report, json) {
        (None, _) => String::new(),
        (Some(report), true) => {
            serde_json::to_string_pretty(report).expect("a report is plain data") + "\n"
        }
        (Some(report), false) => table::draw(report, columns()),
    };
    // With standard output closed, there is no place left for the tables.
    let _ = io::stdout().write_all(end.as_bytes());
    outcome?;
    Ok(report.is_some_and(|report| report.promises_kept))
}

/// The width of the terminal, or of a page. Some terminals report a size of zero.
fn columns() -> u16 {
    let size = rustix::termios::tcgetwinsize(io::stdout()).ok();
    size.map(|size| size.ws_col).filter(|columns| *columns > 0).unwrap_or(PAGE)
}
