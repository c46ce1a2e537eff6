//! The trees of a node as monitors show them.

use crate::platform::{self, lock};
use actix::Recipient;
use blastema_contract::detector::ReadRecord;
use blastema_core::{Instant, ObjectName};
use blastema_trees::{CalledLeaf, NodeView, Status, Tree};
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

/// The ticks with changes that are kept of each tree: what a person reads at once.
const CHANGES: usize = 16;

/// A node of a running tree that is not idle.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct TreeNodeRow {
    /// The tree's component.
    pub tree: ObjectName,
    /// The node's path in the tree.
    pub path: String,
    /// Its type, or the name of its subtree.
    pub type_name: String,
    /// The number of nodes above it.
    pub depth: u32,
    /// Its last answer, such as `RUNNING`.
    pub answer: &'static str,
    /// It is a leaf that is being called at this moment.
    pub called: bool,
}

/// A tick in which nodes have changed their answers.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct TreeChangeRow {
    /// The tree's component.
    pub tree: ObjectName,
    /// The number of the tick, in this incarnation.
    pub tick: u64,
    /// The time of the tick.
    pub at: Instant,
    /// The changes: `Drive::3: RUNNING -> SUCCESS`, separated by commas.
    pub changes: String,
}

/// The trees of one node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct TreeTable {
    trees: Arc<Mutex<BTreeMap<ObjectName, Arc<TreeView>>>>,
    /// Where the record of faults is read; set once, when the node is assembled.
    pub(crate) record: Arc<OnceLock<Recipient<ReadRecord>>>,
}

impl TreeTable {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<ObjectName, Arc<TreeView>>> {
        lock(&self.trees)
    }

    /// Shows a tree, and returns what was shown of the incarnation before.
    pub(super) fn show(&self, name: ObjectName, view: Arc<TreeView>) -> Option<Arc<TreeView>> {
        self.lock().insert(name, view)
    }

    /// The tree has ended in order.
    pub(super) fn forget(&self, name: &ObjectName) {
        self.lock().remove(name);
    }

    /// All nodes that are not idle, in the order of their files.
    pub(crate) fn nodes(&self) -> Vec<TreeNodeRow> {
        self.lock().values().flat_map(|view| view.rows()).collect()
    }

    /// The last changes of all trees.
    pub(crate) fn changes(&self) -> Vec<TreeChangeRow> {
        let trees = self.lock();
        trees.values().flat_map(|view| view.lock().changes.clone()).collect()
    }
}

/// One incarnation of a tree, as other threads see it.
#[derive(Default)]
pub(super) struct TreeView {
    called: CalledLeaf,
    state: Mutex<TreeViewState>,
}

#[derive(Default)]
struct TreeViewState {
    nodes: Vec<TreeNodeRow>,
    ticks: u64,
    changes: VecDeque<TreeChangeRow>,
}

impl TreeView {
    pub(super) fn of(tree: &Tree, name: &ObjectName) -> Self {
        let row = |node: NodeView<'_>| TreeNodeRow {
            tree: name.clone(),
            path: node.path.to_owned(),
            type_name: node.type_name.to_owned(),
            depth: node.depth,
            answer: node.answer.name(),
            called: false,
        };
        let nodes = tree.nodes().map(row).collect();
        let state = TreeViewState { nodes, ..TreeViewState::default() };
        TreeView { called: tree.called(), state: Mutex::new(state) }
    }

    fn lock(&self) -> MutexGuard<'_, TreeViewState> {
        lock(&self.state)
    }

    /// Takes what the last tick, or halt, has changed. A tick without changes costs no allocation.
    pub(super) fn take_changes(&self, tree: &Tree, name: &ObjectName, ticks: u64) {
        let mut state = self.lock();
        state.ticks += ticks;
        if tree.changes().is_empty() {
            return;
        }
        for change in tree.changes() {
            state.nodes[change.node.index()].answer = change.to.name();
        }
        let changes = tree.changes_as_text().trim_end().replace('\n', ", ");
        let tick = state.ticks;
        tracing::debug!(tree = %name, tick, "{changes}");
        if state.changes.len() == CHANGES {
            state.changes.pop_front();
        }
        let (tree, at) = (name.clone(), platform::now());
        state.changes.push_back(TreeChangeRow { tree, tick, at, changes });
    }

    /// The path of the leaf that is called now, or that has not returned.
    pub(super) fn called(&self) -> Option<String> {
        Some(self.lock().nodes[self.called.node()?.index()].path.clone())
    }

    fn rows(&self) -> Vec<TreeNodeRow> {
        let mut nodes = self.lock().nodes.clone();
        if let Some(called) = self.called.node() {
            nodes[called.index()].called = true;
        }
        nodes.retain(|node| node.called || node.answer != Status::Idle.name());
        nodes
    }
}
