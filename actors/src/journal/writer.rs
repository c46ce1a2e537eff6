//! The journal's thread, and the actor that gives it work.

use super::lock::JournalLock;
use super::store::{Author, JournalRow, Moment, Store, StoreError, StoreLimits};
use crate::platform;
use crate::platform::file_lock::{FileLock, beside};
use crate::runtime::guardian::answers_the_monitor;
use crate::runtime::reports::FaultReports;
use actix::prelude::*;
use blastema_contract::detector::{FaultEvent, ReadRecord};
use blastema_core::detection::{FaultEntry, FaultTransition};
use blastema_core::{Incarnation, Instant, NodeName};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use std::{fs, io};

/// The object under whose name faults of the journal stand.
pub(crate) const JOURNAL: &str = "chain/journal";
/// Steps that may wait for the disk: a storm of a few seconds at the notifier's own limit.
const QUEUE: usize = 1024;
/// Steps in one transaction: each costs one sync of the disk, however many steps it holds.
const BATCH: usize = 256;
/// From a failed write, or a full queue, to the next attempt. A disk does not become empty sooner.
/// A file that is removed is noticed as soon.
const RETRY: Duration = Duration::from_secs(5);
/// How long the end of a node waits for the last steps: a slow disk must not hold a robot's
/// shutdown.
const LAST_STEPS: Duration = Duration::from_secs(2);
/// So many damaged files are kept; the last one is replaced by the next.
const SET_ASIDE_MAX: u32 = 8;

/// Work for the thread.
enum Work {
    /// One step of a fault, or all that the node remembers.
    Lines { lines: Vec<JournalRow>, whole: bool },
    /// The node ends.
    End,
}

/// What the thread has done.
#[derive(Debug, Message)]
#[rtype(result = "()")]
enum Wrote {
    /// All work so far is on the disk.
    Done {
        /// With the node's whole record.
        whole: bool,
    },
    /// It is not.
    Failed(String),
    /// It is, in a new file: the one before was damaged, or is not there any more.
    BeganAgain(String),
}

/// Hands every step of every fault to the journal's thread.
pub(crate) struct JournalActor {
    path: PathBuf,
    queue: SyncSender<Work>,
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
    queue: SyncSender<Work>,
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
        // If the queue is full, the thread sees `ends` when it has written all of it.
        let _ = self.queue.try_send(Work::End);
        let _ = self.ended.recv_timeout(LAST_STEPS);
    }
}

/// What the thread owns.
struct Writer {
    path: PathBuf,
    author: Author,
    work: Receiver<Work>,
    ends: Arc<OnceLock<String>>,
    /// Dropped at the end, which the guard waits for.
    ended: SyncSender<()>,
    /// Given back at the end.
    lock: Option<JournalLock>,
}

impl JournalActor {
    /// The actor, and what ends its thread. There is no lock where the file system does not give it
    /// yet.
    pub(crate) fn new(
        path: PathBuf,
        lock: Option<JournalLock>,
        node: NodeName,
        incarnation: Incarnation,
        record: Recipient<ReadRecord>,
        reports: FaultReports,
    ) -> (Self, JournalGuard) {
        let (queue, work) = sync_channel(QUEUE);
        let (ended, awaited) = sync_channel(1);
        let ends = Arc::<OnceLock<String>>::default();
        let guard = JournalGuard { queue: queue.clone(), ends: ends.clone(), ended: awaited };
        let author = Author { node, incarnation, started: platform::wall_clock() };
        let thread = Writer { path: path.clone(), author, work, ends, ended, lock };
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

    fn hand_over(&mut self, work: Work, context: &mut Context<Self>) {
        match self.queue.try_send(work) {
            // After the node's end nothing is written any more.
            Ok(()) | Err(TrySendError::Disconnected(_)) => {}
            Err(TrySendError::Full(_)) => self.fall_behind(context),
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
            let lines = record.entries.into_iter().map(|entry| now.line_of_entry(entry));
            actor.hand_over(Work::Lines { lines: lines.collect(), whole: true }, context);
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
            let lines = vec![Moment::now().line_of_event(event)];
            self.hand_over(Work::Lines { lines, whole: false }, context);
        }
    }
}

impl Handler<Wrote> for JournalActor {
    type Result = ();

    fn handle(&mut self, message: Wrote, context: &mut Context<Self>) {
        match message {
            Wrote::Done { whole } => {
                if whole && std::mem::replace(&mut self.failed, false) {
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

/// The lines of faults, as they are written at this moment.
impl Moment {
    /// An instant of the monotonic clock, with the wall clock's time by its present setting.
    fn of(&self, at: Instant) -> Moment {
        Moment { monotonic: at, wall: self.wall.before(self.monotonic - at) }
    }

    fn line_of_event(&self, event: FaultEvent) -> JournalRow {
        let FaultEvent { fault, at, turn } = event;
        let at = self.of(at);
        let over = fault.is_repaired_by_recovery();
        let mut line = self.blank(fault);
        match turn {
            FaultTransition::Decided { action } => line.action = Some(action),
            FaultTransition::Recovered => {
                line.recovered = Some(at);
                line.repaired = over.then_some(at);
            }
            FaultTransition::Cleared => line.repaired = Some(at),
            FaultTransition::GaveUp { reason } => line.given_up = Some(reason),
            _ => {}
        }
        line
    }

    fn line_of_entry(&self, entry: FaultEntry) -> JournalRow {
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
        let mut store = None;
        // Opened at once, so that an earlier run is marked as ended before this one's first fault.
        let mut result = self.write(&mut store, &[], recipient);
        let mut whole = false;
        loop {
            recipient.do_send(match result {
                Ok(()) => Wrote::Done { whole },
                Err(reason) => Wrote::Failed(reason),
            });
            // A queue that was full when the node ended holds no `Work::End`.
            let timeout = if self.ends.get().is_some() { Duration::ZERO } else { RETRY };
            let first = match self.work.recv_timeout(timeout) {
                Ok(first) => first,
                Err(RecvTimeoutError::Timeout) if self.ends.get().is_none() => {
                    whole = false;
                    result = self.write(&mut store, &[], recipient);
                    continue;
                }
                Err(_) => break,
            };
            whole = false;
            let mut lines = Vec::new();
            let mut over = self.gather(first, &mut lines, &mut whole);
            while lines.len() < BATCH && !over {
                let Ok(next) = self.work.try_recv() else { break };
                over = self.gather(next, &mut lines, &mut whole);
            }
            result = self.write(&mut store, &lines, recipient);
            if over {
                break;
            }
        }
        if let (Some(store), Some(cause)) = (store, self.ends.get()) {
            // What cannot be written now shows as the end of the process.
            let _ = store.end(cause, Moment::now());
        }
        drop((self.lock, self.ended));
    }

    /// Takes a piece of work apart. Answers whether it was the last.
    fn gather(&self, work: Work, gathered: &mut Vec<JournalRow>, is_whole: &mut bool) -> bool {
        let Work::Lines { lines, whole } = work else { return true };
        *is_whole |= whole;
        gathered.extend(lines);
        false
    }

    fn write(
        &mut self,
        store: &mut Option<Store>,
        lines: &[JournalRow],
        recipient: &Recipient<Wrote>,
    ) -> Result<(), String> {
        let removed = store.take_if(|store| !store.is_at(&self.path)).is_some();
        if removed {
            // Its folder may be new as well, and its log belongs to no file.
            self.lock = None;
            logs(&self.path).iter().for_each(|log| drop(fs::remove_file(log)));
        }
        let again = match self.open(store).and_then(|store| store.write(lines)) {
            Ok(()) if removed => "was removed, or is another file".to_owned(),
            Ok(()) => return Ok(()),
            Err(StoreError::Unwritable(reason)) => return Err(reason),
            Err(StoreError::Damaged(reason)) => {
                *store = None;
                let aside = set_aside(&self.path).map_err(|error| {
                    format!("it is damaged ({reason}), and cannot be set aside: {error}")
                })?;
                let fresh = self.open(store).and_then(|store| store.write(lines));
                fresh.map_err(|error| match error {
                    StoreError::Damaged(reason) | StoreError::Unwritable(reason) => reason,
                })?;
                format!("was damaged ({reason}): it is set aside as {}", aside.display())
            }
        };
        let detail = format!("the journal {} {again}, and begins again", self.path.display());
        recipient.do_send(Wrote::BeganAgain(detail));
        Ok(())
    }

    fn open<'a>(&mut self, store: &'a mut Option<Store>) -> Result<&'a mut Store, StoreError> {
        let open = match store.take() {
            Some(open) => open,
            None => {
                let lock = match self.lock.take() {
                    Some(lock) => lock,
                    None => FileLock::acquire(&self.path, &self.author.node)
                        .map(JournalLock::new)
                        .map_err(|error| StoreError::Unwritable(error.to_string()))?,
                };
                let lock = self.lock.insert(lock);
                let open = Store::open(&self.path, &self.author, StoreLimits::default())?;
                lock.begin_run().map_err(|error| {
                    StoreError::Unwritable(format!("the lock of its run: {error}"))
                })?;
                open
            }
        };
        Ok(store.insert(open))
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
