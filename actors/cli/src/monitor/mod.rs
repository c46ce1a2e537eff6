//! What a running node knows of itself, as it shows it at its window.

mod tables;

use crate::args::MonitorOptions;
use serde_json::Value;
use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A node is given so long to show itself: it waits for its own parts for a second at most.
const PATIENCE: Duration = Duration::from_secs(10);
/// The longest picture that is read: that of ten thousand components takes a third of it.
const LONGEST: u64 = 16 << 20;

/// Why a node cannot be shown.
#[derive(Debug, thiserror::Error)]
pub(crate) enum MonitorError {
    /// Nobody shows anything there.
    #[error("no node answers at {}: {error}{}", path.display(), advice(error))]
    Nobody {
        /// The path.
        path: PathBuf,
        /// What the system says.
        error: io::Error,
    },
    /// Somebody else listens there.
    #[error("what is shown at {} is no node: {reason}", path.display())]
    NoNode {
        /// The path.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Nobody reads what is printed.
    #[error("the picture could not be printed: {0}")]
    Print(io::Error),
}

fn advice(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::NotFound => "; give a node its window by NodeBuilder::shown_at",
        io::ErrorKind::ConnectionRefused => {
            "; the node that was shown there has died, or this is no window"
        }
        io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => {
            "; it stands still, or shows itself to others: try again"
        }
        io::ErrorKind::PermissionDenied => "; only the user who runs the node may look",
        _ => "",
    }
}

/// Prints the picture of every node that is asked for.
///
/// # Errors
/// The first of them that cannot be shown; those before it have been.
pub(crate) fn run(options: &MonitorOptions) -> Result<(), MonitorError> {
    for path in &options.windows {
        let text =
            look(path).map_err(|error| MonitorError::Nobody { path: path.clone(), error })?;
        let reason = |error: serde_json::Error| error.to_string();
        let no_node = |reason| MonitorError::NoNode { path: path.clone(), reason };
        let picture: Value = serde_json::from_str(&text).map_err(reason).map_err(no_node)?;
        let shown = if options.json { text } else { tables::draw(&picture) };
        let printed = io::stdout().write_all(shown.as_bytes()).and_then(|()| io::stdout().flush());
        match printed {
            // Whoever reads has seen enough, as `head` has.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => return Ok(()),
            printed => printed.map_err(MonitorError::Print)?,
        }
    }
    Ok(())
}

fn look(path: &Path) -> io::Result<String> {
    let window = UnixStream::connect(path)?;
    window.set_read_timeout(Some(PATIENCE))?;
    let mut text = String::new();
    window.take(LONGEST).read_to_string(&mut text)?;
    Ok(text)
}
