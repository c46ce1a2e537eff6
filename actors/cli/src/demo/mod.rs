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

mod chaos;
pub(crate) mod control;
mod director;
mod display;
#[cfg(test)]
mod fake;
mod flow_accounting;
pub(crate) mod flow_receiver;
mod injection;
mod launcher;
pub(crate) mod machine_instant;
pub(crate) mod protocol;
mod report;
pub(crate) mod robot;
mod robot_state;
mod scenario;
mod table;
pub(crate) mod timings;
mod tone;
mod trial;
mod view;
pub(crate) mod wiring;

use crate::args::DemoOptions;
use director::{DemoError, Director};
use display::{Display, Mode};
use scenario::ScenarioPlan;
use std::io;
use std::time::Duration;

/// The default duration of a run with random faults.
const CHAOS: Duration = Duration::from_secs(60);

/// Runs the demonstration. Returns whether every promise was kept.
///
/// # Errors
/// The demonstration cannot be run to its end.
pub(crate) fn run(options: &DemoOptions) -> Result<bool, DemoError> {
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
