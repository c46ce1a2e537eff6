//! Which incarnation of a node with keys starts: above the one before it, whatever the clock says.
//!
//! ```text
//!  links, router ── handle_known ──► OwnIncarnation ── thread: the file ──┐
//!       ▲                                                                 │
//!       └───────────────────────── IncarnationRaised ─────────────────────┘
//! ```
//!
//! A peer that had a channel with a later incarnation says so in its handshake, which is
//! authenticated. The node then goes on with the number above that one: links, router and sessions
//! are built again under it.
//!
//! The file is written before the node sends its first frame. Where it cannot be, or holds no
//! number, the wall clock alone numbers the incarnation, and the log says what to do.

use crate::platform;
use crate::platform::file_lock::{FileLock, LockError};
use crate::platform::key_files::read_public;
use crate::platform::replace_file::replace_file;
use actix::prelude::*;
use blastema_core::net::NodeId;
use blastema_core::net::trust::incarnation_file::{IncarnationFile, following};
use blastema_core::net::wire::advertisement::INCARNATION_MAX;
use blastema_core::sorted::SortedSet;
use blastema_core::{Incarnation, NodeName};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread;
use std::time::Duration;
use tracing::warn;

/// Another process that starts with the same key has the file for the time of one write to a disk.
const ATTEMPTS: u32 = 50;
const PAUSE: Duration = Duration::from_millis(10);
/// From here on no peer is believed: so many starts are left below the highest number that the file
/// can hold.
const KNOWN_MAX: Incarnation = Incarnation(INCARNATION_MAX.0 - (1 << 20));

/// The node goes on with a higher incarnation than before.
#[derive(Clone, Copy, Debug, Message)]
#[rtype(result = "()")]
pub(super) struct IncarnationRaised;

/// The incarnation of a node that has keys. Clones are the same.
#[derive(Clone)]
pub(super) struct OwnIncarnation(Arc<Numbering>);

struct Numbering {
    node: NodeName,
    file: Option<PathBuf>,
    present: AtomicU64,
    /// Peers whose word was taken. Each is believed once: a hostile one cannot have the links built
    /// again and again.
    believed: Mutex<SortedSet<NodeId>>,
    told: OnceLock<Vec<Recipient<IncarnationRaised>>>,
}

impl OwnIncarnation {
    /// It is kept in the file. A node without one has no keys, and believes no peer.
    pub(super) fn new(node: NodeName, present: Incarnation, file: Option<PathBuf>) -> Self {
        OwnIncarnation(Arc::new(Numbering {
            node,
            file,
            present: AtomicU64::new(present.0),
            believed: Mutex::default(),
            told: OnceLock::new(),
        }))
    }

    /// These are told when it is raised, in this order.
    pub(super) fn tell(&self, recipients: Vec<Recipient<IncarnationRaised>>) {
        // The network is started once.
        let _ = self.0.told.set(recipients);
    }

    /// The present one.
    pub(super) fn present(&self) -> Incarnation {
        Incarnation(self.0.present.load(Relaxed))
    }

    /// A peer, which has proved itself, knows this incarnation of the node.
    pub(super) fn handle_known(&self, peer: NodeId, known: Incarnation) {
        let Numbering { node, file: Some(file), believed, .. } = &*self.0 else { return };
        let mut believed = believed.lock().unwrap_or_else(PoisonError::into_inner);
        let present = self.present();
        if known < present || known >= KNOWN_MAX || !believed.insert(peer) {
            return;
        }
        let incarnation = known.next();
        self.0.present.store(incarnation.0, Relaxed);
        warn!(
            %node, %peer,
            "this node has started as {present}, and the node with the number {peer} has seen {known}: \
             its clock or its file {} was set back; it goes on as {incarnation}: set the clock",
            file.display()
        );
        // A disk may take its time.
        let (own, file) = (self.clone(), file.clone());
        let keep = move || {
            begin(&file, &own.0.node, incarnation);
            own.tell_all();
        };
        if platform::start_thread("incarnation", keep).is_err() {
            self.tell_all();
        }
    }

    fn tell_all(&self) {
        let recipients = self.0.told.get().into_iter().flatten();
        recipients.for_each(|to| to.do_send(IncarnationRaised));
    }
}

/// The incarnation that starts when the clock gives this number; it is kept in the file.
pub(super) fn begin(file: &Path, node: &NodeName, clock: Incarnation) -> Incarnation {
    let (incarnation, complaint) = numbered(file, node, clock);
    if let Some(complaint) = complaint {
        warn!(%node, %incarnation, "{complaint}");
    }
    incarnation
}

/// The same, with what a user should know.
fn numbered(file: &Path, node: &NodeName, clock: Incarnation) -> (Incarnation, Option<String>) {
    // No other process reads the file between these two steps.
    let lock = lock(file, node);
    let read = read(file, node);
    let incarnation = following(read.as_ref().copied().unwrap_or_default(), clock);
    let kept = lock.and_then(|_lock| {
        let text = IncarnationFile { node: node.clone(), incarnation }.to_text();
        replace_file(file, text.as_bytes()).map_err(|error| error.to_string())
    });
    let complaint = match (kept, read) {
        (Ok(()), Ok(_)) => None,
        (Ok(()), Err(error)) => Some(format!(
            "{error}: it was replaced by one with the number of this computer's clock; see that the clock \
             is right, and that no other program writes to the file"
        )),
        (Err(error), _) => Some(format!(
            "the number of this incarnation cannot be kept in {}: {error}; after the clock was set back, \
             the next one would have a lower number: let this user write to the file and its folder",
            file.display()
        )),
    };
    (incarnation, complaint)
}

fn lock(file: &Path, node: &NodeName) -> Result<FileLock, String> {
    let mut attempts = 1;
    loop {
        match FileLock::acquire(file, node) {
            Err(LockError::InUse { .. }) if attempts < ATTEMPTS => attempts += 1,
            acquired => return acquired.map_err(|error| error.to_string()),
        }
        thread::sleep(PAUSE);
    }
}

/// The number in the file; nothing at the node's first start.
fn read(file: &Path, node: &NodeName) -> Result<Option<Incarnation>, String> {
    if !file.try_exists().unwrap_or(true) {
        return Ok(None);
    }
    let text = read_public(file)?;
    let parsed = IncarnationFile::parse(&text, node);
    let parsed = parsed.map_err(|error| format!("{}: {error}", file.display()))?;
    Ok(Some(parsed.incarnation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const NOON: Incarnation = Incarnation(1_795_500_000_000);
    const DAY: u64 = 24 * 60 * 60 * 1000;

    fn base() -> NodeName {
        NodeName::new("base").expect("a name")
    }

    #[test]
    fn an_incarnation_has_a_higher_number_than_the_one_before_it_when_the_clock_was_set_back() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("base.incarnation");
        let start = |clock| numbered(&file, &base(), Incarnation(clock));

        assert_eq!(start(NOON.0), (NOON, None));
        assert_eq!(start(NOON.0), (NOON.next(), None), "in the same millisecond");
        assert_eq!(start(NOON.0 - DAY), (NOON.next().next(), None), "a day back");
        assert_eq!(start(NOON.0 + DAY), (Incarnation(NOON.0 + DAY), None));
        let kept = fs::read_to_string(&file).expect("it is there");
        assert!(kept.ends_with(&format!("incarnation  {}\n", NOON.0 + DAY)), "{kept}");
    }

    #[test]
    fn a_file_that_holds_no_number_is_replaced_and_the_log_says_what_to_do() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("base.incarnation");
        let whole = IncarnationFile { node: base(), incarnation: NOON }.to_text();
        for text in ["", "nonsense", &whole[..30], &whole.replace("base", "arm")] {
            fs::write(&file, text).expect("a folder");

            let (incarnation, complaint) = numbered(&file, &base(), NOON);

            assert_eq!(incarnation, NOON);
            let complaint = complaint.expect("it is no such file");
            let told =
                ["base.incarnation: line", "was replaced by one", "see that the clock is right"];
            assert!(told.iter().all(|words| complaint.contains(words)), "{complaint}");
            assert_eq!(numbered(&file, &base(), NOON), (NOON.next(), None));
        }
    }

    #[test]
    fn a_node_that_cannot_write_its_file_starts_by_the_clock_and_the_log_says_what_to_do() {
        let folder = tempfile::tempdir().expect("a folder");
        let blocked = folder.path().join("base.incarnation");
        // Permissions stop no process of root: something is in the way.
        fs::create_dir(&blocked).expect("a folder");
        let absent = folder.path().join("gone").join("base.incarnation");

        for file in [blocked, absent] {
            let (incarnation, complaint) = numbered(&file, &base(), NOON);

            assert_eq!(incarnation, NOON);
            let complaint = complaint.expect("it cannot be written");
            let told = ["cannot be kept in", "base.incarnation", "let this user write"];
            assert!(told.iter().all(|words| complaint.contains(words)), "{complaint}");
        }
    }

    #[test]
    fn each_peer_is_believed_once_that_it_knows_a_later_incarnation() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("base.incarnation");
        let own = OwnIncarnation::new(base(), NOON, Some(file));
        let check = |peer, known: u64, present: u64| {
            own.handle_known(NodeId(peer), Incarnation(known));
            assert_eq!(own.present().0 - NOON.0, present);
        };

        check(1, NOON.0 - 1, 0);
        check(1, NOON.0 + 10, 11);
        check(1, NOON.0 + 20, 11);
        check(2, NOON.0 + 5, 11);
        check(2, KNOWN_MAX.0, 11);
        check(2, NOON.0 + 30, 31);

        let without_keys = OwnIncarnation::new(base(), NOON, None);
        without_keys.handle_known(NodeId(1), NOON.next());
        assert_eq!(without_keys.present(), NOON);
    }

    #[test]
    fn starts_at_one_moment_have_different_numbers() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("base.incarnation");

        let numbers: Vec<_> = thread::scope(|scope| {
            let start = || numbered(&file, &base(), NOON);
            let starts: Vec<_> = (0..8).map(|_| scope.spawn(start)).collect();
            starts.into_iter().map(|start| start.join().expect("no panic")).collect()
        });

        assert!(numbers.iter().all(|(_, complaint)| complaint.is_none()), "{numbers:?}");
        let different: SortedSet<_> = numbers.iter().map(|(number, _)| *number).collect();
        assert_eq!(different.len(), 8);
        assert_eq!(numbered(&file, &base(), NOON).0, Incarnation(NOON.0 + 8));
    }
}
