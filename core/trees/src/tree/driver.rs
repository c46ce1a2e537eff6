//! The leaves of the application, and what the driver decides about them from outside.

use super::execute::Tick;
use super::leaf::{Halt, Leaf, LeafContext, LeafRun, LeafState};
use super::{TickProblem, Tree, TreeNodeId};
use crate::model::{Kind, LeafKind};
use crate::status::Status;
use std::time::Duration;

impl Tree {
    pub(super) fn tick_leaf(&mut self, id: TreeNodeId, kind: LeafKind) -> Tick {
        let part = self.node(id).part as usize;
        let status = self.node(id).status;
        let state = &mut self.leaves[part];
        if let Some(answer) = state.answer.take() {
            state.deferred = false;
            return Ok(answer);
        }
        let running = status == Status::Running && !state.deferred;
        if kind == LeafKind::Action {
            // A finished action is not called until its parent has reset it.
            if status.is_completed() {
                return Ok(status);
            }
            if running {
                // A panic has taken the body: what it did is not known.
                return match &state.body {
                    Some(_) => {
                        let answer = self.with_body(id, |body, cx| body.running(cx));
                        answer.map_err(|error| self.error(id, TickProblem::Leaf(error)))
                    }
                    None => Ok(Status::Failure),
                };
            }
        }
        if kind != LeafKind::Condition && !self.halting.is_empty() {
            state.deferred = true;
            return Ok(Status::Running);
        }
        state.deferred = false;
        state.since = self.now;
        state.starts = state.starts.wrapping_add(1);
        let answer = self.with_body(id, |body, cx| body.start(cx));
        let answer = answer.map_err(|error| self.error(id, TickProblem::Leaf(error)))?;
        if kind == LeafKind::SyncAction {
            match answer {
                Status::Running => return Err(self.error(id, TickProblem::Answer(answer))),
                // As in the library, which looks at its conditions again then.
                Status::Skipped => self.node_mut(id).status = Status::Skipped,
                _ => {}
            }
        }
        Ok(answer)
    }

    /// Calls a leaf. Meanwhile it is out of the arena, so that a panic takes it away.
    fn with_body<R>(
        &mut self,
        id: TreeNodeId,
        call: impl FnOnce(&mut dyn Leaf, &mut LeafContext<'_>) -> R,
    ) -> R {
        let leaf = self.node(id).part;
        let state = &mut self.leaves[leaf as usize];
        let mut body = state.body.take().unwrap_or_else(|| (state.model.make)());
        let run = LeafRun { node: id, leaf, start: state.starts };
        self.calling = Some(id);
        let result = call(&mut *body, &mut LeafContext { tree: self, run });
        self.calling = None;
        self.leaves[leaf as usize].body = Some(body);
        result
    }

    /// Halts a leaf that runs.
    pub(super) fn halt_leaf(&mut self, id: TreeNodeId) {
        let leaf = self.node(id).part;
        let state = &self.leaves[leaf as usize];
        let run = LeafRun { node: id, leaf, start: state.starts };
        let halts = self.runs(state) && state.body.is_some();
        let state = &mut self.leaves[leaf as usize];
        (state.answer, state.deferred) = (None, false);
        if !halts {
            return;
        }
        if self.with_body(id, |body, cx| body.halt(cx)) == Halt::Pending {
            self.halting.push(run);
        }
    }

    /// Asks the leaves that have been halted whether they have come to rest.
    pub(super) fn poll_halting(&mut self) {
        for index in (0..self.halting.len()).rev() {
            let run = self.halting[index];
            let lost = self.leaves[run.leaf as usize].body.is_none();
            if lost || self.with_body(run.node, |body, cx| body.halting(cx)) == Halt::Done {
                self.halting.remove(index);
            }
        }
    }

    /// The actions that run, with the time of their start; a driver that limits them looks here.
    pub fn running(&self) -> impl Iterator<Item = (LeafRun, Duration)> + '_ {
        self.leaves.iter().zip(0..).filter(|(state, _)| self.runs(state)).map(|(state, leaf)| {
            (LeafRun { node: state.node, leaf, start: state.starts }, state.since)
        })
    }

    /// The leaf that panicked in the last tick or halt, after the driver has caught the panic.
    ///
    /// Its value is gone and is made again for its next start. The driver can go on, and the leaf
    /// fails in the next tick if it was RUNNING, or it [halts](Tree::halt) the tree.
    pub fn panicked(&self) -> Option<TreeNodeId> {
        self.calling
    }

    /// Answers for a leaf that runs: the next tick sees it. For one that is coming to rest after a
    /// halt, it is the end of that. False if the run is over, and nothing changes.
    pub fn complete(&mut self, run: LeafRun, status: Status) -> bool {
        if let Some(index) = self.halting.iter().position(|halting| *halting == run) {
            self.halting.remove(index);
            return true;
        }
        let current = self.is_current(run) && status.is_completed();
        if current {
            self.leaves[run.leaf as usize].answer = Some(status);
            self.wake_at(self.now);
        }
        current
    }

    /// Halts a leaf that takes too long, and lets it fail. False if the run is over.
    pub fn fail(&mut self, run: LeafRun, now: Duration) -> bool {
        self.stop(run, now) && self.complete(run, Status::Failure)
    }

    /// Halts a leaf that takes too long, and starts it again in the next tick. Its parents take it
    /// for RUNNING meanwhile. False if the run is over.
    pub fn retry(&mut self, run: LeafRun, now: Duration) -> bool {
        let stopped = self.stop(run, now);
        if stopped {
            self.leaves[run.leaf as usize].deferred = true;
            self.wake_at(self.now);
        }
        stopped
    }

    fn stop(&mut self, run: LeafRun, now: Duration) -> bool {
        let current = self.is_current(run);
        if current {
            self.now = self.now.max(now);
            self.halt_leaf(run.node);
        }
        current
    }

    fn is_current(&self, run: LeafRun) -> bool {
        let state = &self.leaves[run.leaf as usize];
        self.runs(state) && state.starts == run.start
    }

    fn runs(&self, state: &LeafState) -> bool {
        let node = self.node(state.node);
        let is_action = node.kind == Kind::Leaf(LeafKind::Action);
        is_action && node.status == Status::Running && !state.deferred
    }

    /// What a leaf that runs sees, for a driver that reads its ports or writes its results.
    pub fn leaf_context(&mut self, run: LeafRun) -> Option<LeafContext<'_>> {
        self.is_current(run).then_some(LeafContext { tree: self, run })
    }
}
