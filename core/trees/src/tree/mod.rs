//! A tree that runs.
//!
//! Its nodes lie in one arena in the order of the file; each is ticked by [`Tree::tick`] through
//! its parent, as the library does it. The semantics of each type of node stand in `control.rs`,
//! `decorator.rs` and `builtin_leaf.rs`.

mod builtin_leaf;
mod called;
mod control;
mod decorator;
mod driver;
mod error;
mod execute;
mod leaf;

pub use called::CalledLeaf;
pub use error::{LeafError, PortError, TickError, TickProblem};
pub(crate) use leaf::{BoundPort, LeafModel, LeafState, MakeLeaf, PortBinding};
pub use leaf::{Halt, Leaf, LeafContext, LeafResult, LeafRun};

use crate::blackboard::{Blackboard, BoardId, KeyId};
use crate::model::Kind;
use crate::script::Script;
use crate::status::Status;
use crate::value::{PortType, PortValue, Value};
use std::any::Any;
use std::collections::{BTreeMap, VecDeque};
use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Duration;

/// The number of a node in its tree, in the order of the file, from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TreeNodeId(pub(crate) u32);

impl TreeNodeId {
    /// The number.
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
    pub(crate) labels: Vec<NodeLabel>,
    /// The children of all nodes.
    pub(crate) children: Vec<TreeNodeId>,
    /// The ports of all nodes.
    pub(crate) bindings: Vec<BoundPort>,
    /// The conditions of nodes as indices in `codes`: `_failureIf`, `_successIf`, `_skipIf`,
    /// `_while`, `_onSuccess`, `_onFailure`, `_post`, `_onHalted`.
    pub(crate) hooks: Vec<[Option<u32>; 8]>,
    pub(crate) codes: Vec<Code>,
    pub(crate) loops: Vec<LoopQueue>,
    pub(crate) leaves: Vec<LeafState>,
    pub(crate) board: Blackboard,
    pub(crate) enums: BTreeMap<String, i64>,
    now: Duration,
    /// The earliest time for which a node has asked.
    wake: Option<Duration>,
    /// A node has ended the tick early, so that it could be interrupted.
    yielded: bool,
    /// The same, until `tick_while_yielding` takes notice: as in the library, also in a later run.
    woken: bool,
    /// The leaves that have been halted and have not come to rest, with the time of their halt.
    halting: Vec<(LeafRun, Duration)>,
    /// The leaf that is being called; still set after a panic.
    calling: CalledLeaf,
    /// What the driver lends to the leaves.
    lent: Option<Arc<dyn Any + Send + Sync>>,
    changes: Vec<StatusChange>,
    changes_lost: u32,
}

/// A node.
#[derive(Debug, Default)]
pub(crate) struct TreeNode {
    pub(crate) kind: Kind,
    pub(crate) is_decorator: bool,
    pub(crate) status: Status,
    /// The last answer.
    pub(crate) answer: Status,
    /// Its parent, a `Parallel` or `ParallelAll`, need not tick it again.
    pub(crate) done: bool,
    pub(crate) first_child: u32,
    pub(crate) child_count: u32,
    pub(crate) first_binding: u32,
    pub(crate) board: BoardId,
    /// Its index in `hooks`.
    pub(crate) hooks: Option<u32>,
    /// Its index in `codes`, `loops` or `leaves`.
    pub(crate) part: u32,
    pub(crate) memory: NodeMemory,
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
#[derive(Debug)]
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
    /// The node.
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
    /// Its number.
    pub id: TreeNodeId,
    /// Its path: the names of the subtrees around it, then its own name, or its type and number.
    pub path: &'a str,
    /// The name of its type, or of the subtree.
    pub type_name: &'a str,
    /// The number of nodes above it.
    pub depth: u32,
    /// Its status.
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
            if status != Status::Running || !std::mem::take(&mut self.woken) {
                break;
            }
            status = self.tick_root()?;
        }
        Ok(status)
    }

    fn begin(&mut self, now: Duration) {
        // A clock that is set back would stretch every delay.
        self.now = self.now.max(now);
        self.calling.set(None);
        (self.wake, self.changes_lost) = (None, 0);
        self.changes.clear();
        self.poll_halting();
    }

    fn tick_root(&mut self) -> Result<Status, TickError> {
        let root = TreeNodeId(0);
        if self.nodes.is_empty() {
            return Ok(Status::Skipped);
        }
        self.yielded = false;
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
        self.yielded = false;
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
        if self.yielded { Some(self.now) } else { self.wake }
    }

    /// The path of a node.
    pub fn path(&self, node: TreeNodeId) -> &str {
        &self.labels[node.0 as usize].path
    }

    /// The node of this path.
    pub fn find(&self, path: &str) -> Option<TreeNodeId> {
        let index = self.labels.iter().position(|label| label.path == path)?;
        Some(TreeNodeId(index as u32))
    }

    /// All nodes, in the order of the file.
    pub fn nodes(&self) -> impl Iterator<Item = NodeView<'_>> {
        self.nodes.iter().zip(&self.labels).zip(0..).map(|((node, label), id)| NodeView {
            id: TreeNodeId(id),
            path: &label.path,
            type_name: &label.type_name,
            depth: label.depth,
            status: node.status,
            answer: node.answer,
        })
    }

    /// The nodes whose answers the last tick has changed, in the order of the answers.
    pub fn changes(&self) -> &[StatusChange] {
        &self.changes
    }

    /// [`Tree::changes`] as text, one line each: `Drive::3: RUNNING -> SUCCESS`.
    pub fn changes_as_text(&self) -> String {
        let mut text = String::new();
        for StatusChange { node, from, to } in &self.changes {
            // Writing into a String cannot fail.
            let _ = writeln!(text, "{}: {from} -> {to}", self.path(*node));
        }
        if self.changes_lost > 0 {
            let _ = writeln!(text, "and {} more", self.changes_lost);
        }
        text
    }

    /// Notes a node's answer.
    fn note(&mut self, id: TreeNodeId, to: Status) {
        let from = std::mem::replace(&mut self.nodes[id.0 as usize].answer, to);
        if from != to {
            // The loader reserves this much; loops within one tick could change without end.
            if self.changes.len() < self.changes.capacity() {
                self.changes.push(StatusChange { node: id, from, to });
            } else {
                self.changes_lost += 1;
            }
        }
    }

    /// Reserves the memory that ticks need, so that they allocate none.
    pub(crate) fn reserve(&mut self) {
        // Each node changes in each direction once, and a few do so more often.
        self.changes.reserve_exact(2 * self.nodes.len() + 64);
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
        let error = |kind| PortError::Type { port: key.into(), value: T::TYPE.name().into(), kind };
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
    fn yield_now(&mut self) -> execute::NodeAnswer {
        (self.yielded, self.woken) = (true, true);
        Ok(Status::Running)
    }

    fn wake_at(&mut self, at: Duration) {
        self.wake = Some(self.wake.map_or(at, |wake| wake.min(at)));
    }
}
