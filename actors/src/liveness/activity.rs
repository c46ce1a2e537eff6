//! The activity record of a component: its turns, its signs of life, and its current handler.
//!
//! Every store is plain and every activity record has one writer, the thread that runs its
//! component. Who wants to know since when looks twice.

use crate::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use crate::sync::atomic::{AtomicBool, AtomicU32, AtomicU64};
use blastema_core::Incarnation;
use blastema_core::detection::hang::{ActivityMark, ComponentSample};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// What a component's executor says. A cache line each, so that two arbiters do not share one, and
/// no more: there are as many as components. Counts of 32 bits begin again at zero.
#[derive(Debug, Default)]
#[repr(align(64))]
pub(crate) struct ActivityRecord {
    /// Odd while something is in service; two per message or hook.
    turn: AtomicU64,
    /// Signs of life that the component gave.
    alive: AtomicU32,
    /// Which incarnation it is, 0 between two.
    incarnation: AtomicU64,
    /// The label of what is in service.
    during: AtomicU32,
    /// Signs of life are to be expected.
    speaks: AtomicBool,
    /// A condition of the component runs, beside what is in service.
    condition: AtomicBool,
    /// Its tasks are polled, perhaps beside what is in service.
    tasks: AtomicBool,
    /// What the component announced to take longer than usual, in milliseconds.
    allowance: AtomicU32,
    /// How often a round is due, in nanoseconds; 0 for never.
    interval: AtomicU64,
    /// Rounds, and ticks of its timers, that were begun, and those that this incarnation has missed.
    ticks: AtomicU32,
    missed_ticks: AtomicU64,
    /// Requests whose callers had stopped waiting when their turn came.
    expired: AtomicU64,
}

/// What a look at an activity record finds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct ActivitySample {
    /// What it is judged by.
    pub(crate) component: ComponentSample,
    /// The number of the label of what is in service.
    pub(crate) during: u32,
    /// A condition of a subscription is evaluated.
    pub(crate) condition: bool,
    /// Its own tasks are polled.
    pub(crate) tasks: bool,
}

impl ActivityRecord {
    /// One writer only, so a plain store does. It comes after the label's, also for those who read.
    #[inline]
    pub(crate) fn step(&self) {
        self.turn.store(self.turn.load(Relaxed) + 1, Release);
    }

    /// Something is in service.
    #[inline]
    pub(crate) fn is_busy(&self) -> bool {
        self.turn.load(Relaxed) % 2 == 1
    }

    /// Names what is taken into service.
    #[inline]
    pub(crate) fn begin(&self, label: u32) {
        self.during.store(label, Relaxed);
        self.step();
    }

    /// A condition begins or ends, while something is in service.
    #[inline]
    pub(crate) fn run_condition(&self, runs: bool) {
        self.condition.store(runs, Relaxed);
    }

    /// The poll of its tasks begins or ends.
    #[inline]
    pub(crate) fn poll_tasks(&self, runs: bool) {
        self.tasks.store(runs, Relaxed);
    }

    #[inline]
    pub(crate) fn give_sign(&self) {
        self.alive.store(self.alive.load(Relaxed).wrapping_add(1), Relaxed);
    }

    /// A round begins, or a repeated timer is run.
    pub(crate) fn tick(&self) {
        self.ticks.store(self.ticks.load(Relaxed).wrapping_add(1), Relaxed);
    }

    /// So many rounds, or ticks of a timer, were missed.
    pub(crate) fn miss(&self, missed: u64) {
        if missed > 0 {
            self.missed_ticks.store(self.missed_ticks.load(Relaxed) + missed, Relaxed);
        }
    }

    /// Counts a request whose caller had stopped waiting.
    pub(crate) fn expire(&self) {
        self.expired.store(self.expired.load(Relaxed) + 1, Relaxed);
    }

    pub(crate) fn run_every(&self, interval: Option<Duration>) {
        let nanos = interval.map_or(0, |interval| interval.as_nanos().max(1));
        self.interval.store(u64::try_from(nanos).unwrap_or(u64::MAX), Relaxed);
    }

    pub(crate) fn begin_incarnation(&self, incarnation: u64) {
        self.incarnation.store(incarnation, Relaxed);
        self.allowance.store(0, Relaxed);
        self.missed_ticks.store(0, Relaxed);
    }

    pub(crate) fn expect_signs(&self, expected: bool) {
        self.speaks.store(expected, Relaxed);
    }

    pub(crate) fn allow(&self, span: Duration) {
        self.allowance.store(u32::try_from(span.as_millis()).unwrap_or(u32::MAX), Relaxed);
    }

    /// What changes whenever a component that rests takes something up.
    #[inline]
    pub(crate) fn mark(&self) -> ActivityMark {
        ActivityMark {
            turn: self.turn.load(Acquire),
            incarnation: Incarnation(self.incarnation.load(Relaxed)),
            expired: self.expired.load(Relaxed),
        }
    }

    pub(crate) fn read(&self) -> ActivitySample {
        ActivitySample {
            component: ComponentSample {
                // First, so that the label is of this turn or of a later one: see `step`.
                turn: self.turn.load(Acquire),
                alive: self.alive.load(Relaxed).into(),
                incarnation: Incarnation(self.incarnation.load(Relaxed)),
                speaks: self.speaks.load(Relaxed),
                allowance: Duration::from_millis(self.allowance.load(Relaxed).into()),
                interval: Duration::from_nanos(self.interval.load(Relaxed)),
                ticks: self.ticks.load(Relaxed),
                missed_ticks: self.missed_ticks.load(Relaxed),
                expired: self.expired.load(Relaxed),
            },
            during: self.during.load(Relaxed),
            condition: self.condition.load(Relaxed),
            tasks: self.tasks.load(Relaxed),
        }
    }
}

/// Activity records are made in chunks that stay where they are, so that reading one takes no lock.
const CHUNK: usize = 1024;

/// All activity records of the process. It grows to the largest number of components that lived at
/// one time.
struct ActivityTable {
    chunks: Vec<&'static [ActivityRecord]>,
    free: Vec<u32>,
    next: u32,
}

static TABLE: Mutex<ActivityTable> =
    Mutex::new(ActivityTable { chunks: Vec::new(), free: Vec::new(), next: 0 });

fn table() -> MutexGuard<'static, ActivityTable> {
    TABLE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Where a component's activity record stands, for those who only read it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ActivitySlotRef {
    pub(crate) index: u32,
    pub(crate) activity: &'static ActivityRecord,
}

/// A place in the table; given back when dropped, which an executor that hangs does not do.
pub(crate) struct ActivitySlot {
    pub(crate) index: u32,
    pub(crate) activity: &'static ActivityRecord,
}

impl ActivitySlot {
    pub(crate) fn claim() -> Self {
        let mut table = table();
        let index = table.free.pop().unwrap_or_else(|| {
            table.next += 1;
            table.next - 1
        });
        let (chunk, place) = (index as usize / CHUNK, index as usize % CHUNK);
        if chunk == table.chunks.len() {
            let fresh = (0..CHUNK).map(|_| ActivityRecord::default()).collect::<Vec<_>>();
            table.chunks.push(Vec::leak(fresh));
        }
        ActivitySlot { index, activity: &table.chunks[chunk][place] }
    }
}

impl Drop for ActivitySlot {
    fn drop(&mut self) {
        let activity = self.activity;
        activity.incarnation.store(0, Relaxed);
        activity.speaks.store(false, Relaxed);
        activity.condition.store(false, Relaxed);
        activity.tasks.store(false, Relaxed);
        activity.allowance.store(0, Relaxed);
        activity.interval.store(0, Relaxed);
        if activity.is_busy() {
            activity.step();
        }
        table().free.push(self.index);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stamp_is_odd_while_something_is_in_service() {
        let slot = ActivitySlot::claim();
        assert!(!slot.activity.is_busy());

        slot.activity.begin(7);
        assert!(slot.activity.is_busy());
        assert_eq!(slot.activity.read().during, 7);

        slot.activity.step();
        assert!(!slot.activity.is_busy());
    }

    #[test]
    fn a_slot_that_is_given_back_is_at_rest() {
        let slot = ActivitySlot::claim();
        slot.activity.begin_incarnation(3);
        slot.activity.begin(1);
        slot.activity.expect_signs(true);
        let activity = slot.activity;

        drop(slot);

        let reading = activity.read().component;
        assert!(
            reading.turn.is_multiple_of(2) || reading.incarnation != Incarnation(3),
            "or it was claimed meanwhile"
        );
    }

    #[test]
    fn slots_beyond_one_chunk_are_places_of_their_own() {
        let slots: Vec<ActivitySlot> = (0..=CHUNK).map(|_| ActivitySlot::claim()).collect();
        for (at, slot) in slots.iter().enumerate() {
            slot.activity.begin_incarnation(at as u64 + 1);
        }
        for (at, slot) in slots.iter().enumerate() {
            assert_eq!(slot.activity.mark().incarnation, Incarnation(at as u64 + 1));
        }
    }
}
