//! The application's declared safe outputs.

use crate::chain::callbacks::{CallOutcome, Callbacks};
use crate::host::environment::FaultReports;
use blastema_core::Fault;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, PoisonError};
use tokio::sync::oneshot;
use tracing::error;

/// Called whenever something enters the safe state.
pub(crate) type ApplyOutputs = Arc<dyn Fn(&Fault) + Send + Sync>;

/// Under this name stands what is wrong with the safe outputs.
pub(crate) const SAFE_OUTPUTS: &str = "safe-outputs";

/// The safe outputs of a node, and whether they are all applied already. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct SafeOutputs {
    apply: Option<ApplyOutputs>,
    callbacks: Callbacks,
    reports: FaultReports,
    resting: Arc<AtomicBool>,
}

impl SafeOutputs {
    pub(crate) fn new(
        apply: Option<ApplyOutputs>,
        callbacks: Callbacks,
        reports: FaultReports,
    ) -> Self {
        SafeOutputs { apply, callbacks, reports, resting: Arc::default() }
    }

    /// Whether the application has declared any.
    pub(crate) fn are_declared(&self) -> bool {
        self.apply.is_some()
    }

    /// Something comes to rest. In a node that is at rest, nothing acts any more.
    pub(crate) async fn apply(&self, fault: &Fault) {
        if !self.resting.load(Relaxed) {
            // It ends in every case: with an outcome, or with the thread that no system has any
            // more.
            let _ = self.call(fault).await;
        }
    }

    /// The whole node comes to rest. What is returned completes when the outputs are applied, or
    /// have taken longer than they may.
    pub(crate) fn rest(&self, fault: &Fault) -> oneshot::Receiver<()> {
        self.resting.store(true, Relaxed);
        self.call(fault)
    }

    /// The node is going to work again.
    pub(crate) fn resume(&self) {
        self.resting.store(false, Relaxed);
    }

    fn call(&self, fault: &Fault) -> oneshot::Receiver<()> {
        let (done, applied) = oneshot::channel();
        let Some(apply) = self.apply.clone() else {
            // Nobody waits yet.
            let _ = done.send(());
            return applied;
        };
        let (fault, reports, done) = (fault.clone(), self.reports.clone(), Mutex::new(Some(done)));
        self.callbacks.call(
            move || apply(&fault),
            move |outcome| {
                match outcome {
                    CallOutcome::Done => {}
                    // Rest goes on: what stops can do less harm than what does not.
                    CallOutcome::Panicked(text) => error!(text, "the safe outputs panicked"),
                    CallOutcome::Blocked(limit) => reports.declare(
                        SAFE_OUTPUTS,
                        format!("the safe outputs have blocked their thread for {limit:?}"),
                    ),
                    CallOutcome::ReturnedLate => reports.mend(SAFE_OUTPUTS),
                }
                if let Some(done) = done.lock().unwrap_or_else(PoisonError::into_inner).take() {
                    let _ = done.send(());
                }
            },
        );
        applied
    }
}
