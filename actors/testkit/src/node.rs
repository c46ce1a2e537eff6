//! A whole node under a test's clock.

use crate::guard::Guard;
use crate::probe::Probe;
use blastema::detection::{FaultRecord, FaultTransition, MonitorRow};
use blastema::{
    Event, Fault, FaultEvent, FaultEvents, FaultId, FaultKind, FaultLocation, Injection, Lifecycle,
    Node, NodeBuilder, ObjectName, StartError,
};
use blastema_doubles::PATIENCE;
use std::collections::BTreeSet;
use std::fmt::Write;
use std::ops::Deref;
use std::time::Duration;
use tokio::time::timeout;

/// Between two looks at states that are not reported: finer than anything that a test measures.
const LOOK: Duration = Duration::from_millis(1);

/// A node that lives on the test's thread and under its clock, with everything that a real one has.
///
/// It is a [`Node`], and waits for what the fault chain says of it. What was awaited once is not
/// found again: a second panic is awaited by a second call.
///
/// # Examples
/// ```
/// use blastema::prelude::*;
/// use blastema_testkit::TestNode;
/// use std::time::Duration;
///
/// struct Pump;
/// impl Component for Pump {
///     async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
///         if cx.incarnation().0 == 1 {
///             cx.after(Duration::from_secs(60), |_, _| panic!("the pump ran dry"));
///         }
///         Ok(())
///     }
/// }
///
/// blastema_testkit::run(async {
///     let builder = Node::builder("module1").child(ChildSpec::new("pump", || Pump));
///     let mut node = TestNode::start(builder).await;
///
///     node.advance(Duration::from_secs(59)).await;
///     node.expect_no_faults().await;
///     node.advance(Duration::from_secs(1)).await;
///
///     let panic = node.await_fault(FaultKind::Panic, "pump").await;
///     assert!(panic.detail.contains("the pump ran dry"));
///     node.await_recovered(FaultKind::Panic, "pump").await;
///     assert_eq!(node.row("pump").await.restarts, 1);
/// });
/// ```
pub struct TestNode {
    node: Node,
    events: FaultEvents,
    /// What came before it was awaited.
    unread: Vec<FaultEvent>,
    awaited: BTreeSet<FaultId>,
    probes: usize,
    _guard: Guard,
}

impl Deref for TestNode {
    type Target = Node;

    fn deref(&self) -> &Node {
        &self.node
    }
}

impl TestNode {
    /// Starts the node on this thread, whatever else the builder says about threads.
    ///
    /// # Panics
    /// When it does not start, with the reason.
    pub async fn start(builder: NodeBuilder) -> Self {
        match TestNode::try_start(builder).await {
            Ok(node) => node,
            Err(error) => panic!("the node did not start: {error}"),
        }
    }

    /// Starts the node on this thread.
    ///
    /// # Errors
    /// As [`NodeBuilder::start`].
    pub async fn try_start(builder: NodeBuilder) -> Result<Self, StartError> {
        // A component can already hang while the node starts.
        let guard = Guard::of(builder.running());
        Ok(TestNode::guarded(builder.on_this_thread().start().await?, guard).await)
    }

    /// Takes a node that runs already. Its clock is the test's only if it was built
    /// [`on_this_thread`](NodeBuilder::on_this_thread).
    pub async fn of(node: Node) -> Self {
        let guard = Guard::of(node.running());
        TestNode::guarded(node, guard).await
    }

    async fn guarded(node: Node, _guard: Guard) -> Self {
        let events = node.fault_events();
        let FaultRecord { entries, .. } = node.faults().await;
        let (awaited, unread, probes) = (BTreeSet::new(), Vec::new(), 0);
        let mut test = TestNode { node, events, unread, awaited, probes, _guard };
        // What happened while it started.
        for entry in entries {
            let (at, fault) = (entry.fault.found_at, entry.fault);
            test.unread.push(FaultEvent { fault: fault.clone(), at, turn: FaultTransition::Found });
            let repaired = !fault.is_repaired_by_recovery() || entry.recovered_at.is_none();
            let turns = [
                entry.given_up.map(|(at, reason)| (at, FaultTransition::GaveUp { reason })),
                entry.recovered_at.map(|at| (at, FaultTransition::Recovered)),
                entry.repaired_at.filter(|_| repaired).map(|at| (at, FaultTransition::Cleared)),
            ];
            for (at, turn) in turns.into_iter().flatten() {
                test.unread.push(FaultEvent { fault: fault.clone(), at, turn });
            }
        }
        test
    }

    /// Lets this time pass: everything due on the way happens, each at its own instant.
    pub async fn advance(&self, span: Duration) {
        blastema_doubles::advance(span).await;
    }

    /// Lets all actors handle the messages that they were sent, while the clock stands.
    pub async fn settle(&self) {
        blastema_doubles::settle().await;
    }

    /// The next fault of this kind in the object of this name.
    ///
    /// # Panics
    /// When none is found within [`PATIENCE`]; the text shows the faults that were.
    pub async fn await_fault(&mut self, kind: FaultKind, object: &str) -> Fault {
        let found =
            self.await_turn(&kind, object, "found", |turn| *turn == FaultTransition::Found).await;
        self.awaited.insert(found.fault.id);
        found.fault
    }

    /// Waits for the next recovery from a fault of this kind in the object of this name, and says
    /// how long after it was found that was.
    ///
    /// # Panics
    /// When there is none within [`PATIENCE`]; the text shows the faults that were found.
    pub async fn await_recovered(&mut self, kind: FaultKind, object: &str) -> Duration {
        let is_recovered = |turn: &FaultTransition| *turn == FaultTransition::Recovered;
        let recovered = self.await_turn(&kind, object, "recovered", is_recovered).await;
        self.awaited.insert(recovered.fault.id);
        recovered.at - recovered.fault.found_at
    }

    /// Waits until the recovery from a fault of this kind in the object of this name is given up,
    /// and says why.
    ///
    /// # Panics
    /// When it is not within [`PATIENCE`]; the text shows the faults that were found.
    pub async fn await_given_up(&mut self, kind: FaultKind, object: &str) -> String {
        let is_given_up = |turn: &FaultTransition| matches!(turn, FaultTransition::GaveUp { .. });
        let event = self.await_turn(&kind, object, "given up", is_given_up).await;
        self.awaited.insert(event.fault.id);
        match event.turn {
            FaultTransition::GaveUp { reason } => reason,
            _ => String::new(),
        }
    }

    /// Has the component of this name panic, whatever it is doing.
    ///
    /// # Panics
    /// When no component has the name, like all that puts faults in.
    pub fn kill(&self, component: &str) {
        self.put_in(component, Injection::Panic);
    }

    /// Has the next handler or hook of the component await for ever, until it is taken for hanging.
    pub fn hang(&self, component: &str) {
        self.put_in(component, Injection::Hang);
    }

    /// From now on the component works without giving signs of life.
    pub fn silence(&self, component: &str) {
        self.put_in(component, Injection::Silence);
    }

    /// So many initialisations of the component fail from now on; [`kill`](Self::kill) it to see
    /// the first.
    pub fn fail_init(&self, component: &str, times: u32) {
        self.put_in(component, Injection::FailedInitializations(times));
    }

    /// From now on each handler and hook of the component takes this much longer.
    pub fn slow(&self, component: &str, by: Duration) {
        self.put_in(component, Injection::Delay(by));
    }

    /// Takes out of the component what was put in and still acts.
    pub fn heal(&self, component: &str) {
        self.put_in(component, Injection::Nothing);
    }

    #[track_caller]
    fn put_in(&self, component: &str, injection: Injection) {
        if let Err(why) = self.node.inject(component, injection) {
            panic!("{injection:?} cannot be put in: {why}");
        }
    }

    /// Waits until the object of this name stands there in its incarnation.
    ///
    /// # Panics
    /// When it does not within [`PATIENCE`], or is not watched.
    pub async fn await_state(&self, object: &str, state: Lifecycle) {
        let reached = async {
            while self.row(object).await.state != Some(state) {
                self.advance(LOOK).await;
            }
        };
        if timeout(PATIENCE, reached).await.is_err() {
            let row = self.row(object).await;
            panic!("{object} did not become {state} within {PATIENCE:?}: {row:?}");
        }
    }

    /// What the monitor's table says of the object of this name.
    ///
    /// # Panics
    /// When it says nothing; the text shows what is watched.
    pub async fn row(&self, object: &str) -> MonitorRow {
        let table = self.node.table().await;
        let is_it = |row: &&MonitorRow| is_at(&row.location, object);
        let found = table.iter().find(is_it).cloned();
        found.unwrap_or_else(|| {
            let locations: Vec<String> = table.iter().map(|row| row.location.to_string()).collect();
            panic!("{object} is not watched; these are: {}", locations.join(", "))
        })
    }

    /// Makes sure that no fault was found but those that were awaited.
    ///
    /// # Panics
    /// When there was one; the text shows them.
    pub async fn expect_no_faults(&self) {
        self.settle().await;
        let mut record = self.node.faults().await;
        record.entries.retain(|entry| !self.awaited.contains(&entry.fault.id));
        assert!(record.entries.is_empty(), "unexpected faults:\n{}", describe(&record));
    }

    /// The faults that were found in this object, as lines for a person.
    pub(crate) async fn faults_of(&self, object: &ObjectName) -> Option<String> {
        let mut record = self.node.faults().await;
        record.entries.retain(|entry| is_at(&entry.fault.location, object.as_str()));
        (!record.entries.is_empty()).then(|| describe(&record))
    }

    /// A listener to the topic of this event, from now on.
    ///
    /// # Panics
    /// When the topic carries another contract of this name.
    pub async fn listen<E: Event>(&mut self) -> Probe<E> {
        self.probes += 1;
        let probe = Probe::new();
        let name = format!("testkit/probe{}", self.probes);
        if let Err(error) = self.node.add_child(probe.listener(&name)).await {
            panic!("a probe could not be added: {error}");
        }
        self.settle().await;
        probe
    }

    async fn await_turn(
        &mut self,
        kind: &FaultKind,
        object: &str,
        what: &str,
        wanted: impl Fn(&FaultTransition) -> bool,
    ) -> FaultEvent {
        let wanted = |event: &FaultEvent| {
            event.fault.kind == *kind && is_at(&event.fault.location, object) && wanted(&event.turn)
        };
        if let Some(at) = self.unread.iter().position(wanted) {
            return self.unread.remove(at);
        }
        let found = async {
            while let Some(event) = self.events.next().await {
                if wanted(&event) {
                    return Some(event);
                }
                self.unread.push(event);
            }
            None
        };
        match timeout(PATIENCE, found).await {
            Ok(Some(event)) => event,
            Ok(None) | Err(_) => {
                let record = match describe(&self.node.faults().await).as_str() {
                    "" => "no fault was found at all".to_owned(),
                    record => format!("found were:\n{record}"),
                };
                panic!("no {kind} of {object} was {what} within {PATIENCE:?}; {record}");
            }
        }
    }
}

fn is_at(location: &FaultLocation, object: &str) -> bool {
    match location {
        FaultLocation::Object(address) => {
            address.object.as_str() == object || address.to_string() == object
        }
        FaultLocation::Link { .. } | FaultLocation::Node(_) => location.to_string() == object,
    }
}

/// The record as lines for a person.
fn describe(record: &FaultRecord) -> String {
    let mut lines = String::new();
    for entry in &record.entries {
        let Fault { kind, location, incarnation, detail, count, .. } = &entry.fault;
        let ended = entry.status();
        let symptom = entry.fault.symptom_of.map_or("", |_| "  ");
        // Writing into a string does not fail.
        let _ = writeln!(
            lines,
            "{symptom}{kind} of {location}{incarnation} ×{count}: {detail} ({ended})"
        );
    }
    lines
}
