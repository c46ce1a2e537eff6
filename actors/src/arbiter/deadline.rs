//! The deadlines of the requests that were made on an arbiter. Its heartbeat sweeps them.

use blastema_core::{DeliveryError, Instant};
use std::cell::RefCell;
use std::sync::Arc;
use std::thread::ThreadId;
use std::time::Duration;

/// A request that waits for a reply, as seen by what resolves it without one: its deadline, or the
/// death of its receiver.
pub(crate) trait Cancel: Send + Sync {
    /// Resolves the request with this reason, unless it is resolved already.
    fn cancel(&self, why: DeliveryError);

    /// The slot of the component that asks.
    fn asker(&self) -> Option<u32> {
        None
    }
}

thread_local! {
    /// Requests that were made here and wait for a reply.
    static DEADLINES: RefCell<Deadlines> = const { RefCell::new(Deadlines::new()) };
}

/// Resolves the requests of this thread whose deadline has passed.
pub(super) fn sweep(now: Instant) {
    let due = DEADLINES.with_borrow_mut(|deadlines| deadlines.sweep(now));
    due.into_iter().for_each(|slot| slot.cancel(DeliveryError::DeadlinePassed));
}

/// Requests of one arbiter that wait for a reply: as many as there are futures that wait, and those
/// whose future was dropped on another thread, until the next sweep.
struct Deadlines {
    waiting: Vec<Option<Waiting>>,
    free: Vec<usize>,
    /// Numbers the entries, so that an entry is not taken for an earlier one of the same slot.
    next: u64,
}

struct Waiting {
    number: u64,
    due: Due,
    slot: Arc<dyn Cancel>,
}

/// The first sweep after a request was made turns its span into a point in time, so that the
/// request itself reads no clock. The deadline is late by a beat at most, and never early.
enum Due {
    After(Duration),
    At(Instant),
}

impl Deadlines {
    const fn new() -> Self {
        Deadlines { waiting: Vec::new(), free: Vec::new(), next: 0 }
    }

    /// Removes the requests that are due, and those that only this table still holds.
    fn sweep(&mut self, now: Instant) -> Vec<Arc<dyn Cancel>> {
        let mut due = Vec::new();
        for (at, entry) in self.waiting.iter_mut().enumerate() {
            let Some(waiting) = entry else { continue };
            if let Due::After(span) = waiting.due {
                waiting.due = Due::At(now + span);
            }
            let over = matches!(waiting.due, Due::At(at) if at <= now);
            if over || Arc::strong_count(&waiting.slot) == 1 {
                due.extend(entry.take().map(|waiting| waiting.slot));
                self.free.push(at);
            }
        }
        due
    }
}

/// One request's place among the deadlines of the arbiter on which it was made.
pub(crate) struct Deadline {
    slot_index: usize,
    number: u64,
    thread: ThreadId,
}

impl Deadline {
    /// To be set on an arbiter that [beats](super::heartbeat::ArbiterHeartbeat::beats_here).
    #[inline]
    pub(crate) fn set(span: Duration, slot: Arc<dyn Cancel>) -> Self {
        DEADLINES.with_borrow_mut(|deadlines| {
            let number = deadlines.next;
            deadlines.next += 1;
            let entry = Some(Waiting { number, due: Due::After(span), slot });
            let slot_index = match deadlines.free.pop() {
                Some(slot_index) => {
                    deadlines.waiting[slot_index] = entry;
                    slot_index
                }
                None => {
                    deadlines.waiting.push(entry);
                    deadlines.waiting.len() - 1
                }
            };
            Deadline { slot_index, number, thread: thread_id() }
        })
    }
}

impl Drop for Deadline {
    #[inline]
    fn drop(&mut self) {
        if self.thread != thread_id() {
            return; // The sweep finds it.
        }
        let entry = DEADLINES.try_with(|deadlines| {
            let mut deadlines = deadlines.borrow_mut();
            let waiting = deadlines.waiting.get_mut(self.slot_index)?;
            let entry = waiting.take_if(|waiting| waiting.number == self.number)?;
            deadlines.free.push(self.slot_index);
            Some(entry)
        });
        drop(entry); // Its slot may hold what is the user's.
    }
}

#[inline]
fn thread_id() -> ThreadId {
    thread_local! {
        static ID: ThreadId = std::thread::current().id();
    }
    ID.try_with(|id| *id).unwrap_or_else(|_| std::thread::current().id())
}
