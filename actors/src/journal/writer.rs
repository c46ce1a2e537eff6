//! The journal's thread, and the actor that gives it work.

use super::store::{JournalRow, Moment, Store, StoreError, StoreLimits};
use crate::platform;
use crate::platform::file_lock::{FileLock, beside};
use crate::platform::write_queue::{QueueRefusal, WriteQueue};
use crate::runtime::guardian::answers_the_monitor;
use crate::runtime::reports::FaultReports;
use actix::prelude::*;
use blastema_contract::detector::{FaultEvent, ReadRecord};
use blastema_core::detection::{FaultEntry, FaultTransition};
use blastema_core::{Incarnation, Instant, NodeName};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use std::{fs, io};

/// The object under whose name faults of the journal stand.
pub(crate) const JOURNAL: &str = "chain/journal";
/// Steps that may wait for the disk: a storm of a few seconds at the notifier's own limit.
const QUEUE: usize = 1024;
/// From a failed write, or a full queue, to the next attempt. A disk does not become empty sooner.
const RETRY: Duration = Duration::from_secs(5);
/// How long the end of a node waits for the last steps: a slow disk must not hold a robot's
/// shutdown.
const LAST_STEPS: Duration = Duration::from_secs(2);
/// So many damaged files are kept; the last one is replaced by the next.
const SET_ASIDE_MAX: u32 = 8;

/// What the thread has done.
#[derive(Debug, Message)]
#[rtype(result = "()")]
enum Wrote {
    /// All work so far is on the disk.
    Done,
    /// It is not.
    Failed(String),
    /// It is, in a new file: the one before was damaged.
    BeganAgain(String),
}

/// Hands every step of every fault to the journal's thread.
pub(crate) struct JournalActor {
    path: PathBuf,
    queue: WriteQueue<JournalRow>,
    record: Recipient<ReadRecord>,
    reports: FaultReports,
    /// Steps are missing in the journal: the whole record is to be written.
    behind: bool,
    /// The last write failed, and that was told.
    failed: bool,
    /// A retry is due.
    waits: bool,
    /// The thread, until it is started.
    thread: Option<Writer>,
}

/// Ends the thread when dropped, once it has written what it was given.
pub(crate) struct JournalGuard {
    queue: WriteQueue<JournalRow>,
    /// Why the node ends, once it does.
    ends: Arc<OnceLock<String>>,
    ended: Receiver<()>,
}

impl JournalGuard {
    /// The node ends for this reason, which is the last entry.
    pub(crate) fn end(self, cause: &str) {
        // A guard ends once.
        let _ = self.ends.set(cause.to_owned());
    }
}

impl Drop for JournalGuard {
    fn drop(&mut self) {
        self.queue.close();
        let _ = self.ended.recv_timeout(LAST_STEPS);
    }
}

/// What the thread owns.
struct Writer {
    path: PathBuf,
    node: NodeName,
    incarnation: Incarnation,
    queue: WriteQueue<JournalRow>,
    ends: Arc<OnceLock<String>>,
    /// Dropped at the end, which the guard waits for.
    ended: SyncSender<()>,
    /// Given back at the end.
    lock: Option<FileLock>,
    store: Option<Store>,
}

impl JournalActor {
    /// The actor, and what ends its thread. There is no lock where the file system does not give it
    /// yet.
    pub(crate) fn new(
        path: PathBuf,
        lock: Option<FileLock>,
        (node, incarnation): (NodeName, Incarnation),
        record: Recipient<ReadRecord>,
        reports: FaultReports,
    ) -> (Self, JournalGuard) {
        let queue = WriteQueue::new(QUEUE);
        let (ended, awaited) = sync_channel(1);
        let ends = Arc::<OnceLock<String>>::default();
        let guard = JournalGuard { queue: queue.clone(), ends: ends.clone(), ended: awaited };
        let (of, work) = (path.clone(), queue.clone());
        let thread =
            Writer { path: of, node, incarnation, queue: work, ends, ended, lock, store: None };
        let actor = JournalActor {
            path,
            queue,
            record,
            reports,
            behind: false,
            failed: false,
            waits: false,
            thread: Some(thread),
        };
        (actor, guard)
    }

    fn hand_over(
        &mut self,
        rows: impl IntoIterator<Item = JournalRow>,
        context: &mut Context<Self>,
    ) {
        // After the node's end nothing is written any more.
        if self.queue.push(rows) == Err(QueueRefusal::Full) {
            self.fall_behind(context);
        }
    }

    /// The whole record is written later, in place of single steps.
    fn fall_behind(&mut self, context: &mut Context<Self>) {
        self.behind = true;
        if !std::mem::replace(&mut self.waits, true) {
            context.run_later(RETRY, |actor, context| actor.catch_up(context));
        }
    }

    fn catch_up(&mut self, context: &mut Context<Self>) {
        self.waits = false;
        let record = actix::fut::wrap_future::<_, Self>(self.record.send(ReadRecord));
        context.spawn(record.map(|record, actor, context| {
            let Ok(record) = record else { return actor.fall_behind(context) };
            // Steps that come from here on are newer than the record, and follow it in the queue.
            actor.behind = false;
            let now = Moment::now();
            let rows = record.entries.into_iter().map(|entry| now.row_of_entry(entry));
            actor.hand_over(rows, context);
        }));
    }

    fn fail(&mut self, reason: &str, context: &mut Context<Self>) {
        self.fall_behind(context);
        if !std::mem::replace(&mut self.failed, true) {
            let path = self.path.display();
            let detail = format!(
                "the journal {path} cannot be written, and the node goes on without: {reason}"
            );
            self.reports.declare(JOURNAL, detail);
        }
    }
}

impl Actor for JournalActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        let Some(thread) = self.thread.take() else { return };
        let recipient = context.address().recipient();
        if let Err(error) = platform::start_thread("journal", move || thread.run(&recipient)) {
            self.fail(&format!("its thread cannot be started: {error}"), context);
        }
    }
}

impl Supervised for JournalActor {
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.waits = false;
        self.fall_behind(context);
    }
}

answers_the_monitor!(JournalActor);

impl Handler<FaultEvent> for JournalActor {
    type Result = ();

    fn handle(&mut self, event: FaultEvent, context: &mut Context<Self>) {
        if !self.behind {
            self.hand_over([Moment::now().row_of_event(event)], context);
        }
    }
}

impl Handler<Wrote> for JournalActor {
    type Result = ();

    fn handle(&mut self, message: Wrote, context: &mut Context<Self>) {
        match message {
            Wrote::Done => {
                // The whole record was handed over, and is on the disk.
                if !self.behind && std::mem::replace(&mut self.failed, false) {
                    self.reports.clear(JOURNAL);
                }
            }
            Wrote::Failed(reason) => self.fail(&reason, context),
            Wrote::BeganAgain(detail) => {
                self.failed = true;
                self.reports.declare(JOURNAL, detail);
                self.fall_behind(context);
            }
        }
    }
}

/// The rows of faults, as they are written at this moment.
impl Moment {
    /// An instant of the monotonic clock, with the wall clock's time by its present setting.
    fn of(&self, at: Instant) -> Moment {
        Moment { monotonic: at, wall: self.wall.before(self.monotonic - at) }
    }

    fn row_of_event(&self, event: FaultEvent) -> JournalRow {
        let FaultEvent { fault, at, turn } = event;
        let at = self.of(at);
        let over = fault.is_repaired_by_recovery();
        let mut row = self.blank(fault);
        match turn {
            FaultTransition::Decided { action } => row.action = Some(action),
            FaultTransition::Recovered => {
                row.recovered = Some(at);
                row.repaired = over.then_some(at);
            }
            FaultTransition::Cleared => row.repaired = Some(at),
            FaultTransition::GaveUp { reason } => row.given_up = Some(reason),
            _ => {}
        }
        row
    }

    fn row_of_entry(&self, entry: FaultEntry) -> JournalRow {
        let FaultEntry { fault, decided, recovered_at, repaired_at, given_up, .. } = entry;
        JournalRow {
            action: decided.map(|(_, action)| action),
            recovered: recovered_at.map(|at| self.of(at)),
            repaired: repaired_at.map(|at| self.of(at)),
            given_up: given_up.map(|(_, reason)| reason),
            ..self.blank(fault)
        }
    }

    fn blank(&self, fault: blastema_core::Fault) -> JournalRow {
        let found = self.of(fault.found_at);
        JournalRow { fault, found, action: None, recovered: None, repaired: None, given_up: None }
    }
}

impl Writer {
    fn run(mut self, recipient: &Recipient<Wrote>) {
        // Opened at once, so that faults of earlier runs are marked as ended before this one's first.
        let mut work = Some(Vec::new());
        while let Some(rows) = work {
            recipient.do_send(match self.write(&rows, recipient) {
                Ok(()) => Wrote::Done,
                Err(reason) => Wrote::Failed(reason),
            });
            work = self.queue.take();
        }
        if let (Some(store), Some(cause)) = (self.store, self.ends.get()) {
            // What cannot be written now shows as the end of the process.
            let _ = store.end(cause, Moment::now());
        }
        drop((self.lock, self.ended));
    }

    fn write(&mut self, rows: &[JournalRow], recipient: &Recipient<Wrote>) -> Result<(), String> {
        let reason = match self.try_write(rows) {
            Err(StoreError::Damaged(reason)) => reason,
            written => return written.map_err(|error| error.to_string()),
        };
        self.store = None;
        let aside = set_aside(&self.path).map_err(|error| {
            format!("it is damaged ({reason}), and cannot be set aside: {error}")
        })?;
        self.try_write(rows).map_err(|error| error.to_string())?;
        let (path, aside) = (self.path.display(), aside.display());
        recipient.do_send(Wrote::BeganAgain(format!(
            "the journal {path} was damaged ({reason}): it is set aside as {aside}, and begins again"
        )));
        Ok(())
    }

    fn try_write(&mut self, rows: &[JournalRow]) -> Result<(), StoreError> {
        if self.lock.is_none() {
            let lock = FileLock::acquire(&self.path, &self.node);
            self.lock = Some(lock.map_err(|error| StoreError::Unwritable(error.to_string()))?);
        }
        if self.store.is_none() {
            let author = (&self.node, self.incarnation);
            self.store = Some(Store::open(&self.path, author, StoreLimits::default())?);
        }
        self.store.iter_mut().try_for_each(|store| store.write(rows))
    }
}

/// The files that SQLite keeps beside the database while it is open.
fn logs(path: &Path) -> [PathBuf; 2] {
    ["-wal", "-shm"].map(|ending| {
        let mut name = path.as_os_str().to_owned();
        name.push(ending);
        PathBuf::from(name)
    })
}

/// Renames a damaged database and its log, for a person to look at.
pub(super) fn set_aside(path: &Path) -> io::Result<PathBuf> {
    let numbered = |number: u32| beside(path, &format!("damaged-{number}"));
    let free = (1..SET_ASIDE_MAX).find(|&number| !numbered(number).exists());
    let aside = numbered(free.unwrap_or(SET_ASIDE_MAX));
    fs::rename(path, &aside)?;
    for (log, aside) in logs(path).iter().zip(logs(&aside)) {
        match fs::rename(log, aside) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
    }
    Ok(aside)
}

#[cfg(test)]
mod tests;
