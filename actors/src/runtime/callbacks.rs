//! Calls of the application's code by the middleware: recovery strategies and safe outputs.
//!
//! None of it runs on the fault chain's thread. A strategy has an arbiter of its own. Safe outputs
//! are called one after the other on a thread that is started for them. Each call is entered here
//! while it runs, and the thread that [watches the chain](crate::fault_chain::outside) finds those
//! that take longer than the limit: the call is reported under its name, its thread is abandoned,
//! and the calls that wait behind it go on on a fresh one.
//!
//! Whether a call returned in time is decided once, under the lock of its stage. A call that
//! returns while its delay is being reported waits for the end of that report, so that each thread
//! that is counted as lost is counted as returned afterwards.
//!
//! In a node that runs on one thread, as tests under a paused clock do, calls are made where they
//! are asked for.

use crate::arbiter::pool::{ArbiterPool, THREADS_OF_ONE};
use crate::platform;
use crate::platform::lock;
use crate::platform::panics;
use crate::runtime::reports::FaultReports;
use blastema_core::ObjectName;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, OnceLock};
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
type LateFn = Box<dyn FnOnce(Duration) + Send>;

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
    /// The calls that run and are not late, each with the time for which it was seen to run. At
    /// most one a thread.
    running: Mutex<Vec<(Duration, Arc<ActiveCall>)>>,
    queue: Mutex<Queue>,
    reports: OnceLock<FaultReports>,
}

/// One call that is observed.
struct ActiveCall {
    /// Whose code it is.
    object: ObjectName,
    stage: Mutex<CallStage>,
}

/// How far a call has come.
enum CallStage {
    /// It runs; this is to be called if it takes too long.
    Running(LateFn),
    /// It takes too long, which was reported.
    Blocked,
    Returned,
}

/// Calls of safe outputs that wait: no more than components and actuators enter the safe state at
/// once.
#[derive(Default)]
struct Queue {
    waiting: VecDeque<Job>,
    /// The thread that makes the calls; none while none waits.
    thread: Option<u64>,
    started: u64,
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

impl ActiveCall {
    /// It takes too long, unless it has returned meanwhile.
    fn handle_late(&self, threads: &Threads) {
        let mut stage = lock(&self.stage);
        match std::mem::replace(&mut *stage, CallStage::Blocked) {
            // The lock is held until all is reported: see `RunningCall::end`.
            CallStage::Running(late) => {
                threads.arbiters.note_abandoned(&self.object);
                late(threads.limit);
            }
            decided => *stage = decided,
        }
    }
}

/// One call that runs now.
pub(crate) struct RunningCall {
    threads: Arc<Threads>,
    call: Arc<ActiveCall>,
}

impl RunningCall {
    /// It has returned. Says whether that was in time; if not, its delay has been reported.
    pub(crate) fn end(self) -> bool {
        let RunningCall { threads, call } = self;
        lock(&threads.running).retain(|(_, other)| !Arc::ptr_eq(other, &call));
        let stage = std::mem::replace(&mut *lock(&call.stage), CallStage::Returned);
        let in_time = !matches!(stage, CallStage::Blocked);
        if !in_time {
            threads.arbiters.note_returned(&call.object);
        }
        in_time
    }
}

impl Callbacks {
    /// Calls on threads of their own, each of which may take so long.
    pub(crate) fn on_threads(limit: Duration, arbiters: ArbiterPool) -> Self {
        let start = |name: &str, body| platform::start_thread(name, body).map(drop);
        Self::on_threads_of(Box::new(start), limit, arbiters)
    }

    /// The same, on threads that are started so.
    fn on_threads_of(start: StartThread, limit: Duration, arbiters: ArbiterPool) -> Self {
        Callbacks(Some(Arc::new(Threads {
            limit,
            start,
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

    /// A call of this object's code begins on this thread. Where it takes longer than the limit,
    /// the thread counts as abandoned, and `late` is called on another one. It must not wait for
    /// the call.
    pub(crate) fn enter(
        &self,
        object: &ObjectName,
        late: impl FnOnce(Duration) + Send + 'static,
    ) -> Option<RunningCall> {
        Some(self.0.as_ref()?.enter(object, Box::new(late)))
    }

    /// The next look at the calls that run, `since` after the one before.
    pub(crate) fn look(&self, since: Duration) {
        let Some(threads) = &self.0 else { return };
        let late: Vec<(Duration, Arc<ActiveCall>)> = {
            let mut running = lock(&threads.running);
            running.iter_mut().for_each(|(seen, _)| *seen += since);
            running.extract_if(.., |(seen, _)| *seen > threads.limit).collect()
        };
        late.iter().for_each(|(_, call)| call.handle_late(threads));
        // Behind a call that blocks, others may wait.
        threads.serve();
    }

    /// A fault of `object`, whose code blocks a thread.
    pub(crate) fn declare(&self, object: &ObjectName, detail: String) {
        if let Some(reports) = self.0.as_ref().and_then(|threads| threads.reports.get()) {
            reports.declare(object.as_str(), detail);
        }
    }

    /// What was declared of `object` is over.
    pub(crate) fn clear(&self, object: &ObjectName) {
        if let Some(reports) = self.0.as_ref().and_then(|threads| threads.reports.get()) {
            reports.clear(object.as_str());
        }
    }

    /// Whether code of this object may be called once more.
    ///
    /// # Errors
    /// It keeps its share of threads already.
    pub(crate) fn check_share(&self, object: &ObjectName) -> std::io::Result<()> {
        self.0.as_ref().map_or(Ok(()), |threads| threads.arbiters.check_share(object))
    }

    /// Has safe outputs of the object called, behind those that wait already. `outcome` is told what
    /// became of it. Where the system has no thread left, they are called on the caller's thread:
    /// that outputs are safe comes before all else.
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
    fn enter(self: &Arc<Self>, object: &ObjectName, late: LateFn) -> RunningCall {
        let (object, stage) = (object.clone(), Mutex::new(CallStage::Running(late)));
        let call = Arc::new(ActiveCall { object, stage });
        lock(&self.running).push((Duration::ZERO, call.clone()));
        RunningCall { threads: self.clone(), call }
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
            let (Job { object, run, outcome }, may_call) = {
                let mut queue = lock(&self.queue);
                let Some(job) = queue.waiting.pop_front() else {
                    queue.thread = None;
                    return;
                };
                let may_call = queue.may_call(&job.object);
                (job, may_call)
            };
            if !may_call {
                outcome(CallOutcome::NotMade);
                continue;
            }
            let outcome = Arc::new(Mutex::new(outcome));
            let (threads, report, culprit) = (self.clone(), outcome.clone(), object.clone());
            let late = move |limit| {
                let mut queue = lock(&threads.queue);
                queue.thread.take_if(|thread| *thread == number);
                queue.blocked.push(culprit);
                drop(queue);
                lock(&report)(CallOutcome::Blocked(limit));
            };
            let call = self.enter(&object, Box::new(late));
            let result = guarded(run);
            if call.end() {
                lock(&outcome)(result);
                continue;
            }
            // Another thread makes the calls now.
            lock(&self.queue).forget_blocked(&object);
            lock(&outcome)(CallOutcome::ReturnedLate);
            return self.serve();
        }
    }
}

#[cfg(test)]
mod tests;
