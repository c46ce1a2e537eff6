//! Where components live: arbiters that they share, one per core, or one of their own.
//!
//! A thread that hangs cannot be killed. It is given up, another takes its place, and the given-up
//! ones are counted: too many, and the process itself has to be begun anew.

use super::heartbeat::ArbiterHeartbeat;
use actix_rt::{Arbiter, ArbiterHandle, System};
use blastema_core::ObjectName;
use std::fmt;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Who may live on a thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ThreadKind {
    /// Any component.
    Shared,
    /// One component, which asked for it.
    Own,
    /// Components and the rest of the application: it is the one that started the node.
    Starter,
}

impl fmt::Display for ThreadKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            ThreadKind::Shared => "shared",
            ThreadKind::Own => "own",
            ThreadKind::Starter => "starter",
        })
    }
}

/// Threads that may be given up before that is told: each holds its stack, and whatever its handler
/// had taken, for ever.
pub(crate) const ABANDONED_LIMIT: usize = 4;

/// An arbiter that a component was given.
#[derive(Clone)]
pub(crate) struct ArbiterSlot {
    pub(crate) handle: ArbiterHandle,
    pub(crate) pulse: Arc<ArbiterHeartbeat>,
    own_thread: bool,
}

impl ArbiterSlot {
    /// Another life of the same component can begin here.
    pub(crate) fn is_usable(&self) -> bool {
        !self.own_thread && !self.pulse.is_fenced() && self.handle.alive()
    }

    fn kind(&self) -> ThreadKind {
        match self.own_thread {
            true => ThreadKind::Own,
            false => ThreadKind::Shared,
        }
    }

    /// The component that lived here has ended.
    pub(crate) fn vacate(&self) {
        if self.own_thread {
            self.handle.stop();
        }
    }

    /// The handler that kept a lost arbiter has returned: nobody lives here any more.
    pub(crate) fn return_late(&self) {
        self.handle.stop();
    }
}

/// Is called with the number of threads that are given up now, whenever one more is.
pub(crate) type OnAbandoned = Box<dyn Fn(usize) + Send + Sync>;

/// The threads of a node's components. Clones share them.
#[derive(Clone)]
pub(crate) struct ArbiterPool(Arc<Inner>);

struct Inner {
    /// How many arbiters are shared; none where everything lives on the arbiter that asks.
    shared: usize,
    /// A thread that starts an arbiter must know to which system it belongs.
    system: Option<System>,
    pool: Mutex<Pool>,
    abandoned: Arc<AtomicUsize>,
    on_abandoned: Mutex<Option<OnAbandoned>>,
}

#[derive(Default)]
struct Pool {
    seats: Vec<ArbiterSlot>,
    next: usize,
    /// Threads that components have for themselves, to be ended with the node.
    own: Vec<ArbiterSlot>,
    /// Those that were given up and have not come back, and whose handler keeps them.
    lost: Vec<(ArbiterSlot, ObjectName)>,
    /// The node has ended: a life that begins anew because its arbiter went finds no place.
    stopped: bool,
}

/// A thread that was begun here and has not ended.
pub(crate) struct ArbiterThread {
    pub(crate) kind: ThreadKind,
    pub(crate) pulse: Arc<ArbiterHeartbeat>,
    /// The culprit, if it is given up.
    pub(crate) lost_to: Option<ObjectName>,
}

impl Pool {
    /// At [`ABANDONED_LIMIT`] the process is begun anew; threads that came back are forgotten.
    fn note_lost(&mut self, pulse: &ArbiterHeartbeat, culprit: &ObjectName) {
        self.lost.retain(|(seat, _)| seat.handle.alive());
        for seats in [&mut self.seats, &mut self.own] {
            let gone = seats.extract_if(.., |seat| seat.pulse.id() == pulse.id());
            self.lost.extend(gone.map(|seat| (seat, culprit.clone())));
        }
    }
}

/// Lives as long as an arbiter's event loop turns. Dropped after the arbiter was lost, it says that
/// the thread has come back after all.
pub(crate) struct LoopGuard {
    pulse: Arc<ArbiterHeartbeat>,
    abandoned: Arc<AtomicUsize>,
}

impl Drop for LoopGuard {
    fn drop(&mut self) {
        if self.pulse.is_lost() {
            let _ = self.abandoned.fetch_update(Relaxed, Relaxed, |count| count.checked_sub(1));
        }
    }
}

impl fmt::Debug for ArbiterPool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} shared arbiters, {} abandoned", self.0.shared, self.abandoned())
    }
}

impl ArbiterPool {
    /// Everything lives on the arbiter that starts it: for tests, under one clock.
    pub(crate) fn here() -> Self {
        Self::with(0, None)
    }

    /// So many shared arbiters, and threads of their own for those who ask.
    ///
    /// # Panics
    /// Outside of an actix system.
    pub(crate) fn pool(shared: usize) -> Self {
        Self::with(shared.max(1), Some(System::current()))
    }

    fn with(shared: usize, system: Option<System>) -> Self {
        ArbiterPool(Arc::new(Inner {
            shared,
            system,
            pool: Mutex::default(),
            abandoned: Arc::default(),
            on_abandoned: Mutex::default(),
        }))
    }

    fn pool_of(&self) -> MutexGuard<'_, Pool> {
        self.0.pool.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A place for a component.
    ///
    /// # Errors
    /// The operating system has no thread left, or the node has ended.
    pub(crate) fn place(&self, own_thread: bool) -> std::io::Result<ArbiterSlot> {
        if self.0.shared == 0 {
            let pulse = ArbiterHeartbeat::enrol_here();
            return Ok(ArbiterSlot { handle: Arbiter::current(), pulse, own_thread: false });
        }
        let mut pool = self.pool_of();
        if pool.stopped {
            return Err(std::io::Error::other("the node has ended"));
        }
        pool.own.retain(|seat| seat.handle.alive());
        if own_thread {
            let seat = self.start(true)?;
            pool.own.push(seat.clone());
            return Ok(seat);
        }
        pool.seats.retain(|seat| !seat.pulse.is_lost() && seat.handle.alive());
        let turning = |seat: &&ArbiterSlot| !seat.pulse.is_fenced();
        let free = pool.seats.iter().filter(turning).count();
        if free < self.0.shared {
            let seat = self.start(false)?;
            pool.seats.push(seat.clone());
            return Ok(seat);
        }
        pool.next += 1;
        let seat = pool.seats.iter().filter(turning).nth(pool.next % free);
        Ok(seat.expect("there are as many as were counted").clone())
    }

    fn start(&self, own_thread: bool) -> std::io::Result<ArbiterSlot> {
        if let (None, Some(system)) = (System::try_current(), &self.0.system) {
            System::set_current(system.clone());
        }
        let arbiter = Arbiter::try_with_tokio_rt(|| {
            tokio::runtime::Builder::new_current_thread().enable_all().build()
        })?;
        let handle = arbiter.handle();
        let pulse = Arc::new(ArbiterHeartbeat::default());
        let loan = LoopGuard { pulse: pulse.clone(), abandoned: self.0.abandoned.clone() };
        let adopted = pulse.clone();
        handle.spawn_fn(move || adopted.adopt(loan));
        Ok(ArbiterSlot { handle, pulse, own_thread })
    }

    /// The grace time of this arbiter is over. Says whether it is really lost, or has just come
    /// back.
    pub(crate) fn mark_lost(&self, pulse: &ArbiterHeartbeat, culprit: &ObjectName) -> bool {
        if !pulse.lose() {
            return false;
        }
        self.pool_of().note_lost(pulse, culprit);
        self.note_abandoned();
        true
    }

    /// One more thread is abandoned that is none of these, because the fault chain called what
    /// blocks it.
    pub(crate) fn note_abandoned(&self) {
        let count = self.0.abandoned.fetch_add(1, Relaxed) + 1;
        if let Some(tell) = &*self.0.on_abandoned.lock().unwrap_or_else(PoisonError::into_inner) {
            tell(count);
        }
    }

    /// Such a thread has come back.
    pub(crate) fn note_returned(&self) {
        let _ = self.0.abandoned.fetch_update(Relaxed, Relaxed, |count| count.checked_sub(1));
    }

    /// Everything lives on the arbiter that started it.
    pub(crate) fn are_here(&self) -> bool {
        self.0.shared == 0
    }

    /// All threads that were begun here and have not ended.
    pub(crate) fn threads(&self) -> Vec<ArbiterThread> {
        let pool = self.pool_of();
        let usable = pool.seats.iter().chain(&pool.own).map(|seat| (seat, None));
        let lost = pool.lost.iter().map(|(seat, culprit)| (seat, Some(culprit.clone())));
        let there = usable.chain(lost).filter(|(seat, _)| seat.handle.alive());
        let thread = |(seat, lost_to): (&ArbiterSlot, _)| {
            let (kind, pulse) = (seat.kind(), seat.pulse.clone());
            ArbiterThread { kind, pulse, lost_to }
        };
        there.map(thread).collect()
    }

    /// How many threads are given up now and have not come back.
    pub(crate) fn abandoned(&self) -> usize {
        self.0.abandoned.load(Relaxed)
    }

    /// From now on calls `tell` whenever one more thread is given up; at [`ABANDONED_LIMIT`] the
    /// process should be begun anew.
    pub(crate) fn on_abandoned(&self, tell: OnAbandoned) {
        *self.0.on_abandoned.lock().unwrap_or_else(PoisonError::into_inner) = Some(tell);
    }

    /// Ends all threads that can still hear it, and starts no more.
    pub(crate) fn stop(&self) {
        let ended = Pool { stopped: true, ..Pool::default() };
        let pool = std::mem::replace(&mut *self.pool_of(), ended);
        let lost = pool.lost.iter().map(|(seat, _)| seat);
        for seat in pool.seats.iter().chain(&pool.own).chain(lost) {
            seat.handle.stop();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arbiters_that_were_stopped_start_no_thread_again() {
        System::new().block_on(async {
            let arbiters = ArbiterPool::pool(1);
            arbiters.place(true).expect("a thread");

            arbiters.stop();

            assert!(arbiters.place(true).is_err());
            assert!(arbiters.place(false).is_err());
        });
    }
}
