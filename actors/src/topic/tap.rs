//! Observers of all events of a topic, which are called where the event arrives.

use super::lock;
use crate::component::envelope::Times;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex};

/// Is told of an event and its times. It must not wait.
pub(crate) type TopicTap<E> = Arc<dyn Fn(&E, Times) + Send + Sync>;

/// The taps of one topic: as many as conditions over it.
pub(super) struct TopicTaps<E> {
    /// There are some; to be looked at without the lock.
    any: AtomicBool,
    all: Mutex<Arc<[TopicTap<E>]>>,
}

impl<E> Default for TopicTaps<E> {
    fn default() -> Self {
        TopicTaps { any: AtomicBool::new(false), all: Mutex::new(Arc::new([])) }
    }
}

impl<E> TopicTaps<E> {
    pub(super) fn add(&self, tap: TopicTap<E>) {
        let mut all = lock(&self.all);
        *all = all.iter().cloned().chain([tap]).collect();
        self.any.store(true, Relaxed);
    }

    pub(super) fn remove(&self, tap: &TopicTap<E>) {
        let mut all = lock(&self.all);
        *all = all.iter().filter(|known| !Arc::ptr_eq(known, tap)).cloned().collect();
        self.any.store(!all.is_empty(), Relaxed);
    }

    /// Tells all of them of an event.
    #[inline]
    pub(super) fn tell(&self, event: &E, times: Times) {
        if self.any.load(Relaxed) {
            let all = lock(&self.all).clone();
            all.iter().for_each(|tap| tap(event, times));
        }
    }
}
