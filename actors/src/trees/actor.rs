//! The component that ticks a tree.

use super::connected::FAULT_CONDITION;
use super::host::TreeHost;
use super::leaves::{LeafFault, LeafRules, TreeLeaves};
use super::rows::{TreeTable, TreeView};
use super::shared::{RunningTask, TaskFault, TreeShared};
use super::task::{LeafTask, MakeTask};
use crate::component::context::Context;
use crate::component::incarnation::TimerId;
use crate::component::{Component, Failure};
use crate::host::spec::ChildSpec;
use crate::platform::{self, panics};
use blastema_contract::detector::ReadRecord;
use blastema_core::FaultKind;
use blastema_trees::{LeafRun, Status, TickProblem, Tree, TreeErrors, TreeNodeId};
use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet};
use std::future::poll_fn;
use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;
use std::{fs, io};

/// The rate of a tree whose `ChildSpec` is not given another one.
const RATE_HZ: f64 = 10.0;
/// Passes of one turn; each follows a leaf's fault. More belong to a leaf that fails without end,
/// which the next round meets again.
const PASSES: usize = 100;
/// The shortest time between two turns of a tree that asks for the next one by itself.
const SHORTEST: Duration = Duration::from_millis(1);
/// How long halted leaves may take to come to rest when the component leaves work.
const REST_WITHIN: Duration = Duration::from_secs(1);
/// Between two looks at leaves that come to rest.
const REST_LOOK: Duration = Duration::from_millis(10);
/// Between two looks at the record of faults, for a tree that has a condition over it.
const RECORD_LOOK: Duration = Duration::from_millis(100);
/// The characters of a fault's detail: more than a person reads.
const DETAIL: usize = 1_000;
/// The bytes of a file of trees. A longer one is refused.
const FILE_MAX: u64 = 1 << 20;

/// A behaviour tree as a component: a child of a supervisor, with a life cycle, faults and a plan.
///
/// It ticks its tree ten times a second, unless [`rate_hz`](ChildSpec::rate_hz) is set, and at once
/// when a leaf's future has ended, a condition of a leaf has changed, or a timer of the tree is
/// due. A tree that has ended begins again with the next round. When the component leaves work, all
/// nodes are halted, and all leases given back.
///
/// ```
/// use blastema::prelude::*;
/// use blastema::trees::{BehaviorTree, Status, TreeLeaves};
///
/// # blastema::run(async {
/// let leaves = TreeLeaves::new().action("Explore", [], |_| Ok(Status::Success));
/// let tree = BehaviorTree::of_text(
///     "mission",
///     &leaves,
///     r#"<root BTCPP_format="4">
///          <BehaviorTree ID="Mission">
///            <ReactiveSequence>
///              <IsCommsConnected topic_name="operator/beat"/>
///              <Explore/>
///            </ReactiveSequence>
///          </BehaviorTree>
///        </root>"#,
/// )?;
/// let node = Node::builder("rover").child(tree.rate_hz(20.0)).start().await?;
/// # node.shutdown().await;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// # })?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Default)]
pub struct BehaviorTree {
    source: Arc<TreeSource>,
    shared: Rc<TreeShared>,
    host: Option<Arc<TreeHost>>,
    view: Arc<TreeView>,
    /// The futures and rules of the leaves that have any.
    tasks: BTreeMap<TreeNodeId, MakeTask>,
    rules: BTreeMap<TreeNodeId, LeafRules>,
    /// The last runs that had futures, and the last signs of life of these.
    started: BTreeMap<TreeNodeId, (LeafRun, Rc<Cell<Duration>>)>,
    active: bool,
    /// The next turn that the tree asks for by itself.
    alarm: Option<(Duration, TimerId)>,
    tries: BTreeMap<TreeNodeId, u32>,
    /// The leaves whose fault stands: until they succeed.
    faulty: BTreeSet<TreeNodeId>,
}

/// What all incarnations of a tree are made from. It has been loaded once without an error.
#[derive(Default)]
struct TreeSource {
    leaves: TreeLeaves,
    file: String,
    text: String,
    included: BTreeMap<String, String>,
}

/// A fault of a leaf, or of another node, and what becomes of it.
struct LeafTrouble {
    node: TreeNodeId,
    why: String,
    then: LeafFault,
}

impl BehaviorTree {
    /// A component of this name that ticks the main tree of this text, which includes no files.
    ///
    /// # Errors
    /// All mistakes of the text.
    pub fn of_text(
        name: &str,
        leaves: &TreeLeaves,
        text: &str,
    ) -> Result<ChildSpec<BehaviorTree>, TreeErrors> {
        let file = format!("{name}.xml");
        let no_files = |_: &str| Err("no files are included here".to_owned());
        BehaviorTree::of(leaves, file, text.to_owned(), no_files).map(|make| make(name))
    }

    /// A component of this name that ticks the main tree of this file. The paths of included files
    /// begin at the folder of the file that includes them. All are read now, and not again.
    ///
    /// # Errors
    /// The file cannot be read, or, as [`io::ErrorKind::InvalidData`], it has mistakes: all of
    /// them, as [`TreeErrors`].
    pub fn of_file(
        name: &str,
        leaves: &TreeLeaves,
        file: impl AsRef<Path>,
    ) -> io::Result<ChildSpec<BehaviorTree>> {
        BehaviorTree::read(leaves, file).map(|make| make(name))
    }

    /// Reads a file as [`of_file`](Self::of_file) does, and returns what makes components of it by
    /// their names, such as for a [`Rung`](crate::Rung) that runs a tree.
    ///
    /// # Errors
    /// As [`of_file`](Self::of_file).
    pub fn read(
        leaves: &TreeLeaves,
        file: impl AsRef<Path>,
    ) -> io::Result<impl Fn(&str) -> ChildSpec<BehaviorTree> + Clone + Send + Sync + 'static> {
        let label = file.as_ref().display().to_string();
        let text = read_text(file.as_ref())
            .map_err(|error| io::Error::new(error.kind(), format!("{label}: {error}")))?;
        let include = |path: &str| read_text(Path::new(path)).map_err(|error| error.to_string());
        let made = BehaviorTree::of(leaves, label, text, include);
        made.map_err(|errors| io::Error::new(io::ErrorKind::InvalidData, errors))
    }

    fn of<R: Fn(&str) -> Result<String, String>>(
        leaves: &TreeLeaves,
        file: String,
        text: String,
        read: R,
    ) -> Result<impl Fn(&str) -> ChildSpec<BehaviorTree> + Clone + use<R>, TreeErrors> {
        let (leaves, mut included) = (leaves.clone(), BTreeMap::new());
        let mut include = |path: &str| {
            let text = read(path)?;
            included.insert(path.to_owned(), text.clone());
            Ok(text)
        };
        leaves.factory.load_with(&file, &text, None, &mut include)?;
        let source = Arc::new(TreeSource { leaves, file, text, included });
        let make = move |name: &str| {
            let source = source.clone();
            let make = move || {
                let mut tree = BehaviorTree::default();
                tree.source = source.clone();
                tree
            };
            ChildSpec::new(name, make).rate_hz(RATE_HZ)
        };
        Ok(make)
    }

    /// The time of all trees: since the origin of the node's clock.
    pub(super) fn now() -> Duration {
        Duration::from_nanos(platform::now().as_nanos())
    }

    /// The turn that a leaf's future, a condition or the tree itself has asked for.
    pub(super) fn handle_wake(&mut self, cx: &mut Context<Self>) {
        if let Err(failure) = self.turn(cx) {
            cx.fail(failure);
        }
    }

    /// Ticks the tree, again after each fault of a leaf, and starts what its leaves wait for.
    fn turn(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.shared.turn_asked.set(false);
        if !self.active {
            return Ok(());
        }
        let mut ticks = true;
        for TaskFault { run, why, panicked } in self.shared.faults.take() {
            let is_current = self.shared.tree.borrow_mut().leaf_context(run).is_some();
            if ticks && is_current {
                let then = self.rules_of(run.node).after(panicked);
                ticks = self.handle(LeafTrouble { node: run.node, why, then }, cx)?;
            }
        }
        for _ in 0..PASSES {
            if !ticks {
                break;
            }
            let found = self.tick();
            self.take_changes(1, cx);
            ticks = match found.or_else(|| self.overdue()) {
                Some(found) => self.handle(found, cx)?,
                None => false,
            };
        }
        self.start_tasks(cx);
        self.set_alarm(cx);
        Ok(())
    }

    /// Ticks the tree once. Returns what was found wrong.
    fn tick(&mut self) -> Option<LeafTrouble> {
        let shared = &self.shared;
        let ticked =
            panics::caught(|| shared.tree.borrow_mut().tick_while_yielding(BehaviorTree::now()));
        let (node, why, then) = match ticked {
            Ok(Ok(_)) => return None,
            Ok(Err(error)) => {
                let then = match error.problem {
                    TickProblem::Leaf(_) => self.rules_of(error.node).after(false),
                    // A script, a port or a number in the file: no leaf can fail in its place.
                    _ => LeafFault::RestartTree,
                };
                (error.node, error.problem.to_string(), then)
            }
            Err(why) => {
                let node = self.panicked(&why);
                (node, why, self.rules_of(node).after(true))
            }
        };
        Some(LeafTrouble { node, why, then })
    }

    /// The first leaf that has exceeded its time limit.
    fn overdue(&self) -> Option<LeafTrouble> {
        let (tree, now) = (self.shared.tree.borrow(), BehaviorTree::now());
        let (node, _, is_halted) = self.limits(&tree).find(|&(_, at, _)| now >= at)?;
        let LeafRules { within, on_error, .. } = self.rules_of(node);
        let (what, then) = match is_halted {
            // No rule of the tree helps: none of its actions starts before that.
            true => ("halted, it has not come to rest", LeafFault::Plan),
            false => ("it has not answered", on_error),
        };
        Some(LeafTrouble { node, why: format!("{what} for {within:?}"), then })
    }

    /// When the time limits end of the leaves that run, and of those that come to rest after a halt.
    fn limits<'a>(
        &'a self,
        tree: &'a Tree,
    ) -> impl Iterator<Item = (TreeNodeId, Duration, bool)> + 'a {
        let halted = tree.halting().map(|(run, since)| (run, since, true));
        let all = tree.running().map(|(run, since)| (run, since, false)).chain(halted);
        all.filter_map(|(run, since, is_halted)| {
            let started = self.started.get(&run.node).filter(|(known, _)| *known == run);
            let since = started.map_or(since, |(_, sign)| sign.get().max(since));
            let at = since.checked_add(self.rules_of(run.node).within)?;
            Some((run.node, at, is_halted))
        })
    }

    fn rules_of(&self, node: TreeNodeId) -> LeafRules {
        self.rules.get(&node).copied().unwrap_or_default()
    }

    /// The leaf that has panicked. Where none was called, the engine itself is wrong.
    fn panicked(&self, why: &str) -> TreeNodeId {
        let node = self.shared.tree.borrow().called().node();
        node.unwrap_or_else(|| panic!("a tree {why}"))
    }

    /// Reports a fault of a leaf, which stands until the leaf succeeds.
    fn blame(&mut self, node: TreeNodeId, why: &str, cx: &Context<Self>) -> String {
        let leaf = format!("leaf {}: {why}", self.shared.tree.borrow().path(node));
        // A script's text may be as long as its file.
        let detail: String = leaf.chars().take(DETAIL).collect();
        cx.declare_fault(FaultKind::CheckFailed, detail.clone());
        self.faulty.insert(node);
        detail
    }

    /// Reports a fault and does what its rule says. Whether the tree is to be ticked again at once.
    fn handle(&mut self, found: LeafTrouble, cx: &mut Context<Self>) -> Result<bool, Failure> {
        let LeafTrouble { node, why, then } = found;
        if then == LeafFault::Plan {
            let leaf = self.shared.tree.borrow().path(node).to_owned();
            self.halt(cx);
            return Err(format!("leaf {leaf}: {why}").into());
        }
        let detail = self.blame(node, &why, cx);
        tracing::warn!(tree = %cx.name(), "{detail}");
        let tried = self.tries.entry(node).or_default();
        let retries = matches!(then, LeafFault::Retry(times) if *tried < times);
        *tried = if retries { *tried + 1 } else { 0 };
        if then == LeafFault::RestartTree {
            self.halt(cx);
            return Ok(false);
        }
        let (shared, now) = (self.shared.clone(), BehaviorTree::now());
        let stopped = panics::caught(|| {
            let mut tree = shared.tree.borrow_mut();
            // One that failed to start is started again by the next tick.
            if retries { tree.retry(node, now) } else { tree.fail(node, now) }
        });
        if let Err(why) = &stopped {
            self.blame(node, &format!("halted, it {why}"), cx);
            self.halt(cx);
        }
        Ok(stopped.is_ok())
    }

    /// Halts all nodes, drops their futures, and gives all leases back.
    fn halt(&mut self, cx: &mut Context<Self>) {
        let shared = self.shared.clone();
        // Each panic takes one leaf out, so that this ends.
        let leaves = shared.tree.borrow().nodes().count();
        for _ in 0..=leaves {
            let now = BehaviorTree::now();
            let halted = panics::caught(|| shared.tree.borrow_mut().halt(now));
            self.take_changes(0, cx);
            let (node, why) = match halted {
                Ok(Ok(())) => break,
                Ok(Err(error)) => (error.node, error.problem.to_string()),
                Err(why) => (self.panicked(&why), format!("it {why}")),
            };
            self.blame(node, &format!("halted, {why}"), cx);
        }
        self.drop_halted(cx);
        // All leases are given back.
        drop(shared.commanders.take());
    }

    fn drop_halted(&mut self, cx: &Context<Self>) {
        for (node, why) in self.shared.drop_halted() {
            self.blame(node, &format!("halted, its future {why}"), cx);
        }
    }

    /// Shows what has changed; the fault of a leaf that succeeds is over.
    fn take_changes(&mut self, ticks: u64, cx: &Context<Self>) {
        let tree = self.shared.tree.borrow();
        self.view.take_changes(&tree, cx.name(), ticks);
        for change in tree.changes().iter().filter(|change| change.to == Status::Success) {
            self.tries.remove(&change.node);
            if self.faulty.remove(&change.node) && self.faulty.is_empty() {
                cx.cell.record.clear(FaultKind::CheckFailed);
            }
        }
    }

    /// Starts the futures of leaves that have started, and watches the conditions of new ones.
    fn start_tasks(&mut self, cx: &mut Context<Self>) {
        self.drop_halted(cx);
        let (shared, now) = (self.shared.clone(), BehaviorTree::now());
        for (run, _) in shared.tree.borrow().running() {
            let is_new = self.started.get(&run.node).is_none_or(|(known, _)| *known != run);
            let Some(make) = self.tasks.get(&run.node).filter(|_| is_new) else { continue };
            let sign = Rc::new(Cell::new(now));
            let context = Context::new(cx.cell.clone(), cx.state.clone());
            let task = LeafTask { shared: shared.clone(), run, sign: sign.clone(), cx: context };
            shared.start(RunningTask { run, future: make(task) });
            self.started.insert(run.node, (run, sign));
        }
        for condition in self.host.iter().flat_map(|host| host.take_fresh()) {
            let (shared, state) = (shared.clone(), cx.state.clone());
            cx.spawn(async move {
                let mut changes = condition.changes();
                while changes.next().await.is_some() {
                    shared.ask_turn(&state);
                }
            });
        }
    }

    /// Sets the timer of the next turn that the tree, or a leaf's time limit, needs.
    fn set_alarm(&mut self, cx: &mut Context<Self>) {
        let (tree, now) = (self.shared.tree.borrow(), BehaviorTree::now());
        let next = self.limits(&tree).map(|(_, at, _)| at).chain(tree.next_tick()).min();
        drop(tree);
        let next = next.map(|at| at.max(now + SHORTEST));
        if self.alarm.map(|(at, _)| at) == next {
            return;
        }
        if let Some((_, timer)) = self.alarm.take() {
            cx.cancel(timer);
        }
        self.alarm = next.map(|at| {
            let wake = |tree: &mut Self, cx: &mut _| {
                tree.alarm = None;
                tree.handle_wake(cx);
            };
            (at, cx.after(at - now, wake))
        });
    }

    /// Follows the record of faults, where a condition of the tree looks at it.
    fn follow_faults(&self, host: Arc<TreeHost>, cx: &mut Context<Self>) {
        let Some(record) = host.environment.feature::<TreeTable>().record.get().cloned() else {
            return;
        };
        let (shared, state) = (self.shared.clone(), cx.state.clone());
        cx.spawn(async move {
            while let Ok(record) = record.send(ReadRecord).await {
                if host.take_faults(record) {
                    shared.ask_turn(&state);
                }
                platform::sleep(RECORD_LOOK).await;
            }
        });
    }
}

impl Component for BehaviorTree {
    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let TreeSource { leaves, file, text, included } = &*self.source;
        let mut include =
            |path: &str| included.get(path).cloned().ok_or_else(|| "it was not there".to_owned());
        let mut tree = leaves.factory.load_with(file, text, None, &mut include)?;
        let environment = cx.cell.record.environment.clone();
        let view = Arc::new(TreeView::of(&tree, cx.name()));
        let host = Arc::new(TreeHost::new(environment));
        tree.lend(host.clone());
        for node in tree.nodes() {
            let make = leaves.tasks.get(node.type_name);
            self.tasks.extend(make.map(|make| (node.id, make.clone())));
            let rules = leaves.rules.get(node.type_name);
            self.rules.extend(rules.map(|rules| (node.id, *rules)));
        }
        let looks_at_faults = tree.nodes().any(|node| node.type_name == FAULT_CONDITION);
        self.shared.tree.replace(tree);
        let before = host.environment.feature::<TreeTable>().show(cx.name().clone(), view.clone());
        let called = before.as_ref().and_then(|view| view.called());
        let called = called.and_then(|path| self.shared.tree.borrow().find(&path));
        if let Some(node) = called {
            self.blame(node, "it did not return, and kept the tree's thread", cx);
        }
        let (shared, state) = (self.shared.clone(), cx.state.clone());
        cx.spawn(poll_fn(move |task| shared.poll(&state, task)));
        if looks_at_faults {
            self.follow_faults(host.clone(), cx);
        }
        (self.view, self.host) = (view, Some(host));
        Ok(())
    }

    async fn on_activated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.shared.turn_asked.set(false);
        self.active = true;
        Ok(())
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.turn(cx)
    }

    async fn on_deactivated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.active = false;
        self.halt(cx);
        let until = BehaviorTree::now() + REST_WITHIN;
        while self.shared.tree.borrow().halting().next().is_some() {
            if BehaviorTree::now() >= until {
                return Err(format!("a halted leaf did not come to rest in {REST_WITHIN:?}").into());
            }
            platform::sleep(REST_LOOK).await;
            self.halt(cx);
        }
        Ok(())
    }

    async fn on_aborting(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.active = false;
        self.halt(cx);
        // What has not come to rest ends with its value: the tree begins again without it.
        self.shared.tree.borrow_mut().drop_halting();
        Ok(())
    }

    async fn on_finalize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.cell.record.environment.feature::<TreeTable>().forget(cx.name());
        Ok(())
    }
}

impl Drop for BehaviorTree {
    fn drop(&mut self) {
        // The futures hold what holds them.
        drop(self.shared.tasks.take());
    }
}

/// Reads a file of trees, which another process may have made.
fn read_text(file: &Path) -> io::Result<String> {
    let about = fs::metadata(file)?;
    let refused = |why| Err(io::Error::new(io::ErrorKind::InvalidInput, why));
    if !about.is_file() {
        return refused("it is no regular file");
    }
    if about.len() > FILE_MAX {
        return refused("it has more than 1 MiB: divide it by `<include path=…/>`");
    }
    fs::read_to_string(file)
}
