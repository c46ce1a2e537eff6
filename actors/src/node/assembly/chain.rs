//! The fault chain of a node: how its actors are made, and what the rest of the node sees of them.

use super::{named, registrations};
use crate::actuator::ActuatorTable;
use crate::arbiter::pool::ArbiterPool;
use crate::component::environment::ComponentEnvironment;
use crate::fault_chain::detection::DetectionActor;
use crate::fault_chain::outside::{ChainWatch, OutsideSetup};
use crate::fault_chain::recoverer::{RecovererActor, RecovererSetup};
use crate::fault_chain::strategy::{
    NetworkOrders, SAFE_OUTPUTS, SafeOutputs, StrategyContext, StrategyTargets, object_of,
};
use crate::fault_chain::supervisor::directory::SupervisorDirectory;
use crate::liveness::sampler::SamplerGuard;
use crate::node::builder::{FaultDescription, NodeBuilder};
use crate::node::controller::{NodeController, NodeControllerSetup, NodeState, SubscribeSafeState};
use crate::node::error::StartError;
use crate::node::tree::PreparedTree;
use crate::platform::{self, ProcessWatchdog, lock};
use crate::registry::Registry;
use crate::runtime::callbacks::Callbacks;
use crate::runtime::guardian::Guardian;
use crate::runtime::reports::FaultReports;
use actix::prelude::*;
use blastema_contract::monitor::{NodeEnding, Register, Unregister};
use blastema_contract::notifier::AddPort;
use blastema_contract::reports::AreYouAlive;
use blastema_contract::strategy::EnterSafeState;
use blastema_core::detection::{RecovererPort, RegistrationError};
use blastema_core::recovery;
use blastema_core::{Fault, FaultKind, Incarnation, NodeName, ObjectName};
use std::collections::BTreeSet;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;
use tokio::sync::watch;

/// The fault chain as the rest of the node sees it.
pub(in crate::node) struct FaultChain {
    /// Observes, judges and tells; reads the table and the record.
    pub(in crate::node) monitor: Addr<DetectionActor>,
    pub(super) recoverer: Addr<RecovererActor>,
    pub(in crate::node) controller: Addr<NodeController>,
    /// Where its actors live.
    pub(in crate::node) arbiter: Option<ArbiterHandle>,
    /// Keeps them, and what supervisors need that are added while the node runs.
    pub(in crate::node) guardian: Guardian,
    pub(in crate::node) directory: SupervisorDirectory,
    /// How the node is.
    pub(in crate::node) state: watch::Receiver<NodeState>,
    /// Whether the chain stands.
    stands: watch::Sender<bool>,
    pub(in crate::node) safe_outputs: SafeOutputs,
    pub(in crate::node) callbacks: Callbacks,
    pub(super) network: Arc<OnceLock<NetworkOrders>>,
    guards: Mutex<ChainGuards>,
}

/// What ends with the chain, when it is dropped.
#[derive(Default)]
struct ChainGuards {
    /// Looks at arbiters and components.
    sampler: Option<SamplerGuard>,
    /// Watches the chain itself.
    outside: Option<ChainWatch>,
    /// Writes what it was given.
    #[cfg(feature = "journal")]
    journal: Option<crate::journal::JournalGuard>,
}

impl FaultChain {
    /// Where its actors answer.
    pub(super) fn pings(&self) -> Vec<(ObjectName, Recipient<AreYouAlive>)> {
        vec![
            (named("chain/detection"), self.monitor.clone().recipient()),
            (named("chain/recoverer"), self.recoverer.clone().recipient()),
            (named("controller"), self.controller.clone().recipient()),
        ]
    }

    /// Watches these objects from now on, and returns the first that cannot be watched as it
    /// wishes.
    pub(super) async fn register_all(
        &self,
        registrations: Vec<Register>,
    ) -> Result<(), RegistrationError> {
        let mut registered = Ok(());
        for registration in registrations {
            // The chain's mailboxes close only when the node has ended.
            if let Ok(answer) = self.monitor.send(registration).await {
                registered = registered.and(answer.map(drop));
            }
        }
        registered
    }

    /// Watches what was prepared after the start.
    pub(in crate::node) async fn register(&self, node: &NodeName, tree: &PreparedTree) {
        // The names that components depend on were checked, and an object that cannot be watched
        // as it wishes still has its guard.
        if let Ok(registrations) = registrations(node, tree) {
            let _ = self.register_all(registrations).await;
        }
    }

    pub(in crate::node) fn dismiss(&self, object: ObjectName) {
        self.monitor.do_send(Unregister { object });
    }

    /// What an actor of the chain answers; `None` where it has ended, or the chain stands.
    pub(in crate::node) async fn answer<T>(
        &self,
        asked: impl Future<Output = Result<T, MailboxError>>,
    ) -> Option<T> {
        let mut stands = self.stands.subscribe();
        tokio::select! {
            biased;
            answer = asked => answer.ok(),
            true = async { stands.wait_for(|stands| *stands).await.is_ok() } => None,
        }
    }

    /// The node ends: what goes away with it from now on is no fault.
    pub(in crate::node) fn expect_end(&self) {
        self.monitor.do_send(NodeEnding);
    }

    /// Ends its threads for this reason; in order, unless the process is not to be thought of as
    /// well.
    #[cfg_attr(not(feature = "journal"), expect(unused_variables, reason = "nothing keeps it"))]
    pub(in crate::node) fn stop(&self, cause: &str, in_order: bool) {
        let guards = std::mem::take(&mut *lock(&self.guards));
        drop(guards.sampler);
        if let Some(outside) = guards.outside {
            outside.end(in_order);
        }
        #[cfg(feature = "journal")]
        if let Some(journal) = guards.journal {
            journal.end(cause);
        }
        if let Some(arbiter) = &self.arbiter {
            arbiter.stop();
        }
    }

    /// Whether its faults are kept in a file, which is to be told how the node ends.
    pub(in crate::node) fn keeps_journal(&self) -> bool {
        #[cfg(feature = "journal")]
        return lock(&self.guards).journal.is_some();
        #[cfg(not(feature = "journal"))]
        false
    }

    #[cfg(feature = "journal")]
    pub(super) fn keep_journal(&self, guard: crate::journal::JournalGuard) {
        lock(&self.guards).journal = Some(guard);
    }

    pub(super) fn keep_sampler(&self, sampler: SamplerGuard) {
        lock(&self.guards).sampler = Some(sampler);
    }
}

/// Makes the fault chain; it has nothing to watch yet. Its strategies use the returned tables.
pub(super) fn make_chain(
    builder: &NodeBuilder,
    node: &NodeName,
    incarnation: Incarnation,
    arbiters: &ArbiterPool,
) -> Result<(FaultChain, Registry, ActuatorTable), StartError> {
    let NodeBuilder { faults, process, .. } = builder;
    let arbiter = process.placement.own_arbiter()?;
    let on_arbiter = arbiter.as_ref();
    let guardian = Guardian::default();

    let of = node.clone();
    let monitor = guardian.start(
        named("chain/detection"),
        on_arbiter,
        move |_: &mut Context<DetectionActor>| DetectionActor::new(of),
    );
    guardian.report_to(monitor.clone().recipient());

    let callbacks = match arbiter {
        None => Callbacks::default(),
        Some(_) => Callbacks::on_threads(faults.callback_limit, arbiters.clone()),
    };
    let reports = reports(&monitor);
    callbacks.report_to(reports.clone());
    let (state, actuators) = (builder.state.subscribe(), ActuatorTable::new(callbacks.clone()));
    let safe_outputs = SafeOutputs::new(faults.safe_outputs.clone(), callbacks.clone(), reports);
    let setup = NodeControllerSetup {
        node: node.clone(),
        incarnation,
        state: builder.state.clone(),
        safe_outputs: safe_outputs.clone(),
        actuators: actuators.clone(),
        nodes: monitor.clone().recipient(),
    };
    let controller =
        guardian.start(named("controller"), on_arbiter, move |_: &mut Context<NodeController>| {
            NodeController::new(setup)
        });

    let (directory, registry) = (SupervisorDirectory::default(), Registry::default());
    registry.watch_in(guardian.watched());
    let network = Arc::<OnceLock<_>>::default();
    let context = StrategyContext::new(StrategyTargets {
        node: node.clone(),
        directory: directory.clone(),
        registry: registry.clone(),
        network: network.clone(),
        safe_outputs: safe_outputs.clone(),
        rest_node: controller.clone().recipient(),
    });
    let (plan, seed) = (faults.plan.clone(), platform::random_seed());
    let setup = RecovererSetup {
        machine: recovery::Recoverer::new(node.clone(), plan, seed),
        strategies: faults.strategies.clone(),
        context,
        detector: monitor.clone().recipient(),
        callbacks: callbacks.clone(),
    };
    let recoverer = guardian.start(
        named("chain/recoverer"),
        on_arbiter,
        move |_: &mut Context<RecovererActor>| RecovererActor::new(setup),
    );
    controller.do_send(SubscribeSafeState(monitor.clone().recipient()));
    controller.do_send(SubscribeSafeState(recoverer.clone().recipient()));
    monitor.do_send(AddPort {
        port: RecovererPort::Local,
        recover: recoverer.clone().recipient(),
        stand_down: Some(recoverer.clone().recipient()),
    });

    let chain = FaultChain {
        monitor,
        recoverer,
        controller,
        arbiter,
        guardian,
        directory,
        state,
        stands: watch::Sender::new(false),
        safe_outputs,
        callbacks,
        network,
        guards: Mutex::default(),
    };
    Ok((chain, registry, actuators))
}

/// Whom guards and components tell.
pub(super) fn reports(monitor: &Addr<DetectionActor>) -> FaultReports {
    FaultReports {
        exits: Some(monitor.clone().recipient()),
        states: Some(monitor.clone().recipient()),
        faults: Some(monitor.clone().recipient()),
        cleared: Some(monitor.clone().recipient()),
    }
}

/// The application's code that the chain calls: faults of it stand under these names.
pub(super) fn callbacks_of(faults: &FaultDescription) -> BTreeSet<ObjectName> {
    let strategies = faults.strategies.names().map(object_of);
    let outputs = faults.safe_outputs.iter().map(|_| named(SAFE_OUTPUTS));
    // Two names may differ by what no name of an object can hold.
    strategies.chain(outputs).collect()
}

impl FaultChain {
    /// Watches the chain from outside from now on, and strokes these as long as it answers.
    pub(super) fn watch_chain(
        &self,
        node: &NodeName,
        watchdogs: Vec<Box<dyn ProcessWatchdog>>,
        environment: Arc<ComponentEnvironment>,
    ) -> Result<(), StartError> {
        let (node, actuators) = (node.clone(), environment.feature::<ActuatorTable>().clone());
        let stop_limit = move || match environment.feature::<ActuatorTable>().are_stopping() {
            true => Duration::from_millis(environment.longest_stop_ms.load(Relaxed)),
            false => Duration::ZERO,
        };
        let safe_outputs = self.safe_outputs.clone();
        let rest: Recipient<EnterSafeState> = self.controller.clone().recipient();
        let last_resort = move |reason: String| {
            let now = platform::now();
            let fault = Fault::of_node(node.clone(), FaultKind::Hang, reason.clone(), now);
            // Nothing here waits for them.
            drop(safe_outputs.rest(&fault));
            actuators.rest();
            // Should the chain answer again, the node enters the safe state in order.
            rest.do_send(EnterSafeState { fault, reason });
        };
        let outside = ChainWatch::start(OutsideSetup {
            callbacks: self.callbacks.clone(),
            pings: self.pings(),
            watchdogs,
            stands: self.stands.clone(),
            stop_limit: Box::new(stop_limit),
            last_resort: Box::new(last_resort),
        })?;
        lock(&self.guards).outside = Some(outside);
        Ok(())
    }
}
