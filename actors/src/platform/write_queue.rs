//! Work for a thread that writes to a disk: what comes while it writes, it takes together.

use super::lock;
use std::sync::{Arc, Condvar, Mutex, PoisonError};

/// A bounded queue into a thread that writes. Clones share it.
pub(crate) struct WriteQueue<T>(Arc<Shared<T>>);

struct Shared<T> {
    state: Mutex<State<T>>,
    changed: Condvar,
    limit: usize,
}

struct State<T> {
    waiting: Vec<T>,
    is_closed: bool,
}

/// Why a queue takes nothing now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum QueueRefusal {
    /// The thread is behind by as much as may wait.
    Full,
    /// It ends.
    Closed,
}

impl<T> Clone for WriteQueue<T> {
    fn clone(&self) -> Self {
        WriteQueue(self.0.clone())
    }
}

impl<T> WriteQueue<T> {
    /// A queue that takes more while fewer than `limit` pieces of work wait.
    pub(crate) fn new(limit: usize) -> Self {
        let state = Mutex::new(State { waiting: Vec::new(), is_closed: false });
        WriteQueue(Arc::new(Shared { state, changed: Condvar::new(), limit }))
    }

    /// Whether it takes more.
    pub(crate) fn check(&self) -> Result<(), QueueRefusal> {
        let state = lock(&self.0.state);
        match state.is_closed {
            true => Err(QueueRefusal::Closed),
            false if state.waiting.len() < self.0.limit => Ok(()),
            false => Err(QueueRefusal::Full),
        }
    }

    /// Hands work over, where it [takes](Self::check) more.
    pub(crate) fn push(&self, work: impl IntoIterator<Item = T>) -> Result<(), QueueRefusal> {
        self.check()?;
        lock(&self.0.state).waiting.extend(work);
        self.0.changed.notify_one();
        Ok(())
    }

    /// Takes no more work.
    pub(crate) fn close(&self) {
        lock(&self.0.state).is_closed = true;
        self.0.changed.notify_one();
    }

    /// Waits for work, and takes all of it; `None` once it is closed and all is taken.
    pub(crate) fn take(&self) -> Option<Vec<T>> {
        let mut state = lock(&self.0.state);
        while state.waiting.is_empty() && !state.is_closed {
            state = self.0.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        Some(std::mem::take(&mut state.waiting)).filter(|work| !work.is_empty())
    }
}
