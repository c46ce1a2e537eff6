//! What a double has seen, and the wait for more.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use tokio::sync::Notify;

/// A test that records more than this has lost control of what it tests.
const LIMIT: usize = 1 << 20;

/// Shared between a double's actor, which writes, and the test, which reads.
pub(crate) struct Record<T>(Arc<Shared<T>>);

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
    pub(crate) fn push(&self, item: T) {
        let mut seen = self.0.seen.lock().unwrap_or_else(PoisonError::into_inner);
        assert!(seen.len() < LIMIT, "a double has recorded {LIMIT} messages that nobody read");
        seen.push_back(item);
        drop(seen);
        self.0.news.notify_one();
    }

    pub(crate) fn pop(&self) -> Option<T> {
        self.0.seen.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }

    pub(crate) fn drain(&self) -> Vec<T> {
        self.0.seen.lock().unwrap_or_else(PoisonError::into_inner).drain(..).collect()
    }

    pub(crate) fn len(&self) -> usize {
        self.0.seen.lock().unwrap_or_else(PoisonError::into_inner).len()
    }

    /// The next item, however long it takes. For one waiting test, not for several.
    pub(crate) async fn next(&self) -> T {
        loop {
            if let Some(item) = self.pop() {
                return item;
            }
            self.0.news.notified().await;
        }
    }
}
