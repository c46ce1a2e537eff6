//! Carries a plan out on a node, and collects what a builder of robots can see of it.

use crate::ledger::{Answer, Asked, Cause, Entry, Ledger, What};
use crate::part::{Load, Reading, WATCHER, Watcher, Work};
use crate::plan::{Action, Clock, Deed, Robot, Step, TOPICS};
use blastema::core::delivery::dead_letters::DeadLetterCount;
use blastema::core::recovery::ChildState;
use blastema::detection::FaultEntry;
use blastema::platform::now;
use blastema::prelude::*;
use blastema::{
    FaultEvent, FaultEvents, FaultRecord, FaultStatus, Injection, Instant, Lifecycle, MonitorRow,
    SupervisionTree,
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
    /// The node was shut down in time.
    pub(crate) ended: bool,
    /// How many lines the ledger had when it had been shut down, and some time later.
    pub(crate) lines: (usize, usize),
}

/// In virtual time: as long as the longest ladder, with its pauses, and the longest wait.
const QUIET: Duration = Duration::from_secs(60);
/// On real threads: as long as a busy machine may take.
const PATIENCE: Duration = Duration::from_secs(60);

pub(crate) fn carry_out(robot: &Arc<Robot>) -> Evidence {
    let ledger = Ledger::new(robot.clone());
    match robot.clock {
        Clock::Virtual => blastema_testkit::run(live(&ledger)),
        Clock::Real { .. } => blastema::run(live(&ledger)),
    }
}

async fn live(ledger: &Ledger) -> Evidence {
    let robot = ledger.robot.clone();
    let watcher = ledger.clone();
    let watcher = ChildSpec::new(WATCHER, move || Watcher(watcher.clone())).on_own_thread();
    let mut builder = robot.builder(ledger);
    let mut events = builder.fault_events();
    if robot.clock == Clock::Virtual {
        builder = builder.on_this_thread();
    }
    let node = builder.start().await.expect("nothing is wrong yet");
    node.add_child(watcher).await.expect("the root takes one more");

    let mut asked = Vec::new();
    let mut at_ms = 0;
    for step in &robot.steps {
        pass(&robot, Duration::from_millis(step.at_ms - at_ms)).await;
        at_ms = step.at_ms;
        asked.extend(take(&node, ledger, step));
    }
    let quiet_at = now();
    ledger.cut();
    for part in &robot.parts {
        let _ = node.inject(&part.name, Injection::Nothing);
    }
    for request in asked {
        let _ = request.await;
    }
    match robot.clock {
        Clock::Virtual => pass(&robot, QUIET).await,
        Clock::Real { .. } => {
            let _ = tokio::time::timeout(PATIENCE, quiet(&node, ledger)).await;
        }
    }
    let seen_at = now();
    let (table, record, tree, state) =
        (node.table().await, node.faults().await, node.tree().await, node.state());
    let mut answers = Vec::new();
    for part in &robot.parts {
        answers.push(answer_of(&node, ledger, &part.name).await);
    }
    let dead = node.dead_letters().counts();
    let ended = tokio::time::timeout(PATIENCE, node.shutdown()).await.is_ok();
    let lines = ledger.entries().len();
    pass(&robot, Duration::from_millis(50)).await;
    let (events, missed_events) = told(&mut events).await;
    let entries = ledger.entries();
    let lines = (lines, entries.len());
    Evidence {
        robot,
        asked: ledger.asked(),
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
        lines,
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
    let sender = node.sender::<Work>(name).expect("a component of the plan");
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

/// Whether nothing is being recovered from.
async fn is_quiet(node: &Node) -> bool {
    if matches!(node.state(), NodeState::InSafeState { .. }) {
        return true;
    }
    let (record, Some(tree)) = (node.faults().await, node.tree().await) else { return false };
    if record.entries.iter().any(is_open) {
        return false;
    }
    let table = node.table().await;
    leaves(&tree).iter().all(|(name, state, _)| match state {
        ChildState::Running => table.iter().any(|row| {
            row.place.to_string() == format!("robot:{name}") && row.state == Some(Lifecycle::Active)
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

fn take(node: &Node, ledger: &Ledger, step: &Step) -> Option<JoinHandle<()>> {
    let Step { part, action, .. } = step;
    let part = *part;
    let name = &ledger.robot.parts[part].name;
    let put_in = |cause, injection| {
        ledger.write_current(part, What::Struck(cause));
        node.inject(name, injection).expect("a component of the plan");
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
        Action::Hook(hook, pull) => ledger.pull(part, hook, pull.clone()),
        Action::Condition => ledger.strike_condition(part),
        Action::Kill => put_in(Cause::Kill, Injection::Panic),
        Action::Hang => put_in(Cause::Hang, Injection::Hang),
        Action::Silence => put_in(Cause::Silence, Injection::Silence),
        Action::FailInit(times) => {
            put_in(Cause::FailInit, Injection::FailedInitializations(*times))
        }
        Action::Slow(ms) => put_in(Cause::Slow, Injection::Delay(Duration::from_millis(*ms))),
        Action::Heal => node.inject(name, Injection::Nothing).expect("a component of the plan"),
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
