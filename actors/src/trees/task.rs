//! A leaf that waits: one future for each start of it.

use super::actor::BehaviorTree;
use super::shared::TreeShared;
use crate::component::context::Context;
use blastema_trees::{LeafResult, LeafRun, PortError, PortValue};
use std::cell::Cell;
use std::pin::Pin;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

/// The future of a leaf.
pub(super) type LeafFuture = Pin<Box<dyn Future<Output = LeafResult>>>;
/// Makes the future of one start of a leaf.
pub(super) type MakeTask = Arc<dyn Fn(LeafTask) -> LeafFuture + Send + Sync>;

/// One start of a leaf that waits for something: its ports, and what its component can do. Given to
/// the function that [`TreeLeaves::task`](super::TreeLeaves::task) registers.
pub struct LeafTask {
    pub(super) shared: Rc<TreeShared>,
    pub(super) run: LeafRun,
    pub(super) sign: Rc<Cell<Duration>>,
    pub(super) cx: Context<BehaviorTree>,
}

impl LeafTask {
    /// The leaf's path in the tree.
    pub fn path(&self) -> String {
        self.shared.tree.borrow().path(self.run.node).to_owned()
    }

    /// The value of a port.
    ///
    /// # Errors
    /// It is not given, not written yet, or does not convert.
    pub fn input<T: PortValue>(&self, port: &str) -> Result<T, PortError> {
        self.optional_input(port)?.ok_or_else(|| PortError::Missing(port.into()))
    }

    /// The value of a port, or none where the tree does not give it.
    ///
    /// # Errors
    /// It is not written yet, or does not convert.
    pub fn optional_input<T: PortValue>(&self, port: &str) -> Result<Option<T>, PortError> {
        let mut tree = self.shared.tree.borrow_mut();
        tree.leaf_context(self.run).map_or(Ok(None), |leaf| leaf.optional_input(port))
    }

    /// Writes a port; nothing is written where the tree does not connect it.
    ///
    /// # Errors
    /// The entry keeps another type.
    pub fn output<T: PortValue>(&self, port: &str, value: T) -> Result<(), PortError> {
        let mut tree = self.shared.tree.borrow_mut();
        tree.leaf_context(self.run).map_or(Ok(()), |mut leaf| leaf.output(port, value))
    }

    /// The context of the tree's component, for senders, publishers, variables and commanders.
    pub fn context(&mut self) -> &mut Context<BehaviorTree> {
        &mut self.cx
    }

    /// Reports a sign of life: the leaf's [time limit](super::LeafRules::within) begins again.
    pub fn alive(&self) {
        self.sign.set(BehaviorTree::now());
    }
}
