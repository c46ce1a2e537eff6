//! Prints the snapshots of running nodes.

pub(crate) mod client;
pub(crate) mod tables;

use self::client::look;
use self::tables::Colour;
use crate::args::MonitorOptions;
use std::io::{self, IsTerminal};

/// Prints the snapshot of each node of the command line.
///
/// # Errors
/// The first node that cannot be shown; those before it have been printed.
pub(crate) fn run(options: &MonitorOptions) -> Result<(), String> {
    for path in &options.sockets {
        let seen = blastema::run(look(path, options.within))?;
        let colour = if io::stdout().is_terminal() { Colour::Ansi } else { Colour::Plain };
        let shown = if options.json { seen.text } else { tables::draw(&seen.snapshot, colour) };
        crate::print(&shown)?;
    }
    Ok(())
}
