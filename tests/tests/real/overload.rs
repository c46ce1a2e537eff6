//! Components that keep their thread by real work, on real threads. Everything is judged by counts
//! and order: a busy machine makes these tests slower, and changes nothing else.

use blastema::core::detection::{FaultEntry, FaultRecord};
use blastema::prelude::*;
use blastema::{Incarnation, NodeBuilder};
use blastema_testkit::TestNode;
use blastema_tests::{MS, Part, accepts, serves, until};
use rustix::time::{ClockId, clock_gettime};
use std::sync::Arc;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::time::Duration;

/// As long as anything here may take on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// Work that needs a processor for so long.
fn burn(span: Duration) {
    let used = || Duration::try_from(clock_gettime(ClockId::ThreadCPUTime)).expect("it counts up");
    let end = used() + span;
    while used() < end {
        std::hint::spin_loop();
    }
}

#[derive(Clone, Copy, Debug, Event)]
struct Plan30;

/// Counts its rounds, each of which takes so long.
struct Safety(Arc<Counts>, Duration);
impl Component for Safety {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        burn(self.1);
        self.0.rounds.fetch_add(1, SeqCst);
        Ok(())
    }
}

#[derive(Default)]
struct Counts {
    planned: AtomicU64,
    rounds: AtomicU64,
    /// Of the rounds, those while a plan was made.
    beside: AtomicU64,
    load: AtomicBool,
}

impl Counts {
    /// It needs 30 ms for each message.
    fn planner(self: &Arc<Self>) -> ChildSpec<Part<Arc<Self>, Plan30>> {
        let planner = accepts("planner", self.clone(), |counts, _: Plan30, _| {
            let rounds = counts.rounds.load(SeqCst);
            burn(30 * MS);
            // On one thread with the planner, the safety component has no round meanwhile.
            counts.beside.fetch_add(counts.rounds.load(SeqCst) - rounds, SeqCst);
            counts.planned.fetch_add(1, SeqCst);
        });
        planner.queue(16, WhenFull::DropOldest).max_block(LONG).ready_within(LONG)
    }

    fn safety(self: &Arc<Self>, name: &str, work: Duration) -> ChildSpec<Safety> {
        let counts = self.clone();
        let spec = ChildSpec::new(name, move || Safety(counts.clone(), work));
        spec.max_block(LONG).ready_within(LONG)
    }

    /// A planner that gets 40 messages a second, and a 50 Hz neighbour with a watch of 110 ms.
    fn robot(self: &Arc<Self>) -> NodeBuilder {
        let safety = self.safety("safety", Duration::ZERO).rate_hz(50.0);
        Node::builder("m")
            .work_threads(1)
            .child(self.planner())
            .child(safety.liveness(Liveness::push(20 * MS, 5)))
    }

    /// Feeds the planner until it is told to end.
    fn feed(self: &Arc<Self>, node: &Node) {
        let planner = node.sender::<Plan30>("planner").expect("a planner");
        let counts = self.clone();
        counts.load.store(true, SeqCst);
        tokio::task::spawn_local(async move {
            while counts.load.load(SeqCst) {
                let _ = planner.tell(Plan30);
                tokio::time::sleep(25 * MS).await;
            }
        });
    }
}

async fn start(builder: NodeBuilder) -> TestNode {
    TestNode::of(builder.start().await.expect("the node starts")).await
}

/// Waits for the overload of a component; it is the computer's where that has hardly any time.
async fn await_overload(node: &Node, name: &str) {
    let location = format!("m:{name}");
    let is_overload =
        |entry: &FaultEntry| is_of(entry, &FaultKind::Overload, &location) || is_computers(entry);
    until(async || node.faults().await.entries.iter().any(is_overload), "an overload").await;
}

fn is_of(entry: &FaultEntry, kind: &FaultKind, location: &str) -> bool {
    entry.fault.kind == *kind && entry.fault.location.to_string() == location
}

/// The computer is overloaded, which it may be wherever tests are run.
fn is_computers(entry: &FaultEntry) -> bool {
    is_of(entry, &FaultKind::Overload, "m")
}

/// Everything that was found is the planner's overload, or its symptom.
fn has_one_root(record: &FaultRecord) -> bool {
    let planner = |entry: &&FaultEntry| {
        is_of(entry, &FaultKind::Overload, "m:planner") || is_computers(entry)
    };
    let roots: Vec<_> = record.entries.iter().filter(planner).map(|e| e.fault.id).collect();
    record.entries.iter().all(|entry| match entry.fault.symptom_of {
        Some(root) => roots.contains(&root) && entry.decided.is_none(),
        None => planner(&entry),
    })
}

#[test]
fn who_keeps_a_thread_is_the_root_of_an_overload_and_its_neighbour_is_not_restarted() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let counts = Arc::<Counts>::default();
        let node = start(counts.robot()).await;

        counts.feed(&node);
        await_overload(&node, "planner").await;
        tokio::time::sleep(1000 * MS).await;

        let record = node.faults().await;
        assert!(has_one_root(&record), "{record:#?}");
        let planners = |entry: &&FaultEntry| is_of(entry, &FaultKind::Overload, "m:planner");
        let mut planners = record.entries.iter().filter(planners);
        assert!(planners.all(|entry| entry.fault.detail.contains("it keeps its thread for")));
        assert!(node.row("safety").await.missed_rounds > 0);
        counts.load.store(false, SeqCst);
        let none_stands = async || node.faults().await.entries.iter().all(|e| !e.stands());
        until(none_stands, "the load is gone, and so are the faults").await;
        assert!(has_one_root(&node.faults().await));
        for name in ["planner", "safety"] {
            assert_eq!(node.row(name).await.incarnation, Incarnation(1), "{name}");
        }
        node.shutdown().await;
    });
}

#[test]
fn a_planner_that_was_moved_to_its_own_thread_lets_its_neighbour_keep_its_rounds() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let counts = Arc::<Counts>::default();
        let ladder = Ladder::first(RecoveryAction::MoveToOwnThread).then(RecoveryAction::Observe);
        let plan = Plan::default().on(FaultKind::Overload, ladder);
        let mut node = start(counts.robot().plan(plan)).await;

        counts.feed(&node);
        await_overload(&node, "planner").await;
        // A thread of its own gives the planner no time where the computer has none.
        if node.faults().await.entries.iter().any(is_computers) {
            return node.shutdown().await;
        }
        node.await_recovered(FaultKind::Overload, "planner").await;

        assert_eq!(node.row("planner").await.incarnation, Incarnation(2));
        assert_eq!(node.row("safety").await.incarnation, Incarnation(1));
        let has_rounds = async || counts.beside.load(SeqCst) > 10;
        until(has_rounds, "a neighbour has its rounds while plans are made").await;
        counts.load.store(false, SeqCst);
        node.shutdown().await;
    });
}

#[test]
fn rounds_that_overrun_their_period_are_counted_and_a_fault() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let counts = Arc::<Counts>::default();
        let slow = counts.safety("slow", 25 * MS).rate_hz(100.0);
        let node = start(Node::builder("m").work_threads(1).child(slow)).await;

        await_overload(&node, "slow").await;

        let record = node.faults().await;
        let tells = |entry: &FaultEntry| entry.fault.detail.contains("rounds were missed");
        assert!(record.entries.iter().any(tells), "{record:#?}");
        let row = node.row("slow").await;
        let (missed, done) = (row.missed_rounds, counts.rounds.load(SeqCst));
        assert!(missed > done / 2, "{missed} missed, {done} done");
        assert_eq!(row.incarnation, Incarnation(1));
        node.shutdown().await;
    });
}

/// Sets a thousand timers of 10 ms, each of which takes 20 µs: twice what a thread can do.
struct Clockwork(Arc<Counts>);
impl Component for Clockwork {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        for _ in 0..1000 {
            cx.every(10 * MS, |clockwork, _| {
                burn(Duration::from_micros(20));
                clockwork.0.planned.fetch_add(1, SeqCst);
            });
        }
        Ok(())
    }
}

#[test]
fn timers_that_cannot_be_kept_are_run_as_often_as_can_be_and_are_an_overload() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let counts = Arc::<Counts>::default();
        let own = counts.clone();
        let clockwork = ChildSpec::new("clockwork", move || Clockwork(own.clone()));
        let safety = counts.safety("safety", Duration::ZERO).rate_hz(50.0);
        let builder = Node::builder("m").work_threads(1).child(clockwork).child(safety);
        let node = start(builder).await;

        await_overload(&node, "clockwork").await;

        assert!(node.row("clockwork").await.missed_rounds > 0);
        let count = || (counts.planned.load(SeqCst), counts.rounds.load(SeqCst));
        let (called, rounds) = count();
        until(async || count().0 >= called + 20_000, "it goes on").await;
        let (called, rounds) = (count().0 - called, count().1 - rounds);
        // A thousand in each interval of the safety component, if both share the thread alone.
        assert!(called >= 200 * rounds && rounds > 0, "{called} calls, {rounds} rounds");
        assert!(called <= 2000 * rounds, "{called} calls, {rounds} rounds");
        assert_eq!(node.row("clockwork").await.incarnation, Incarnation(1));
        node.shutdown().await;
    });
}

#[derive(Clone, Copy, Debug, Request)]
#[contract(reply = ())]
struct Calibrate;

#[test]
fn a_declared_long_operation_is_no_hang_though_a_short_one_ended_within_it() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let camera = serves("camera", (), |_, _: Calibrate, cx| {
            let _long = cx.long_operation(LONG);
            drop(cx.long_operation(MS));
            // It needs no processor, only the thread.
            blastema_tests::burn(250 * MS);
        });
        let camera = camera.max_block(60 * MS);
        let node = start(Node::builder("m").work_threads(1).child(camera)).await;

        let camera = node.sender::<Calibrate>("camera").expect("a camera");
        for _ in 0..6 {
            camera.ask_within(Calibrate, LONG).await.expect("it lives");
        }

        node.expect_no_faults().await;
        assert_eq!(node.row("camera").await.incarnation, Incarnation(1));
        node.shutdown().await;
    });
}
