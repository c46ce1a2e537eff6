//! What is told of all events of a topic: read at each event, and changed seldom.

use super::lock;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex};

/// A list that is copied when it changes.
pub(super) struct SharedList<T> {
    /// There are some; to be looked at without the lock.
    any: AtomicBool,
    all: Mutex<Arc<[T]>>,
}

impl<T> Default for SharedList<T> {
    fn default() -> Self {
        SharedList { any: AtomicBool::new(false), all: Mutex::new(Arc::new([])) }
    }
}

impl<T> SharedList<T> {
    #[inline]
    pub(super) fn any(&self) -> bool {
        self.any.load(Relaxed)
    }

    pub(super) fn all(&self) -> Arc<[T]> {
        lock(&self.all).clone()
    }

    /// Sets it to what this makes of it.
    pub(super) fn change(&self, changed: impl FnOnce(&[T]) -> Arc<[T]>) {
        let mut all = lock(&self.all);
        *all = changed(&all);
        self.any.store(!all.is_empty(), Relaxed);
    }
}
