//! Ticks, resets and halts one node, whatever its type.

use super::{Code, TickError, TickProblem, Tree, TreeNodeId};
use crate::model::{ChildOrder, Kind};
use crate::script::truth;
use crate::status::Status;
use crate::value::{PortValue, Value};

/// The answer of a node in a tick.
pub(super) type NodeAnswer = Result<Status, Box<TickError>>;

/// A result, or the error of a node.
type Checked<T> = Result<T, Box<TickError>>;

/// The answers of `_failureIf`, `_successIf` and `_skipIf` where they hold, and of `_while` where
/// it does not.
const BEFORE: [Status; 4] = [Status::Failure, Status::Success, Status::Skipped, Status::Skipped];

impl Tree {
    /// Ticks a node: its conditions before, itself, its scripts after.
    pub(super) fn execute(&mut self, id: TreeNodeId) -> NodeAnswer {
        let status = match self.check_before(id)? {
            Some(status) => status,
            None => self.tick_kind(id)?,
        };
        if status == Status::Idle {
            return Err(self.may_not_answer(id, status));
        }
        if status.is_completed() && self.node(id).hooks.is_some() {
            self.run_hook(id, if status == Status::Success { 4 } else { 5 })?;
            self.run_hook(id, 6)?;
        }
        // A skipped node keeps its status; only its parent is told.
        if status != Status::Skipped {
            self.node_mut(id).status = status;
        }
        self.note(id, status);
        if self.node(id).is_decorator {
            let child = self.child(id, 0);
            if self.node(child).status.is_completed() {
                self.node_mut(child).status = Status::Idle;
            }
        }
        Ok(status)
    }

    fn tick_kind(&mut self, id: TreeNodeId) -> NodeAnswer {
        match self.node(id).kind {
            Kind::Ordered(order) => self.ordered(id, order, self.node(id).child_count),
            Kind::Reactive { go } => self.reactive(id, go),
            Kind::Parallel => self.parallel(id),
            Kind::ParallelAll => self.parallel_all(id),
            Kind::Branch { looks_again } => self.branch(id, looks_again),
            Kind::Switch(cases) => self.switch(id, u32::from(cases)),
            Kind::TryCatch => self.try_catch(id),
            Kind::Inverter => self.map_child(id, |status| match status {
                Status::Success => Status::Failure,
                Status::Failure => Status::Success,
                other => other,
            }),
            Kind::Force(forced) => {
                self.map_child(id, |status| if status.is_completed() { forced } else { status })
            }
            Kind::Repeat { until } => self.repeat(id, until),
            Kind::KeepRunningUntilFailure => self.map_child(id, |status| match status {
                Status::Failure => status,
                _ => Status::Running,
            }),
            Kind::Delay => self.delay(id),
            Kind::Timeout => self.timeout(id),
            Kind::RunOnce => self.run_once(id),
            Kind::Precondition => self.precondition(id),
            Kind::Loop => self.tick_loop(id),
            Kind::Updated(otherwise) => self.updated(id, otherwise),
            Kind::SubTree => self.subtree(id),
            Kind::Always(status) => Ok(status),
            Kind::Script => self.run(id, self.node(id).part).map(|_| Status::Success),
            Kind::ScriptCondition => self.holds(id, self.node(id).part).map(Status::from),
            Kind::SetBlackboard => self.set_blackboard(id),
            Kind::UnsetBlackboard => self.unset_blackboard(id),
            Kind::Sleep => self.sleep(id),
            Kind::WasEntryUpdated => Ok(Status::from(self.is_updated(id))),
            Kind::Leaf(kind) => self.tick_leaf(id, kind),
        }
    }

    /// The decision of a node's conditions. All but `_while` are looked at only before it starts.
    fn check_before(&mut self, id: TreeNodeId) -> Checked<Option<Status>> {
        let node = self.node(id);
        let Some(hooks) = node.hooks else { return Ok(None) };
        let fresh = matches!(node.status, Status::Idle | Status::Skipped);
        let running = node.status == Status::Running;
        for (index, status) in BEFORE.into_iter().enumerate() {
            let is_while = index == 3;
            let Some(code) = self.hooks[hooks as usize][index] else { continue };
            if (fresh || running && is_while) && self.holds(id, code)? != is_while {
                if running {
                    self.halt_node(id)?;
                }
                return Ok(Some(status));
            }
        }
        Ok(None)
    }

    /// Runs `_onSuccess`, `_onFailure`, `_post` or `_onHalted`, by its index.
    fn run_hook(&mut self, id: TreeNodeId, index: usize) -> Checked<()> {
        let Some(hooks) = self.node(id).hooks else { return Ok(()) };
        let Some(code) = self.hooks[hooks as usize][index] else { return Ok(()) };
        self.run(id, code).map(drop)
    }

    /// Runs a script of a node.
    pub(super) fn run(&mut self, id: TreeNodeId, code: u32) -> Checked<Value> {
        let Code { text, script } = &self.codes[code as usize];
        script
            .run(&mut self.board, &self.enums)
            .map_err(|why| self.error(id, format!("its script `{text}` fails: {why}")))
    }

    /// Whether a script of a node holds.
    pub(super) fn holds(&mut self, id: TreeNodeId, code: u32) -> Checked<bool> {
        let value = self.run(id, code)?;
        truth(&value).ok_or_else(|| {
            let text = &self.codes[code as usize].text;
            self.error(
                id,
                format!("its script `{text}` fails: `{value}` is neither true nor false"),
            )
        })
    }

    /// Brings a child into the state from which it starts: halts it if it runs.
    pub(super) fn reset(&mut self, id: TreeNodeId) -> Checked<()> {
        if self.node(id).status == Status::Running {
            self.halt_node(id)?;
        }
        self.node_mut(id).status = Status::Idle;
        Ok(())
    }

    /// Resets the children from this one on.
    pub(super) fn reset_children(&mut self, id: TreeNodeId, from: u32) -> Checked<()> {
        for index in from..self.node(id).child_count {
            self.reset(self.child(id, index))?;
        }
        Ok(())
    }

    /// Halts a node, also one that does not run, and runs its `_onHalted`.
    pub(super) fn halt_node(&mut self, id: TreeNodeId) -> Checked<()> {
        self.clear(id)?;
        self.note(id, Status::Idle);
        self.run_hook(id, 7)
    }

    /// Resets the children, and the memory that does not outlive a halt.
    pub(super) fn clear(&mut self, id: TreeNodeId) -> Checked<()> {
        let node = self.node_mut(id);
        let memory = &mut node.memory;
        match node.kind {
            // Their memory outlives a halt.
            Kind::Ordered(ChildOrder { keeps: true, .. })
            | Kind::RunOnce
            | Kind::Precondition
            | Kind::WasEntryUpdated => {}
            Kind::Updated(_) => memory.flag = false,
            Kind::TryCatch => self.halt_try_catch(id)?,
            Kind::Leaf(_) => self.halt_leaf(id),
            _ => (memory.index, memory.count, memory.failures, memory.flag) = (0, 0, 0, false),
        }
        self.undo_done(id);
        self.reset_children(id, 0)?;
        self.node_mut(id).status = Status::Idle;
        Ok(())
    }

    /// Lets a `Parallel` tick all its children again.
    pub(super) fn undo_done(&mut self, id: TreeNodeId) {
        for index in 0..self.node(id).child_count {
            let child = self.child(id, index);
            self.node_mut(child).done = false;
        }
    }

    /// The value of a port of a built-in node.
    pub(super) fn port<T: PortValue>(&self, id: TreeNodeId, port: usize) -> Checked<T> {
        let value = super::leaf::read(self, self.bound(id, port));
        value.map_err(|error| self.error(id, error))
    }

    pub(super) fn may_not_answer(&self, id: TreeNodeId, status: Status) -> Box<TickError> {
        self.error(id, format!("it answered {status}, which it may not"))
    }

    pub(super) fn error(&self, id: TreeNodeId, why: impl ToString) -> Box<TickError> {
        self.failed(id, TickProblem::Node(why.to_string()))
    }

    pub(super) fn failed(&self, id: TreeNodeId, problem: TickProblem) -> Box<TickError> {
        Box::new(TickError { node: id, path: self.path(id).to_owned(), problem })
    }
}
