//! The state that an arbiter publishes: its heartbeat, the running component, and whether it is
//! lost.
//!
//! A worker reads no clock. Its beat, a task that wakes every 10 ms, counts up, notes the time for
//! those who need it only roughly, and sweeps the deadlines of requests that were made here.

use super::deadline;
use crate::platform;
use crate::platform::processor_time::ThreadNumber;
use blastema_core::{DeliveryError, Instant};
use std::cell::{Cell, OnceCell};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicU8, AtomicU32, AtomicU64};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::time::MissedTickBehavior;

/// How often an arbiter beats: a fiftieth of the default limit for a blocking handler.
pub(crate) const HEARTBEAT_INTERVAL: Duration = Duration::from_millis(10);

/// A handler keeps the arbiter: what it sends is refused.
const FENCED: u8 = 1;
/// It did not come back in time; its components live elsewhere.
const LOST: u8 = 2;
/// The component that is running now is isolated.
const MUTED: u8 = 4;

/// One arbiter's signs of life. Its thread writes the beat, and the sampler the fence.
pub(crate) struct ArbiterHeartbeat {
    id: u64,
    beat: AtomicU64,
    /// 1 + the slot of the component on the thread right now; 0 between polls.
    running: AtomicU32,
    flags: AtomicU8,
    /// The time of the last beat, in nanoseconds; 0 where none beats.
    time: AtomicU64,
    /// Its thread, once it beats.
    thread: OnceLock<ThreadNumber>,
}

thread_local! {
    static HERE: OnceCell<Arc<ArbiterHeartbeat>> = const { OnceCell::new() };
    static BEATS: Cell<bool> = const { Cell::new(false) };
}

/// Why nothing may be sent from here now, if that is so. A send that is past this check when the
/// fence goes up may still land: to be strict would cost every message a lock.
#[inline]
pub(crate) fn send_refusal() -> Option<DeliveryError> {
    let flags =
        HERE.try_with(|here| here.get().map_or(0, |heartbeat| heartbeat.flags.load(Relaxed)));
    match flags.unwrap_or(0) {
        0 => None,
        MUTED => Some(DeliveryError::SenderIsolated),
        _ => Some(DeliveryError::Fenced),
    }
}

/// The slot of the component that runs on this thread.
pub(crate) fn running_here() -> Option<u32> {
    HERE.try_with(|here| here.get().and_then(|heartbeat| heartbeat.running())).ok().flatten()
}

/// The time to the precision of the beat.
#[inline]
pub(crate) fn coarse_now() -> Instant {
    let beaten =
        HERE.try_with(|here| here.get().map_or(0, |heartbeat| heartbeat.time.load(Relaxed)));
    match beaten.unwrap_or(0) {
        0 => platform::now(),
        nanos => Instant::from_nanos(nanos),
    }
}

impl Default for ArbiterHeartbeat {
    fn default() -> Self {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        ArbiterHeartbeat {
            id: NEXT.fetch_add(1, Relaxed),
            beat: AtomicU64::new(0),
            running: AtomicU32::new(0),
            flags: AtomicU8::new(0),
            time: AtomicU64::new(0),
            thread: OnceLock::new(),
        }
    }
}

impl ArbiterHeartbeat {
    /// Tells it from every other heartbeat of the process.
    pub(crate) fn id(&self) -> u64 {
        self.id
    }

    /// Whether this thread is an arbiter that was registered and whose loop turns.
    #[inline]
    pub(crate) fn beats_here() -> bool {
        BEATS.try_with(Cell::get).unwrap_or(false)
    }

    /// Gives this thread its heartbeat, and lets it beat while its event loop turns.
    ///
    /// # Panics
    /// Outside of an actix arbiter.
    pub(crate) fn register_here() -> Arc<ArbiterHeartbeat> {
        let heartbeat = HERE.with(|here| here.get_or_init(Arc::default).clone());
        if let Some(beat) = heartbeat.clone().start_beating() {
            actix_rt::spawn(beat);
        }
        heartbeat
    }

    /// Gives this fresh thread, whose runtime is its own, a heartbeat that another one reads
    /// already.
    pub(crate) fn adopt(self: &Arc<Self>) {
        HERE.with(|here| {
            let _ = here.set(self.clone());
        });
        if let Some(beat) = self.clone().start_beating() {
            // A task of the runtime: one of the arbiter's `LocalSet` costs each beat two more
            // system calls, since its timer wakes the set through the driver.
            tokio::spawn(beat);
        }
    }

    /// What beats from now on, unless something beats here already.
    fn start_beating(self: Arc<Self>) -> Option<impl Future<Output = ()> + Send> {
        /// A thread may hold one event loop after another, as tests do.
        struct Beating(Arc<ArbiterHeartbeat>);
        impl Drop for Beating {
            fn drop(&mut self) {
                self.0.time.store(0, Relaxed);
                let _ = BEATS.try_with(|beats| beats.set(false));
            }
        }
        if BEATS.replace(true) {
            return None;
        }
        let beating = Beating(self.clone());
        let _ = self.thread.set(ThreadNumber::here());
        self.time.store(platform::now().as_nanos(), Relaxed);
        Some(async move {
            let _beating = beating;
            let mut ticks = tokio::time::interval(HEARTBEAT_INTERVAL);
            ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
            loop {
                ticks.tick().await;
                self.beat(platform::now());
            }
        })
    }

    fn beat(&self, now: Instant) {
        self.beat.store(self.beat.load(Relaxed) + 1, Relaxed);
        self.time.store(now.as_nanos(), Relaxed);
        // The event loop turns, so the handler that kept it has returned.
        self.lift();
        // This is the arbiter's own thread, where its deadlines are.
        deadline::sweep(now);
    }

    /// How often it has beaten.
    pub(crate) fn beats(&self) -> u64 {
        self.beat.load(Relaxed)
    }

    /// Its thread; `None` before its first beat, and where threads have no numbers.
    pub(crate) fn thread(&self) -> Option<ThreadNumber> {
        self.thread.get().copied()
    }

    /// When it last beat; `None` where none beats.
    pub(crate) fn last_beat(&self) -> Option<Instant> {
        match self.time.load(Relaxed) {
            0 => None,
            nanos => Some(Instant::from_nanos(nanos)),
        }
    }

    /// The slot of the component that its thread is running.
    pub(crate) fn running(&self) -> Option<u32> {
        self.running.load(Relaxed).checked_sub(1)
    }

    /// From now on the thread runs the component of this slot, or none.
    #[inline]
    pub(crate) fn run(&self, slot: Option<u32>) {
        self.running.store(slot.map_or(0, |slot| slot + 1), Relaxed);
    }

    /// Whether the arbiter has been given up, or is about to be.
    #[inline]
    pub(crate) fn is_fenced(&self) -> bool {
        self.flags.load(Relaxed) & (FENCED | LOST) != 0
    }

    /// Whether its components live elsewhere now.
    #[inline]
    pub(crate) fn is_lost(&self) -> bool {
        self.flags.load(Relaxed) & LOST != 0
    }

    /// Lets nothing out until the handler that keeps the thread has returned.
    pub(crate) fn fence(&self) {
        self.flags.fetch_or(FENCED, Relaxed);
    }

    /// The handler has returned. Too late once the arbiter is lost.
    pub(crate) fn lift(&self) {
        if self.flags.load(Relaxed) & FENCED != 0 {
            let _ = self.flags.fetch_update(Relaxed, Relaxed, |flags| {
                (flags & LOST == 0).then_some(flags & !FENCED)
            });
        }
    }

    /// The grace time is over. Says whether the arbiter was still fenced.
    pub(crate) fn lose(&self) -> bool {
        let lost = self.flags.fetch_update(Relaxed, Relaxed, |flags| {
            (flags & (FENCED | LOST) == FENCED).then_some(flags | LOST)
        });
        lost.is_ok()
    }

    /// Forbids the component that runs now to send, or ends that.
    pub(crate) fn mute(&self, muted: bool) {
        if muted {
            self.flags.fetch_or(MUTED, Relaxed);
        } else {
            self.flags.fetch_and(!MUTED, Relaxed);
        }
    }

    /// Its thread is this one.
    pub(crate) fn is_here(&self) -> bool {
        HERE.try_with(|here| here.get().is_some_and(|here| std::ptr::eq(&**here, self)))
            .unwrap_or(false)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_doubles::{advance, now, paused};

    #[test]
    fn a_fence_is_lifted_by_the_beat_unless_the_arbiter_is_lost() {
        let heartbeat = ArbiterHeartbeat::default();
        assert!(!heartbeat.lose(), "only a fenced arbiter can be lost");
        heartbeat.fence();
        assert!(heartbeat.is_fenced() && !heartbeat.is_lost());

        heartbeat.beat(Instant::from_millis(1));
        assert!(!heartbeat.is_fenced());

        heartbeat.fence();
        assert!(heartbeat.lose());
        assert!(!heartbeat.lose(), "once");
        heartbeat.beat(Instant::from_millis(2));
        assert!(heartbeat.is_fenced() && heartbeat.is_lost());
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn who_is_isolated_is_told_so_and_who_is_fenced_is_told_that() {
        assert_eq!(send_refusal(), None);
        let heartbeat = ArbiterHeartbeat::register_here();
        heartbeat.mute(true);
        assert_eq!(send_refusal(), Some(DeliveryError::SenderIsolated));
        heartbeat.fence();
        assert_eq!(send_refusal(), Some(DeliveryError::Fenced));
        heartbeat.mute(false);
        assert_eq!(send_refusal(), Some(DeliveryError::Fenced));
        heartbeat.lift();
        assert_eq!(send_refusal(), None);
    }

    #[test]
    fn a_thread_beats_in_each_of_its_event_loops_and_not_between_them() {
        for _ in 0..2 {
            assert!(!ArbiterHeartbeat::beats_here());
            paused(async {
                let heartbeat = ArbiterHeartbeat::register_here();
                let before = heartbeat.beats();
                advance(Duration::from_millis(100)).await;
                assert!((9..=11).contains(&(heartbeat.beats() - before)));
                assert!(platform::now() - coarse_now() <= HEARTBEAT_INTERVAL);
                assert!(now() > Instant::ORIGIN && ArbiterHeartbeat::beats_here());
            });
        }
    }
}
