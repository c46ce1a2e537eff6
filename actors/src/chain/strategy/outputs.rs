//! The application's declared safe outputs.

use crate::panics;
use blastema_core::Fault;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use tracing::error;

/// Called whenever something comes to safe rest. It must not block.
pub(crate) type Apply = Arc<dyn Fn(&Fault) + Send + Sync>;

/// The safe outputs of a node, and whether they are all applied already. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct SafeOutputs {
    apply: Option<Apply>,
    resting: Arc<AtomicBool>,
}

impl SafeOutputs {
    pub(crate) fn new(apply: Option<Apply>) -> Self {
        SafeOutputs { apply, resting: Arc::default() }
    }

    /// Something comes to rest. In a node that is at rest, nothing acts any more.
    pub(crate) fn apply(&self, fault: &Fault) {
        if !self.resting.load(Relaxed) {
            self.call(fault);
        }
    }

    /// The whole node comes to rest.
    pub(crate) fn rest(&self, fault: &Fault) {
        self.resting.store(true, Relaxed);
        self.call(fault);
    }

    /// The node is going to work again.
    pub(crate) fn resume(&self) {
        self.resting.store(false, Relaxed);
    }

    fn call(&self, fault: &Fault) {
        let Some(apply) = &self.apply else { return };
        let _guarded = panics::Guarded::enter();
        if let Err(payload) = catch_unwind(AssertUnwindSafe(|| apply(fault))) {
            // Rest goes on: what stops can do less harm than what does not.
            error!(text = panics::text_of(payload), "the safe outputs panicked");
        }
    }
}
