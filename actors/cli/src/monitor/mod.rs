//! What a running node knows of itself, as it shows it at its window.

pub(crate) mod look;
pub(crate) mod tables;

use self::look::{LookError, look};
use crate::args::MonitorOptions;
use std::io::{self, Write};

/// Why nodes cannot be shown.
#[derive(Debug, thiserror::Error)]
pub(crate) enum MonitorError {
    /// One of them is not to be seen.
    #[error(transparent)]
    Look(#[from] LookError),
    /// Nobody reads what is printed.
    #[error("the picture could not be printed: {0}")]
    Print(io::Error),
}

/// Prints the picture of every node that is asked for.
///
/// # Errors
/// The first of them that cannot be shown; those before it have been.
pub(crate) fn run(options: &MonitorOptions) -> Result<(), MonitorError> {
    for path in &options.windows {
        let seen = blastema::run(look(path, options.within))?;
        let shown = if options.json { seen.text } else { tables::draw(&seen.picture) };
        let printed = io::stdout().write_all(shown.as_bytes()).and_then(|()| io::stdout().flush());
        match printed {
            // Whoever reads has seen enough, as `head` has.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => return Ok(()),
            printed => printed.map_err(MonitorError::Print)?,
        }
    }
    Ok(())
}
