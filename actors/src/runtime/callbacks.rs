//! Calls of safe outputs and cut-offs by the middleware.
//!
//! None of them runs on the fault chain's thread. They are called one after the other on a thread
//! that is started for them. The thread that [watches the chain](crate::fault_chain::outside) finds
//! a call that takes longer than the limit: it is reported under its name, its thread is abandoned,
//! and the calls that wait behind it go on on a fresh one.
//!
//! Whether a call returned in time is decided once, under the lock of the queue. A call that
//! returns while its delay is being reported waits for the end of that report, so that each thread
//! that is counted as lost is counted as returned afterwards.
//!
//! In a node that runs on one thread, as tests under a paused clock do, calls are made where they
//! are asked for.

use crate::arbiter::pool::{ArbiterPool, THREADS_OF_ONE};
use crate::platform;
use crate::platform::lock;
use crate::platform::panics;
use blastema_core::ObjectName;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex};
use std::time::Duration;

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

/// Is told what became of a call: once, and once more where that was [`CallOutcome::Blocked`].
type OutcomeFn = Box<dyn Fn(CallOutcome) + Send>;

/// Starts a thread of this name, or says that the system has none left.
type StartThread = Box<dyn Fn(&str, Box<dyn FnOnce() + Send>) -> std::io::Result<()> + Send + Sync>;

/// The calls of one node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct Callbacks(Option<Arc<Threads>>);

/// What calls on threads of their own need.
struct Threads {
    limit: Duration,
    start: StartThread,
    /// Counts the threads that are abandoned, with those of components.
    arbiters: ArbiterPool,
    queue: Mutex<Queue>,
}

/// Calls that wait: no more than components and actuators enter the safe state at once.
#[derive(Default)]
struct Queue {
    waiting: VecDeque<Job>,
    /// The thread that makes the calls; none while none waits.
    thread: Option<u64>,
    started: u64,
    /// The call that it makes.
    running: Option<RunningCall>,
    /// Whose calls block a thread now. What an object blocks by its handlers is not held against it
    /// here: the safe outputs of a component that hangs are called in every case.
    blocked: Vec<ObjectName>,
}

struct Job {
    /// Whose code it is.
    object: ObjectName,
    run: Box<dyn FnOnce() + Send>,
    outcome: OutcomeFn,
}

/// One call that runs and is not late.
struct RunningCall {
    object: ObjectName,
    outcome: Arc<Mutex<OutcomeFn>>,
    /// For how long it was seen to run.
    seen: Duration,
}

impl Callbacks {
    /// Calls on threads of their own, each of which may take so long.
    pub(crate) fn on_threads(limit: Duration, arbiters: ArbiterPool) -> Self {
        let start = |name: &str, body| platform::start_thread(name, body).map(drop);
        Self::on_threads_of(Box::new(start), limit, arbiters)
    }

    /// The same, on threads that are started so.
    fn on_threads_of(start: StartThread, limit: Duration, arbiters: ArbiterPool) -> Self {
        Callbacks(Some(Arc::new(Threads { limit, start, arbiters, queue: Mutex::default() })))
    }

    /// Whether calls are made on threads of their own.
    pub(crate) fn have_threads(&self) -> bool {
        self.0.is_some()
    }

    /// How long a call may take; `None` where it cannot be observed.
    pub(crate) fn limit(&self) -> Option<Duration> {
        self.0.as_ref().map(|threads| threads.limit)
    }

    /// The next look at the call that runs, `since` after the one before.
    pub(crate) fn look(&self, since: Duration) {
        let Some(threads) = &self.0 else { return };
        threads.look(since);
        // Behind a call that blocks, others may wait.
        threads.serve();
    }

    /// Has code of the object called, behind what waits already. `outcome` is told what became of
    /// it. Where the system has no thread left, it is called on the caller's thread: that outputs
    /// are safe comes before all else.
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
        threads.serve();
    }
}

/// Calls a function; a panic in it is caught.
fn guarded(run: impl FnOnce()) -> CallOutcome {
    let _guarded = panics::PanicGuard::enter();
    match catch_unwind(AssertUnwindSafe(run)) {
        Ok(()) => CallOutcome::Done,
        Err(payload) => CallOutcome::Panicked(panics::read(payload).text),
    }
}

impl Queue {
    /// Each further call of an object that blocks so many threads might keep one more for ever.
    fn may_call(&self, object: &ObjectName) -> bool {
        self.blocked.iter().filter(|blocked| *blocked == object).count() < THREADS_OF_ONE
    }

    /// One call of the object that blocked a thread has returned.
    fn forget_blocked(&mut self, object: &ObjectName) {
        if let Some(at) = self.blocked.iter().position(|blocked| blocked == object) {
            self.blocked.swap_remove(at);
        }
    }
}

impl Threads {
    /// Abandons the thread whose call takes too long.
    fn look(&self, since: Duration) {
        let mut queue = lock(&self.queue);
        let Some(running) = &mut queue.running else { return };
        running.seen += since;
        if running.seen <= self.limit {
            return;
        }
        let Some(RunningCall { object, outcome, .. }) = queue.running.take() else { return };
        queue.thread = None;
        queue.blocked.push(object.clone());
        // Held until all is reported: see `work`.
        let tell = lock(&outcome);
        drop(queue);
        self.arbiters.note_abandoned(&object);
        tell(CallOutcome::Blocked(self.limit));
    }

    /// Sees that a thread makes the calls that wait.
    fn serve(self: &Arc<Self>) {
        let mut queue = lock(&self.queue);
        if queue.thread.is_some() || queue.waiting.is_empty() {
            return;
        }
        queue.started += 1;
        let number = queue.started;
        queue.thread = Some(number);
        drop(queue);
        let threads = self.clone();
        if (self.start)("safe-outputs", Box::new(move || threads.work(number))).is_err() {
            self.work(number);
        }
    }

    /// Makes calls until none waits, or until this thread is abandoned.
    fn work(self: &Arc<Self>, number: u64) {
        loop {
            let mut queue = lock(&self.queue);
            let Some(Job { object, run, outcome }) = queue.waiting.pop_front() else {
                queue.thread = None;
                return;
            };
            if !queue.may_call(&object) {
                drop(queue);
                outcome(CallOutcome::NotMade);
                continue;
            }
            let outcome = Arc::new(Mutex::new(outcome));
            let (of, seen) = (object.clone(), Duration::ZERO);
            queue.running = Some(RunningCall { object: of, outcome: outcome.clone(), seen });
            drop(queue);
            let result = guarded(run);
            let mut queue = lock(&self.queue);
            if queue.thread == Some(number) {
                queue.running = None;
                drop(queue);
                lock(&outcome)(result);
                continue;
            }
            // Another thread makes the calls now.
            queue.forget_blocked(&object);
            drop(queue);
            let tell = lock(&outcome);
            self.arbiters.note_returned(&object);
            tell(CallOutcome::ReturnedLate);
            return self.serve();
        }
    }
}

#[cfg(test)]
mod tests;
