//! Prints the snapshots of running nodes.

pub(crate) mod client;
pub(crate) mod tables;

use self::client::{InspectError, look};
use self::tables::Colour;
use crate::args::MonitorOptions;
use std::io::{self, IsTerminal, Write};

/// The reason why a node cannot be shown.
#[derive(Debug, thiserror::Error)]
pub(crate) enum MonitorError {
    /// A snapshot cannot be read.
    #[error(transparent)]
    Look(#[from] InspectError),
    /// Standard output failed.
    #[error("the snapshot could not be printed: {0}")]
    Print(io::Error),
}

/// Prints the snapshot of each node of the command line.
///
/// # Errors
/// The first node that cannot be shown; those before it have been printed.
pub(crate) fn run(options: &MonitorOptions) -> Result<(), MonitorError> {
    for path in &options.sockets {
        let seen = blastema::run(look(path, options.within))?;
        let colour = if io::stdout().is_terminal() { Colour::Ansi } else { Colour::Plain };
        let shown = if options.json { seen.text } else { tables::draw(&seen.picture, colour) };
        let printed = io::stdout().write_all(shown.as_bytes()).and_then(|()| io::stdout().flush());
        match printed {
            // The reader has closed its end, as `head` does.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => return Ok(()),
            printed => printed.map_err(MonitorError::Print)?,
        }
    }
    Ok(())
}
