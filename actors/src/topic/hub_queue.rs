//! What publishers know of a hub, and listeners that leave it.

use super::batch_position::{BatchPosition, BatchProgress};
use super::lock;
use crate::component::envelope::Times;
use crate::messaging::queue::{BoundedQueue, Pushed};
use crate::sync::Mutex;
use crate::sync::atomic::Ordering::SeqCst;
use crate::sync::atomic::{AtomicBool, AtomicU64, fence};
use blastema_core::Event;
use std::cell::Cell;
use std::cmp::Ordering;
use std::collections::VecDeque;
use std::sync::Arc;

/// What publishers know of a hub, and listeners that leave it.
pub(crate) struct HubQueue<E> {
    pub(super) queue: BoundedQueue<Posted<E>>,
    pub(super) id: u64,
    /// Changed under the topic's lock.
    pub(super) listeners: AtomicU64,
    /// Its last listener has left. Changed under the topic's lock.
    pub(super) retired: AtomicBool,
    pub(super) serving: Mutex<HubBatch<E>>,
    pub(super) position: BatchPosition,
    /// How often an entry has gone from here, so that the hub need not ask each whether it is still
    /// here.
    pub(super) gone: AtomicU64,
}

/// What a hub has taken from its queue, or is to give to one entry before that: for listeners that
/// leave a hub that is stuck.
pub(super) struct HubBatch<E> {
    pub(super) events: Arc<Vec<Posted<E>>>,
    /// They are for this entry only.
    pub(super) only: Option<u64>,
    /// The entries that have left during this batch, and how many of its events they left to the
    /// hub.
    pub(super) left: Vec<(u64, usize)>,
    /// What entries brought along from the hubs that they left.
    pub(super) brought: VecDeque<(u64, Vec<Posted<E>>)>,
}

impl<E> HubBatch<E> {
    /// How many of the events are behind this entry, or not for it.
    fn past(&self, entry: u64, progress: &BatchProgress) -> usize {
        match entry.cmp(&progress.entry) {
            _ if self.only.is_some_and(|only| only != entry) => self.events.len(),
            Ordering::Less => self.events.len(),
            // The event that it served when it was abandoned is not served again.
            Ordering::Equal => progress.begun,
            Ordering::Greater => 0,
        }
    }
}

#[derive(Clone)]
pub(super) struct Posted<E> {
    pub(super) event: E,
    pub(super) at: Times,
    /// Counts the topic's events.
    pub(super) number: u64,
}

impl<E> HubQueue<E> {
    /// Hands an event over; a hub drops its oldest one where it has no room.
    #[inline]
    pub(super) fn push(&self, event: E, at: Times, number: u64) -> Pushed<Posted<E>> {
        let pushed = self.queue.push_quietly(0, event, |event| Posted { event, at, number });
        // Refused only where the hub has retired, which publishers no longer know.
        pushed.unwrap_or(Pushed { displaced: None, parked: None })
    }

    /// Gives these events to this entry before all others.
    pub(super) fn bring(&self, entry: u64, events: Vec<Posted<E>>) {
        if !events.is_empty() {
            lock(&self.serving).brought.push_back((entry, events));
            self.queue.wake();
        }
    }

    /// Whether this entry is yet to be given events from here, of those since `since`.
    pub(super) fn awaits(&self, entry: u64, since: u64) -> bool {
        let serving = lock(&self.serving);
        let mut served = serving.events.iter().skip(serving.past(entry, &self.position.read()));
        serving.brought.iter().any(|(of, _)| *of == entry)
            || served.any(|posted| serving.only.is_some() || posted.number >= since)
            || self.queue.newest_is(|posted| posted.number >= since)
    }
}

impl<E: Event> HubQueue<E> {
    /// Whether this entry's condition has an event that it has not decided on: lost where it
    /// leaves.
    pub(super) fn is_undecided(&self, entry: u64) -> bool {
        let progress = self.position.read();
        progress.entry == entry && progress.is_undecided
    }

    /// Whether the event that was begun last is for this entry still: the entry is present, or has
    /// left without taking this event along.
    pub(super) fn still_gets(&self, entry: u64, is_present: impl FnOnce() -> bool) -> bool {
        // With the fence in `leftover`: either this thread finds that the entry has left, or the
        // other one finds that the event was begun.
        fence(SeqCst);
        let begun = self.position.read().begun;
        let leaves_it = |&(number, past): &(u64, usize)| number == entry && begun <= past;
        is_present() || lock(&self.serving).left.iter().any(leaves_it)
    }

    /// The events since `since` that an entry leaves undelivered here. `leave` ends the entry, and
    /// `is_undecided` is set where its condition has not decided on one event more.
    pub(super) fn leftover(
        &self,
        since: u64,
        leave: impl FnOnce() -> u64,
        is_undecided: &Cell<bool>,
    ) -> Vec<Posted<E>> {
        let mut serving = lock(&self.serving);
        let entry = leave();
        fence(SeqCst); // See `still_gets`.
        let progress = self.position.read();
        let past = serving.past(entry, &progress);
        is_undecided.set(entry == progress.entry && progress.is_undecided);
        serving.left.push((entry, past - usize::from(is_undecided.get())));
        let mut left = Vec::new();
        if let Some(at) = serving.brought.iter().position(|(of, _)| *of == entry) {
            left.extend(serving.brought.remove(at).into_iter().flat_map(|(_, events)| events));
        }
        let served = serving.events.iter().skip(past);
        left.extend(served.filter(|p| serving.only.is_some() || p.number >= since).cloned());
        left.extend(self.queue.snapshot().into_iter().filter(|posted| posted.number >= since));
        left
    }
}
