//! Where components live: arbiters that they share, one per core, or one of their own.
//!
//! A thread that hangs cannot be killed. It is given up, another takes its place, and the given-up
//! ones are counted by their culprits: a culprit that keeps too many gets no more, and where too
//! many culprits keep some, the process itself has to be restarted.
//!
//! Incarnations are placed on threads that answer only, and one that waits on a thread which does
//! not answer any more is moved to another before it begins. An incarnation that follows a hang has
//! a thread for itself, so that a component that hangs again keeps no other.

use super::heartbeat::ArbiterHeartbeat;
use crate::platform;
use crate::platform::lock;
use crate::platform::scheduling::ThreadScheduling;
use actix_rt::{Arbiter, ArbiterHandle, System};
use blastema_core::sorted::SortedMap;
use blastema_core::{Instant, ObjectName};
use std::ops::Deref;
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;
use std::{fmt, io};

/// Which components may run on a thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ThreadKind {
    /// Any component that has no thread of its own.
    Shared,
    /// One component: it asked for a thread of its own, or its previous incarnation kept another
    /// thread.
    Own,
    /// Components and the rest of the application: the thread that started the node.
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

/// Threads that one component, strategy or other culprit may keep: each holds its stack, and
/// whatever its handler had taken, for ever. As many as an intensity of three restarts spends.
pub(crate) const THREADS_OF_ONE: usize = 4;

/// So many culprits that keep lost threads, and the process should be restarted: what strikes so
/// many of them is none of them.
pub(crate) const CULPRITS_LIMIT: usize = 4;

/// Shared threads beyond those that were asked for, while none of these answers.
const SPARE: usize = 4;

/// A thread whose last beat is older does not answer: ten beats, more than a handler of 30 ms of
/// each of two neighbours takes.
const ANSWERS_WITHIN: Duration = Duration::from_millis(100);

/// An arbiter that a component was given. Clones share it.
#[derive(Clone)]
pub(crate) struct ArbiterSlot(Arc<ArbiterEntry>);

pub(crate) struct ArbiterEntry {
    pub(crate) handle: ArbiterHandle,
    pub(crate) heartbeat: Arc<ArbiterHeartbeat>,
    own_thread: bool,
}

impl Deref for ArbiterSlot {
    type Target = ArbiterEntry;

    fn deref(&self) -> &ArbiterEntry {
        &self.0
    }
}

impl ArbiterSlot {
    fn new(handle: ArbiterHandle, heartbeat: Arc<ArbiterHeartbeat>, own_thread: bool) -> Self {
        ArbiterSlot(Arc::new(ArbiterEntry { handle, heartbeat, own_thread }))
    }

    /// Another incarnation of the same component can begin here.
    pub(crate) fn is_usable(&self) -> bool {
        !self.own_thread && !self.heartbeat.is_fenced() && self.answers(platform::now())
    }

    /// Its event loop turns, or will: no component keeps it. One that runs no component and is late
    /// was not given a processor; another thread would wait for one as well.
    fn answers(&self, now: Instant) -> bool {
        let beats = self.heartbeat.last_beat().is_none_or(|at| now - at <= ANSWERS_WITHIN);
        (beats || self.heartbeat.running().is_none()) && self.handle.alive()
    }

    /// One component has it to itself.
    pub(crate) fn is_own_thread(&self) -> bool {
        self.own_thread
    }

    fn kind(&self) -> ThreadKind {
        if self.own_thread { ThreadKind::Own } else { ThreadKind::Shared }
    }

    /// The component that lived here has ended.
    pub(crate) fn vacate(&self) {
        if self.own_thread {
            self.handle.stop();
        }
    }

    /// The handler that kept a lost arbiter has returned: no component lives here any more.
    pub(crate) fn return_late(&self) {
        self.handle.stop();
    }
}

/// An incarnation that is to begin on the arbiter that it is given.
pub(crate) type PendingIncarnation = Box<dyn FnOnce(ArbiterSlot) + Send>;

/// How many threads each culprit has kept for good.
pub(crate) type LostThreads = SortedMap<ObjectName, usize>;

/// Is called with the threads that are lost now, whenever one more is.
pub(crate) type OnAbandoned = Box<dyn Fn(&LostThreads) + Send + Sync>;

/// The threads of a node's components. Clones share them.
#[derive(Clone)]
pub(crate) struct ArbiterPool(Arc<Inner>);

struct Inner {
    /// How many arbiters are shared; none where everything lives on the arbiter that asks.
    shared: usize,
    /// A thread that starts an arbiter must know to which system it belongs.
    system: Option<System>,
    pool: Mutex<Pool>,
    on_abandoned: Mutex<Option<OnAbandoned>>,
}

#[derive(Default)]
struct Pool {
    slots: Vec<ArbiterSlot>,
    next: usize,
    /// Threads that components have for themselves, to be ended with the node.
    own: Vec<ArbiterSlot>,
    /// Threads that were given up and have not come back.
    kept: Vec<KeptThread>,
    /// Incarnations that were sent to a shared thread and may still wait there.
    pending: Vec<(ArbiterSlot, Weak<Mutex<Option<PendingIncarnation>>>)>,
    /// The node has ended: a next incarnation whose arbiter went finds no place.
    stopped: bool,
}

/// A thread that was given up, and its culprit.
struct KeptThread {
    culprit: ObjectName,
    /// Where it is one of these; what the fault chain called, and blocks, is elsewhere.
    slot: Option<ArbiterSlot>,
}

impl KeptThread {
    fn is_kept(&self) -> bool {
        self.slot.as_ref().is_none_or(|slot| slot.heartbeat.is_fenced() && slot.handle.alive())
    }

    fn is_lost(&self) -> bool {
        self.slot.as_ref().is_none_or(|slot| slot.heartbeat.is_lost() && slot.handle.alive())
    }
}

/// A thread that was begun here and has not ended.
pub(crate) struct ArbiterThread {
    pub(crate) kind: ThreadKind,
    pub(crate) heartbeat: Arc<ArbiterHeartbeat>,
    /// The culprit, if it is lost.
    pub(crate) lost_to: Option<ObjectName>,
}

impl Pool {
    /// Forgets threads that came back, or are lost, as places.
    fn tidy(&mut self) {
        self.kept.retain(KeptThread::is_kept);
        for slots in [&mut self.slots, &mut self.own] {
            slots.retain(|slot| !slot.heartbeat.is_lost() && slot.handle.alive());
        }
    }

    fn lost(&self) -> LostThreads {
        let mut lost = LostThreads::new();
        for thread in self.kept.iter().filter(|thread| thread.is_lost()) {
            *lost.entry(thread.culprit.clone()).or_default() += 1;
        }
        lost
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
        let (pool, on_abandoned) = (Mutex::default(), Mutex::default());
        ArbiterPool(Arc::new(Inner { shared, system, pool, on_abandoned }))
    }

    /// A place for a component, on a thread of its own where it is told how that is scheduled.
    ///
    /// # Errors
    /// It keeps too many threads, the operating system has none left or forbids such a one, or the
    /// node has ended.
    pub(crate) fn place(
        &self,
        object: &ObjectName,
        own_thread: Option<ThreadScheduling>,
    ) -> io::Result<ArbiterSlot> {
        if self.0.shared == 0 {
            let heartbeat = ArbiterHeartbeat::register_here();
            return Ok(ArbiterSlot::new(Arbiter::current(), heartbeat, false));
        }
        self.check_share(object)?;
        self.place_in(&mut lock(&self.0.pool), own_thread)
    }

    fn place_in(
        &self,
        pool: &mut Pool,
        own_thread: Option<ThreadScheduling>,
    ) -> io::Result<ArbiterSlot> {
        if pool.stopped {
            return Err(io::Error::other("the node has ended"));
        }
        pool.tidy();
        if own_thread.is_some() {
            let slot = self.start(own_thread)?;
            pool.own.push(slot.clone());
            return Ok(slot);
        }
        let now = platform::now();
        let turning = || pool.slots.iter().filter(|slot| !slot.heartbeat.is_fenced());
        let answering: Vec<&ArbiterSlot> = turning().filter(|slot| slot.answers(now)).collect();
        let wanted = self.0.shared + if answering.is_empty() { SPARE } else { 0 };
        if turning().count() < wanted {
            let slot = self.start(None)?;
            pool.slots.push(slot.clone());
            return Ok(slot);
        }
        let among = if answering.is_empty() { turning().collect() } else { answering };
        pool.next += 1;
        Ok(among[pool.next % among.len()].clone())
    }

    /// Whether a culprit may have one more thread.
    ///
    /// # Errors
    /// It keeps its share already.
    pub(crate) fn check_share(&self, culprit: &ObjectName) -> io::Result<()> {
        let mut pool = lock(&self.0.pool);
        pool.tidy();
        let kept = pool.kept.iter().filter(|thread| thread.culprit == *culprit).count();
        if kept < THREADS_OF_ONE {
            return Ok(());
        }
        let reason = format!("{culprit} keeps {kept} threads in calls that do not return");
        Err(io::Error::other(reason))
    }

    /// Has an incarnation begin on `slot`; on another shared thread if that one does not answer.
    pub(crate) fn start_on(&self, slot: ArbiterSlot, incarnation: PendingIncarnation) {
        let waiting = Arc::new(Mutex::new(Some(incarnation)));
        if !slot.own_thread && self.0.shared > 0 {
            lock(&self.0.pool).pending.push((slot.clone(), Arc::downgrade(&waiting)));
        }
        let handle = slot.handle.clone();
        handle.spawn_fn(move || {
            let incarnation = lock(&waiting).take();
            if let Some(incarnation) = incarnation {
                incarnation(slot);
            }
        });
    }

    /// Moves the incarnations that wait on threads which do not answer.
    pub(crate) fn move_pending(&self, now: Instant) {
        let mut pool = lock(&self.0.pool);
        if pool.pending.is_empty() {
            return;
        }
        let waiting = std::mem::take(&mut pool.pending);
        let mut moved = Vec::new();
        for (slot, incarnation) in waiting {
            let Some(kept) = incarnation.upgrade() else { continue };
            let mut kept = lock(&kept);
            if kept.is_none() {
                continue;
            }
            if slot.answers(now) {
                pool.pending.push((slot, incarnation));
                continue;
            }
            match self.place_in(&mut pool, None) {
                Ok(other) => moved.extend(kept.take().map(|incarnation| (other, incarnation))),
                Err(_) => pool.pending.push((slot, incarnation)),
            }
        }
        drop(pool);
        moved.into_iter().for_each(|(slot, incarnation)| self.start_on(slot, incarnation));
    }

    fn start(&self, own_thread: Option<ThreadScheduling>) -> io::Result<ArbiterSlot> {
        if let (None, Some(system)) = (System::try_current(), &self.0.system) {
            System::set_current(system.clone());
        }
        let handle = platform::scheduled_arbiter(own_thread.unwrap_or_default())?;
        let heartbeat = Arc::new(ArbiterHeartbeat::default());
        let adopted = heartbeat.clone();
        handle.spawn_fn(move || adopted.adopt());
        Ok(ArbiterSlot::new(handle, heartbeat, own_thread.is_some()))
    }

    /// The culprit keeps this arbiter: nothing that is sent from it gets out any more.
    pub(crate) fn fence(&self, slot: &ArbiterSlot, culprit: &ObjectName) {
        let mut pool = lock(&self.0.pool);
        // One that came back and is kept again has one culprit.
        let is_another = |kept: &ArbiterSlot| kept.heartbeat.id() != slot.heartbeat.id();
        pool.kept.retain(|thread| thread.slot.as_ref().is_none_or(is_another));
        slot.heartbeat.fence();
        pool.kept.push(KeptThread { culprit: culprit.clone(), slot: Some(slot.clone()) });
    }

    /// The grace time of this arbiter is over. Says whether it is really lost, or has just come
    /// back.
    pub(crate) fn mark_lost(&self, heartbeat: &ArbiterHeartbeat) -> bool {
        let lost = heartbeat.lose();
        if lost {
            self.tell_abandoned();
        }
        lost
    }

    /// One more thread is abandoned that is none of these, because the fault chain called what
    /// blocks it.
    pub(crate) fn note_abandoned(&self, culprit: &ObjectName) {
        lock(&self.0.pool).kept.push(KeptThread { culprit: culprit.clone(), slot: None });
        self.tell_abandoned();
    }

    /// Such a thread has come back.
    pub(crate) fn note_returned(&self, culprit: &ObjectName) {
        let kept = &mut lock(&self.0.pool).kept;
        let is_its = |thread: &KeptThread| thread.slot.is_none() && thread.culprit == *culprit;
        if let Some(at) = kept.iter().position(is_its) {
            kept.swap_remove(at);
        }
    }

    fn tell_abandoned(&self) {
        let lost = self.lost();
        if let Some(tell) = &*lock(&self.0.on_abandoned) {
            tell(&lost);
        }
    }

    /// Everything lives on the arbiter that started it.
    pub(crate) fn are_here(&self) -> bool {
        self.0.shared == 0
    }

    /// All threads that were begun here and have not ended.
    pub(crate) fn threads(&self) -> Vec<ArbiterThread> {
        let mut pool = lock(&self.0.pool);
        pool.tidy();
        let usable = pool.slots.iter().chain(&pool.own).map(|slot| (slot, None));
        let lost = pool.kept.iter().filter(|thread| thread.is_lost());
        let lost = lost.filter_map(|lost| Some((lost.slot.as_ref()?, Some(lost.culprit.clone()))));
        let thread = |(slot, lost_to): (&ArbiterSlot, _)| {
            let (kind, heartbeat) = (slot.kind(), slot.heartbeat.clone());
            ArbiterThread { kind, heartbeat, lost_to }
        };
        usable.chain(lost).map(thread).collect()
    }

    /// How many threads each culprit keeps for good now.
    pub(crate) fn lost(&self) -> LostThreads {
        lock(&self.0.pool).lost()
    }

    /// How many threads are lost now and have not come back.
    pub(crate) fn abandoned(&self) -> usize {
        self.lost().values().sum()
    }

    /// From now on calls `tell` whenever one more thread is lost; at [`CULPRITS_LIMIT`] the process
    /// should be restarted.
    pub(crate) fn on_abandoned(&self, tell: OnAbandoned) {
        *lock(&self.0.on_abandoned) = Some(tell);
    }

    /// Ends all threads that can still hear it, and starts no more.
    pub(crate) fn stop(&self) {
        let ended = Pool { stopped: true, ..Pool::default() };
        let pool = std::mem::replace(&mut *lock(&self.0.pool), ended);
        let kept = pool.kept.iter().filter_map(|thread| thread.slot.as_ref());
        for slot in pool.slots.iter().chain(&pool.own).chain(kept) {
            slot.handle.stop();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::{Receiver, Sender, channel};

    /// For threads of a busy computer.
    const PATIENCE: Duration = Duration::from_secs(30);

    fn name(text: &str) -> ObjectName {
        text.parse().unwrap()
    }

    /// A thread of its own, scheduled as any other.
    const OWN: Option<ThreadScheduling> = Some(ThreadScheduling { priority: None, cpu: None });

    fn place(arbiters: &ArbiterPool) -> ArbiterSlot {
        arbiters.place(&name("arm"), None).expect("a thread")
    }

    /// Has a component keep a thread until the sender is dropped.
    fn keep(slot: &ArbiterSlot) -> Sender<()> {
        let (hold, held) = channel::<()>();
        let (begun, begins) = channel();
        let heartbeat = slot.heartbeat.clone();
        slot.handle.spawn_fn(move || {
            heartbeat.run(Some(0));
            begun.send(()).unwrap();
            let _ = held.recv();
            heartbeat.run(None);
        });
        begins.recv_timeout(PATIENCE).expect("it begins");
        hold
    }

    /// Boards an incarnation that says on which thread it begins.
    fn start_on(arbiters: &ArbiterPool, slot: &ArbiterSlot) -> Receiver<u64> {
        let (begun, begins) = channel();
        let incarnation = move |slot: ArbiterSlot| begun.send(slot.heartbeat.id()).unwrap();
        arbiters.start_on(slot.clone(), Box::new(incarnation));
        begins
    }

    /// Waits until the thread does not answer any more.
    async fn until_silent(slot: &ArbiterSlot) {
        while slot.answers(platform::now()) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    /// On real threads.
    mod real {
        use super::*;

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn arbiters_that_were_stopped_start_no_thread_again() {
            let arbiters = ArbiterPool::pool(1);
            arbiters.place(&name("arm"), OWN).expect("a thread");

            arbiters.stop();

            assert!(arbiters.place(&name("arm"), OWN).is_err());
            assert!(arbiters.place(&name("arm"), None).is_err());
        }

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn a_thread_that_does_not_answer_is_no_place_and_no_more_than_some_are_started_for_it()
         {
            let arbiters = ArbiterPool::pool(1);
            let mut holds = Vec::new();
            let mut ids = Vec::new();
            for _ in 0..=SPARE {
                let slot = place(&arbiters);
                holds.push(keep(&slot));
                until_silent(&slot).await;
                ids.push(slot.heartbeat.id());
            }
            assert!(ids.is_sorted_by(|a, b| a < b), "each on a fresh thread: {ids:?}");

            let last = place(&arbiters);
            assert!(ids.contains(&last.heartbeat.id()), "none is left that could be started");
            holds.pop();
            arbiters.stop();
        }

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn a_thread_that_no_component_keeps_is_a_place_however_late_its_beat_is() {
            let arbiters = ArbiterPool::pool(1);
            let slot = place(&arbiters);
            let begun = start_on(&arbiters, &slot).recv_timeout(PATIENCE);
            assert_eq!(begun, Ok(slot.heartbeat.id()), "it has begun to beat");
            let late = platform::now() + Duration::from_secs(3600);

            assert!(slot.answers(late), "it waits for a processor");
            slot.heartbeat.run(Some(0));
            assert!(!slot.answers(late), "a component keeps it");
            arbiters.stop();
        }

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn an_incarnation_that_waits_on_a_thread_which_does_not_answer_is_moved_and_begins_once()
         {
            let arbiters = ArbiterPool::pool(1);
            let slot = place(&arbiters);
            let hold = keep(&slot);
            let begins = start_on(&arbiters, &slot);
            arbiters.move_pending(slot.heartbeat.last_beat().expect("it has beaten"));
            until_silent(&slot).await;
            assert!(begins.try_recv().is_err(), "it waits");

            arbiters.move_pending(platform::now());

            let begun = begins.recv_timeout(PATIENCE).expect("it begins");
            assert_ne!(begun, slot.heartbeat.id());
            drop(hold);
            let after = start_on(&arbiters, &slot);
            assert_eq!(after.recv_timeout(PATIENCE), Ok(slot.heartbeat.id()));
            assert!(begins.try_recv().is_err(), "once");
            arbiters.stop();
        }

        #[blastema_macros::test(crate = "blastema_doubles::real")]
        async fn a_culprit_that_keeps_its_share_gets_no_more_and_others_do() {
            let arbiters = ArbiterPool::pool(1);
            let (arm, leg) = (name("arm"), name("leg"));
            let mut holds = Vec::new();
            for _ in 0..THREADS_OF_ONE {
                let slot = arbiters.place(&arm, OWN).expect("a thread");
                holds.push(keep(&slot));
                arbiters.fence(&slot, &arm);
                assert_eq!(arbiters.abandoned(), 0, "it may come back");
            }

            let refused = arbiters.place(&arm, OWN).err().expect("it keeps its share");
            assert!(refused.to_string().contains("arm keeps 4 threads"), "{refused}");
            let slot = arbiters.place(&leg, OWN).expect("a thread for another");
            arbiters.fence(&slot, &leg);
            let kept: Vec<_> =
                lock(&arbiters.0.pool).own.iter().map(|s| s.heartbeat.clone()).collect();
            assert!(kept.iter().filter(|heartbeat| arbiters.mark_lost(heartbeat)).count() >= 4);
            assert_eq!(arbiters.lost()[&arm], THREADS_OF_ONE);

            holds.clear();
            while arbiters.lost().contains_key(&arm) {
                let kept = &lock(&arbiters.0.pool).kept;
                kept.iter().filter_map(|kept| kept.slot.as_ref()).for_each(|s| s.return_late());
                std::thread::yield_now();
            }
            arbiters.place(&arm, OWN).expect("its threads came back");
            arbiters.stop();
        }
    }
}
