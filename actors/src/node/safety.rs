//! What is done for the robot's safety when a program ends otherwise than by [`Node::shutdown`].
//!
//! Nothing can be awaited then. The safe outputs and cut-offs are called on their own thread, and
//! safe commands are
//! put into the queues of actuators; for as long as a call may take, the thread that ends the
//! program waits for them.

use super::{Node, NodeState, Shared};
use crate::arbiter::heartbeat::ArbiterHeartbeat;
use crate::fault_chain::strategy::NOT_RETURNED;
use crate::platform;
use crate::platform::signals::{Termination, Terminations, on_termination};
use blastema_core::{Fault, FaultKind};
use std::io;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError, Weak};
use std::time::Duration;
use tokio::sync::oneshot::error::TryRecvError;
use tracing::{info, warn};

/// How often it is looked whether the outputs are safe.
const LOOK: Duration = Duration::from_millis(1);

/// The nodes of this process whose safe outputs signals apply: those that have any, and have not
/// ended.
static NODES: Mutex<Vec<Weak<Shared>>> = Mutex::new(Vec::new());
/// Who waits in [`Node::run_until_signal`] for the first signal.
static WAITING: AtomicUsize = AtomicUsize::new(0);

fn nodes() -> MutexGuard<'static, Vec<Weak<Shared>>> {
    // Each change is one insertion or removal.
    NODES.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    /// Applies the safe outputs and cuts the actuators off, from whichever thread this is, and says
    /// so; once. Nothing
    /// is done for a node that has none, has stopped, or is at rest.
    pub(super) fn become_safe(&self, cause: &str) {
        let outputs = &self.chain.safe_outputs;
        let actuators = self.environment.actuators();
        let works = matches!(*self.state.borrow(), NodeState::Starting | NodeState::Running);
        let has_none = !outputs.are_declared() && actuators.is_empty();
        if !works || has_none {
            return;
        }
        if self.safe.swap(true, SeqCst) {
            return;
        }
        let now = platform::now();
        let fault = Fault::of_node(self.name.clone(), FaultKind::NodeAtRest, cause.into(), now);
        let mut applied = outputs.rest(&fault);
        actuators.rest();
        let mut left = self.chain.callbacks.limit().unwrap_or_default();
        let mut known = Err(NOT_RETURNED);
        let said = loop {
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
            platform::wait(LOOK);
            left = left.saturating_sub(LOOK);
        };
        let said = said.err().unwrap_or("safe outputs applied");
        // A node that runs on one thread belongs to a test, which has its own output.
        if self.chain.callbacks.have_threads() {
            platform::tell_person(&format!("blastema: node {}: {cause}: {said}", self.name));
        }
        warn!(node = %self.name, cause, "{said}");
    }
}

/// A signal has come, and another one may.
fn handle_signal(signal: Termination, is_first: bool) {
    if is_first && WAITING.load(SeqCst) > 0 {
        return; // Who waits shuts the node down in order.
    }
    let alive: Vec<_> = nodes().iter().filter_map(Weak::upgrade).collect();
    alive.iter().for_each(|node| node.become_safe(signal.name()));
    platform::end_process(signal.exit_code())
}

/// Handles signals from now on, for all nodes of the process.
fn handle_signals() -> io::Result<()> {
    static STARTED: OnceLock<()> = OnceLock::new();
    static STARTING: Mutex<()> = Mutex::new(());
    let _one = STARTING.lock().unwrap_or_else(PoisonError::into_inner);
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

impl Node {
    /// Has SIGTERM and SIGINT apply the safe outputs, if this node has any.
    pub(super) fn apply_safe_outputs_on_signals(&self) -> io::Result<()> {
        let outputs = self.0.chain.safe_outputs.are_declared();
        if !outputs && self.0.environment.actuators().is_empty() {
            return Ok(());
        }
        let mut nodes = nodes();
        nodes.retain(|node| node.strong_count() > 0);
        nodes.push(std::sync::Arc::downgrade(&self.0));
        drop(nodes);
        handle_signals()
    }

    /// Waits for SIGTERM or SIGINT (Ctrl-C), and [shuts down](Node::shutdown) in order. A second
    /// signal during that
    /// applies the safe outputs and ends the process at once. Returns too when the node was shut
    /// down otherwise; a
    /// node in the safe state waits on, so that a person can look at it.
    ///
    /// ```no_run
    /// use blastema::prelude::*;
    /// # struct Lamp;
    /// # impl Component for Lamp {}
    ///
    /// #[blastema::main]
    /// async fn main() -> Result<(), Box<dyn std::error::Error>> {
    ///     let node = Node::builder("module1").child(ChildSpec::new("lamp", ||
    /// Lamp)).start().await?;
    ///     node.run_until_signal().await?;
    ///     Ok(())
    /// }
    /// ```
    ///
    /// # Errors
    /// The operating system does not tell of signals.
    pub async fn run_until_signal(&self) -> io::Result<()> {
        struct Waits;
        impl Drop for Waits {
            fn drop(&mut self) {
                WAITING.fetch_sub(1, SeqCst);
            }
        }
        let mut terminations = Terminations::listen()?;
        WAITING.fetch_add(1, SeqCst);
        let _waits = Waits;
        handle_signals()?;
        let mut state = self.0.state.clone();
        tokio::select! {
            signal = terminations.next() => {
                info!(node = %self.0.name, signal = signal.name(), "the node is shut down");
                self.shutdown().await;
            }
            // Also where nobody is left who could say so.
            _ = state.wait_for(|state| *state == NodeState::Stopped) => {}
        }
        Ok(())
    }
}
