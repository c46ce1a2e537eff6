//! The main job: a robot of three processes that is killed, hung and unplugged, and grows back.
//!
//! ```text
//!   Scenario (what next? was all well?)           module::run, in three child processes
//!     ▲ │                                          ▲
//!     │ ▼                                          │
//!   Director ── Launcher, Control ── JSON lines ───┘
//!     │
//!     └──► Display (a thread): DemoView or lines, in the end the table
//! ```
//!
//! The scenario is a pure machine; the director is its body and, for the modules, what the init system
//! of a robot's computers would be: it starts again what ended.

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
mod text_style;
pub(crate) mod timings;
mod trial;
mod view;
pub(crate) mod wiring;

use crate::args::DemoOptions;
use director::{DemoError, Director};
use display::{Display, Mode};
use scenario::ScenarioPlan;
use std::io;
use std::time::Duration;

/// How long chaos goes on if nothing is said.
const CHAOS: Duration = Duration::from_secs(60);

/// Runs the demonstration; whether every promise was kept.
///
/// # Errors
/// It could not be run, or not to its end.
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
    // The thread that starts the processes is this one: they end with it.
    let (report, outcome) = runtime
        .block_on(async { Ok::<_, DemoError>(Director::start(plan)?.run(&display).await) })?;
    if options.json {
        let document = serde_json::to_string_pretty(&report).expect("a report is plain data");
        display.document(document + "\n");
    } else {
        let columns = display.columns();
        display.end(table::draw(&report, columns));
    }
    outcome.map(|()| report.promises_kept)
}
