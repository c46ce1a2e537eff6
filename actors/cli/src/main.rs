//! The command-line program of the Blastema middleware.
//!
//! `blastema monitor` shows the state of a running node, `blastema fault list` its faults, also
//! those of earlier runs. `blastema tree model` prints what editors of behaviour trees load,
//! `blastema keys` makes the keys of a robot's nodes, `blastema node` gives them orders, and
//! `blastema component` their components. `blastema check`, `graph` and `run` start the program of
//! a robot file, and `blastema new` writes a robot. Exit status: 0 it was done, 1 only a part of
//! it, 2 it could not be done.
#![allow(clippy::disallowed_methods, reason = "a program measures and waits for nodes")]

mod args;
mod device;
mod fault_list;
mod keys;
mod monitor;
mod operator;
mod robot;

use args::{Arguments, FaultJob, Subcommand, TreeJob};
use blastema::platform::print;
use clap::Parser;
use std::io::{self, Write};
use std::process::ExitCode;

/// The command could not be carried out.
const NOT_DONE: u8 = 2;
/// A part of the command was not carried out.
const PARTLY_DONE: u8 = 1;

fn main() -> ExitCode {
    blastema::launch_processes();
    let outcome = match Arguments::parse().subcommand {
        Subcommand::Monitor(options) => monitor::run(&options).map(|()| true),
        Subcommand::Fault(FaultJob::List(options)) => fault_list::run(&options).map(|()| true),
        Subcommand::Tree(TreeJob::Model) => {
            print(&blastema::trees::TreeLeaves::new().model()).map(|()| true)
        }
        Subcommand::Keys(job) => keys::run(&job),
        Subcommand::Node(job) => operator::run(&job),
        Subcommand::Device(job) => device::run(&job).map(|()| true),
        Subcommand::Component(job) => operator::component::run(&job).map(|()| true),
        Subcommand::Acknowledge { policy, to } => {
            operator::component::acknowledge(policy.as_deref(), &to).map(|()| true)
        }
        Subcommand::Check(options) => robot::run("check", &options),
        Subcommand::Graph(options) => robot::run("graph", &options),
        Subcommand::Run(options) => robot::run("run", &options),
        Subcommand::Schema => print(blastema_robot::XSD).map(|()| true),
        Subcommand::New(options) => robot::new(&options).map(|()| true),
    };
    match outcome {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(PARTLY_DONE),
        Err(reason) => {
            // With standard error closed, there is no place left for the reason.
            let _ = writeln!(io::stderr(), "blastema: {reason}");
            ExitCode::from(NOT_DONE)
        }
    }
}
