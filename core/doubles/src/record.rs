//! What a double has seen, and the wait for more.

use std::any::type_name;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::Notify;
use tokio::time::timeout;

/// How long a double waits for a message before the test has failed. Under a paused clock this is
/// no time at all; with sockets it is long enough for a machine that is busy with other tests.
pub const PATIENCE: Duration = Duration::from_secs(30);

/// A test that records more than this has lost control of what it tests.
const LIMIT: usize = 1 << 20;

/// Shared between a double, which writes, and the test, which reads.
///
/// # Examples
/// ```
/// use blastema_doubles::{Record, paused};
///
/// paused(async {
///     let record = Record::default();
///     record.push(1);
///     record.push(2);
///     assert_eq!(record.wait(|n| *n == 2).await, 2);
/// });
/// ```
pub struct Record<T>(Arc<Shared<T>>);

struct Shared<T> {
    seen: Mutex<VecDeque<T>>,
    news: Notify,
}

impl<T> Clone for Record<T> {
    fn clone(&self) -> Self {
        Record(self.0.clone())
    }
}

impl<T> Default for Record<T> {
    fn default() -> Self {
        Record(Arc::new(Shared { seen: Mutex::new(VecDeque::new()), news: Notify::new() }))
    }
}

impl<T> Record<T> {
    /// Takes note of one more.
    ///
    /// # Panics
    /// When a million were recorded that the test has not read.
    pub fn push(&self, item: T) {
        let mut seen = self.0.seen.lock().unwrap_or_else(PoisonError::into_inner);
        assert!(seen.len() < LIMIT, "a double has recorded {LIMIT} messages without a reader");
        seen.push_back(item);
        drop(seen);
        self.0.news.notify_one();
    }

    fn pop(&self) -> Option<T> {
        self.0.seen.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }

    /// Everything that was noted and not yet taken.
    pub fn drain(&self) -> Vec<T> {
        self.0.seen.lock().unwrap_or_else(PoisonError::into_inner).drain(..).collect()
    }

    /// Whether everything that was noted has been taken.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// How many were noted and not yet taken.
    pub fn len(&self) -> usize {
        self.0.seen.lock().unwrap_or_else(PoisonError::into_inner).len()
    }

    /// The next item, however long it takes. For one waiting test, not for several.
    pub async fn next(&self) -> T {
        loop {
            if let Some(item) = self.pop() {
                return item;
            }
            self.0.news.notified().await;
        }
    }

    /// The next item.
    ///
    /// # Panics
    /// When none comes within [`PATIENCE`].
    pub async fn expect(&self) -> T {
        patient(self.next(), type_name::<T>()).await
    }

    /// The next item for which `wanted` holds; those before it are thrown away.
    ///
    /// # Panics
    /// When none comes within [`PATIENCE`].
    pub async fn wait(&self, mut wanted: impl FnMut(&T) -> bool) -> T {
        let found = async {
            loop {
                let item = self.next().await;
                if wanted(&item) {
                    return item;
                }
            }
        };
        patient(found, type_name::<T>()).await
    }

    /// Makes sure that none comes during this time, nor was there one before.
    ///
    /// # Panics
    /// When there is one.
    pub async fn expect_none_for(&self, span: Duration) {
        let come = timeout(span, self.next()).await;
        assert!(come.is_err(), "a {} came where none should", type_name::<T>());
    }
}

/// Waits as long as a test should.
async fn patient<T>(wait: impl Future<Output = T>, what: &str) -> T {
    match timeout(PATIENCE, wait).await {
        Ok(found) => found,
        Err(_) => panic!("no {what} came within {PATIENCE:?}"),
    }
}
