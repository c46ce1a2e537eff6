//! The journal's actor and its thread, on files in a temporary folder.

use super::super::{JournalStatus, NODE_ENDED, read};
use super::*;
use crate::platform::file_lock::FileLock;
use actix::dev::{MessageResponse, OneshotSender};
use blastema_core::detection::FaultRecord;
use blastema_core::{Fault, FaultId, FaultKind, FaultLocation};
use blastema_doubles::{advance, paused};
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;

/// For a disk and a thread of a busy computer.
const TIMEOUT: Duration = Duration::from_secs(60);

/// The record, which leaves the first request without a reply.
struct Record {
    requests: Arc<AtomicU32>,
}

impl Actor for Record {
    type Context = Context<Self>;
}

struct Answer(Option<FaultRecord>);

impl MessageResponse<Record, ReadRecord> for Answer {
    fn handle(self, _: &mut Context<Record>, asker: Option<OneshotSender<FaultRecord>>) {
        if let (Some(record), Some(asker)) = (self.0, asker) {
            let _ = asker.send(record);
        }
    }
}

impl Handler<ReadRecord> for Record {
    type Result = Answer;

    fn handle(&mut self, _: ReadRecord, _: &mut Context<Self>) -> Answer {
        let is_first = self.requests.fetch_add(1, Relaxed) == 0;
        Answer((!is_first).then(FaultRecord::default))
    }
}

fn journal(path: &Path, requests: &Arc<AtomicU32>) -> (JournalActor, JournalGuard) {
    let (mut actor, guard) = without_lock(path, requests);
    let thread = actor.thread.as_mut().unwrap();
    thread.lock = Some(JournalLock::new(FileLock::acquire(path, &thread.author.node).unwrap()));
    (actor, guard)
}

fn without_lock(path: &Path, requests: &Arc<AtomicU32>) -> (JournalActor, JournalGuard) {
    let node: NodeName = NodeName::new("a").unwrap();
    let record = Record { requests: requests.clone() }.start().recipient();
    let (incarnation, reports) = (Incarnation::FIRST, FaultReports::default());
    let (path, lock) = (path.to_owned(), None);
    JournalActor::new(path, lock, node, incarnation, record, reports)
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_record_that_cannot_be_read_is_requested_again() {
    let folder = tempfile::tempdir().unwrap();
    let requests = Arc::<AtomicU32>::default();
    let (actor, _guard) = journal(&folder.path().join("faults"), &requests);
    let actor = actor.start();

    actor.do_send(Wrote::Failed("no space left".to_owned()));
    advance(RETRY * 3).await;

    assert_eq!(requests.load(Relaxed), 2);
}

/// On real threads.
mod real {
    use super::*;

    fn step(id: u64) -> JournalRow {
        let fault = Fault {
            id: FaultId(id),
            severity: FaultKind::Panic.severity(),
            kind: FaultKind::Panic,
            location: FaultLocation::Object("a:arm".parse().unwrap()),
            incarnation: Incarnation::FIRST,
            detail: String::new(),
            found_at: Instant::ORIGIN,
            symptom_of: None,
            count: 1,
        };
        Moment::now().blank(fault)
    }

    fn written(path: &Path) -> Vec<u64> {
        read(path).unwrap().iter().map(|entry| entry.id).collect()
    }

    #[test]
    fn a_journal_in_a_folder_that_comes_later_is_written_then() {
        let _turn = blastema_doubles::turn();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("later/faults");
        paused(async {
            let (mut actor, guard) = without_lock(&path, &Arc::default());
            let mut thread = actor.thread.take().unwrap();
            let recipient = actor.start().recipient();
            let mut store = None;
            let refused = thread.write(&mut store, &[step(1)], &recipient).unwrap_err();
            assert!(refused.contains("No such file"), "{refused}");

            fs::create_dir(folder.path().join("later")).unwrap();
            thread.write(&mut store, &[step(1)], &recipient).unwrap();

            assert_eq!(written(&path), [1]);
            let other = NodeName::new("b").unwrap();
            assert!(FileLock::acquire(&path, &other).is_err(), "one node writes it");
            drop((thread, guard));
        });
    }

    #[test]
    fn a_journal_that_is_removed_begins_again_with_the_whole_record() {
        let _turn = blastema_doubles::turn();
        for with_folder in [false, true] {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("kept/faults");
            fs::create_dir(folder.path().join("kept")).unwrap();
            let requests = Arc::<AtomicU32>::default();
            paused(async {
                let (mut actor, guard) = journal(&path, &requests);
                let mut thread = actor.thread.take().unwrap();
                let recipient = actor.start().recipient();
                let mut store = None;
                thread.write(&mut store, &[step(1), step(2)], &recipient).unwrap();

                match with_folder {
                    false => fs::remove_file(&path).unwrap(),
                    true => {
                        fs::remove_dir_all(folder.path().join("kept")).unwrap();
                        fs::create_dir(folder.path().join("kept")).unwrap();
                    }
                }
                // As it does every five seconds, also without a fault.
                thread.write(&mut store, &[], &recipient).unwrap();
                advance(RETRY).await;
                assert_eq!(requests.load(Relaxed), 1, "the actor reads the whole record");
                thread.write(&mut store, &[step(2)], &recipient).unwrap();

                assert_eq!(written(&path), [2]);
                assert_eq!(read(&path).unwrap()[0].status, JournalStatus::Open);
                drop((thread, guard));
            });
        }
    }

    #[test]
    fn the_thread_ends_with_its_node_though_its_queue_was_full() {
        let _turn = blastema_doubles::turn();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("faults");
        paused(async {
            let (mut actor, guard) = journal(&path, &Arc::default());
            for id in 1..=QUEUE as u64 {
                let step = Work::Lines { lines: vec![step(id)], whole: false };
                assert!(actor.queue.try_send(step).is_ok());
            }
            guard.ends.set("a test".to_owned()).unwrap();
            assert!(matches!(actor.queue.try_send(Work::End), Err(TrySendError::Full(_))));

            let thread = actor.thread.take().unwrap();
            let recipient = actor.start().recipient();
            std::thread::spawn(move || thread.run(&recipient));

            let ended = guard.ended.recv_timeout(TIMEOUT);
            assert_eq!(ended, Err(std::sync::mpsc::RecvTimeoutError::Disconnected));
        });
        let entries = read(&path).unwrap();
        assert!(entries.iter().any(|entry| entry.code == NODE_ENDED));
    }
}
