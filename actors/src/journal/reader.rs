//! What stands in a journal.

use super::lock;
use super::store::{APPLICATION, ENDED_WITH_PROCESS, NODE_ENDED, VERSION, version_of};
use crate::platform::wall_time::WallTime;
use rusqlite::{Connection, ErrorCode, OpenFlags, Row};
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// How long a lock of the writer is waited for.
const BUSY: Duration = Duration::from_secs(2);

/// Why a journal cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// Nothing is there.
    #[error(
        "there is no journal {}: give the path that NodeBuilder::journal was given",
        path.display()
    )]
    Missing {
        /// The path that was given.
        path: PathBuf,
    },
    /// The file is not a journal that this program can read.
    #[error("{} is no journal: {reason}", path.display())]
    NoJournal {
        /// The path of the file.
        path: PathBuf,
        /// What is there instead.
        reason: String,
    },
    /// The file cannot be read.
    #[error("the journal {} cannot be read: {reason}", path.display())]
    Unreadable {
        /// The path of the journal.
        path: PathBuf,
        /// What the database said.
        reason: String,
    },
}

/// One fault of a journal with its status; or, with the code [`NODE_ENDED`], when and why the node
/// ended, unless its process was killed.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct JournalEntry {
    /// The order in which faults were found, over all runs. Numbers may be left out.
    pub sequence: u64,
    /// The node that found it.
    pub node: String,
    /// Which incarnation of the node that was.
    pub node_incarnation: u64,
    /// Its number in the record of that incarnation.
    pub id: u64,
    /// The code of its kind.
    pub code: String,
    /// The kind of fault, as text.
    pub kind: String,
    /// How bad it is: `warning`, `error` or `critical`; `note` for the end of a node.
    pub severity: String,
    /// Where it is.
    pub location: String,
    /// Which incarnation of the place it struck last.
    pub incarnation: u64,
    /// The particulars: a panic's text and source line, a check's value and limit.
    pub detail: String,
    /// How often it was seen while it stood.
    pub count: u64,
    /// The number of its root in the same run.
    pub symptom_of: Option<u64>,
    /// The recovery action that was chosen last.
    pub action: Option<String>,
    /// Why the recoverer ceased to try.
    pub given_up: Option<String>,
    /// When it was found.
    pub found_at: WallTime,
    /// When service was restored, and how long after it was found.
    pub recovered: Option<(WallTime, Duration)>,
    /// When its cause was away, and how long after it was found.
    pub repaired: Option<(WallTime, Duration)>,
    /// How it is.
    pub status: JournalStatus,
}

/// How a fault of a journal is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum JournalStatus {
    /// The fault is open, and service is not restored.
    Open,
    /// The fault is open, and the recoverer has given it up.
    GivenUp,
    /// Service is restored; the part is not repaired.
    Recovered,
    /// Its cause is away.
    Closed,
    /// The fault was open when the node was shut down.
    EndedInOrder,
    /// The fault was open when the node's process died.
    EndedWithProcess,
}

impl JournalStatus {
    /// Whether the fault stands now.
    pub fn stands(self) -> bool {
        matches!(self, JournalStatus::Open | JournalStatus::GivenUp | JournalStatus::Recovered)
    }
}

impl fmt::Display for JournalStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            JournalStatus::Open => "open",
            JournalStatus::GivenUp => "given up",
            JournalStatus::Recovered => "recovered",
            JournalStatus::Closed => "closed",
            JournalStatus::EndedInOrder => "ended with the node",
            JournalStatus::EndedWithProcess => "ended with the process",
        })
    }
}

/// Reads all faults of the journal at `path`, in the order in which they were found. The node that
/// writes it may go on meanwhile.
///
/// # Errors
/// There is no journal, or it cannot be read.
///
/// # Examples
/// ```no_run
/// for entry in blastema::journal::read("/var/lib/robot/faults.db".as_ref())? {
///     println!("{} {} {}: {}", entry.found_at, entry.location, entry.kind, entry.status);
/// }
/// # Ok::<(), blastema::journal::ReadError>(())
/// ```
pub fn read(path: &Path) -> Result<Vec<JournalEntry>, ReadError> {
    if !path.exists() {
        return Err(ReadError::Missing { path: path.to_owned() });
    }
    if path.is_dir() {
        let reason = "it is a folder: give the path of the file in it".to_owned();
        return Err(ReadError::NoJournal { path: path.to_owned(), reason });
    }
    let unreadable = |error: rusqlite::Error| match error.sqlite_error_code() {
        Some(ErrorCode::NotADatabase) => {
            ReadError::NoJournal { path: path.to_owned(), reason: "it is no database".to_owned() }
        }
        Some(ErrorCode::ReadOnly) => {
            let reason =
                "you may not write in its folder, as SQLite must: copy it into one of yours";
            ReadError::Unreadable { path: path.to_owned(), reason: reason.to_owned() }
        }
        _ => ReadError::Unreadable { path: path.to_owned(), reason: error.to_string() },
    };
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = Connection::open_with_flags(path, flags).map_err(unreadable)?;
    connection.busy_timeout(BUSY).map_err(unreadable)?;
    check(&connection, path).map_err(unreadable)??;
    loop {
        // Before the faults are read: a node that ends in between has marked its run by then.
        let running = lock::is_running(path);
        let entries = entries(&connection, running).map_err(unreadable)?;
        // What a node has written that began in between stands, and was taken for ended.
        if running || !lock::is_running(path) {
            return Ok(entries);
        }
    }
}

fn check(connection: &Connection, path: &Path) -> rusqlite::Result<Result<(), ReadError>> {
    let no_journal = |reason: String| Err(ReadError::NoJournal { path: path.to_owned(), reason });
    let application: i32 =
        connection.pragma_query_value(None, "application_id", |row| row.get(0))?;
    Ok(match version_of(connection)? {
        _ if application != APPLICATION => {
            no_journal("it is a database of another program".to_owned())
        }
        VERSION => {
            let found: String =
                connection.query_row("PRAGMA quick_check(1)", [], |row| row.get(0))?;
            match found == "ok" {
                true => Ok(()),
                false => Err(ReadError::Unreadable { path: path.to_owned(), reason: found }),
            }
        }
        other => no_journal(format!("it has version {other}, and this program knows {VERSION}")),
    })
}

fn entries(connection: &Connection, running: bool) -> rusqlite::Result<Vec<JournalEntry>> {
    let mut statement = connection.prepare(
        "SELECT sequence, node, run.incarnation AS node_incarnation, id, code, kind, severity,
             place, fault.incarnation AS incarnation, detail, count, symptom_of, measure AS action, given_up,
             found_us, found_ns, recovered_us, recovered_ns, repaired_us, repaired_ns, ended,
             run.run = (SELECT max(run) FROM run) AS is_last
         FROM fault JOIN run USING (run) ORDER BY sequence",
    )?;
    statement.query_map([], |row| entry(row, running))?.collect()
}

fn entry(row: &Row<'_>, running: bool) -> rusqlite::Result<JournalEntry> {
    let found_ns: i64 = row.get("found_ns")?;
    let moment = |wall: &str, monotonic: &str| -> rusqlite::Result<_> {
        let (wall, monotonic): (Option<i64>, Option<i64>) = (row.get(wall)?, row.get(monotonic)?);
        let span = |at: i64| Duration::from_nanos(unsigned(at.saturating_sub(found_ns)));
        Ok(wall.zip(monotonic).map(|(wall, at)| (WallTime::from_micros(wall), span(at))))
    };
    let recovered = moment("recovered_us", "recovered_ns")?;
    let repaired = moment("repaired_us", "repaired_ns")?;
    let given_up: Option<String> = row.get("given_up")?;
    let (ended, is_last): (Option<String>, bool) = (row.get("ended")?, row.get("is_last")?);
    let code: String = row.get("code")?;
    let status = match ended.as_deref() {
        _ if repaired.is_some() || code == NODE_ENDED => JournalStatus::Closed,
        Some(ended) if ended != ENDED_WITH_PROCESS => JournalStatus::EndedInOrder,
        None if running && is_last => match (&recovered, &given_up) {
            (Some(_), _) => JournalStatus::Recovered,
            (None, Some(_)) => JournalStatus::GivenUp,
            (None, None) => JournalStatus::Open,
        },
        _ => JournalStatus::EndedWithProcess,
    };
    Ok(JournalEntry {
        sequence: unsigned(row.get("sequence")?),
        node: row.get("node")?,
        node_incarnation: unsigned(row.get("node_incarnation")?),
        id: unsigned(row.get("id")?),
        code,
        kind: row.get("kind")?,
        severity: row.get("severity")?,
        location: row.get("place")?,
        incarnation: unsigned(row.get("incarnation")?),
        detail: row.get("detail")?,
        count: unsigned(row.get("count")?),
        symptom_of: row.get::<_, Option<i64>>("symptom_of")?.map(unsigned),
        action: row.get("action")?,
        given_up,
        found_at: WallTime::from_micros(row.get("found_us")?),
        recovered,
        repaired,
        status,
    })
}

fn unsigned(value: i64) -> u64 {
    u64::try_from(value).unwrap_or_default()
}
