//! Databases in a temporary folder, written by runs of invented nodes.

use super::lock::JournalLock;
use super::store::{Author, JournalRow, Moment, Store, StoreError, StoreLimits};
use super::writer::set_aside;
use super::{JournalEntry, JournalStatus, NODE_ENDED, ReadError, WallTime, read};
use crate::platform::file_lock::{FileLock, LockError};
use blastema_core::{Fault, FaultId, FaultKind, FaultLocation, Incarnation, Instant, NodeName};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A folder with a path in it; the folder goes with the test.
fn journal() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("faults");
    (folder, path)
}

fn node(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn author(name: &str, incarnation: u64) -> Author {
    let started = WallTime::from_micros(1_000_000);
    Author { node: node(name), incarnation: Incarnation(incarnation), started }
}

fn open(path: &Path, incarnation: u64) -> Store {
    Store::open(path, &author("a", incarnation), StoreLimits::default()).unwrap()
}

fn locked(path: &Path, name: &str) -> Result<JournalLock, LockError> {
    FileLock::acquire(path, &node(name)).map(JournalLock::new)
}

/// The next run of the node, once it has marked the others as ended.
fn run(path: &Path, incarnation: u64) -> (JournalLock, Store) {
    let lock = locked(path, "a").unwrap();
    let store = open(path, incarnation);
    lock.begin_run().unwrap();
    (lock, store)
}

fn moment(millis: u64, wall: i64) -> Moment {
    Moment { monotonic: Instant::from_millis(millis), wall: WallTime::from_micros(wall) }
}

fn line(id: u64, found: Moment) -> JournalRow {
    let fault = Fault {
        id: FaultId(id),
        severity: FaultKind::LinkDown.severity(),
        kind: FaultKind::LinkDown,
        location: FaultLocation::Link { node: node("a"), link: "eth".into(), neighbour: None },
        incarnation: Incarnation(0),
        detail: "no hello".to_owned(),
        found_at: found.monotonic,
        symptom_of: None,
        count: 1,
    };
    JournalRow { fault, found, action: None, recovered: None, repaired: None, given_up: None }
}

fn statuses(path: &Path) -> Vec<(u64, JournalStatus)> {
    read(path).unwrap().into_iter().map(|entry| (entry.id, entry.status)).collect()
}

#[test]
fn a_fault_is_read_as_it_was_written_step_by_step() {
    let (_folder, path) = journal();
    let (lock, mut store) = run(&path, 7);
    let found = moment(100, 5_000_000);
    store.write(&[line(1, found)]).unwrap();
    assert_eq!(statuses(&path), [(1, JournalStatus::Open)]);

    let given_up = JournalRow { given_up: Some("no path".to_owned()), ..line(1, found) };
    store.write(&[JournalRow { action: Some("re-route".to_owned()), ..line(1, found) }]).unwrap();
    store.write(&[given_up]).unwrap();
    assert_eq!(statuses(&path), [(1, JournalStatus::GivenUp)]);
    let recovered = JournalRow { recovered: Some(moment(130, 5_030_000)), ..line(1, found) };
    store.write(&[recovered]).unwrap();
    assert_eq!(statuses(&path), [(1, JournalStatus::Recovered)]);
    store
        .write(&[JournalRow { repaired: Some(moment(900, 5_800_000)), ..line(1, found) }])
        .unwrap();

    let entries = read(&path).unwrap();
    let [entry] = entries.as_slice() else { panic!("one fault, and not {entries:?}") };
    let JournalEntry { node, code, location, action, given_up, recovered, repaired, .. } = entry;
    assert_eq!((node.as_str(), code.as_str(), location.as_str()), ("a", "B11", "a -eth-"));
    assert_eq!((action.as_deref(), given_up.as_deref()), (Some("re-route"), None));
    let span = Duration::from_millis;
    assert_eq!(*recovered, Some((WallTime::from_micros(5_030_000), span(30))));
    assert_eq!(*repaired, Some((WallTime::from_micros(5_800_000), span(800))));
    assert_eq!(entry.status, JournalStatus::Closed);
    drop(lock);
}

#[test]
fn open_faults_of_a_run_that_is_over_are_not_open() {
    let (_folder, path) = journal();
    let (lock, mut first) = run(&path, 1);
    first.write(&[line(1, moment(1, 1)), line(2, moment(2, 2))]).unwrap();
    let repaired = Some(moment(3, 3));
    first.write(&[JournalRow { repaired, ..line(2, moment(2, 2)) }]).unwrap();
    drop((first, lock));

    let with_process = (1, JournalStatus::EndedWithProcess);
    assert_eq!(statuses(&path), [with_process, (2, JournalStatus::Closed)], "its lock is free");
    let (_lock, mut second) = run(&path, 2);
    second.write(&[line(1, moment(4, 4))]).unwrap();
    let open_again = (1, JournalStatus::Open);
    assert_eq!(statuses(&path), [with_process, (2, JournalStatus::Closed), open_again]);
    second.end("the program shut it down", moment(5, 6)).unwrap();
    let entries = read(&path).unwrap();
    let [.., fault, end] = entries.as_slice() else { panic!("{entries:?}") };
    assert_eq!((fault.id, fault.status), (1, JournalStatus::EndedInOrder));
    let row = (end.code.as_str(), end.location.as_str(), end.detail.as_str(), end.status);
    assert_eq!(row, (NODE_ENDED, "a", "the program shut it down", JournalStatus::Closed));
    assert_eq!((end.found_at, end.node_incarnation), (WallTime::from_micros(6), 2));
}

#[test]
fn faults_of_a_killed_process_are_not_open_while_the_next_one_begins() {
    let (_folder, path) = journal();
    let (lock, mut first) = run(&path, 1);
    first.write(&[line(1, moment(1, 1))]).unwrap();
    assert_eq!(statuses(&path), [(1, JournalStatus::Open)]);
    drop((first, lock));

    let lock = locked(&path, "a").unwrap();
    let ended = [(1, JournalStatus::EndedWithProcess)];
    assert_eq!(statuses(&path), ended, "the next process has not opened the file yet");
    let mut second = open(&path, 2);
    lock.begin_run().unwrap();
    assert_eq!(statuses(&path), ended);
    second.write(&[line(1, moment(2, 2))]).unwrap();
    assert_eq!(statuses(&path), [ended[0], (1, JournalStatus::Open)]);
}

#[test]
fn a_wall_clock_that_is_set_back_changes_no_order_and_no_span() {
    let (_folder, path) = journal();
    let mut store = open(&path, 1);
    store.write(&[line(1, moment(1_000, 9_000_000))]).unwrap();
    let recovered = Some(moment(1_500, 2_500_000));
    store.write(&[JournalRow { recovered, ..line(1, moment(1_000, 2_000_000)) }]).unwrap();
    store.write(&[line(2, moment(2_000, 3_000_000))]).unwrap();

    let entries = read(&path).unwrap();
    let found: Vec<_> = entries.iter().map(|entry| (entry.id, entry.found_at)).collect();
    let [before, after] = [9_000_000, 3_000_000].map(WallTime::from_micros);
    assert_eq!(found, [(1, before), (2, after)], "the first time that was written stays");
    assert_eq!(entries[0].recovered.map(|(_, span)| span), Some(Duration::from_millis(500)));
}

#[test]
fn the_oldest_faults_that_are_over_make_room() {
    let (_folder, path) = journal();
    let limits = StoreLimits { faults: 3, ..StoreLimits::default() };
    let mut store = Store::open(&path, &author("a", 1), limits).unwrap();
    let repaired = Some(moment(9, 9));
    store.write(&[line(1, moment(1, 1)), line(2, moment(2, 2))]).unwrap();
    store.write(&[JournalRow { repaired, ..line(2, moment(2, 2)) }]).unwrap();

    store.write(&[line(3, moment(3, 3)), line(4, moment(4, 4))]).unwrap();
    let ids = |path: &Path| read(path).unwrap().iter().map(|entry| entry.id).collect::<Vec<_>>();
    assert_eq!(ids(&path), [1, 3, 4]);
    store.write(&[line(5, moment(5, 5))]).unwrap();
    assert_eq!(ids(&path), [3, 4, 5], "where none is over, the oldest");
}

#[test]
fn a_file_that_is_full_keeps_what_it_has_and_says_so() {
    let (_folder, path) = journal();
    let limits = StoreLimits { pages: 12, ..StoreLimits::default() };
    let mut store = Store::open(&path, &author("a", 1), limits).unwrap();
    let mut long = line(1, moment(1, 1));
    long.fault.detail = "x".repeat(5_000);
    let mut written = 0;
    let error = loop {
        (long.fault.id, written) = (FaultId(written + 1), written + 1);
        match store.write(std::slice::from_ref(&long)) {
            Ok(()) => assert!(written < 1_000, "it is bounded"),
            Err(error) => break error,
        }
    };
    assert!(matches!(&error, StoreError::Unwritable(text) if text.contains("full")), "{error:?}");
    assert_eq!(read(&path).unwrap().len() as u64, written - 1);
    assert!(read(&path).unwrap().iter().all(|entry| entry.detail.len() == 2048));
}

#[test]
fn a_damaged_file_is_known_as_such_and_can_be_set_aside() {
    let (_folder, path) = journal();
    drop(open(&path, 1));
    let whole = fs::read(&path).unwrap();
    let mut spoilt = whole.clone();
    spoilt[100..].fill(0x5a);
    let mut pages_gone = whole.clone();
    pages_gone[5000..].fill(0x5a);
    let mut cut = whole.clone();
    cut.truncate(whole.len() / 2);
    let mut cut_in_a_page = whole;
    cut_in_a_page.truncate(5000);
    for bytes in [spoilt, pages_gone, cut, cut_in_a_page] {
        fs::write(&path, &bytes).unwrap();
        assert!(read(&path).is_err());
        let error = Store::open(&path, &author("a", 2), StoreLimits::default()).unwrap_err();
        assert!(matches!(error, StoreError::Damaged(_)), "{error:?}");

        let aside = set_aside(&path).unwrap();
        assert_eq!(fs::read(&aside).unwrap(), bytes);
        drop(open(&path, 2));
    }
}

#[test]
fn a_file_that_no_journal_wrote_is_left_alone() {
    let (_folder, path) = journal();
    let mut image = vec![0x5a; 5000];
    image[..16].copy_from_slice(b"SQLite format 3\0");
    let text = b"no database at all, but a text of some length".to_vec();
    for bytes in [text, b"short".to_vec(), image] {
        fs::write(&path, &bytes).unwrap();

        let error = Store::open(&path, &author("a", 2), StoreLimits::default()).unwrap_err();

        let StoreError::Unwritable(reason) = error else { panic!("{error:?}") };
        assert!(reason.contains("give the journal another path"), "{reason}");
        assert_eq!(fs::read(&path).unwrap(), bytes);
    }
}

#[test]
fn a_database_of_another_program_or_a_newer_one_is_left_alone() {
    let (_folder, path) = journal();
    let foreign = rusqlite::Connection::open(&path).unwrap();
    foreign.execute_batch("CREATE TABLE song (name TEXT)").unwrap();
    let refused = |path: &Path| {
        let error = Store::open(path, &author("a", 1), StoreLimits::default()).unwrap_err();
        let StoreError::Unwritable(reason) = error else { panic!("{error:?}") };
        reason
    };
    assert!(refused(&path).contains("another program"));
    assert!(matches!(read(&path), Err(ReadError::NoJournal { .. })));
    drop(foreign);
    fs::remove_file(&path).unwrap();

    drop(open(&path, 1));
    let newer = rusqlite::Connection::open(&path).unwrap();
    newer.pragma_update(None, "user_version", 2).unwrap();
    assert!(refused(&path).contains("version 2"));
    assert!(matches!(read(&path), Err(ReadError::NoJournal { .. })));
    fs::write(&path, "no database at all, but a text of some length").unwrap();
    assert!(matches!(read(&path), Err(ReadError::NoJournal { .. })));
    assert!(matches!(read(&path.join("x")), Err(ReadError::Missing { .. })));
    let folder = read(path.parent().unwrap());
    assert!(matches!(folder, Err(ReadError::NoJournal { .. })), "{folder:?}");
}

#[test]
fn two_nodes_do_not_write_one_journal_and_the_second_learns_who_does() {
    let (_folder, path) = journal();
    let lock = locked(&path, "a").unwrap();

    let Err(LockError::InUse { by }) = locked(&path, "b") else { panic!("it is in use") };
    assert_eq!(by, format!("node a, process {}", std::process::id()));
    drop(lock);
    assert!(locked(&path, "b").is_ok());
}
