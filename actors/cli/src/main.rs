//! The command-line program of the Blastema middleware.
//!
//! `blastema` without arguments runs the demonstration: a robot of three processes that is killed,
//! hung and unplugged, and recovers. Exit status: 0 all promises kept, 1 a promise broken, 2 not
//! run. `blastema monitor` shows the state of a running node, `blastema fault list` its
//! faults, also those of earlier runs, `blastema keys` makes the keys of a robot's nodes, and
//! `blastema node` gives them orders.

mod args;
mod demo;
mod fault;
#[cfg(test)]
mod golden;
mod keys;
mod module;
mod monitor;
mod operator;

use args::{Arguments, FaultJob, Subcommand};
use clap::Parser;
use std::io::Write;
use std::process::ExitCode;

/// The demonstration could not be run, or was not run to its end.
const NOT_RUN: u8 = 2;
/// A fault stayed unrecovered, or a promise was broken.
const PROMISE_BROKEN: u8 = 1;

fn main() -> ExitCode {
    let outcome = match Arguments::parse().into_subcommand() {
        Subcommand::Demo(options) => demo::run(&options).map_err(|error| error.to_string()),
        Subcommand::Monitor(options) => {
            monitor::run(&options).map(|()| true).map_err(|error| error.to_string())
        }
        Subcommand::Fault(FaultJob::List(options)) => {
            fault::run(&options).map(|()| true).map_err(|error| error.to_string())
        }
        Subcommand::Keys(job) => keys::run(&job),
        Subcommand::Node(job) => operator::run(&job),
        Subcommand::Module(options) => {
            module::run(&options).map(|()| true).map_err(|error| error.to_string())
        }
    };
    match outcome {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(PROMISE_BROKEN),
        Err(reason) => {
            // With standard error closed, there is no place left for the reason.
            let _ = writeln!(std::io::stderr(), "blastema: {reason}");
            ExitCode::from(NOT_RUN)
        }
    }
}
