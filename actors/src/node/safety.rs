//! What is done for the robot's safety when a program ends otherwise than by [`Node::shutdown`].
//!
//! Nothing can be awaited then. The safe outputs and cut-offs are called on their own thread, and
//! safe commands are put into the queues of actuators; for as long as a call may take, the thread
//! that ends the program waits for them.

use super::{NodeState, Shared};
use crate::actuator::ActuatorTable;
use crate::arbiter::heartbeat::ArbiterHeartbeat;
use crate::fault_chain::strategy::NOT_RETURNED;
use crate::platform::signals::{Termination, Terminations, on_termination};
use crate::platform::{self, lock};
use blastema_core::{Fault, FaultKind};
use std::sync::atomic::Ordering::SeqCst;
use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, Weak};
use std::time::Duration;
use std::{fmt, io};
use tokio::sync::oneshot::error::TryRecvError;
use tracing::warn;

/// How often it is looked whether the outputs are safe.
const POLL_INTERVAL: Duration = Duration::from_millis(1);

/// The nodes of this process, which signals end.
static NODES: Mutex<Vec<Weak<Shared>>> = Mutex::new(Vec::new());
/// How long a process may take beyond the longest `shutdown_within` of a component, and again beyond
/// the calls that make its outputs safe. With the usual limit of a call that is a second in all.
const LAST_STEPS: Duration = Duration::from_millis(250);

/// The callers of [`Node::run_until_signal`] and [`NodeBuilder::run_until`](super::NodeBuilder::run_until).
static WAITING: AtomicUsize = AtomicUsize::new(0);

fn nodes() -> MutexGuard<'static, Vec<Weak<Shared>>> {
    // Each change is one insertion or removal.
    lock(&NODES)
}

/// What is known of the outputs of a node.
#[derive(Default)]
pub(super) struct OutputState {
    /// Components have begun, so that outputs may have to be made safe.
    pub(super) begun: AtomicBool,
    /// The safe outputs were applied without the fault chain.
    safe: Mutex<bool>,
}

impl Shared {
    /// Has SIGTERM, SIGINT and SIGHUP apply the safe outputs and close the journal, if this node
    /// has any.
    pub(super) fn apply_safe_outputs_on_signals(self: &Arc<Self>) -> io::Result<()> {
        if !self.chain.safe_outputs.are_declared() {
            for actuator in self.environment.feature::<ActuatorTable>().without_cut_off() {
                warn!(%actuator, "nothing stops this actuator if its component hangs: declare a cut_off, or safe_outputs of the node");
            }
        }
        let mut nodes = nodes();
        nodes.retain(|node| node.strong_count() > 0);
        nodes.push(Arc::downgrade(self));
        drop(nodes);
        if self.has_outputs() || self.chain.keeps_journal() { handle_signals() } else { Ok(()) }
    }

    /// Applies the safe outputs and cuts the actuators off, from whichever thread this is; once.
    /// Says on standard error and in the log that the node ends otherwise than in order, for this
    /// cause, and what came of its outputs. Nothing is done, or said, for a node that has stopped
    /// or is in the safe state, nor for one without outputs that never came to work.
    pub(super) fn become_safe(&self, cause: &str) {
        let has_outputs = self.has_outputs();
        let ends = match *self.chain.state.borrow() {
            NodeState::Starting => has_outputs,
            NodeState::Running => true,
            NodeState::InSafeState { .. } | NodeState::Stopped => false,
        };
        // Where another thread makes it safe now, that is awaited.
        if ends || self.is_safe() {
            self.make_safe(cause);
        }
    }

    /// The same, whatever the node's state. Another caller waits meanwhile.
    pub(super) fn make_safe(&self, cause: &str) {
        let mut is_safe = lock(&self.outputs.safe);
        if std::mem::replace(&mut *is_safe, true) {
            return;
        }
        let has_outputs = self.has_outputs();
        let outcome =
            if has_outputs { self.apply_outputs(cause) } else { "it has no safe outputs" };
        // A node that runs on one thread belongs to a test, which has its own output.
        if self.chain.callbacks.have_threads() {
            platform::tell_of_node(&format!("node {}: {cause}: {outcome}", self.name));
        }
        warn!(node = %self.name, cause, "{outcome}");
    }

    /// Whether its outputs were made safe, once that is done.
    pub(super) fn is_safe(&self) -> bool {
        *lock(&self.outputs.safe)
    }

    fn has_outputs(&self) -> bool {
        self.chain.safe_outputs.are_declared()
            || !self.environment.feature::<ActuatorTable>().is_empty()
    }

    /// What is to be said of the outputs, once they are safe or have taken longer than they may.
    fn apply_outputs(&self, cause: &str) -> &'static str {
        let actuators = self.environment.feature::<ActuatorTable>();
        let now = platform::now();
        let fault =
            Fault::of_node(self.name.clone(), FaultKind::NodeInSafeState, cause.into(), now);
        let mut applied = self.chain.safe_outputs.rest(&fault);
        actuators.rest();
        let mut left = self.chain.callbacks.limit().unwrap_or_default();
        let mut known = Err(NOT_RETURNED);
        let outcome = loop {
            let ended = match applied.try_recv() {
                Ok(end) => {
                    known = end;
                    true
                }
                Err(TryRecvError::Empty) => false,
                Err(TryRecvError::Closed) => true,
            };
            if ended && (actuators.are_at_rest() || ArbiterHeartbeat::beats_here()) {
                break known;
            }
            if left.is_zero() {
                break known;
            }
            platform::wait(POLL_INTERVAL);
            left = left.saturating_sub(POLL_INTERVAL);
        };
        match outcome {
            Err(why) => why,
            Ok(()) if self.chain.safe_outputs.are_declared() => "safe outputs applied",
            Ok(()) if actuators.are_at_rest() => "its actuators are at rest",
            Ok(()) => "its actuators have not all carried out their safe commands",
        }
    }
}

/// A signal has come, and another one may.
fn handle_signal(signal: Termination, is_first: bool) {
    if !is_first || WAITING.load(SeqCst) == 0 {
        return end_all(signal);
    }
    // The caller that waits shuts its node down in order. If a component, or the caller, hangs, the
    // process ends all the same.
    let longest = |node: &Arc<Shared>| node.environment.longest_stop_ms.load(SeqCst);
    let longest = alive().iter().map(longest).max().unwrap_or_default();
    let wait = Duration::from_millis(longest).saturating_add(LAST_STEPS);
    let overdue = move || {
        platform::wait(wait);
        if WAITING.load(SeqCst) > 0 {
            end_all(signal);
        }
    };
    if platform::start_thread("signal-limit", overdue).is_err() {
        end_all(signal);
    }
}

/// Whether a caller runs a node of this process until it ends, so that the process ends with it.
pub(super) fn is_waited_for() -> bool {
    WAITING.load(SeqCst) > 0
}

fn alive() -> Vec<Arc<Shared>> {
    nodes().iter().filter_map(Weak::upgrade).collect()
}

/// Ends the process, its outputs safe. Neither a log nor an output that blocks keeps it.
fn end_all(signal: Termination) {
    let nodes = alive();
    let call = nodes.iter().filter_map(|node| node.chain.callbacks.limit()).max();
    let end_late = move || {
        platform::wait(call.unwrap_or_default() + LAST_STEPS);
        platform::end_process(signal.exit_code())
    };
    // Where the system has no thread left, nothing bounds what follows.
    let _ = platform::start_thread("signal-end", end_late);
    nodes.iter().for_each(|node| node.end(signal.name()));
    platform::end_process(signal.exit_code())
}

/// Handles signals from now on, for all nodes of the process.
fn handle_signals() -> io::Result<()> {
    static STARTED: OnceLock<()> = OnceLock::new();
    static STARTING: Mutex<()> = Mutex::new(());
    let _one = lock(&STARTING);
    if STARTED.get().is_none() {
        let mut is_first = true;
        on_termination(move |signal| {
            handle_signal(signal, is_first);
            is_first = false;
        })?;
        // It was seen to be empty under the lock.
        let _ = STARTED.set(());
    }
    Ok(())
}

/// What ends a node that runs to its end: a signal, or else the program.
#[derive(Clone, Copy, Debug)]
pub(super) struct EndCause(Option<Termination>);

impl EndCause {
    /// The exit status of a process that this signal ended.
    pub(super) fn exit_code(self) -> Option<i32> {
        self.0.map(Termination::exit_code)
    }
}

impl fmt::Display for EndCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0.map_or("the program", Termination::name))
    }
}

/// While it is there, the first signal shuts a node down and does not end the process.
pub(super) struct SignalWait(Terminations);

impl SignalWait {
    pub(super) fn begin() -> io::Result<Self> {
        let terminations = Terminations::listen()?;
        WAITING.fetch_add(1, SeqCst);
        let wait = SignalWait(terminations);
        handle_signals()?;
        Ok(wait)
    }

    /// Resolves at the first signal, or with `end`.
    pub(super) async fn cause(&mut self, end: impl Future<Output = ()>) -> EndCause {
        tokio::select! {
            signal = self.0.next() => EndCause(Some(signal)),
            () = end => EndCause(None),
        }
    }
}

impl Drop for SignalWait {
    fn drop(&mut self) {
        WAITING.fetch_sub(1, SeqCst);
    }
}
