//! The leaves of the application, and what the driver decides about them from outside.

use super::NodeAnswer;
use super::called::CalledLeaf;
use super::leaf::{Halt, Leaf, LeafContext, LeafRun, LeafState};
use super::{TickProblem, Tree, TreeNodeId};
use crate::model::{Kind, LeafKind};
use crate::status::Status;
use std::any::Any;
use std::sync::Arc;
use std::time::Duration;

impl Tree {
    pub(super) fn tick_leaf(&mut self, id: TreeNodeId, kind: LeafKind) -> NodeAnswer {
        let part = self.node(id).part as usize;
        let status = self.node(id).status;
        let state = &mut self.leaves[part];
        if let Some(answer) = state.answer.take() {
            state.deferred = false;
            return Ok(answer);
        }
        // A finished action is not called until its parent has reset it.
        if kind == LeafKind::Action && status.is_completed() {
            return Ok(status);
        }
        let runs = kind == LeafKind::Action && status == Status::Running && !state.deferred;
        // A panic has taken the leaf: what it did is not known.
        if runs && state.leaf.is_none() {
            return Ok(Status::Failure);
        }
        if !runs {
            state.deferred = kind != LeafKind::Condition && !self.halting.is_empty();
            if state.deferred {
                return Ok(Status::Running);
            }
            state.since = self.clock.now;
            state.starts = state.starts.wrapping_add(1);
        }
        let call = if runs { <dyn Leaf>::running } else { <dyn Leaf>::start };
        let answer = self.with_leaf(id, call);
        let answer = answer.map_err(|error| self.failed(id, TickProblem::Leaf(error)))?;
        if kind == LeafKind::SyncAction {
            match answer {
                Status::Running => return Err(self.may_not_answer(id, answer)),
                // As in the library, which looks at its conditions again then.
                Status::Skipped => self.node_mut(id).status = Status::Skipped,
                _ => {}
            }
        }
        Ok(answer)
    }

    /// Calls a leaf. Meanwhile it is out of the arena, so that a panic takes it away.
    fn with_leaf<R>(
        &mut self,
        id: TreeNodeId,
        call: impl FnOnce(&mut dyn Leaf, &mut LeafContext<'_>) -> R,
    ) -> R {
        let state = self.leaf_mut(id);
        let mut leaf = state.leaf.take().unwrap_or_else(|| (state.model.make)());
        let run = LeafRun { node: id, start: state.starts };
        self.calling.set(Some(id));
        let result = call(&mut *leaf, &mut LeafContext { tree: self, run });
        self.calling.set(None);
        self.leaf_mut(id).leaf = Some(leaf);
        result
    }

    pub(super) fn leaf(&self, id: TreeNodeId) -> &LeafState {
        &self.leaves[self.node(id).part as usize]
    }

    fn leaf_mut(&mut self, id: TreeNodeId) -> &mut LeafState {
        let part = self.node(id).part as usize;
        &mut self.leaves[part]
    }

    /// Halts a leaf that runs.
    pub(super) fn halt_leaf(&mut self, id: TreeNodeId) {
        let state = self.leaf(id);
        let run = LeafRun { node: id, start: state.starts };
        // A leaf that has been completed has nothing to halt.
        let halts = self.runs(state) && state.leaf.is_some() && state.answer.is_none();
        let state = self.leaf_mut(id);
        (state.answer, state.deferred) = (None, false);
        if !halts {
            return;
        }
        if self.with_leaf(id, |leaf, cx| leaf.halt(cx)) == Halt::Pending {
            self.halting.push((run, self.clock.now));
        }
    }

    /// Asks the leaves that have been halted whether they have come to rest.
    pub(super) fn poll_halting(&mut self) {
        for index in (0..self.halting.len()).rev() {
            let (run, _) = self.halting[index];
            let lost = self.leaf(run.node).leaf.is_none();
            if lost || self.with_leaf(run.node, |leaf, cx| leaf.halting(cx)) == Halt::Done {
                self.halting.remove(index);
            }
        }
    }

    /// The actions that run, with the time of their start; a driver that limits them looks here.
    pub fn running(&self) -> impl Iterator<Item = (LeafRun, Duration)> + '_ {
        let running = self.leaves.iter().filter(|state| self.runs(state));
        running.map(|state| (LeafRun { node: state.node, start: state.starts }, state.since))
    }

    /// The leaves that have not come to rest since they were halted, with the time of that. No
    /// action of the tree starts meanwhile; a driver that limits this looks here.
    pub fn halting(&self) -> impl Iterator<Item = (LeafRun, Duration)> + '_ {
        self.halting.iter().copied()
    }

    /// Drops the leaves that have not come to rest. They are made again for their next start.
    pub fn drop_halting(&mut self) {
        while let Some((run, _)) = self.halting.pop() {
            self.leaf_mut(run.node).leaf = None;
        }
    }

    /// The leaf that is being called, for a thread that watches the one that ticks, and, after the
    /// driver has caught a panic, the leaf that panicked in the last tick or halt.
    ///
    /// The value of such a leaf is gone and is made again for its next start. The driver can go on,
    /// and the leaf fails in the next tick if it was RUNNING, or it [halts](Tree::halt) the tree.
    pub fn called(&self) -> CalledLeaf {
        self.calling.clone()
    }

    /// Lends the leaves what they use beside their ports: [`LeafContext::lent`].
    pub fn lend<T: Any + Send + Sync>(&mut self, services: Arc<T>) {
        self.lent = Some(services);
    }

    /// Answers for a leaf that runs: the next tick sees it. For one that is coming to rest after a
    /// halt, it is the end of that. False if the run is over, and nothing changes.
    pub fn complete(&mut self, run: LeafRun, status: Status) -> bool {
        if let Some(index) = self.halting.iter().position(|(halting, _)| *halting == run) {
            self.halting.remove(index);
            return true;
        }
        let current = self.is_current(run) && status.is_completed();
        if current {
            self.answer(run.node, Some(status));
        }
        current
    }

    /// Sets the answer of a leaf's next tick; none starts the leaf again.
    fn answer(&mut self, node: TreeNodeId, answer: Option<Status>) {
        let state = self.leaf_mut(node);
        (state.answer, state.deferred) = (answer, answer.is_none());
        self.wake_at(self.clock.now);
    }

    /// Lets a leaf fail when it is ticked next, after an error, a panic, or its time limit. It is
    /// halted where it runs. False if the node is no leaf of the application.
    pub fn fail(&mut self, node: TreeNodeId, now: Duration) -> bool {
        self.stop(node, now, Some(Status::Failure))
    }

    /// Starts a leaf again in the next tick; its parents take it for RUNNING meanwhile. It is
    /// halted where it runs. False if the node is no leaf of the application.
    pub fn retry(&mut self, node: TreeNodeId, now: Duration) -> bool {
        self.stop(node, now, None)
    }

    fn stop(&mut self, node: TreeNodeId, now: Duration, answer: Option<Status>) -> bool {
        let is_leaf = matches!(self.node(node).kind, Kind::Leaf(_));
        if is_leaf {
            self.clock.now = self.clock.now.max(now);
            self.halt_leaf(node);
            self.answer(node, answer);
        }
        is_leaf
    }

    fn is_current(&self, run: LeafRun) -> bool {
        let state = self.leaf(run.node);
        self.runs(state) && state.starts == run.start
    }

    fn runs(&self, state: &LeafState) -> bool {
        let node = self.node(state.node);
        let is_action = node.kind == Kind::Leaf(LeafKind::Action);
        is_action && node.status == Status::Running && !state.deferred
    }

    /// The context of a leaf that runs, for a driver that reads its ports or writes its results.
    pub fn leaf_context(&mut self, run: LeafRun) -> Option<LeafContext<'_>> {
        self.is_current(run).then_some(LeafContext { tree: self, run })
    }
}
