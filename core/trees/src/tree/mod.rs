//! A tree that runs.
//!
//! Its nodes lie in one arena in the order of the file; each is ticked by [`Tree::tick`] through
//! its parent, as the library does it. The semantics of each type of node stand in `builtin.rs`.

mod builtin;
mod called;
mod driver;
mod error;
mod leaf;

pub use called::CalledLeaf;
pub use error::{LeafError, PortError, TickError, TickProblem};
pub(crate) use leaf::{BoundPort, LeafModel, LeafState, MakeLeaf, PortBinding};
pub use leaf::{Halt, Leaf, LeafContext, LeafResult, LeafRun};

use crate::blackboard::{Blackboard, BoardId, KeyId};
use crate::model::{Kind, TickOrder};
use crate::script::{Script, truth};
use crate::status::Status;
use crate::value::{PortType, PortValue, Value};
use std::any::Any;
use std::collections::VecDeque;
use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Duration;

/// The number of a node in its tree, in the order of the file, from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TreeNodeId(pub(crate) u32);

impl TreeNodeId {
    /// Returns the number as an index.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// A tree that runs. It does nothing by itself: its driver ticks it.
///
/// All times are since one moment that the driver chooses. The default tree has no nodes, and is
/// always skipped.
#[derive(Default)]
pub struct Tree {
    pub(crate) nodes: Vec<TreeNode>,
    /// The children of all nodes.
    pub(crate) children: Vec<TreeNodeId>,
    /// The ports of all nodes.
    pub(crate) bindings: Vec<BoundPort>,
    pub(crate) codes: Vec<Code>,
    pub(crate) loops: Vec<LoopQueue>,
    pub(crate) leaves: Vec<LeafState>,
    pub(crate) board: Blackboard,
    clock: TickClock,
    /// The leaves that have been halted and have not come to rest, with the time of their halt.
    halting: Vec<(LeafRun, Duration)>,
    /// The leaf that is being called; still set after a panic.
    calling: CalledLeaf,
    /// What the driver lends to the leaves.
    lent: Option<Arc<dyn Any + Send + Sync>>,
    changes: ChangeLog,
}

/// The time of the present tick, and when the next one is due.
#[derive(Default)]
struct TickClock {
    now: Duration,
    /// The earliest time for which a node has asked.
    wake: Option<Duration>,
    /// A node has ended the tick early, so that it could be interrupted.
    yielded: bool,
    /// The same, until `tick_while_yielding` takes notice: as in the library, also in a later run.
    woken: bool,
}

/// The changes of the last tick, and how many more there were than their list holds.
#[derive(Default)]
struct ChangeLog {
    list: Vec<StatusChange>,
    lost: u32,
}

#[derive(Debug, Default)]
pub(crate) struct TreeNode {
    pub(crate) kind: Kind,
    pub(crate) status: Status,
    /// The last answer.
    pub(crate) answer: Status,
    /// Its parent, a `Parallel` or `ParallelAll`, need not tick it again.
    pub(crate) done: bool,
    pub(crate) first_child: u32,
    pub(crate) child_count: u32,
    pub(crate) first_binding: u32,
    pub(crate) board: BoardId,
    /// Its conditions as indices in `codes`: `_failureIf`, `_successIf`, `_skipIf`, `_while`,
    /// `_onSuccess`, `_onFailure`, `_post`, `_onHalted`.
    pub(crate) hooks: Option<Box<[Option<u32>; 8]>>,
    /// Its index in `codes`, `loops` or `leaves`.
    pub(crate) part: u32,
    pub(crate) memory: NodeMemory,
    pub(crate) label: NodeLabel,
}

/// The memory of a node between ticks; each type of node gives the fields its own meaning.
#[derive(Debug, Default)]
pub(crate) struct NodeMemory {
    index: u32,
    count: u32,
    failures: u32,
    flag: bool,
    status: Status,
    time: Duration,
    writes: u64,
}

/// The names of a node, for monitors and errors.
#[derive(Debug, Default)]
pub(crate) struct NodeLabel {
    pub(crate) path: String,
    /// The name of the node's type, or of the subtree.
    pub(crate) type_name: String,
    pub(crate) depth: u32,
}

/// A script with its text.
#[derive(Debug)]
pub(crate) struct Code {
    pub(crate) text: String,
    pub(crate) script: Script,
}

/// The elements that a `Loop` has still to go through.
#[derive(Debug)]
pub(crate) struct LoopQueue {
    pub(crate) element: PortType,
    pub(crate) queue: VecDeque<Value>,
    pub(crate) loaded: bool,
}

/// A change of a node's answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StatusChange {
    /// The node whose answer changed.
    pub node: TreeNodeId,
    /// The answer before.
    pub from: Status,
    /// The answer now; `Idle` if the node has been halted.
    pub to: Status,
}

/// A node as monitors show it.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub struct NodeView<'a> {
    /// The node's number in its tree.
    pub id: TreeNodeId,
    /// Its path: the names of the subtrees around it, then its own name, or its type and number.
    pub path: &'a str,
    /// The name of its type, or of the subtree.
    pub type_name: &'a str,
    /// The number of nodes above it.
    pub depth: u32,
    /// The node's present status.
    pub status: Status,
    /// The answer of its last tick; `Idle` if it has been halted since.
    pub answer: Status,
}

impl Tree {
    /// Ticks the tree once: `tickExactlyOnce` of BehaviorTree.CPP.
    ///
    /// # Errors
    ///
    /// A node could not be ticked. Nothing is halted; the next tick goes on from there.
    pub fn tick(&mut self, now: Duration) -> Result<Status, TickError> {
        self.begin(now);
        self.tick_root()
    }

    /// Ticks the tree again and again while nodes end the tick only to be interruptible:
    /// `tickOnce` of BehaviorTree.CPP. It does so at most a thousand times, and fewer in a tree of
    /// more than a hundred nodes, since a `Repeat` without end would never return.
    ///
    /// # Errors
    ///
    /// A node could not be ticked. Nothing is halted; the next tick goes on from there.
    pub fn tick_while_yielding(&mut self, now: Duration) -> Result<Status, TickError> {
        self.begin(now);
        let mut status = self.tick_root()?;
        // A hundred thousand nodes take a few milliseconds, whatever the size of the tree.
        let ticks = (100_000 / self.nodes.len().max(100)).max(1);
        for _ in 1..ticks {
            if status != Status::Running || !std::mem::take(&mut self.clock.woken) {
                break;
            }
            status = self.tick_root()?;
        }
        Ok(status)
    }

    fn begin(&mut self, now: Duration) {
        // A clock that is set back would stretch every delay.
        self.clock.now = self.clock.now.max(now);
        self.calling.set(None);
        (self.clock.wake, self.changes.lost) = (None, 0);
        self.changes.list.clear();
        self.poll_halting();
    }

    fn tick_root(&mut self) -> Result<Status, TickError> {
        let root = TreeNodeId(0);
        if self.nodes.is_empty() {
            return Ok(Status::Skipped);
        }
        self.clock.yielded = false;
        let status = self.execute(root).map_err(|error| *error)?;
        if status.is_completed() {
            self.node_mut(root).status = Status::Idle;
        }
        Ok(status)
    }

    /// Halts every node that runs. [`Tree::halting`] has the leaves that have yet to come to rest.
    ///
    /// # Errors
    ///
    /// A script `_onHalted` failed; all nodes are halted nevertheless.
    pub fn halt(&mut self, now: Duration) -> Result<(), TickError> {
        self.begin(now);
        self.clock.yielded = false;
        let mut result = Ok(());
        for id in (0..self.nodes.len() as u32).map(TreeNodeId) {
            let running = self.node(id).status == Status::Running;
            let halted = if running { self.halt_node(id) } else { self.clear(id) };
            result = result.and(halted);
            self.node_mut(id).status = Status::Idle;
        }
        result.map_err(|error| *error)
    }

    /// The next time at which a tick can change something by itself: a timer fires, or the last
    /// tick was ended early. The driver itself knows when something comes from outside.
    pub fn next_tick(&self) -> Option<Duration> {
        if self.clock.yielded { Some(self.clock.now) } else { self.clock.wake }
    }

    /// The path of a node.
    pub fn path(&self, node: TreeNodeId) -> &str {
        &self.node(node).label.path
    }

    /// The node of this path.
    pub fn find(&self, path: &str) -> Option<TreeNodeId> {
        let index = self.nodes.iter().position(|node| node.label.path == path)?;
        Some(TreeNodeId(index as u32))
    }

    /// All nodes, in the order of the file.
    pub fn nodes(&self) -> impl Iterator<Item = NodeView<'_>> {
        self.nodes.iter().zip(0..).map(|(node, id)| NodeView {
            id: TreeNodeId(id),
            path: &node.label.path,
            type_name: &node.label.type_name,
            depth: node.label.depth,
            status: node.status,
            answer: node.answer,
        })
    }

    /// The nodes whose answers the last tick has changed, in the order of the answers.
    pub fn changes(&self) -> &[StatusChange] {
        &self.changes.list
    }

    /// [`Tree::changes`] as text, one line each: `Drive::3: RUNNING -> SUCCESS`.
    pub fn changes_as_text(&self) -> String {
        let mut text = String::new();
        for StatusChange { node, from, to } in self.changes() {
            // Writing into a String cannot fail.
            let _ = writeln!(text, "{}: {from} -> {to}", self.path(*node));
        }
        if self.changes.lost > 0 {
            let _ = writeln!(text, "and {} more", self.changes.lost);
        }
        text
    }

    /// Notes a node's answer.
    fn note(&mut self, id: TreeNodeId, to: Status) {
        let from = std::mem::replace(&mut self.nodes[id.0 as usize].answer, to);
        if from != to {
            // The loader reserves this much; loops within one tick could change without end.
            let ChangeLog { list, lost } = &mut self.changes;
            match list.len() < list.capacity() {
                true => list.push(StatusChange { node: id, from, to }),
                false => *lost += 1,
            }
        }
    }

    /// Reserves the memory that ticks need, so that they allocate none.
    pub(crate) fn reserve(&mut self) {
        // Each node changes in each direction once, and a few do so more often.
        self.changes.list.reserve_exact(2 * self.nodes.len() + 64);
        self.halting.reserve_exact(self.leaves.len());
    }

    /// The value of a key of the root's blackboard.
    pub fn value(&self, key: &str) -> Option<&Value> {
        self.board.value(self.board.find(key)?)
    }

    /// Whether a key of the root's blackboard exists: a port declares it, or it was written.
    pub fn has_key(&self, key: &str) -> bool {
        self.board.find(key).is_some_and(|key| self.board.exists(key))
    }

    /// Writes a key of the root's blackboard.
    ///
    /// # Errors
    ///
    /// The key has another type, to which the value does not convert, or the blackboard is full.
    pub fn set<T: PortValue>(&mut self, key: &str, value: T) -> Result<(), PortError> {
        let error = |kind| PortError::of_type(key, T::TYPE.name(), kind);
        let id = match self.board.find(key) {
            Some(id) => id,
            None if self.board.is_full() => return Err(error("entry of a full blackboard")),
            None => self.board.key(Blackboard::ROOT, key),
        };
        self.board.set(id, value).map_err(error)
    }

    fn node(&self, id: TreeNodeId) -> &TreeNode {
        &self.nodes[id.0 as usize]
    }

    fn node_mut(&mut self, id: TreeNodeId) -> &mut TreeNode {
        &mut self.nodes[id.0 as usize]
    }

    fn memory(&mut self, id: TreeNodeId) -> &mut NodeMemory {
        &mut self.nodes[id.0 as usize].memory
    }

    fn child(&self, id: TreeNodeId, index: u32) -> TreeNodeId {
        self.children[(self.node(id).first_child + index) as usize]
    }

    fn bound(&self, id: TreeNodeId, port: usize) -> &BoundPort {
        &self.bindings[self.node(id).first_binding as usize + port]
    }

    fn binding(&self, id: TreeNodeId, port: usize) -> &PortBinding {
        &self.bound(id, port).binding
    }

    /// The key that a port is connected to.
    fn key(&self, id: TreeNodeId, port: usize) -> Option<KeyId> {
        match self.binding(id, port) {
            PortBinding::Key(key) => Some(*key),
            _ => None,
        }
    }

    /// The value of a port, whatever its type; none while it has no value.
    fn raw(&self, id: TreeNodeId, port: usize) -> Option<&Value> {
        match self.binding(id, port) {
            PortBinding::Literal(value) => Some(value),
            PortBinding::Key(key) => self.board.value(*key),
            PortBinding::Missing | PortBinding::Entry(_) => None,
        }
    }

    /// Ends the tick, and asks for the next one at once.
    fn yield_now(&mut self) -> NodeAnswer {
        (self.clock.yielded, self.clock.woken) = (true, true);
        Ok(Status::Running)
    }

    fn wake_at(&mut self, at: Duration) {
        self.clock.wake = Some(self.clock.wake.map_or(at, |wake| wake.min(at)));
    }
}

/// The answer of a node in a tick.
pub(super) type NodeAnswer = Result<Status, Box<TickError>>;

/// A result, or the error of a node.
type Checked<T> = Result<T, Box<TickError>>;

/// The answers of `_failureIf`, `_successIf` and `_skipIf` where they hold, and of `_while` where
/// it does not.
const BEFORE: [Status; 4] = [Status::Failure, Status::Success, Status::Skipped, Status::Skipped];

/// How one node is ticked, reset and halted, whatever its type.
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
        if self.node(id).kind.children() == (1..=1) {
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
        if node.hooks.is_none() {
            return Ok(None);
        }
        let fresh = matches!(node.status, Status::Idle | Status::Skipped);
        let running = node.status == Status::Running;
        for (index, status) in BEFORE.into_iter().enumerate() {
            let is_while = index == 3;
            let Some(code) = self.hook(id, index) else { continue };
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
        self.hook(id, index).map_or(Ok(()), |code| self.run(id, code).map(drop))
    }

    fn hook(&self, id: TreeNodeId, index: usize) -> Option<u32> {
        self.node(id).hooks.as_ref()?[index]
    }

    /// Runs a script of a node.
    pub(super) fn run(&mut self, id: TreeNodeId, code: u32) -> Checked<Value> {
        let Code { text, script } = &self.codes[code as usize];
        script
            .run(&mut self.board)
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
            Kind::Ordered(TickOrder { keeps: true, .. })
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
        let value = leaf::read(self, self.bound(id, port));
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
