//! Code of the application that the fault chain calls and that blocks or fails, on real threads.

use blastema::core::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};
use blastema::prelude::*;
use blastema::{
    ActuatorSpec, CommandTimeout, FaultTransition, NodeBuilder, RecoveryStrategy, StrategyContext,
};
use blastema_tests::{MS, PATIENCE, found, until};
use std::path::Path;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::mpsc::{Receiver, Sender as Hold, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// For calls that block.
const LIMIT: Duration = Duration::from_millis(200);

fn oil() -> FaultKind {
    FaultKind::Custom("OIL".into())
}

/// Says in which incarnation it is.
#[derive(Clone, Debug, Request)]
#[contract(name = "outside/ask", reply = u64)]
struct Ask;

/// Declares the fault `OIL`.
#[derive(Clone, Debug, Request)]
#[contract(name = "outside/leak", reply = ())]
struct Leak;

/// Declares the fault `GREASE`.
#[derive(Clone, Debug, Request)]
#[contract(name = "outside/grind", reply = ())]
struct Grind;

struct Joint;

impl Component for Joint {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Ask>().serve::<Leak>().serve::<Grind>();
    }
}

impl Handle<Grind> for Joint {
    async fn handle(&mut self, _: Grind, cx: &mut Context<Self>) {
        cx.declare_fault(FaultKind::Custom("GREASE".into()), "it grinds");
    }
}

impl Handle<Ask> for Joint {
    async fn handle(&mut self, _: Ask, cx: &mut Context<Self>) -> u64 {
        cx.incarnation().0
    }
}

impl Handle<Leak> for Joint {
    async fn handle(&mut self, _: Leak, cx: &mut Context<Self>) {
        cx.declare_fault(oil(), "a leak");
    }
}

/// Turns the wheels.
#[derive(Clone, Debug, Request)]
#[contract(name = "outside/drive", reply = f32)]
struct Drive(f32);

fn joint(name: &str) -> ChildSpec<Joint> {
    ChildSpec::new(name, || Joint)
}

fn robot(ladder: Ladder) -> NodeBuilder {
    Node::builder("module1")
        .fault_kind("OIL")
        .callback_limit(LIMIT)
        .plan(Plan::default().on(oil(), ladder))
        .child(joint("joint1"))
        .child(joint("joint2"))
}

async fn leak(node: &Node, joint: &str) {
    node.sender::<Leak>(joint).unwrap().ask(Leak).await.unwrap();
}

async fn incarnation(node: &Node, joint: &str) -> Option<u64> {
    node.sender::<Ask>(joint).unwrap().ask(Ask).await.ok()
}

/// What stands of `location` in the record of faults: that it was found, and whether it has ended.
async fn fault_of(node: &Node, location: &str) -> Option<(FaultKind, String, bool)> {
    let entries = node.faults().await.entries;
    let location = format!("module1:{location}");
    let entry =
        entries.into_iter().rev().find(|entry| entry.fault.location.to_string() == location)?;
    let ended = !entry.stands();
    Some((entry.fault.kind, entry.fault.detail, ended))
}

/// Blocks its caller until the other end is dropped.
#[derive(Clone)]
struct Block(Arc<Mutex<Option<Receiver<()>>>>);

impl Block {
    fn new() -> (Hold<()>, Block) {
        let (hold, held) = channel();
        (hold, Block(Arc::new(Mutex::new(Some(held)))))
    }

    /// The first time; afterwards it does nothing.
    fn block(&self) {
        let held = self.0.lock().unwrap().take();
        if let Some(held) = held {
            let _ = held.recv();
        }
    }
}

/// Blocks at joint1, the first time; restarts every other.
struct Oil(Block);

impl RecoveryStrategy for Oil {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        context: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        if order.fault.location.to_string().ends_with("joint1") {
            self.0.block();
        }
        context.restart(&order.fault).await
    }
}

#[test]
fn a_strategy_that_blocks_is_named_and_the_fault_chain_goes_on_without_it() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let (hold, block) = Block::new();
        let ladder =
            Ladder::first(RecoveryAction::Custom("oil".into())).then(RecoveryAction::Restart);
        let builder = robot(ladder).recovery("oil", move || Oil(block.clone()));
        let node = builder.start().await.unwrap();

        leak(&node, "joint1").await;
        leak(&node, "joint2").await;

        until(async || incarnation(&node, "joint1").await == Some(2), "it comes to be").await;
        until(async || incarnation(&node, "joint2").await == Some(2), "it comes to be").await;
        let named =
            found(async || fault_of(&node, "chain/strategy/oil").await, "it comes to be").await;
        assert_eq!((named.0, named.2), (FaultKind::CheckFailed, false), "{}", named.1);
        assert!(named.1.contains("oil") && named.1.contains("200ms"), "{}", named.1);
        assert_eq!(node.abandoned_threads(), 1);
        assert!(
            node.table().await.iter().any(|row| row.location.to_string().ends_with("strategy/oil"))
        );

        drop(hold);
        found(
            async || fault_of(&node, "chain/strategy/oil").await.filter(|fault| fault.2),
            "it comes to be",
        )
        .await;
        assert_eq!(node.abandoned_threads(), 0);
        leak(&node, "joint1").await;
        until(async || incarnation(&node, "joint1").await == Some(3), "it comes to be").await;
        node.shutdown().await;
    });
}

/// Blocks each time that it is called, until the other end is dropped.
struct Rusty(Arc<Mutex<Receiver<()>>>);

impl RecoveryStrategy for Rusty {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        context: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        let _ = self.0.lock().unwrap_or_else(PoisonError::into_inner).recv();
        context.restart(&order.fault).await
    }
}

#[test]
fn a_strategy_that_blocks_again_and_again_is_not_called_any_more_and_the_node_goes_on() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let (hold, held) = channel();
        let held = Arc::new(Mutex::new(held));
        let rusty = RecoveryAction::Custom("rusty".into());
        let ladder = Ladder::first(rusty).times(6).then(RecoveryAction::Restart);
        let builder = robot(ladder).recovery("rusty", move || Rusty(held.clone()));
        let node = builder.start().await.unwrap();

        leak(&node, "joint1").await;

        until(async || incarnation(&node, "joint1").await == Some(2), "it comes to be").await;
        assert_eq!(node.abandoned_threads(), 4, "two more attempts were refused a thread");
        assert_eq!(node.state(), NodeState::Running);
        assert_eq!(incarnation(&node, "joint2").await, Some(1));
        let named =
            found(async || fault_of(&node, "chain/strategy/rusty").await, "it comes to be").await;
        assert_eq!((named.0, named.2), (FaultKind::CheckFailed, false), "{}", named.1);
        drop(hold);
        node.shutdown().await;
    });
}

/// Does not help, each time in another way.
struct Useless(AtomicUsize);

impl RecoveryStrategy for Useless {
    async fn carry_out(
        &self,
        _: &RecoveryOrder,
        _: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        match self.0.fetch_add(1, SeqCst) {
            0 => panic!("the can explodes"),
            1 => std::future::pending().await,
            _ => Err("the can is empty".into()),
        }
    }
}

#[test]
fn strategies_that_block_or_fail_hold_up_no_other_strategy() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let (hold, block) = Block::new();
        let grease = FaultKind::Custom("GREASE".into());
        let useless = RecoveryAction::Custom("useless".into());
        let ladder = Ladder::first(useless).times(3).within(LIMIT).then(RecoveryAction::Restart);
        let plan = Plan::default()
            .on(
                oil(),
                Ladder::first(RecoveryAction::Custom("oil".into())).then(RecoveryAction::SafeStop),
            )
            .on(grease, ladder);
        let builder = Node::builder("module1")
            .callback_limit(Duration::from_secs(60))
            .fault_kind("OIL")
            .fault_kind("GREASE")
            .plan(plan)
            .recovery("oil", move || Oil(block.clone()))
            .recovery("useless", || Useless(AtomicUsize::new(0)))
            .child(joint("joint1"))
            .child(joint("joint2"));
        let mut builder = builder;
        let mut events = builder.fault_events();
        let node = builder.start().await.unwrap();
        leak(&node, "joint1").await;
        node.sender::<Grind>("joint2").unwrap().ask(Grind).await.unwrap();

        until(async || incarnation(&node, "joint2").await == Some(2), "it comes to be").await;

        let mut decided = Vec::new();
        while decided.len() < 5 {
            let event = events.next().await.expect("it runs");
            if let FaultTransition::Decided { action } = event.turn {
                decided.push(action);
            }
        }
        decided.sort();
        let expected = ["oil", "restart", "useless", "useless, attempt 2", "useless, attempt 3"];
        assert_eq!(decided, expected);
        assert_eq!(incarnation(&node, "joint1").await, Some(1), "its strategy still blocks");
        drop(hold);
        until(async || incarnation(&node, "joint1").await == Some(2), "it comes to be").await;
        node.shutdown().await;
    });
}

#[test]
fn a_node_is_shut_down_while_its_strategies_and_safe_outputs_block() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let ((hold, block), (hold_outputs, outputs)) = (Block::new(), Block::new());
        let ladder =
            Ladder::first(RecoveryAction::Custom("oil".into())).then(RecoveryAction::SafeStop);
        let builder = robot(ladder)
            .safe_outputs(move |_| outputs.block())
            .recovery("oil", move || Oil(block.clone()));
        let node = builder.start().await.unwrap();

        leak(&node, "joint1").await;

        let named = found(async || fault_of(&node, "safe-outputs").await, "it comes to be").await;
        assert_eq!((named.0, named.2), (FaultKind::CheckFailed, false), "{}", named.1);
        let rests = async || node.sender::<Ask>("joint1").unwrap().ask(Ask).await.is_err();
        until(async || rests().await, "it comes to be").await;
        assert_eq!(incarnation(&node, "joint2").await, Some(1));
        assert_eq!(node.abandoned_threads(), 2);
        tokio::time::timeout(PATIENCE, node.shutdown()).await.expect("it ends");
        drop((hold, hold_outputs));
    });
}

#[test]
fn a_node_whose_safe_outputs_block_restarts_nothing_more_and_comes_to_rest() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let (hold, outputs) = Block::new();
        let builder = Node::builder("module1").child(joint("joint1")).callback_limit(LIMIT);
        let mut builder = builder
            .fault_kind("OIL")
            .plan(Plan::default().on(oil(), Ladder::first(RecoveryAction::Restart).times(3)))
            .intensity(0, Duration::from_secs(60))
            .when_exceeded(WhenExceeded::Escalate)
            .safe_outputs(move |_| outputs.block());
        let mut events = builder.fault_events();
        let node = builder.start().await.unwrap();

        leak(&node, "joint1").await;

        let state =
            tokio::time::timeout(PATIENCE, node.ended()).await.expect("it enters the safe state");
        assert!(matches!(state, NodeState::InSafeState { .. }), "{state:?}");
        found(async || fault_of(&node, "safe-outputs").await, "it comes to be").await;
        drop(hold);
        node.shutdown().await;
        drop(node);
        let mut decided = Vec::new();
        while let Some(event) = events.next().await {
            if let FaultTransition::Decided { action } = event.turn
                && action.starts_with("restart")
            {
                decided.push(action);
            }
        }
        assert_eq!(decided, ["restart"], "it is too late for another attempt");
    });
}

/// An actuator whose cut-off blocks.
struct Gripper(Block);

impl Component for Gripper {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(
            ActuatorSpec::new(Drive(0.0), CommandTimeout::Hold)
                .cut_off(|| CUT.lock().unwrap().block()),
        );
    }
}

/// The ports of a component are those of its type.
static CUT: std::sync::LazyLock<Mutex<Block>> =
    std::sync::LazyLock::new(|| Mutex::new(Block::new().1));

impl Handle<Drive> for Gripper {
    async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) -> f32 {
        let _ = &self.0;
        drive.0
    }
}

#[test]
fn a_cut_off_that_blocks_is_a_fault_of_its_component_and_keeps_the_actuator_from_commanders() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let (hold, block) = Block::new();
        let kept = block.clone();
        let gripper = ChildSpec::new("gripper", move || Gripper(kept.clone()));
        let node = Node::builder("module1").callback_limit(LIMIT).child(gripper);
        let node = node.start().await.unwrap();
        let held = block.0.lock().unwrap().take();
        *CUT.lock().unwrap() = Block(Arc::new(Mutex::new(held)));
        let commander = node.commander::<Drive>("gripper", "console").unwrap();
        commander.claim().await.unwrap();
        commander.release().await.unwrap();

        let named = found(async || fault_of(&node, "gripper").await, "it comes to be").await;

        assert_eq!(named.0, FaultKind::CheckFailed);
        assert!(named.1.contains("cut-off"), "{}", named.1);
        let refused = commander.claim_within(LIMIT).await;
        assert_eq!(refused, Err(DeliveryError::Restarting), "it would be cut off at any time");
        drop(hold);
        commander.claim_within(PATIENCE).await.expect("the cut-off has returned");
        assert_eq!(commander.command(Drive(2.0)).await, Ok(2.0));
        node.shutdown().await;
    });
}

#[test]
fn a_callback_limit_that_makes_no_sense_is_refused_and_so_are_two_strategies_of_a_name() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        for limit in [MS, Duration::from_secs(61)] {
            let refused = Node::builder("n").callback_limit(limit).start().await.unwrap_err();
            assert!(matches!(refused, StartError::Setting { setting: "callback_limit", .. }));
        }
        let (_, block) = Block::new();
        let (first, second) = (block.clone(), block);
        let twice = Node::builder("n").recovery("oil", move || Oil(first.clone()));
        let refused = twice.recovery("oil", move || Oil(second.clone())).start().await;
        let refused = refused.unwrap_err().to_string();
        assert!(refused.contains("\"oil\" twice"), "{refused}");
    });
}

#[test]
fn a_watchdog_that_cannot_be_used_is_refused_with_what_to_do() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("watchdog");
        let refused = Node::builder("n").watchdog_device(&missing).start().await.unwrap_err();
        assert!(matches!(refused, StartError::ProcessWatchdog(_)), "{refused:?}");
        let text = refused.to_string();
        assert!(
            text.contains(&missing.display().to_string()) && text.contains("modprobe"),
            "{text}"
        );
        let refused = Node::builder("n").watchdog_device("watchdog").start().await.unwrap_err();
        assert!(refused.to_string().contains("absolute"), "{refused}");
        for other in [Path::new("/dev/null"), folder.path()] {
            let refused = Node::builder("n").watchdog_device(other).start().await.unwrap_err();
            assert!(matches!(refused, StartError::ProcessWatchdog(_)), "{refused:?}");
            assert!(refused.to_string().contains("is no watchdog"), "{refused}");
        }
        let here = Node::builder("n").notify_systemd().on_this_thread().start().await;
        assert!(here.unwrap_err().to_string().contains("on_this_thread"));
    });
}
