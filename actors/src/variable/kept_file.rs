//! A file in which values outlive the node's process.
//!
//! ```text
//!  "blastema-variables 1\n" │ values, by the codec │ CRC-32C of all before, little-endian
//! ```
//!
//! The whole file is replaced: whatever ends the process, or the power, leaves the old file or the
//! new one.

use crate::platform::file_lock::{FileLock, beside};
use crate::platform::replace_file::replace_file;
use crate::platform::{self, lock};
use blastema_core::DeliveryError;
use blastema_core::contract::codec;
use blastema_core::variables::PersistedValue;
use crc::{CRC_32_ISCSI, Crc};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

static CHECK: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);
const MAGIC: &[u8] = b"blastema-variables 1\n";
/// The most bytes of a file: all that a robot's settings take, many times over.
const FILE_MAX: usize = 16 * 1024 * 1024;
/// Writes that may wait for the disk; beyond, writers are told to slow down.
const WAITING_MAX: usize = 4096;

/// Why a file's values cannot be had.
#[derive(Debug, thiserror::Error)]
pub(super) enum LoadError {
    #[error("it cannot be read: {0}")]
    Unreadable(#[from] io::Error),
    #[error("it is no file of variables, or of another version")]
    Foreign,
    #[error("it is damaged: its checksum differs")]
    Damaged,
}

/// The values of the file; none where there is no file.
pub(super) fn load(path: &Path) -> Result<Vec<PersistedValue>, LoadError> {
    let bytes = match fs::read(path) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error.into()),
    };
    let Some((checked, sum)) = bytes.split_last_chunk::<4>() else {
        return Err(LoadError::Damaged);
    };
    if CHECK.checksum(checked) != u32::from_le_bytes(*sum) {
        return Err(LoadError::Damaged);
    }
    let values = checked.strip_prefix(MAGIC).ok_or(LoadError::Foreign)?;
    codec::decode_bounded::<_, FILE_MAX>(values).map_err(|_| LoadError::Foreign)
}

/// Renames a file that cannot be used, so that a user can inspect it.
pub(super) fn set_aside(path: &Path) -> io::Result<PathBuf> {
    let aside = beside(path, "damaged");
    fs::rename(path, &aside)?;
    Ok(aside)
}

fn save(path: &Path, values: &Vec<PersistedValue>) -> io::Result<()> {
    let mut encoded = Vec::new();
    codec::encode_bounded(values, FILE_MAX, &mut encoded).map_err(io::Error::other)?;
    let mut bytes = [MAGIC, &encoded].concat();
    bytes.extend(CHECK.checksum(&bytes).to_le_bytes());
    replace_file(path, &bytes)
}

/// Told whether the values are on the disk.
pub(super) type WriteDone = Box<dyn FnOnce(Result<(), String>) + Send>;

/// Writes the file on a thread of its own: of several changes that come while it writes, all are in
/// the next file. Closed or dropped, it writes what was given to it, gives the lock back, and ends.
pub(super) struct PersistenceFile(Arc<Shared>);

struct Shared {
    order: Mutex<Order>,
    changed: Condvar,
}

#[derive(Default)]
struct Order {
    values: Option<Vec<PersistedValue>>,
    /// Who waits for that.
    waiting: Vec<WriteDone>,
    ended: bool,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Order> {
        lock(&self.order)
    }
}

impl PersistenceFile {
    /// The lock is `None` where the file's folder cannot be written, which is told already, and lasts.
    /// `changed` is told when the file cannot be written, and when it can be again.
    pub(super) fn start(
        path: PathBuf,
        lock: Option<FileLock>,
        changed: impl Fn(Result<(), String>) + Send + 'static,
    ) -> io::Result<Self> {
        let shared =
            Arc::new(Shared { order: Mutex::new(Order::default()), changed: Condvar::new() });
        let kept = shared.clone();
        platform::start_thread("variables", move || {
            write_when_told(&path, &kept, lock.is_some(), changed);
            drop(lock);
        })?;
        Ok(PersistenceFile(shared))
    }

    /// Whether it takes one more change.
    pub(super) fn check(&self) -> Result<(), DeliveryError> {
        let order = self.0.lock();
        match order.ended {
            true => Err(DeliveryError::NotKept { reason: "the node has ended".to_owned() }),
            false if order.waiting.len() < WAITING_MAX => Ok(()),
            false => Err(DeliveryError::Full),
        }
    }

    /// Takes no change any more.
    pub(super) fn close(&self) {
        self.0.lock().ended = true;
        self.0.changed.notify_one();
    }

    pub(super) fn keep(&self, values: Vec<PersistedValue>, then: WriteDone) {
        let mut order = self.0.lock();
        order.values = Some(values);
        order.waiting.push(then);
        drop(order);
        self.0.changed.notify_one();
    }
}

impl Drop for PersistenceFile {
    fn drop(&mut self) {
        self.close();
    }
}

fn write_when_told(
    path: &Path,
    shared: &Shared,
    locked: bool,
    changed: impl Fn(Result<(), String>),
) {
    let mut failing = false;
    loop {
        let mut order = shared.lock();
        while order.values.is_none() && !order.ended {
            order = shared.changed.wait(order).unwrap_or_else(PoisonError::into_inner);
        }
        let Some(values) = order.values.take() else { return };
        let waiting = std::mem::take(&mut order.waiting);
        drop(order);
        let saved = save(path, &values).map_err(|error| error.to_string());
        if std::mem::replace(&mut failing, saved.is_err()) != failing && locked {
            let place = path.display();
            let told = saved.clone();
            changed(told.map_err(|why| format!("variables cannot be kept in {place}: {why}")));
        }
        waiting.into_iter().for_each(|then| then(saved.clone()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_core::ObjectName;

    fn values(count: u8) -> Vec<PersistedValue> {
        let object = ObjectName::new("arm").unwrap();
        let value = |n: u8| PersistedValue {
            variable: (object.clone(), format!("v{n}")),
            fingerprint: 7,
            value: vec![n; usize::from(n)],
        };
        (0..count).map(value).collect()
    }

    #[test]
    fn what_was_saved_is_loaded_and_no_file_is_no_value() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("variables");
        assert_eq!(load(&path).unwrap(), []);

        save(&path, &values(3)).unwrap();
        save(&path, &values(9)).unwrap();

        assert_eq!(load(&path).unwrap(), values(9));
        assert!(!beside(&path, "new").exists());
    }

    #[test]
    fn that_the_file_cannot_be_written_is_told_and_that_it_can_be_again() {
        let folder = tempfile::tempdir().unwrap();
        let (path, later) = (folder.path().join("later/variables"), folder.path().join("later"));
        let shared =
            Arc::new(Shared { order: Mutex::new(Order::default()), changed: Condvar::new() });
        let next = shared.clone();
        let refused: WriteDone = Box::new(move |written| {
            assert!(written.is_err());
            fs::create_dir(&later).unwrap();
            next.lock().values = Some(values(2));
        });
        let (values, waiting) = (Some(values(1)), vec![refused]);
        *shared.lock() = Order { values, waiting, ended: true };
        let told = Mutex::new(Vec::new());

        write_when_told(&path, &shared, true, |written| lock(&told).push(written.is_ok()));

        assert_eq!(*lock(&told), [false, true]);
        assert_eq!(load(&path).unwrap().len(), 2);
    }

    #[test]
    fn a_file_of_which_any_bit_is_wrong_or_missing_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("variables");
        save(&path, &values(3)).unwrap();
        let right = fs::read(&path).unwrap();

        for at in 0..right.len() {
            let mut wrong = right.clone();
            wrong[at] ^= 1 << (at % 8);
            fs::write(&path, wrong).unwrap();
            assert!(load(&path).is_err(), "byte {at}");
            fs::write(&path, &right[..at]).unwrap();
            assert!(load(&path).is_err(), "cut off at {at}");
        }
        let aside = set_aside(&path).unwrap();
        assert!(aside.exists() && load(&path).unwrap().is_empty());
    }
}
