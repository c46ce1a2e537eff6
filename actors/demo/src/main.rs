//! The demonstration: a robot of three processes that is killed, hung and unplugged, and recovers.
//!
//! ```text
//!   Scenario (next fault; promises kept?)    module::run, in three child processes
//!     ▲ │                                          ▲
//!     │ ▼                                          │
//!   Director ── Launcher, Control ── JSON lines ───┘
//!     │
//!     └──► Display (a thread): live view or lines, at the end the tables
//! ```
//!
//! The scenario is a pure state machine, which the director drives. For the modules the director is
//! what the init system is on a robot's computers: it restarts a process that has ended.

mod args;
mod chaos;
mod control;
mod director;
mod display;
#[cfg(test)]
mod fake;
mod flow_accounting;
mod flow_receiver;
#[cfg(test)]
mod golden;
mod injection;
mod launcher;
mod machine_instant;
mod module;
mod protocol;
mod report;
mod robot;
mod robot_state;
mod run_keys;
mod scenario;
mod table;
mod timings;
mod tone;
mod trial;
mod view;
mod wiring;

use args::{DemoArguments, DemoOptions, DemoPart};
use clap::Parser;
use director::{DemoError, Director};
use display::{Display, Mode};
use scenario::ScenarioPlan;
use std::io::{self, Write};
use std::process::ExitCode;
use std::time::Duration;

/// The demonstration could not be run, or was not run to its end.
const NOT_RUN: u8 = 2;
/// A fault stayed unrecovered, or a promise was broken.
const PROMISE_BROKEN: u8 = 1;

/// The default duration of a run with random faults.
const CHAOS: Duration = Duration::from_secs(60);

fn main() -> ExitCode {
    let arguments = DemoArguments::parse();
    let outcome = match arguments.part {
        Some(DemoPart::Module(options)) => {
            module::run(&options).map(|()| true).map_err(|error| error.to_string())
        }
        None => run(&arguments.demo).map_err(|error| error.to_string()),
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
fn run(options: &DemoOptions) -> Result<bool, DemoError> {
    let system = |what| move |source: io::Error| DemoError::System { what, source };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(system("no runtime"))?;
    let display = Display::start(Mode::choose(options.json)).map_err(system("no thread"))?;
    let plan = ScenarioPlan {
        chaos: options.chaos,
        seed: options.seed,
        length: options.length.or(options.chaos.then_some(CHAOS)),
        ..ScenarioPlan::default()
    };
    // The processes end with the thread that starts them, which is this one.
    let (report, outcome) = runtime
        .block_on(async { Ok::<_, DemoError>(Director::start(plan)?.run(&display).await) })?;
    let end = if options.json {
        serde_json::to_string_pretty(&report).expect("a report is plain data") + "\n"
    } else {
        table::draw(&report, display.columns())
    };
    display.end(end);
    outcome.map(|()| report.promises_kept)
}
