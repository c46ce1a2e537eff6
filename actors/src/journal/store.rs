//! The journal's database: its tables, and what is written into them.

use super::WallTime;
use crate::platform;
use blastema_core::fault::shortened;
use blastema_core::{Fault, Incarnation, Instant, NodeName};
use rusqlite::{Connection, ErrorCode, OpenFlags, Statement, Transaction, params};
use std::fs::File;
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::time::Duration;

/// So many faults are kept in a journal: those of months, in about five megabytes.
pub const FAULTS_MAX: u32 = 10_000;
/// The file never takes more, whatever happens: twice what `FAULTS_MAX` of the longest particulars
/// take.
const PAGES_MAX: u32 = 16_384;
/// How long a reader's lock is waited for. In WAL mode readers lock only while a log is being
/// recovered.
const BUSY: Duration = Duration::from_secs(2);

/// "BlFJ": what the file is, in its header.
pub(super) const APPLICATION: i32 = 0x426c_464a;
/// Of the tables below.
pub(super) const VERSION: i32 = 1;

const SCHEMA: &str = "
    CREATE TABLE run (
        run INTEGER PRIMARY KEY AUTOINCREMENT,
        node TEXT NOT NULL,
        incarnation INTEGER NOT NULL,
        started_us INTEGER NOT NULL,
        ended TEXT,
        UNIQUE (node, incarnation)
    );
    CREATE TABLE fault (
        sequence INTEGER PRIMARY KEY AUTOINCREMENT,
        run INTEGER NOT NULL REFERENCES run,
        id INTEGER NOT NULL,
        code TEXT NOT NULL,
        kind TEXT NOT NULL,
        severity TEXT NOT NULL,
        place TEXT NOT NULL,
        incarnation INTEGER NOT NULL,
        detail TEXT NOT NULL,
        count INTEGER NOT NULL,
        symptom_of INTEGER,
        found_us INTEGER NOT NULL,
        found_ns INTEGER NOT NULL,
        measure TEXT,
        recovered_us INTEGER,
        recovered_ns INTEGER,
        repaired_us INTEGER,
        repaired_ns INTEGER,
        given_up TEXT,
        UNIQUE (run, id)
    );";

/// Writes a line for a fault, or what is new into the line that it has.
const PUT: &str =
    "INSERT INTO fault (run, id, code, kind, severity, place, incarnation, detail, count,
     symptom_of, found_us, found_ns, measure, recovered_us, recovered_ns, repaired_us,
     repaired_ns, given_up)
 VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12, ?13, ?14, ?15, ?16, ?17, ?18)
 ON CONFLICT (run, id) DO UPDATE SET
     place = excluded.place,
     incarnation = excluded.incarnation,
     detail = excluded.detail,
     count = excluded.count,
     symptom_of = excluded.symptom_of,
     measure = coalesce(excluded.measure, measure),
     recovered_us = coalesce(recovered_us, excluded.recovered_us),
     recovered_ns = coalesce(recovered_ns, excluded.recovered_ns),
     repaired_us = coalesce(repaired_us, excluded.repaired_us),
     repaired_ns = coalesce(repaired_ns, excluded.repaired_ns),
     given_up = CASE WHEN excluded.recovered_us IS NULL
         THEN coalesce(excluded.given_up, given_up) END";

/// The end of a run as an entry of its own, after all of its faults: those are numbered from 1.
const PUT_END: &str = "INSERT INTO fault
     (run, id, code, kind, severity, place, incarnation, detail, count, found_us, found_ns)
 SELECT run, 0, ?2, 'node ended', 'note', node, incarnation, ?3, 1, ?4, ?5 FROM run WHERE run = ?1
 ON CONFLICT (run, id) DO NOTHING";

/// The code of the entry that records when and why a node ended. No fault has this code.
pub const NODE_ENDED: &str = "B00";

/// The node of the run ended, and its journal was closed.
pub(super) const ENDED_IN_ORDER: &str = "in order";
/// The process of the run ended without a word.
pub(super) const ENDED_WITH_PROCESS: &str = "with the process";

/// Why a journal cannot be written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum StoreError {
    /// Its bytes are not what was written.
    Damaged(String),
    /// The disk, the file's permissions, or what stands there instead.
    Unwritable(String),
}

impl From<rusqlite::Error> for StoreError {
    fn from(error: rusqlite::Error) -> Self {
        match error.sqlite_error_code() {
            Some(ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase) => {
                StoreError::Damaged(error.to_string())
            }
            _ => StoreError::Unwritable(error.to_string()),
        }
    }
}

/// A moment on both clocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Moment {
    pub(super) monotonic: Instant,
    pub(super) wall: WallTime,
}

impl Moment {
    /// The present one.
    pub(super) fn now() -> Self {
        Moment { monotonic: platform::now(), wall: platform::wall_clock() }
    }
}

/// What is to be written of one fault. What is `None` leaves what was written before.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct JournalRow {
    pub(super) fault: Fault,
    pub(super) found: Moment,
    pub(super) action: Option<String>,
    pub(super) recovered: Option<Moment>,
    pub(super) repaired: Option<Moment>,
    pub(super) given_up: Option<String>,
}

/// The incarnation of a node that writes the journal.
#[derive(Clone, Debug)]
pub(super) struct Author {
    pub(super) node: NodeName,
    pub(super) incarnation: Incarnation,
    pub(super) started: WallTime,
}

/// How much a journal may hold.
#[derive(Clone, Copy, Debug)]
pub(super) struct StoreLimits {
    pub(super) faults: u32,
    pub(super) pages: u32,
}

impl Default for StoreLimits {
    fn default() -> Self {
        StoreLimits { faults: FAULTS_MAX, pages: PAGES_MAX }
    }
}

/// An open journal, in one run of a node.
#[derive(Debug)]
pub(super) struct Store {
    connection: Connection,
    run: i64,
    limits: StoreLimits,
    /// Its device and its number there.
    file: Option<(u64, u64)>,
}

impl Store {
    /// Opens the journal, or makes it, and goes on with the run of `author`. All other runs are
    /// over.
    pub(super) fn open(
        path: &Path,
        author: &Author,
        limits: StoreLimits,
    ) -> Result<Self, StoreError> {
        // From its bytes: SQLite tells nothing of a file that it finds damaged.
        let is_journal = has_journal_header(path);
        let mut connection = Connection::open_with_flags(
            path,
            OpenFlags::SQLITE_OPEN_READ_WRITE
                | OpenFlags::SQLITE_OPEN_CREATE
                | OpenFlags::SQLITE_OPEN_NO_MUTEX,
        )?;
        connection.busy_timeout(BUSY)?;
        check(&connection, is_journal)?;
        if version_of(&connection)? == 0 {
            // Before the log takes over, so that the file itself says whose it is.
            connection.pragma_update(None, "application_id", APPLICATION)?;
        }
        // The answer is the mode that the file system bears.
        let _: String = connection.query_row("PRAGMA journal_mode = WAL", [], |row| row.get(0))?;
        connection.pragma_update(None, "synchronous", "FULL")?;
        connection
            .query_row(&format!("PRAGMA max_page_count = {}", limits.pages), [], |_| Ok(()))?;
        let transaction = connection.transaction()?;
        if version_of(&transaction)? == 0 {
            transaction.execute_batch(SCHEMA)?;
            transaction.pragma_update(None, "user_version", VERSION)?;
        }
        let (node, incarnation) = (author.node.as_str(), number(author.incarnation.0));
        transaction.execute(
            "INSERT INTO run (node, incarnation, started_us) VALUES (?1, ?2, ?3)
             ON CONFLICT (node, incarnation) DO NOTHING",
            params![node, incarnation, author.started.as_micros()],
        )?;
        let run = transaction.query_row(
            "SELECT run FROM run WHERE node = ?1 AND incarnation = ?2",
            params![node, incarnation],
            |row| row.get(0),
        )?;
        transaction.execute(
            "UPDATE run SET ended = ?1 WHERE ended IS NULL AND run <> ?2",
            params![ENDED_WITH_PROCESS, run],
        )?;
        transaction.commit()?;
        Ok(Store { connection, run, limits, file: identity(path) })
    }

    /// Whether the file is still at this path. SQLite goes on writing into one that was removed.
    pub(super) fn is_at(&self, path: &Path) -> bool {
        identity(path) == self.file
    }

    /// Writes these lines, all or none.
    pub(super) fn write(&mut self, lines: &[JournalRow]) -> Result<(), StoreError> {
        if lines.is_empty() {
            return Ok(());
        }
        let transaction = self.connection.transaction()?;
        let mut statement = transaction.prepare(PUT)?;
        lines.iter().try_for_each(|line| put(&mut statement, self.run, line))?;
        drop(statement);
        trim(&transaction, self.run, self.limits.faults)?;
        transaction.commit()?;
        Ok(())
    }

    /// The run ends, for this reason.
    pub(super) fn end(self, cause: &str, at: Moment) -> Result<(), StoreError> {
        let ended = "UPDATE run SET ended = ?1 WHERE run = ?2";
        self.connection.execute(ended, params![ENDED_IN_ORDER, self.run])?;
        let (wall, monotonic) = (at.wall.as_micros(), number(at.monotonic.as_nanos()));
        let entry = params![self.run, NODE_ENDED, shortened(cause), wall, monotonic];
        self.connection.execute(PUT_END, entry)?;
        self.connection.close().map_err(|(_, error)| error.into())
    }
}

/// Whether it is a journal, or a new file, and whole. Only a file whose header says that it is a
/// journal is damaged; any other is not ours, and is left alone.
fn check(connection: &Connection, is_journal: bool) -> Result<(), StoreError> {
    let foreign =
        |what: &str| StoreError::Unwritable(format!("it is {what}: give the journal another path"));
    let not_ours = |error: rusqlite::Error| match StoreError::from(error) {
        StoreError::Damaged(reason) if !is_journal => foreign(&format!("no journal ({reason})")),
        error => error,
    };
    let application: i32 = connection
        .pragma_query_value(None, "application_id", |row| row.get(0))
        .map_err(not_ours)?;
    if application != APPLICATION {
        let tables = "SELECT count(*) FROM sqlite_master";
        let tables: i64 = connection.query_row(tables, [], |row| row.get(0)).map_err(not_ours)?;
        if application != 0 || tables != 0 {
            return Err(foreign("a database of another program"));
        }
    }
    let version = version_of(connection)?;
    if version > VERSION {
        let what = format!("it has version {version}, and this program knows {VERSION}: update it");
        return Err(StoreError::Unwritable(what));
    }
    let found: String = connection.query_row("PRAGMA quick_check(1)", [], |row| row.get(0))?;
    if found != "ok" {
        return Err(StoreError::Damaged(found));
    }
    Ok(())
}

fn identity(path: &Path) -> Option<(u64, u64)> {
    std::fs::metadata(path).ok().map(|file| (file.dev(), file.ino()))
}

/// Whether the file's header says that it is a journal: see section 1.3 of SQLite's file format.
fn has_journal_header(path: &Path) -> bool {
    let mut header = [0; 72];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut header));
    read.is_ok()
        && header.starts_with(b"SQLite format 3\0")
        && header.ends_with(&APPLICATION.to_be_bytes())
}

pub(super) fn version_of(connection: &Connection) -> rusqlite::Result<i32> {
    connection.pragma_query_value(None, "user_version", |row| row.get(0))
}

fn put(statement: &mut Statement<'_>, run: i64, line: &JournalRow) -> rusqlite::Result<()> {
    let fault = &line.fault;
    let wall = |moment: Option<Moment>| moment.map(|moment| moment.wall.as_micros());
    let monotonic = |moment: Option<Moment>| moment.map(|m| number(m.monotonic.as_nanos()));
    statement.execute(params![
        run,
        number(fault.id.0),
        fault.kind.code(),
        fault.kind.text(),
        fault.severity.to_string(),
        fault.location.to_string(),
        number(fault.incarnation.0),
        shortened(&fault.detail),
        fault.count,
        fault.symptom_of.map(|root| number(root.0)),
        line.found.wall.as_micros(),
        number(line.found.monotonic.as_nanos()),
        line.action,
        wall(line.recovered),
        monotonic(line.recovered),
        wall(line.repaired),
        monotonic(line.repaired),
        line.given_up.as_deref().map(shortened),
    ])?;
    Ok(())
}

/// Removes what is beyond the limit: of the faults that are over the oldest first, then of all.
fn trim(transaction: &Transaction<'_>, run: i64, limit: u32) -> rusqlite::Result<()> {
    let count: i64 = transaction.query_row("SELECT count(*) FROM fault", [], |row| row.get(0))?;
    if count <= i64::from(limit) {
        return Ok(());
    }
    transaction.execute(
        "DELETE FROM fault WHERE sequence IN (
             SELECT sequence FROM fault
             ORDER BY run = ?1 AND repaired_us IS NULL, sequence LIMIT ?2)",
        params![run, count - i64::from(limit)],
    )?;
    transaction.execute(
        "DELETE FROM run WHERE run <> ?1 AND run NOT IN (SELECT run FROM fault)",
        params![run],
    )?;
    Ok(())
}

/// SQLite's integers are signed.
fn number(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}
