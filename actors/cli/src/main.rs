//! The command-line program of the Blastema middleware.
//!
//! `blastema` without arguments runs the main job: a robot of three processes that is killed, hung
//! and unplugged, and grows back. Exit status: 0 all promises kept, 1 a promise broken, 2 not run.
//! `blastema monitor` shows what a running node knows of itself, `blastema fault list` its faults,
//! also those of earlier runs.

mod args;
mod demo;
mod fault;
#[cfg(test)]
mod golden;
mod module;
mod monitor;

use args::{Arguments, FaultJob, Job};
use clap::Parser;
use std::io::Write;
use std::process::ExitCode;

/// The demonstration could not be run, or was not run to its end.
const NOT_RUN: u8 = 2;
/// A fault stayed unrecovered, or a promise was broken.
const PROMISE_BROKEN: u8 = 1;

fn main() -> ExitCode {
    let outcome = match Arguments::parse().into_job() {
        Job::Demo(options) => demo::run(&options).map_err(|error| error.to_string()),
        Job::Monitor(options) => {
            monitor::run(&options).map(|()| true).map_err(|error| error.to_string())
        }
        Job::Fault(FaultJob::List(options)) => {
            fault::run(&options).map(|()| true).map_err(|error| error.to_string())
        }
        Job::Module(options) => {
            module::run(&options).map(|()| true).map_err(|error| error.to_string())
        }
    };
    match outcome {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(PROMISE_BROKEN),
        Err(reason) => {
            // Nobody is left to tell if standard error is gone too.
            let _ = writeln!(std::io::stderr(), "blastema: {reason}");
            ExitCode::from(NOT_RUN)
        }
    }
}
