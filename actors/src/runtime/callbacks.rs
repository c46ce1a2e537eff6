//! Calls of the application's code by the fault chain: recovery strategies and safe outputs.
//!
//! None of it runs on the fault chain's thread. A strategy has an arbiter of its own; safe outputs
//! are called one after the other on a thread that is started for them. Each call is entered here
//! while it runs, and the thread that [watches the chain](crate::fault_chain::outside) finds those
//! that take longer than the limit: the call is reported under its name, its thread is abandoned,
//! and what waits behind it goes on on a fresh one.
//!
//! In a node that runs on one thread, as tests under a paused clock do, calls are made where they
//! are asked for.

use crate::arbiter::pool::{ArbiterPool, THREADS_OF_ONE};
use crate::platform;
use crate::platform::panics;
use crate::runtime::reports::FaultReports;
use blastema_core::ObjectName;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;

/// How long one call may keep its thread, unless the node is told otherwise: as long as a handler
/// of a component.
pub(crate) const CALLBACK_LIMIT: Duration = Duration::from_millis(500);

/// What became of one call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum CallOutcome {
    /// It returned in time.
    Done,
    /// It panicked, with this text.
    Panicked(String),
    /// It has taken longer than this limit and still runs.
    Blocked(Duration),
    /// It was not made, because so many calls of the same object block already.
    NotMade,
    /// It blocked, and has returned after all.
    ReturnedLate,
}

/// Is told what became of a call: once, and once more where that was [`CallOutcome::Blocked`] and
/// it returns.
type OutcomeFn = Box<dyn Fn(CallOutcome) + Send>;
type LateFn = Box<dyn FnOnce(Duration) + Send>;

/// The calls of one node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct Callbacks(Option<Arc<Threads>>);

/// What calls on threads of their own need.
struct Threads {
    limit: Duration,
    /// Counts the threads that are abandoned, with those of components.
    arbiters: ArbiterPool,
    running: Mutex<ActiveCalls>,
    queue: Mutex<Queue>,
    reports: OnceLock<FaultReports>,
}

/// At most one call a thread.
#[derive(Default)]
struct ActiveCalls {
    next: u64,
    calls: Vec<ActiveCall>,
}

struct ActiveCall {
    id: u64,
    /// For how long it was seen to run.
    seen: Duration,
    late: LateFn,
}

/// Safe outputs that are to be applied: no more than components and actuators come to rest at once.
#[derive(Default)]
struct Queue {
    waiting: VecDeque<Job>,
    /// The thread that makes the calls; none while none waits.
    thread: Option<u64>,
    started: u64,
}

struct Job {
    /// Whose code it is.
    object: ObjectName,
    run: Box<dyn FnOnce() + Send>,
    outcome: OutcomeFn,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// One call that runs now.
pub(crate) struct RunningCall {
    threads: Arc<Threads>,
    id: u64,
}

impl RunningCall {
    /// It has returned. Says whether that was in time.
    pub(crate) fn end(self) -> bool {
        let calls = &mut lock(&self.threads.running).calls;
        let at = calls.iter().position(|call| call.id == self.id);
        at.map(|at| calls.swap_remove(at)).is_some()
    }
}

impl Callbacks {
    /// Calls on threads of their own, each of which may take so long.
    pub(crate) fn on_threads(limit: Duration, arbiters: ArbiterPool) -> Self {
        Callbacks(Some(Arc::new(Threads {
            limit,
            arbiters,
            running: Mutex::default(),
            queue: Mutex::default(),
            reports: OnceLock::new(),
        })))
    }

    /// Reports calls that block from now on.
    pub(crate) fn report_to(&self, reports: FaultReports) {
        if let Some(threads) = &self.0 {
            // A node's chain is made once.
            let _ = threads.reports.set(reports);
        }
    }

    /// Whether calls are made on threads of their own.
    pub(crate) fn have_threads(&self) -> bool {
        self.0.is_some()
    }

    /// How long a call may take; `None` where it cannot be observed.
    pub(crate) fn limit(&self) -> Option<Duration> {
        self.0.as_ref().map(|threads| threads.limit)
    }

    /// A call begins on this thread. Where it takes longer than the limit, `late` is called on
    /// another one.
    pub(crate) fn enter(
        &self,
        late: impl FnOnce(Duration) + Send + 'static,
    ) -> Option<RunningCall> {
        let threads = self.0.clone()?;
        let mut running = lock(&threads.running);
        let id = running.next;
        running.next += 1;
        running.calls.push(ActiveCall { id, seen: Duration::ZERO, late: Box::new(late) });
        drop(running);
        Some(RunningCall { threads, id })
    }

    /// The next look at the calls that run, `since` after the one before.
    pub(crate) fn look(&self, since: Duration) {
        let Some(threads) = &self.0 else { return };
        let late: Vec<ActiveCall> = {
            let mut running = lock(&threads.running);
            running.calls.iter_mut().for_each(|call| call.seen += since);
            running.calls.extract_if(.., |call| call.seen > threads.limit).collect()
        };
        // Without the lock: what is told may make the next call.
        late.into_iter().for_each(|call| (call.late)(threads.limit));
    }

    /// One more thread is abandoned to `object`, whose code blocks it.
    pub(crate) fn abandon_thread(&self, object: &ObjectName, detail: String) {
        let Some(threads) = &self.0 else { return };
        if let Some(reports) = threads.reports.get() {
            reports.declare(object.as_str(), detail);
        }
        threads.arbiters.note_abandoned(object);
    }

    /// Whether code of this object may be called once more.
    ///
    /// # Errors
    /// It keeps its share of threads already.
    pub(crate) fn check_share(&self, object: &ObjectName) -> std::io::Result<()> {
        self.0.as_ref().map_or(Ok(()), |threads| threads.arbiters.check_share(object))
    }

    /// The code that blocked a thread has returned.
    pub(crate) fn take_back_thread(&self, object: &ObjectName) {
        let Some(threads) = &self.0 else { return };
        threads.arbiters.note_returned(object);
        if let Some(reports) = threads.reports.get() {
            reports.mend(object.as_str());
        }
    }

    /// Has this function of the object called, behind those that wait already. `outcome` is told
    /// what became of it.
    pub(crate) fn call(
        &self,
        object: &ObjectName,
        run: impl FnOnce() + Send + 'static,
        outcome: impl Fn(CallOutcome) + Send + 'static,
    ) {
        let Some(threads) = &self.0 else {
            return outcome(guarded(run));
        };
        let object = object.clone();
        let job = Job { object, run: Box::new(run), outcome: Box::new(outcome) };
        lock(&threads.queue).waiting.push_back(job);
        threads.clone().serve();
    }
}

/// Calls a function; a panic in it is caught.
fn guarded(run: impl FnOnce()) -> CallOutcome {
    let _guarded = panics::PanicGuard::enter();
    match catch_unwind(AssertUnwindSafe(run)) {
        Ok(()) => CallOutcome::Done,
        Err(payload) => CallOutcome::Panicked(panics::text_of(payload)),
    }
}

impl Threads {
    /// Sees that a thread makes the calls that wait.
    fn serve(self: Arc<Self>) {
        let mut queue = lock(&self.queue);
        if queue.thread.is_some() || queue.waiting.is_empty() {
            return;
        }
        queue.started += 1;
        let number = queue.started;
        queue.thread = Some(number);
        drop(queue);
        let threads = self.clone();
        if platform::start_thread("safe-outputs", move || threads.work(number)).is_err() {
            // No thread is left in the system. That outputs are safe comes before all else.
            self.work(number);
        }
    }

    /// Makes calls until none waits, or until this thread is abandoned.
    fn work(self: Arc<Self>, number: u64) {
        loop {
            let next = {
                let mut queue = lock(&self.queue);
                let next = queue.waiting.pop_front();
                if next.is_none() {
                    queue.thread = None;
                }
                next
            };
            let Some(Job { object, run, outcome }) = next else { return };
            if self.arbiters.calls_blocked_by(&object) >= THREADS_OF_ONE {
                // Each further call would keep one more thread for ever.
                outcome(CallOutcome::NotMade);
                continue;
            }
            let outcome = Arc::new(Mutex::new(outcome));
            let (threads, told, culprit) = (self.clone(), outcome.clone(), object.clone());
            let call = Callbacks(Some(self.clone())).enter(move |limit| {
                lock(&threads.queue).thread.take_if(|thread| *thread == number);
                threads.arbiters.note_abandoned(&culprit);
                lock(&told)(CallOutcome::Blocked(limit));
                threads.clone().serve();
            });
            let result = guarded(run);
            if call.is_some_and(RunningCall::end) {
                lock(&outcome)(result);
                continue;
            }
            // Another thread makes the calls now.
            self.arbiters.note_returned(&object);
            return lock(&outcome)(CallOutcome::ReturnedLate);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::{Receiver, Sender, channel};

    const LIMIT: Duration = Duration::from_millis(100);
    /// For threads of a busy computer.
    const PATIENCE: Duration = Duration::from_secs(30);

    /// The number of a call, and what became of it.
    type Told = (u32, CallOutcome);

    struct Rig {
        callbacks: Callbacks,
        told: (Sender<Told>, Receiver<Told>),
    }

    impl Rig {
        fn new() -> Self {
            let callbacks = Callbacks::on_threads(LIMIT, ArbiterPool::here());
            Rig { callbacks, told: channel() }
        }

        fn call(&self, number: u32, run: impl FnOnce() + Send + 'static) {
            self.call_of("arm", number, run);
        }

        fn call_of(&self, object: &str, number: u32, run: impl FnOnce() + Send + 'static) {
            let told = self.told.0.clone();
            let outcome = move |outcome| told.send((number, outcome)).unwrap();
            self.callbacks.call(&object.parse().unwrap(), run, outcome);
        }

        /// Blocks until the sender is dropped.
        fn block(&self, number: u32) -> Sender<()> {
            let (hold, held) = channel::<()>();
            let (begun, begins) = channel();
            self.call(number, move || {
                begun.send(()).unwrap();
                let _ = held.recv();
            });
            begins.recv_timeout(PATIENCE).expect("a thread makes the call");
            hold
        }

        fn told(&self) -> (u32, CallOutcome) {
            self.told.1.recv_timeout(PATIENCE).expect("a call has an outcome")
        }

        fn abandoned(&self) -> usize {
            self.callbacks.0.as_ref().unwrap().arbiters.abandoned()
        }
    }

    #[test]
    fn calls_are_made_in_order_and_a_panic_is_an_outcome() {
        let rig = Rig::new();

        rig.call(1, || {});
        rig.call(2, || panic!("no brake"));
        rig.call(3, || {});

        assert_eq!(rig.told(), (1, CallOutcome::Done));
        assert_eq!(rig.told(), (2, CallOutcome::Panicked("no brake".into())));
        assert_eq!(rig.told(), (3, CallOutcome::Done));
    }

    #[test]
    fn a_call_that_blocks_is_told_once_and_those_behind_it_are_made_on_another_thread() {
        let rig = Rig::new();
        let hold = rig.block(1);
        rig.call(2, || {});

        rig.callbacks.look(LIMIT);
        assert!(rig.told.1.try_recv().is_err(), "it has the whole limit");
        rig.callbacks.look(Duration::from_millis(1));

        assert_eq!(rig.told(), (1, CallOutcome::Blocked(LIMIT)));
        assert_eq!(rig.told(), (2, CallOutcome::Done));
        assert_eq!(rig.abandoned(), 1);
        rig.callbacks.look(10 * LIMIT);
        drop(hold);
        assert_eq!(rig.told(), (1, CallOutcome::ReturnedLate));
        assert_eq!(rig.abandoned(), 0);
        rig.call(3, || {});
        assert_eq!(rig.told(), (3, CallOutcome::Done));
    }

    #[test]
    fn an_object_whose_calls_block_is_called_no_more_and_others_are() {
        let rig = Rig::new();
        let mut holds = Vec::new();
        for number in 0..THREADS_OF_ONE as u32 {
            holds.push(rig.block(number));
            rig.callbacks.look(2 * LIMIT);
            assert_eq!(rig.told(), (number, CallOutcome::Blocked(LIMIT)));
        }

        rig.call(9, || panic!("it is not called"));
        assert_eq!(rig.told(), (9, CallOutcome::NotMade));

        rig.call_of("leg", 8, || {});
        assert_eq!(rig.told(), (8, CallOutcome::Done));

        holds.clear();
        for _ in 0..THREADS_OF_ONE {
            assert_eq!(rig.told().1, CallOutcome::ReturnedLate);
        }
        rig.call(10, || {});
        assert_eq!(rig.told(), (10, CallOutcome::Done));
    }
}
