//! Which incarnation of a node with keys starts: above the one before it, whatever the clock says.
//!
//! The file is written before the node sends its first frame. Where it cannot be, or holds no
//! number, the wall clock alone numbers the incarnation, and the log says what to do.

use crate::platform;
use crate::platform::file_lock::{FileLock, LockError};
use crate::platform::key_files::read_public;
use crate::platform::replace_file::replace_file;
use blastema_core::net::trust::incarnation_file::{IncarnationFile, following};
use blastema_core::{Incarnation, NodeName};
use std::path::Path;
use std::time::Duration;
use tracing::warn;

/// Another process that starts with the same key has the file for the time of one write to a disk.
const ATTEMPTS: u32 = 50;
const PAUSE: Duration = Duration::from_millis(10);

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
        platform::wait(PAUSE);
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
    use std::collections::BTreeSet;
    use std::{fs, thread};

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
    fn starts_at_one_moment_have_different_numbers() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("base.incarnation");

        let numbers: Vec<_> = thread::scope(|scope| {
            let start = || numbered(&file, &base(), NOON);
            let starts: Vec<_> = (0..8).map(|_| scope.spawn(start)).collect();
            starts.into_iter().map(|start| start.join().expect("no panic")).collect()
        });

        assert!(numbers.iter().all(|(_, complaint)| complaint.is_none()), "{numbers:?}");
        let different: BTreeSet<_> = numbers.iter().map(|(number, _)| *number).collect();
        assert_eq!(different.len(), 8);
        assert_eq!(numbered(&file, &base(), NOON).0, Incarnation(NOON.0 + 8));
    }
}
