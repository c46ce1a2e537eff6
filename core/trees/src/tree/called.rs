//! The leaf that is being called, as other threads see it.

use super::TreeNodeId;
use std::sync::Arc;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;

/// The leaf that a tree calls at the moment. Clones see the same tree, from any thread: so a leaf
/// that does not return is known by its node.
#[derive(Clone, Debug, Default)]
pub struct CalledLeaf(Arc<AtomicU32>);

impl CalledLeaf {
    /// The leaf, while it is called.
    pub fn node(&self) -> Option<TreeNodeId> {
        self.0.load(Relaxed).checked_sub(1).map(TreeNodeId)
    }

    pub(super) fn set(&self, node: Option<TreeNodeId>) {
        // A tree has 65,535 nodes at most.
        self.0.store(node.map_or(0, |node| node.0 + 1), Relaxed);
    }
}
