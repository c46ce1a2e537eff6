//! What a tree's component shares with the futures of its leaves.

use super::actor::BehaviorTree;
use super::task::LeafFuture;
use crate::component::incarnation::{IncarnationState, TimerMode};
use crate::platform::panics;
use blastema_core::{Contract, DeliveryError};
use blastema_trees::{LeafRun, Status, Tree, TreeNodeId};
use std::any::{Any, TypeId};
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

/// A leaf whose future runs.
pub(super) struct RunningTask {
    pub(super) run: LeafRun,
    pub(super) future: LeafFuture,
}

/// The end of a leaf that is no answer.
pub(super) struct TaskFault {
    pub(super) run: LeafRun,
    pub(super) why: String,
    pub(super) panicked: bool,
}

/// What a tree's component shares with the futures of its leaves. A future is dropped outside of
/// any borrow, since it may use this when it is dropped.
#[derive(Default)]
pub(super) struct TreeShared {
    pub(super) tree: RefCell<Tree>,
    pub(super) tasks: RefCell<Vec<RunningTask>>,
    pub(super) faults: RefCell<Vec<TaskFault>>,
    /// By the actuator and the type of its commands. What the tree has claimed is released when it
    /// is halted.
    pub(super) commanders: RefCell<BTreeMap<(String, TypeId), Box<dyn Any>>>,
    waker: RefCell<Option<Waker>>,
    /// Until the component has its turn.
    pub(super) turn_asked: Cell<bool>,
}

impl TreeShared {
    /// Polls the futures. The component has its turn once one has ended.
    pub(super) fn poll(
        &self,
        state: &IncarnationState<BehaviorTree>,
        cx: &mut Context<'_>,
    ) -> Poll<()> {
        self.waker.replace(Some(cx.waker().clone()));
        let mut going = Vec::new();
        for mut task in self.tasks.take() {
            match panics::caught(|| task.future.as_mut().poll(cx)) {
                Ok(Poll::Pending) => going.push(task),
                Ok(Poll::Ready(result)) => {
                    self.end(task, result.map_err(|why| (why.to_string(), false)), state)
                }
                Err(why) => self.end(task, Err((why, true)), state),
            }
        }
        // Nothing starts a leaf while futures are polled.
        self.tasks.replace(going);
        Poll::Pending
    }

    fn end(
        &self,
        task: RunningTask,
        result: Result<Status, (String, bool)>,
        state: &IncarnationState<BehaviorTree>,
    ) {
        let run = task.run;
        let dropped = panics::caught(|| drop(task)).map_err(|why| (why, true));
        let answered = match dropped.and(result) {
            Ok(status) if status.is_completed() => {
                self.tree.borrow_mut().complete(run, status);
                Ok(())
            }
            Ok(status) => {
                Err((format!("it ended with {status}: return SUCCESS or FAILURE"), false))
            }
            Err(fault) => Err(fault),
        };
        if let Err((why, panicked)) = answered {
            self.faults.borrow_mut().push(TaskFault { run, why, panicked });
        }
        self.ask_turn(state);
    }

    /// Has the component tick the tree as soon as it has its turn.
    pub(super) fn ask_turn(&self, state: &IncarnationState<BehaviorTree>) {
        if !self.turn_asked.replace(true) {
            let turn = |tree: &mut BehaviorTree, cx: &mut _| tree.handle_wake(cx);
            state.set_timer(TimerMode::Once(Duration::ZERO), Box::new(turn));
        }
    }

    /// Starts a future.
    pub(super) fn start(&self, task: RunningTask) {
        self.tasks.borrow_mut().push(task);
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
    }

    /// Drops the futures of leaves that were halted or failed, and returns those that panicked.
    pub(super) fn drop_halted(&self) -> Vec<(TreeNodeId, String)> {
        let (mut tree, mut tasks) = (self.tree.borrow_mut(), self.tasks.borrow_mut());
        let is_over = |task: &mut RunningTask| tree.leaf_context(task.run).is_none();
        let halted: Vec<_> = tasks.extract_if(.., is_over).collect();
        drop((tree, tasks));
        let dropped = halted.into_iter().map(|task| (task.run.node, panics::caught(|| drop(task))));
        dropped.filter_map(|(node, dropped)| Some((node, dropped.err()?))).collect()
    }

    /// The commander of an actuator, which lasts until the tree is halted.
    pub(super) fn commander<M: Contract>(
        &self,
        actuator: &str,
        make: impl FnOnce() -> Result<crate::Commander<M>, DeliveryError>,
    ) -> Result<crate::Commander<M>, DeliveryError> {
        let key = (actuator.to_owned(), TypeId::of::<M>());
        if let Some(known) = self.commanders.borrow().get(&key).and_then(|any| any.downcast_ref()) {
            return Ok(crate::Commander::clone(known));
        }
        let commander = make()?;
        self.commanders.borrow_mut().insert(key, Box::new(commander.clone()));
        Ok(commander)
    }
}
