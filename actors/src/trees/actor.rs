//! The component that ticks a tree.

use super::connected::FAULT_CONDITION;
use super::host::TreeHost;
use super::leaves::{LeafFault, LeafRules, TreeLeaves};
use super::rows::{TreeTable, TreeView};
use super::shared::{RunningTask, TaskFault, TreeShared};
use super::task::{LeafTask, MakeTask};
use crate::component::context::Context;
use crate::component::environment::ComponentEnvironment;
use crate::component::incarnation::TimerId;
use crate::component::{Component, Failure};
use crate::host::spec::ChildSpec;
use crate::platform::{self, panics};
use blastema_contract::detector::ReadRecord;
use blastema_core::FaultKind;
use blastema_trees::{LeafRun, Status, TickProblem, TreeErrors, TreeNodeId};
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
        let file = (format!("{name}.xml"), text.to_owned());
        let no_files = |_: &str| Err("no files are included here".to_owned());
        BehaviorTree::of(leaves, file, no_files).map(|make| make(name))
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
        let made = BehaviorTree::of(leaves, (label, text), include);
        made.map_err(|errors| io::Error::new(io::ErrorKind::InvalidData, errors))
    }

    fn of<R: Fn(&str) -> Result<String, String>>(
        leaves: &TreeLeaves,
        (file, text): (String, String),
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
        self.shared.begin_turn();
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
            let found = self.tick(cx);
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
    fn tick(&mut self, cx: &Context<Self>) -> Option<LeafTrouble> {
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
            Err(why) => match shared.tree.borrow().panicked() {
                Some(node) => (node, why, self.rules_of(node).after(true)),
                // No leaf was called: the engine itself is wrong.
                None => panic!("the tree {} {why}", cx.name()),
            },
        };
        Some(LeafTrouble { node, why, then })
    }

    /// The first leaf that has exceeded its time limit.
    fn overdue(&self) -> Option<LeafTrouble> {
        let (tree, now) = (self.shared.tree.borrow(), BehaviorTree::now());
        let late = |&(run, since): &(LeafRun, Duration)| {
            now.saturating_sub(self.last_sign(run, since)) >= self.rules_of(run.node).within
        };
        let (run, _) = tree.running().find(late)?;
        let rules = self.rules_of(run.node);
        let why = format!("it has not answered for {:?}", rules.within);
        Some(LeafTrouble { node: run.node, why, then: rules.on_error })
    }

    fn last_sign(&self, run: LeafRun, since: Duration) -> Duration {
        let tasks = self.shared.tasks.borrow();
        let task = tasks.iter().find(|task| task.run == run);
        task.map_or(since, |task| task.sign.get().max(since))
    }

    fn rules_of(&self, node: TreeNodeId) -> LeafRules {
        self.rules.get(&node).copied().unwrap_or_default()
    }

    /// Reports a fault and does what its rule says. Whether the tree is to be ticked again at once.
    fn handle(&mut self, found: LeafTrouble, cx: &mut Context<Self>) -> Result<bool, Failure> {
        let LeafTrouble { node, why, then } = found;
        let path = self.shared.tree.borrow().path(node).to_owned();
        let detail = format!("leaf {path}: {why}");
        tracing::warn!(tree = %cx.name(), "{detail}");
        if then != LeafFault::Plan {
            cx.declare_fault(FaultKind::CheckFailed, detail.clone());
            self.faulty.insert(node);
        }
        let tried = self.tries.entry(node).or_default();
        let retries = matches!(then, LeafFault::Retry(times) if *tried < times);
        *tried = if retries { *tried + 1 } else { 0 };
        if then == LeafFault::RestartTree {
            self.halt(cx);
            return Ok(false);
        }
        if then == LeafFault::Plan {
            self.halt(cx);
            return Err(detail.into());
        }
        let (shared, now) = (self.shared.clone(), BehaviorTree::now());
        let stopped = panics::caught(|| {
            let mut tree = shared.tree.borrow_mut();
            let run = tree.running().map(|(run, _)| run).find(|run| run.node == node);
            match (run, retries) {
                (Some(run), true) => tree.retry(run, now),
                (Some(run), false) => tree.fail(run, now),
                // It failed to start: the next tick starts it again.
                (None, true) => true,
                (None, false) => tree.fail_next(node),
            }
        });
        if let Err(why) = &stopped {
            cx.declare_fault(FaultKind::CheckFailed, format!("leaf {path}, halted: {why}"));
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
            let why = match halted {
                Ok(Ok(())) => break,
                Ok(Err(error)) => {
                    self.faulty.insert(error.node);
                    error.to_string()
                }
                Err(why) => {
                    let (tree, node) = (shared.tree.borrow(), shared.tree.borrow().panicked());
                    self.faulty.extend(node);
                    format!("{}: {why}", node.map(|node| tree.path(node)).unwrap_or_default())
                }
            };
            cx.declare_fault(FaultKind::CheckFailed, format!("leaf {why}, when it was halted"));
        }
        self.drop_halted(cx);
        shared.release();
    }

    fn drop_halted(&mut self, cx: &Context<Self>) {
        for (node, why) in self.shared.drop_halted() {
            self.faulty.insert(node);
            let leaf = self.shared.tree.borrow().path(node).to_owned();
            let detail = format!("leaf {leaf}, halted: its future {why}");
            cx.declare_fault(FaultKind::CheckFailed, detail);
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
        let (tree, known) = (shared.tree.borrow(), shared.tasks.borrow());
        let is_new = |run: &LeafRun| known.iter().all(|task| task.run != *run);
        let new = tree
            .running()
            .map(|(run, _)| run)
            .filter(|run| self.tasks.contains_key(&run.node) && is_new(run));
        let new: Vec<LeafRun> = new.collect();
        drop((tree, known));
        for run in new {
            let sign = Rc::new(Cell::new(now));
            let context = Context::new(cx.cell.clone(), cx.state.clone());
            let leaf = LeafTask { shared: shared.clone(), run, sign: sign.clone(), cx: context };
            let future = self.tasks[&run.node](leaf);
            shared.start(RunningTask { run, sign, future });
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
        let limits = tree.running().filter_map(|(run, since)| {
            self.last_sign(run, since).checked_add(self.rules_of(run.node).within)
        });
        let next = limits.chain(tree.next_tick()).min();
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
        let Some(record) = host.environment.trees().record().cloned() else { return };
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
        let before = host.environment.trees().show(cx.name().clone(), view.clone());
        if let Some(path) = before.as_ref().and_then(|view| view.called()) {
            let tree = self.shared.tree.borrow();
            let node = tree.nodes().map(|node| node.id).find(|node| tree.path(*node) == path);
            self.faulty.extend(node);
            let detail = format!("leaf {path}: it did not return, and kept the tree's thread");
            cx.declare_fault(FaultKind::CheckFailed, detail);
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
        self.shared.begin_turn();
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
        while self.shared.tree.borrow().is_halting() {
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
        Ok(())
    }

    async fn on_finalize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.cell.record.environment.trees().forget(cx.name());
        Ok(())
    }
}

impl Drop for BehaviorTree {
    fn drop(&mut self) {
        // The futures hold what holds them.
        drop(self.shared.tasks.take());
    }
}

impl ComponentEnvironment {
    /// The trees of the node.
    pub(crate) fn trees(&self) -> &TreeTable {
        self.extensions.get()
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
