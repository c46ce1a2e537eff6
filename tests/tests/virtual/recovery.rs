//! Every way to recover, in whole nodes: a component fails, and what comes of it is read from the
//! record of faults, the tree, and what the components themselves went through.

use blastema::core::detection::FaultEntry;
use blastema::core::recovery::{ChildState, RecoveryDone, RecoveryFailed, RecoveryOrder};
use blastema::prelude::*;
use blastema::{Fault, NodeBuilder, RecoveryStrategy, StrategyContext};
use blastema_doubles::{advance, paused};
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Provokes a fault in the component that serves it.
#[derive(Clone, Copy, Debug, Request)]
#[contract(name = "test/provoke", version = 1, reply = bool)]
enum Provoke {
    Nothing,
    Panic,
    Error,
    Fatal,
    Hang,
}

/// What all parts of one robot went through, and how their next incarnations are to begin.
#[derive(Clone, Default)]
struct Diary(Arc<Mutex<Pages>>);

#[derive(Default)]
struct Pages {
    lines: Vec<String>,
    /// So many initialisations of this part fail.
    failing: Vec<(&'static str, usize)>,
    resets_fail: bool,
}

impl Diary {
    fn note(&self, line: String) {
        self.0.lock().unwrap().lines.push(line);
    }

    fn take(&self) -> Vec<String> {
        std::mem::take(&mut self.0.lock().unwrap().lines)
    }

    fn fails(&self, part: &'static str, times: usize) {
        self.0.lock().unwrap().failing.push((part, times));
    }
}

struct Part {
    name: &'static str,
    diary: Diary,
    failure: Option<Failure>,
}

impl Component for Part {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Provoke>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.diary.note(format!("{} begins", self.name));
        let mut pages = self.diary.0.lock().unwrap();
        match pages.failing.iter_mut().find(|(part, times)| *part == self.name && *times > 0) {
            Some((_, times)) => {
                *times -= 1;
                Err("no device".into())
            }
            None => Ok(()),
        }
    }

    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.failure.take().map_or(Ok(()), Err)
    }

    async fn on_reset(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.diary.note(format!("{} resets", self.name));
        match self.diary.0.lock().unwrap().resets_fail {
            true => Err("jammed".into()),
            false => Ok(()),
        }
    }

    async fn on_finalize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.diary.note(format!("{} ends", self.name));
        Ok(())
    }
}

impl Handle<Provoke> for Part {
    async fn handle(&mut self, provocation: Provoke, _: &mut Context<Self>) -> bool {
        match provocation {
            Provoke::Nothing => {}
            Provoke::Panic => panic!("as it was told"),
            Provoke::Error => self.failure = Some("too hot".into()),
            Provoke::Fatal => self.failure = Some(Failure::fatal("on fire")),
            Provoke::Hang => std::future::pending().await,
        }
        true
    }
}

fn part(name: &'static str, diary: &Diary) -> ChildSpec<Part> {
    let diary = diary.clone();
    ChildSpec::new(name, move || Part { name, diary: diary.clone(), failure: None })
        .rate_hz(100.0)
        .max_wait(Duration::from_secs(1))
}

fn node() -> NodeBuilder {
    Node::builder("here").on_this_thread()
}

async fn start(builder: NodeBuilder) -> Node {
    builder.start().await.expect("a node that starts")
}

async fn provoke(node: &Node, part: &str, what: Provoke) {
    let part: Sender<Provoke> = node.sender(part).expect("it takes provocations");
    part.tell(what).expect("room in its queue");
    advance(Duration::from_secs(3)).await;
}

async fn answers(node: &Node, part: &str) -> bool {
    let part: Sender<Provoke> = node.sender(part).expect("it takes provocations");
    matches!(part.ask(Provoke::Nothing).await, Ok(true))
}

/// The record in words: `panic of laser: recovered`.
async fn record(node: &Node) -> Vec<String> {
    let told = |entry: FaultEntry| {
        let end = match (entry.recovered_at, entry.repaired_at, entry.given_up) {
            (Some(_), ..) => "recovered".into(),
            (None, Some(_), _) => "cleared".into(),
            (None, None, Some((_, reason))) => reason,
            (None, None, None) => "stands".into(),
        };
        let location = entry.fault.location.to_string();
        format!("{} of {}: {end}", entry.fault.kind, location.trim_start_matches("here:"))
    };
    node.faults().await.entries.into_iter().map(told).collect()
}

#[test]
fn a_panic_is_followed_by_the_next_incarnation() {
    paused(async {
        let diary = Diary::default();
        let node = start(node().child(part("laser", &diary)).child(part("arm", &diary))).await;
        diary.take();

        provoke(&node, "laser", Provoke::Panic).await;

        assert_eq!(diary.take(), ["laser begins"]);
        assert_eq!(record(&node).await, ["panic of laser: recovered"]);
        assert!(answers(&node, "laser").await);
        let tree = node.tree().await.expect("it runs");
        assert_eq!((tree.restarts_left, tree.children[0].restarts), (2, 1));
    });
}

#[test]
fn restarts_on_the_spot_are_drawn_from_the_supervisors_budget() {
    paused(async {
        let diary = Diary::default();
        let drive = SupervisorSpec::new("drive", Strategy::OneForOne)
            .intensity(2, Duration::from_secs(60))
            .when_exceeded(WhenExceeded::Escalate)
            .child(part("wheel", &diary))
            .child(part("brake", &diary));
        let node = start(node().supervisor(drive)).await;
        diary.take();

        provoke(&node, "wheel", Provoke::Panic).await;
        provoke(&node, "brake", Provoke::Panic).await;
        assert_eq!(diary.take(), ["wheel begins", "brake begins"]);

        provoke(&node, "wheel", Provoke::Panic).await;

        assert_eq!(diary.take(), ["brake ends", "wheel begins", "brake begins"]);
        let all: [&str; 4] = [
            "panic of wheel: recovered",
            "panic of brake: recovered",
            "panic of wheel: recovered",
            "restart storm of drive: recovered",
        ];
        assert_eq!(record(&node).await, all);
        assert!(answers(&node, "wheel").await && answers(&node, "brake").await);
    });
}

#[test]
fn whoever_depends_on_the_one_that_failed_begins_anew_with_it() {
    paused(async {
        let diary = Diary::default();
        let drive = SupervisorSpec::new("drive", Strategy::RestForOne)
            .child(part("motors", &diary))
            .child(part("odometry", &diary))
            .child(part("planner", &diary));
        let node = start(node().supervisor(drive)).await;
        diary.take();

        provoke(&node, "odometry", Provoke::Panic).await;

        assert_eq!(diary.take(), ["planner ends", "odometry begins", "planner begins"]);
        assert_eq!(record(&node).await, ["panic of odometry: recovered"]);
    });
}

#[test]
fn an_error_is_reset_in_the_same_incarnation() {
    paused(async {
        let diary = Diary::default();
        let node = start(node().child(part("arm", &diary))).await;
        diary.take();

        provoke(&node, "arm", Provoke::Error).await;

        assert_eq!(diary.take(), ["arm resets"]);
        assert_eq!(record(&node).await, ["error state of arm: recovered"]);
        assert!(answers(&node, "arm").await);
    });
}

#[test]
fn an_error_that_cannot_be_reset_is_followed_by_the_next_incarnation() {
    paused(async {
        let diary = Diary::default();
        let node = start(node().child(part("arm", &diary))).await;
        diary.take();
        diary.0.lock().unwrap().resets_fail = true;

        provoke(&node, "arm", Provoke::Error).await;

        let done = diary.take();
        assert_eq!(done, ["arm resets", "arm ends", "arm begins"]);
        let record = record(&node).await;
        assert!(record.iter().all(|line| line.ends_with("recovered")), "{record:?}");
        assert!(answers(&node, "arm").await);
    });
}

#[test]
fn a_fatal_fault_is_followed_by_the_next_incarnation_also_where_ending_is_allowed() {
    paused(async {
        let diary = Diary::default();
        let group = SupervisorSpec::new("group", Strategy::OneForOne)
            .child_with(part("arm", &diary), Restart::Transient);
        let node = start(node().supervisor(group)).await;
        diary.take();

        provoke(&node, "arm", Provoke::Fatal).await;

        assert_eq!(diary.take(), ["arm ends", "arm begins"]);
        assert_eq!(record(&node).await, ["fatal error of arm: recovered"]);
        assert!(answers(&node, "arm").await);
    });
}

#[test]
fn a_handler_that_never_returns_is_given_up_and_replaced() {
    paused(async {
        let diary = Diary::default();
        let node = start(node().child(part("arm", &diary)).child(part("laser", &diary))).await;
        diary.take();

        provoke(&node, "arm", Provoke::Hang).await;

        assert_eq!(diary.take(), ["arm begins"]);
        assert_eq!(record(&node).await, ["hang of arm: recovered"]);
        assert!(answers(&node, "arm").await);
    });
}

#[test]
fn an_initialisation_that_fails_at_first_is_tried_again_and_the_rest_waits() {
    paused(async {
        let diary = Diary::default();
        diary.fails("arm", 2);

        let node = start(node().child(part("arm", &diary)).child(part("hand", &diary))).await;
        advance(Duration::from_secs(1)).await;

        let begun: Vec<String> =
            diary.take().into_iter().filter(|line| line.ends_with("begins")).collect();
        assert_eq!(begun, ["arm begins", "arm begins", "arm begins", "hand begins"]);
        assert_eq!(record(&node).await, ["initialisation failed of arm: recovered"]);
        assert_eq!(node.state(), NodeState::Running);
    });
}

#[test]
fn what_never_initialises_ends_in_safe_rest_and_the_others_go_to_work() {
    paused(async {
        let diary = Diary::default();
        diary.fails("arm", usize::MAX);
        let applied = Arc::new(AtomicUsize::new(0));
        let outputs = applied.clone();
        let builder = node()
            .intensity(5, Duration::from_secs(10))
            .child(part("arm", &diary))
            .child(part("laser", &diary))
            .safe_outputs(move |fault: &Fault| {
                assert_eq!(fault.kind, FaultKind::InitializationFailed);
                outputs.fetch_add(1, SeqCst);
            });

        let node = start(builder).await;
        advance(Duration::from_secs(1)).await;

        assert_eq!(
            record(&node).await,
            ["initialisation failed of arm: contained by safe stop; service is not restored"]
        );
        assert_eq!(applied.load(SeqCst), 1);
        assert!(answers(&node, "laser").await);
        let tree = node.tree().await.expect("it runs");
        assert_eq!(tree.children[0].state, ChildState::Resting);
        assert_eq!(node.state(), NodeState::Running);
    });
}

#[test]
fn a_storm_that_reaches_the_root_puts_the_node_to_rest() {
    paused(async {
        let diary = Diary::default();
        let builder = node()
            .intensity(1, Duration::from_secs(60))
            .when_exceeded(WhenExceeded::Escalate)
            .child(part("arm", &diary))
            .child(part("laser", &diary));
        let node = start(builder).await;

        provoke(&node, "arm", Provoke::Panic).await;
        diary.take();
        provoke(&node, "arm", Provoke::Panic).await;

        assert!(matches!(node.ended().await, NodeState::InSafeState { .. }), "{:?}", node.state());
        assert_eq!(diary.take(), ["laser ends"]);
    });
}

#[test]
fn a_temporary_child_that_dies_is_let_go() {
    paused(async {
        let diary = Diary::default();
        let group = SupervisorSpec::new("group", Strategy::OneForOne)
            .child_with(part("probe", &diary), Restart::Temporary)
            .child(part("arm", &diary));
        let node = start(node().supervisor(group)).await;
        diary.take();

        provoke(&node, "probe", Provoke::Panic).await;

        assert_eq!(diary.take(), [""; 0]);
        let told = record(&node).await;
        assert_eq!(told.len(), 1, "{told:?}");
        assert!(told[0].starts_with("panic of probe: it is not restarted"), "{told:?}");
        assert!(answers(&node, "arm").await);
        assert!(!answers(&node, "probe").await);
    });
}

/// Counts, and restarts.
struct Homing(Arc<AtomicUsize>);

impl RecoveryStrategy for Homing {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        tools: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        self.0.fetch_add(1, SeqCst);
        tools.restart(&order.fault).await
    }
}

#[test]
fn a_strategy_of_the_application_takes_the_place_of_the_built_in_one() {
    paused(async {
        let diary = Diary::default();
        let called = Arc::new(AtomicUsize::new(0));
        let counter = called.clone();
        let homing = Ladder::first(RecoveryAction::Custom("homing".into()));
        let arm = "arm".parse().expect("a good name");
        let builder = node()
            .child(part("arm", &diary))
            .plan(Plan::default().on_component(arm, FaultKind::Panic, homing))
            .recovery("homing", move || Homing(counter.clone()));
        let node = start(builder).await;
        diary.take();

        provoke(&node, "arm", Provoke::Panic).await;

        assert_eq!(called.load(SeqCst), 1);
        assert_eq!(diary.take(), ["arm begins"]);
        assert_eq!(record(&node).await, ["panic of arm: recovered"]);
    });
}

#[test]
fn a_plan_that_names_no_strategy_is_refused_before_anything_starts() {
    paused(async {
        let diary = Diary::default();
        let homing = Ladder::first(RecoveryAction::Custom("homign".into()));
        let builder = node()
            .child(part("arm", &diary))
            .plan(Plan::default().on(FaultKind::Panic, homing))
            .recovery("homing", || Homing(Arc::default()));

        let refused = builder.start().await.expect_err("the plan is wrong");

        assert!(refused.to_string().ends_with("did you mean \"homing\"?"), "{refused}");
        assert_eq!(diary.take(), [""; 0]);
    });
}
