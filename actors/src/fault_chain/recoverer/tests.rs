use super::*;
use crate::fault_chain::strategy::{
    ApplyOutputs, NetworkOrders, RecoveryStrategy, SafeOutputs, StrategyTargets,
};
use crate::fault_chain::supervisor::SupervisorChild;
use crate::fault_chain::tests::scripted::{Bench, ScriptedReply, fault};
use crate::registry::Registry;
use crate::runtime::callbacks::Callbacks;
use crate::runtime::reports::FaultReports;
use blastema_contract::strategy::{EnterSafeState, IsolateNode, Reroute};
use blastema_core::detection::RecoveryOutcome;
use blastema_core::recovery::{Ladder, Plan, RecoveryDone, SupervisorRules};
use blastema_core::{Fault, FaultId, FaultKind, FaultLocation, NodeName};
use blastema_doubles::{Probe, settle};
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::SeqCst;
use std::time::Duration;

struct Chain {
    bench: Bench,
    root: SupervisorChild,
    recoverer: Addr<RecovererActor>,
    outcomes: Probe<FaultOutcome>,
    router: Probe<Reroute>,
    node: Probe<EnterSafeState>,
    safe_outputs: Arc<AtomicUsize>,
}

impl Chain {
    async fn new(plan: Plan, strategies: StrategyTable) -> Self {
        let bench = Bench::new();
        let root = bench.serving(SupervisorRules::default(), &["laser", "arm"]).await;
        let (outcomes, node) = (Probe::start(), Probe::start());
        let router = Probe::replying(|Reroute { location }| match location {
            FaultLocation::Node(_) => Err("no other way leads there".into()),
            _ => Ok(RecoveryDone::default()),
        });
        let here = NodeName::new("here").expect("a good name");
        let safe_outputs = Arc::new(AtomicUsize::new(0));
        let applied = safe_outputs.clone();
        let apply: ApplyOutputs = Arc::new(move |_| {
            applied.fetch_add(1, SeqCst);
        });
        let network = Probe::replying(|IsolateNode { node, cause, .. }| match node.as_str() {
            "there" => Ok(RecoveryDone::default()),
            _ => Err(cause.into()),
        });
        let context = StrategyContext::new(StrategyTargets {
            node: here.clone(),
            directory: bench.directory.clone(),
            registry: Registry::default(),
            network: Arc::new(std::sync::OnceLock::from(NetworkOrders {
                reroute: router.recipient(),
                isolate: network.recipient(),
            })),
            safe_outputs: SafeOutputs::new(
                Some(apply),
                Callbacks::default(),
                FaultReports::default(),
            ),
            rest_node: node.recipient(),
        });
        let setup = RecovererSetup {
            machine: recovery::Recoverer::new(here, plan, 7),
            strategies,
            context,
            detector: outcomes.recipient(),
            callbacks: Callbacks::default(),
        };
        let name = "chain/recoverer".parse().expect("a good name");
        let make = move |_: &mut Context<RecovererActor>| RecovererActor::new(setup);
        let recoverer = bench.guardian.start(name, None, make);
        Chain { bench, root, recoverer, outcomes, router, node, safe_outputs }
    }

    async fn built_in() -> Self {
        Chain::new(Plan::default(), StrategyTable::default()).await
    }

    async fn recover(&self, fault: Fault) {
        if let (FaultKind::Panic, FaultLocation::Object(address)) = (&fault.kind, &fault.location) {
            self.bench.script.dies(address.object.as_str());
        }
        let confirmed = self.recoverer.send(Recover { fault }).await;
        assert_eq!(confirmed.expect("it lives"), Confirmed);
    }

    /// What becomes of the faults, as `1 restart` and `1 recovered`, until `last` has come.
    async fn reported_until(&self, last: &str) -> Vec<String> {
        let mut reported = Vec::new();
        while reported.last().is_none_or(|line| line != last) {
            let FaultOutcome { id: FaultId(id), what, .. } = self.outcomes.expect().await;
            reported.push(match what {
                RecoveryOutcome::Decided { action } => format!("{id} {action}"),
                RecoveryOutcome::Failed { action, reason } => {
                    format!("{id} {action} failed: {reason}")
                }
                RecoveryOutcome::Recovered => format!("{id} recovered"),
                RecoveryOutcome::Waits => format!("{id} waits"),
                RecoveryOutcome::GaveUp { reason } => format!("{id} given up: {reason}"),
            });
        }
        reported
    }
}

/// Calls itself by what a test wants it to do.
struct Homing {
    made: Arc<AtomicUsize>,
}

impl RecoveryStrategy for Homing {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        context: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        assert!(self.made.load(SeqCst) > 0);
        match order.attempt {
            1 => panic!("the gripper is open"),
            2 => std::future::pending().await,
            3 => Err("still not there".into()),
            _ => context.reset(&order.fault.location).await,
        }
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_nobody_keeps_puts_the_node_to_rest() {
    let chain = Chain::built_in().await;

    chain.recover(fault(1, FaultKind::Panic, "router", 1)).await;

    let rest = chain.node.expect().await;
    assert_eq!(rest.reason, "no supervisor keeps here:router");
    assert_eq!(rest.fault.id, FaultId(1));
    assert_eq!(chain.safe_outputs.load(SeqCst), 1);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_lost_link_is_rerouted_and_a_lost_node_observed() {
    let chain = Chain::built_in().await;
    let here = NodeName::new("here").expect("a good name");
    let link = FaultLocation::Link { node: here, link: "ethernet".into(), neighbour: None };
    let there = FaultLocation::Node(NodeName::new("there").expect("a good name"));

    let down = fault(1, FaultKind::LinkDown, "laser", 1);
    chain.recover(Fault { location: link.clone(), ..down.clone() }).await;
    assert_eq!(chain.reported_until("1 recovered").await, ["1 reroute", "1 recovered"]);
    assert_eq!(chain.router.expect().await.location, link);

    let lost = Fault { kind: FaultKind::NodeLost, id: FaultId(2), ..down };
    chain.recover(Fault { location: there, ..lost }).await;
    assert_eq!(
        chain.reported_until("2 observe").await,
        ["2 reroute", "2 reroute failed: no other way leads there", "2 observe"]
    );
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_faulty_node_is_isolated_and_where_that_cannot_be_it_is_observed() {
    let chain = Chain::built_in().await;
    let contained = "given up: contained by isolate; service is not restored";
    for (id, node, last) in [(1, "there", contained), (2, "nowhere", "observe")] {
        let location = FaultLocation::Node(NodeName::new(node).expect("a good name"));
        let fault = Fault { location, ..fault(id, FaultKind::NodeFaulty, "laser", 1) };
        chain.recover(fault).await;
        let reported = chain.reported_until(&format!("{id} {last}")).await;
        assert_eq!(reported[0], format!("{id} isolate"), "{reported:?}");
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_strategy_of_the_application_is_made_once_and_only_when_needed() {
    let made = Arc::new(AtomicUsize::new(0));
    let mut strategies = StrategyTable::default();
    let counter = made.clone();
    strategies.hand_over("homing", move || {
        counter.fetch_add(1, SeqCst);
        Homing { made: counter.clone() }
    });
    assert_eq!(strategies.names().collect::<Vec<_>>(), ["homing"]);
    let ladder = Ladder::first(RecoveryAction::Custom("homing".into()))
        .times(4)
        .within(Duration::from_secs(1));
    let plan = Plan::default().on(FaultKind::CheckFailed, ladder);
    let chain = Chain::new(plan, strategies).await;
    assert_eq!(made.load(SeqCst), 0);

    chain.recover(fault(1, FaultKind::CheckFailed, "arm", 1)).await;

    let reported = chain.reported_until("1 recovered").await;
    assert_eq!(reported.len(), 8, "{reported:?}");
    assert!(
        reported[1].contains("panicked") && reported[1].contains("the gripper is open"),
        "{reported:?}"
    );
    assert!(reported[5].ends_with("failed: still not there"), "{reported:?}");
    assert_eq!(chain.bench.script.done(), ["reset arm"]);
    assert_eq!(made.load(SeqCst), 1);
}

#[derive(Message)]
#[rtype(result = "()")]
struct Poison;

impl Handler<Poison> for RecovererActor {
    type Result = ();

    fn handle(&mut self, _: Poison, _: &mut Context<Self>) {
        panic!("a mistake in the recoverer");
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_recoverer_that_panics_takes_up_again_what_was_open() {
    let chain = Chain::built_in().await;
    chain.bench.script.answer("start laser", &[ScriptedReply::Hangs]);
    chain.recover(fault(1, FaultKind::Panic, "laser", 1)).await;
    settle().await;

    chain.recoverer.do_send(Poison);

    let overdue =
        "1 restart failed: laser: its next incarnation did not start: not at work within 5s";
    let reported = chain.reported_until("1 recovered").await;
    assert_eq!(
        reported,
        ["1 restart", "1 restart", overdue, "1 restart, attempt 2", "1 recovered"]
    );
    assert!(chain.bench.deaths.expect().await.restarted_as.is_some());
    drop(chain.root);
}
