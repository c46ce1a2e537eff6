//! The application's declared safe outputs.

use crate::platform::lock;
use crate::runtime::callbacks::{CallOutcome, Callbacks};
use crate::runtime::reports::FaultReports;
use blastema_core::{Fault, ObjectName};
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex};
use tokio::sync::oneshot;

/// Called whenever something enters the safe state.
pub(crate) type ApplyOutputs = Arc<dyn Fn(&Fault) + Send + Sync>;

/// Under this name stands what is wrong with the safe outputs.
pub(crate) const SAFE_OUTPUTS: &str = "safe-outputs";

/// The report of safe outputs that block.
pub(crate) const NOT_RETURNED: &str = "the safe outputs were called, and have not returned in time";

/// Whether the safe outputs were applied, or what is to be reported instead.
pub(crate) type Applied = Result<(), &'static str>;

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

    /// An object enters the safe state. In a node in the safe state, no component acts.
    pub(crate) async fn apply(&self, fault: &Fault) {
        if !self.resting.load(Relaxed) {
            // It ends in every case: with an outcome, or with the thread that no system has any
            // more.
            let _ = self.call(fault).await;
        }
    }

    /// The node enters the safe state. The returned future completes when the outputs are applied,
    /// or have taken longer than they may.
    pub(crate) fn rest(&self, fault: &Fault) -> oneshot::Receiver<Applied> {
        self.resting.store(true, Relaxed);
        self.call(fault)
    }

    /// The node is going to work again.
    pub(crate) fn resume(&self) {
        self.resting.store(false, Relaxed);
    }

    fn call(&self, fault: &Fault) -> oneshot::Receiver<Applied> {
        let (done, applied) = oneshot::channel();
        let Some(apply) = self.apply.clone() else {
            // The receiver was created above and is returned below.
            let _ = done.send(Ok(()));
            return applied;
        };
        let (fault, reports, done) = (fault.clone(), self.reports.clone(), Mutex::new(Some(done)));
        self.callbacks.call(
            &ObjectName::new(SAFE_OUTPUTS).expect("this name is well formed"),
            move || apply(&fault),
            move |outcome| {
                // The safe state is entered all the same: components that stop do less harm than
                // components that go on.
                let (detail, applied) = match outcome {
                    CallOutcome::Done => (None, Ok(())),
                    CallOutcome::ReturnedLate => {
                        reports.clear(SAFE_OUTPUTS);
                        (None, Ok(()))
                    }
                    CallOutcome::Panicked(text) => (
                        Some(format!("the safe outputs panicked: {text}")),
                        Err("the safe outputs panicked, and may be applied in part"),
                    ),
                    CallOutcome::Blocked(limit) => (
                        Some(format!("the safe outputs have blocked their thread for {limit:?}")),
                        Err(NOT_RETURNED),
                    ),
                    CallOutcome::NotMade => (
                        Some("the safe outputs were not called: too many calls block".to_owned()),
                        Err("the safe outputs were not called"),
                    ),
                };
                detail.into_iter().for_each(|detail| reports.declare(SAFE_OUTPUTS, detail));
                if let Some(done) = lock(&done).take() {
                    let _ = done.send(applied);
                }
            },
        );
        applied
    }
}
