//! The main job: a robot of three processes that is killed, hung and unplugged, and grows back.
//!
//! ```text
//!   Story (what next? was all well?)           module::run, in three child processes
//!     ▲ │                                          ▲
//!     │ ▼                                          │
//!   Director ── Launcher, Control ── JSON lines ───┘
//!     │
//!     └──► Display (a thread): Picture or lines, in the end the table
//! ```

mod chaos;
#[cfg(test)]
mod fake;
mod injection;
mod known;
mod ledger;
pub(crate) mod moment;
pub(crate) mod protocol;
mod report;
pub(crate) mod robot;
mod story;
pub(crate) mod tally;
pub(crate) mod timings;
mod trial;
pub(crate) mod wiring;

use crate::args::DemoOptions;

pub(crate) fn run(_options: &DemoOptions) -> Result<bool, std::io::Error> {
    Ok(true)
}
