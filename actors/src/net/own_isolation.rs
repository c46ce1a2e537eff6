//! That another node had this one's name before, and this one is refused by all.

use blastema_core::{DeliveryError, Incarnation, NodeName};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;

/// Whether this node is refused. Clones are the same.
#[derive(Clone)]
pub(super) struct OwnIsolation {
    node: NodeName,
    /// The incarnation of the other one; no incarnation has the number 0.
    other: Arc<AtomicU64>,
}

impl OwnIsolation {
    pub(super) fn new(node: NodeName) -> Self {
        OwnIsolation { node, other: Arc::default() }
    }

    /// This incarnation of another node has the name.
    pub(super) fn set_name_taken(&self, other: Incarnation) {
        self.other.store(other.0, Relaxed);
    }

    /// A session was opened, or no node has refused this one for a while.
    pub(super) fn clear(&self) {
        self.other.store(0, Relaxed);
    }

    /// Why no session begins.
    pub(super) fn why(&self) -> DeliveryError {
        match self.other.load(Relaxed) {
            0 => DeliveryError::Restarting,
            incarnation => DeliveryError::NameTaken {
                name: self.node.to_string(),
                by: Incarnation(incarnation).to_string(),
            },
        }
    }
}
