//! Carries a plan out on a node, and collects what a builder of robots can see of it.

use crate::robots::ledger::{Answer, Asked, Cause, Entry, Ledger, What};
use crate::robots::part::{Load, Reading, WATCHER, Watcher, Work};
use crate::robots::plan::{Action, Clock, Deed, Robot, Step, TOPICS};
use blastema::core::delivery::dead_letters::DeadLetterCount;
use blastema::core::recovery::ChildState;
use blastema::detection::FaultEntry;
use blastema::platform::now;
use blastema::prelude::*;
use blastema::{
    FaultEvent, FaultEvents, FaultRecord, FaultStatus, Injection, Instant, Lifecycle, MonitorRow,
    StartError, SupervisionTree,
};
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinHandle;

/// All that is known of one run.
pub(crate) struct Evidence {
    pub(crate) robot: Arc<Robot>,
    pub(crate) entries: Vec<Entry>,
    pub(crate) asked: Vec<Asked>,
    pub(crate) record: FaultRecord,
    pub(crate) events: Vec<FaultEvent>,
    pub(crate) missed_events: u64,
    pub(crate) table: Vec<MonitorRow>,
    pub(crate) tree: Option<SupervisionTree>,
    pub(crate) state: NodeState,
    pub(crate) dead: Vec<DeadLetterCount>,
    /// What each component answered at last.
    pub(crate) answers: Vec<Answer>,
    /// From when on nothing went wrong any more.
    pub(crate) quiet_at: Instant,
    /// When the pictures were taken.
    pub(crate) seen_at: Instant,
    /// What each component was when the watcher began to watch.
    pub(crate) watched_from: Vec<(String, ChildState, u64)>,
    /// What a person wanted of a component, and why it was not done.
    pub(crate) refused: Vec<(usize, String)>,
    /// Steps of which nothing was heard again.
    pub(crate) unanswered: Vec<Step>,
    /// The node was shut down in time.
    pub(crate) ended: bool,
    /// What the ledger got after that.
    pub(crate) late_entries: Vec<Entry>,
}

/// A node that did not start.
pub(crate) struct Refusal {
    pub(crate) robot: Arc<Robot>,
    pub(crate) entries: Vec<Entry>,
    pub(crate) error: StartError,
    /// What the ledger got after that.
    pub(crate) late_entries: Vec<Entry>,
}

/// In virtual time: as long as the longest ladder, with its pauses, and the longest wait.
const QUIET: Duration = Duration::from_secs(60);
/// On real threads: as long as a busy machine may take.
const PATIENCE: Duration = Duration::from_secs(60);

/// A millisecond each, for the watcher to come up.
const PATIENT_LOOKS: usize = 500;
/// How often pictures are taken again.
const PICTURES: usize = 20;
/// In which an ended node might do something: longer than most waits of a plan.
const REST: Duration = Duration::from_secs(1);
/// The same on real threads.
const REAL_REST: Duration = Duration::from_millis(50);

pub(crate) fn carry_out(robot: &Arc<Robot>) -> Result<Evidence, Box<Refusal>> {
    let ledger = Ledger::new(robot.clone());
    match robot.clock {
        Clock::Virtual => blastema_testkit::run(live(&ledger)),
        Clock::Real { .. } => blastema::run(live(&ledger)),
    }
}

async fn live(ledger: &Ledger) -> Result<Evidence, Box<Refusal>> {
    let robot = ledger.robot.clone();
    let watcher = ledger.clone();
    let watcher = ChildSpec::new(WATCHER, move || Watcher(watcher.clone())).on_own_thread();
    let mut builder = robot.builder(ledger);
    let mut events = builder.fault_events();
    if robot.clock == Clock::Virtual {
        builder = builder.on_this_thread();
    }
    let (early, steps): (Vec<&Step>, Vec<&Step>) = robot.steps.iter().partition(|step| step.early);
    early.into_iter().for_each(|step| take_early(ledger, step));
    let node = match builder.start().await {
        Ok(node) => node,
        Err(error) => {
            let entries = ledger.entries();
            rest(&robot).await;
            let late_entries = ledger.entries().split_off(entries.len());
            return Err(Box::new(Refusal { robot, entries, error, late_entries }));
        }
    };
    let added = node.add_child(watcher).await;
    assert!(added.is_ok() || at_rest(&node), "the root takes one more: {:?}", added.err());
    // Behind a sibling that waits for its device the watcher waits too: then it judges nothing.
    for _ in 0..PATIENT_LOOKS {
        if ledger.is_watched() || at_rest(&node) {
            break;
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    let tree = if ledger.is_watched() { node.tree().await } else { None };
    let watched_from = tree.as_ref().map(leaves).unwrap_or_default();

    let mut asked = Vec::new();
    let mut at_ms = 0;
    for step in steps {
        pass(&robot, Duration::from_millis(step.at_ms - at_ms)).await;
        at_ms = step.at_ms;
        asked.extend(take(&node, ledger, step).map(|task| (step.clone(), task)));
    }
    let quiet_at = now();
    ledger.cut();
    for part in &robot.parts {
        let _ = node.inject(&part.name, Injection::Nothing);
    }
    let mut unanswered = Vec::new();
    for (step, task) in asked {
        if tokio::time::timeout(PATIENCE, task).await.is_err() {
            unanswered.push(step);
        }
    }
    match robot.clock {
        Clock::Virtual => pass(&robot, QUIET).await,
        Clock::Real { .. } => {
            let _ = tokio::time::timeout(PATIENCE, quiet(&node, ledger)).await;
        }
    }
    let mut pictures = Pictures::take(&node, ledger).await;
    for _ in 0..PICTURES {
        if pictures.progress == ledger.progress() {
            break;
        }
        // Something went on meanwhile, so that they need not agree.
        pictures = Pictures::take(&node, ledger).await;
    }
    let Pictures { seen_at, table, record, tree, state, answers, .. } = pictures;
    let dead = node.dead_letters().counts();
    let ended = tokio::time::timeout(PATIENCE, node.shutdown()).await.is_ok();
    let until = ledger.entries().len();
    rest(&robot).await;
    let (events, missed_events) = told(&mut events).await;
    let entries = ledger.entries();
    let late_entries = entries[until..].to_vec();
    Ok(Evidence {
        robot,
        asked: ledger.asked(),
        refused: ledger.refused(),
        watched_from,
        unanswered,
        entries,
        record,
        events,
        missed_events,
        table,
        tree,
        state,
        dead,
        answers,
        quiet_at,
        seen_at,
        ended,
        late_entries,
    })
}

/// What the node shows at one time.
struct Pictures {
    seen_at: Instant,
    table: Vec<MonitorRow>,
    record: FaultRecord,
    tree: Option<SupervisionTree>,
    state: NodeState,
    answers: Vec<Answer>,
    /// How far the components were before.
    progress: (usize, usize),
}

impl Pictures {
    async fn take(node: &Node, ledger: &Ledger) -> Pictures {
        let (progress, seen_at) = (ledger.progress(), now());
        let (table, record, tree, state) =
            (node.table().await, node.faults().await, node.tree().await, node.state());
        let mut answers = Vec::new();
        for part in &ledger.robot.parts {
            answers.push(answer_of(node, ledger, &part.name).await);
        }
        Pictures { seen_at, table, record, tree, state, answers, progress }
    }
}

async fn told(events: &mut FaultEvents) -> (Vec<FaultEvent>, u64) {
    let mut all = Vec::new();
    while let Some(event) = events.next().await {
        all.push(event);
    }
    (all, events.missed())
}

async fn pass(robot: &Robot, span: Duration) {
    match robot.clock {
        Clock::Virtual => blastema_testkit::advance(span).await,
        Clock::Real { .. } => tokio::time::sleep(span).await,
    }
}

/// Lets an ended node do what it might do.
async fn rest(robot: &Robot) {
    let span = if robot.clock == Clock::Virtual { REST } else { REAL_REST };
    pass(robot, span).await;
}

/// Waits until all that was sent is served, and nothing is being recovered from.
async fn quiet(node: &Node, ledger: &Ledger) {
    loop {
        let before = ledger.progress();
        for part in &ledger.robot.parts {
            answer_of(node, ledger, &part.name).await;
        }
        let mark = ledger.number();
        for topic in 0..TOPICS {
            let publisher = node.publisher::<Reading>(&format!("t{topic}"));
            let _ = publisher.map(|publisher| publisher.publish(Reading::mark(topic, mark)));
        }
        tokio::time::sleep(Duration::from_millis(40)).await;
        while node.state() == NodeState::Running && !all_have(node, ledger, mark).await {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        if is_quiet(node).await && ledger.progress() == before && before.1 == 0 {
            return;
        }
    }
}

/// Whether this mark has reached every listener that runs.
async fn all_have(node: &Node, ledger: &Ledger, mark: u64) -> bool {
    let Some(tree) = node.tree().await else { return false };
    let leaves = leaves(&tree);
    ledger.robot.parts.iter().enumerate().all(|(part, plan)| {
        let runs = leaves
            .iter()
            .any(|(name, state, _)| *name == plan.name && *state == ChildState::Running);
        !runs || plan.listens.iter().all(|(topic, _)| ledger.has_mark(part, *topic, mark))
    })
}

/// What the component answers when its queue has room for the question.
async fn answer_of(node: &Node, ledger: &Ledger, name: &str) -> Answer {
    let Ok(sender) = node.sender::<Work>(name) else { return Answer::NotTaken("unknown".into()) };
    let start = now();
    loop {
        let work = Work { number: ledger.number(), deed: Deed::Nothing };
        let answer = sender.ask_within(work, PATIENCE).await;
        let is_full = answer.as_ref().is_err_and(|error| {
            matches!(error.kind, DeliveryError::Full | DeliveryError::Restarting)
        });
        if !is_full || now() - start > PATIENCE {
            return Answer::of(answer);
        }
        tokio::time::sleep(Duration::from_millis(3)).await;
    }
}

fn at_rest(node: &Node) -> bool {
    matches!(node.state(), NodeState::InSafeState { .. })
}

/// Whether nothing is being recovered from.
async fn is_quiet(node: &Node) -> bool {
    if at_rest(node) {
        return true;
    }
    let (record, Some(tree)) = (node.faults().await, node.tree().await) else { return false };
    if record.entries.iter().any(is_open) {
        return false;
    }
    let table = node.table().await;
    leaves(&tree).iter().all(|(name, state, _)| match state {
        ChildState::Running => table.iter().any(|row| {
            row.location.to_string() == format!("robot:{name}")
                && row.state == Some(Lifecycle::Active)
        }),
        state => matches!(state, ChildState::Resting | ChildState::Finished),
    })
}

/// Whether a fault stands though something is to be done about it.
pub(crate) fn is_open(entry: &FaultEntry) -> bool {
    let observed = entry.decided.as_ref().is_some_and(|(_, action)| action == "observe");
    entry.status() == FaultStatus::Open && !observed
}

/// All that stand below, with their states and incarnations; of what is not running, nothing below.
pub(crate) fn leaves(tree: &SupervisionTree) -> Vec<(String, ChildState, u64)> {
    let mut leaves = Vec::new();
    for child in &tree.children {
        match &child.below {
            Some(below) if child.state == ChildState::Running => leaves.extend(self::leaves(below)),
            _ => leaves.push((child.name.to_string(), child.state, child.incarnation.0)),
        }
    }
    leaves
}

/// What can go wrong before there is a node.
fn take_early(ledger: &Ledger, Step { part, action, .. }: &Step) {
    match action {
        Action::Hook(hook, pull) => ledger.pull(*part, hook, pull.clone()),
        Action::Condition(blow) => ledger.strike_condition(*part, *blow),
        Action::Unplug => ledger.plug_in(*part, false),
        action => unreachable!("{action:?} needs a node"),
    }
}

fn take(node: &Node, ledger: &Ledger, step: &Step) -> Option<JoinHandle<()>> {
    let Step { part, action, .. } = step;
    let part = *part;
    let name = &ledger.robot.parts[part].name;
    // A component that is not there, or not any more, is not struck.
    let put_in = |cause, injection| {
        if node.sender::<Work>(name).is_ok() {
            ledger.write_current(part, What::Struck(cause));
            let _ = node.inject(name, injection);
        }
    };
    match action {
        Action::Tell(deed) => {
            let work = Work { number: ledger.number(), deed: deed.clone() };
            if let Ok(sender) = node.sender::<Work>(name) {
                let _ = sender.tell(work);
            }
        }
        Action::Ask(deed, deadline_ms) => {
            let Ok(sender) = node.sender::<Work>(name) else { return None };
            let number = ledger.ask(part, None, *deadline_ms);
            let work = Work { number, deed: deed.clone() };
            let (ledger, within) = (ledger.clone(), Duration::from_millis(*deadline_ms));
            return Some(tokio::task::spawn_local(async move {
                let answer = sender.ask_within(work, within).await;
                ledger.answer(number, Answer::of(answer));
            }));
        }
        Action::Hook(..) | Action::Condition(_) | Action::Unplug => take_early(ledger, step),
        Action::PlugIn => ledger.plug_in(part, true),
        Action::Add if ledger.is_to_be_added(part) => {
            let (node, ledger) = (node.clone(), ledger.clone());
            return Some(tokio::task::spawn_local(async move {
                let (spec, _) = ledger.robot.spec(part, &ledger);
                match node.add_child(spec).await {
                    Ok(_) => ledger.write_current(part, What::Struck(Cause::Added)),
                    Err(error) => ledger.refuse(part, error.to_string()),
                }
            }));
        }
        Action::Add => {}
        Action::Remove => {
            let (node, ledger, name) = (node.clone(), ledger.clone(), name.clone());
            return Some(tokio::task::spawn_local(async move {
                // Only the root's own can be removed.
                if node.remove_child(&name).await.is_ok() {
                    ledger.write_current(part, What::Struck(Cause::Removed));
                }
            }));
        }
        Action::Kill => put_in(Cause::Kill, Injection::Panic),
        Action::Hang => put_in(Cause::Hang, Injection::Hang),
        Action::Silence => put_in(Cause::Silence, Injection::Silence),
        Action::FailInit(times) => {
            put_in(Cause::FailInit, Injection::FailedInitializations(*times))
        }
        Action::Slow(ms) => put_in(Cause::Slow, Injection::Delay(Duration::from_millis(*ms))),
        Action::Heal => drop(node.inject(name, Injection::Nothing)),
        Action::Flood(count) => {
            ledger.write_current(part, What::Struck(Cause::Flood));
            let sender = node.sender::<Load>(name).ok()?;
            (0..*count).for_each(|n| {
                let _ = sender.tell(Load(n));
            });
        }
        Action::RestartChild => {
            ledger.write_current(part, What::Struck(Cause::RestartChild));
            let (node, name) = (node.clone(), name.clone());
            return Some(tokio::task::spawn_local(async move {
                let _ = node.restart_child(&name).await;
            }));
        }
    }
    None
}
