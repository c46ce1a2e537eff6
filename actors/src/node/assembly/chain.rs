//! The fault chain of a node: how its actors are made, and what the rest of the node sees of them.

use super::{enrolment, named, own_arbiter};
use crate::chain::detector::Detector;
use crate::chain::directory::Directory;
use crate::chain::monitor::Monitor;
use crate::chain::notifier::Notifier;
use crate::chain::recoverer::{Recoverer, RecovererSetup};
use crate::chain::strategy::{SafeOutputs, ToolBox, Tools};
use crate::guardian::Guardian;
use crate::host::watch::WatchGuard;
use crate::lease::Yard;
use crate::node::builder::{NodeBuilder, Placement, StartError};
use crate::node::keeper::{Keeper, KeeperSetup, NodeState, TellRest};
use crate::node::tree::Planted;
use crate::platform;
use crate::registry::Registry;
use actix::prelude::*;
use blastema_contract::detector::{ReadRecord, Subscribe};
use blastema_contract::monitor::{Dismiss, Enrol, ReadTable};
use blastema_contract::notifier::AddPort;
use blastema_contract::recoverer::Recover;
use blastema_contract::reports::AreYouAlive;
use blastema_contract::strategy::{IsolateNode, Reroute};
use blastema_core::detection::{DetectorLimits, EnrolError, MonitorLimits, NotifierLimits, Port};
use blastema_core::recovery::{self, RecovererLimits};
use blastema_core::{Incarnation, NodeName, ObjectName};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use tokio::sync::watch;

/// The fault chain as the rest of the node sees it.
pub(in crate::node) struct Chain {
    pub(in crate::node) table: Recipient<ReadTable>,
    pub(in crate::node) record: Recipient<ReadRecord>,
    pub(in crate::node) subscribe: Recipient<Subscribe>,
    pub(super) enrol: Recipient<Enrol>,
    dismiss: Recipient<Dismiss>,
    pub(super) arbiter: Option<ArbiterHandle>,
    /// Where its actors answer.
    pub(super) inquiries: Vec<(ObjectName, Recipient<AreYouAlive>)>,
    pub(super) notifier: Recipient<AddPort>,
    pub(super) recoverer: Recipient<Recover>,
    /// Looks at arbiters and components; it ends when it is dropped.
    lookout: Mutex<Option<WatchGuard>>,
    pub(super) router: Arc<OnceLock<(Recipient<Reroute>, Recipient<IsolateNode>)>>,
}

impl Chain {
    pub(super) async fn enrol_all(&self, enrolments: Vec<Enrol>) -> Result<(), StartError> {
        for enrolment in enrolments {
            // The chain's mailboxes close only when the node has ended.
            if let Ok(answer) = self.enrol.send(enrolment).await {
                answer?;
            }
        }
        Ok(())
    }

    /// Watches a component that was planted after the start.
    pub(in crate::node) async fn enrol(&self, node: &NodeName, planted: &Planted) {
        let name = planted.child.name();
        if let Ok(enrolment) = enrolment(node, name, &planted.depends_on) {
            // A component that cannot be watched as it wishes still has its guard.
            let _: Result<Result<_, EnrolError>, _> = self.enrol.send(enrolment).await;
        }
    }

    pub(in crate::node) fn dismiss(&self, object: ObjectName) {
        self.dismiss.do_send(Dismiss { object });
    }

    pub(in crate::node) fn stop(&self) {
        self.look_out(None);
        if let Some(arbiter) = &self.arbiter {
            arbiter.stop();
        }
    }

    pub(super) fn look_out(&self, lookout: Option<WatchGuard>) {
        *self.lookout.lock().unwrap_or_else(PoisonError::into_inner) = lookout;
    }
}

/// Everything between the threads and the components.
pub(super) struct Parts {
    pub(super) guardian: Guardian,
    pub(super) chain: Chain,
    pub(super) monitor: Addr<Monitor>,
    pub(super) keeper: Addr<Keeper>,
    pub(super) state: watch::Receiver<NodeState>,
    pub(super) directory: Directory,
    pub(super) registry: Registry,
    pub(super) actuators: Yard,
}

/// Makes the fault chain; it has nothing to watch yet.
pub(super) fn make_chain(
    builder: &NodeBuilder,
    (node, incarnation): (&NodeName, Incarnation),
) -> Result<Parts, StartError> {
    let arbiter = match builder.placement {
        Placement::Here => None,
        Placement::Threads { .. } | Placement::ComponentsHere => Some(own_arbiter()?),
    };
    let place = arbiter.as_ref();
    let guardian = Guardian::default();

    let notifier = guardian.start(named("chain/notifier"), place, |_: &mut Context<Notifier>| {
        Notifier::new(NotifierLimits::default())
    });
    let (of, found, cleared) =
        (node.clone(), notifier.clone().recipient(), notifier.clone().recipient());
    let detector =
        guardian.start(named("chain/detector"), place, move |_: &mut Context<Detector>| {
            Detector::new(of, DetectorLimits::default(), found, cleared)
        });
    let (of, observed) = (node.clone(), detector.clone().recipient());
    let monitor = guardian.start(named("chain/monitor"), place, move |_: &mut Context<Monitor>| {
        Monitor::new(of, MonitorLimits::default(), observed)
    });
    guardian.report_to(monitor.clone().recipient());

    let (state, actuators) = (builder.state.subscribe(), Yard::default());
    let safe_outputs = SafeOutputs::new(builder.safe_outputs.clone());
    let setup = KeeperSetup {
        node: node.clone(),
        incarnation,
        state: builder.state.clone(),
        safe_outputs: safe_outputs.clone(),
        actuators: actuators.clone(),
        nodes: monitor.clone().recipient(),
    };
    let keeper =
        guardian.start(named("keeper"), place, move |_: &mut Context<Keeper>| Keeper::new(setup));

    let (directory, registry) = (Directory::default(), Registry::default());
    let router = Arc::<OnceLock<_>>::default();
    let tools = Tools::new(ToolBox {
        node: node.clone(),
        directory: directory.clone(),
        registry: registry.clone(),
        router: router.clone(),
        safe_outputs,
        rest_node: keeper.clone().recipient(),
    });
    let seed = platform::random_seed();
    let plan = builder.plan.clone();
    let setup = RecovererSetup {
        machine: recovery::Recoverer::new(node.clone(), plan, RecovererLimits::default(), seed),
        strategies: builder.strategies.clone(),
        tools,
        detector: detector.clone().recipient(),
        guardian: guardian.clone(),
    };
    let recoverer =
        guardian.start(named("chain/recoverer"), place, move |_: &mut Context<Recoverer>| {
            Recoverer::new(setup)
        });
    keeper.do_send(TellRest(recoverer.clone().recipient()));
    notifier.do_send(AddPort {
        port: Port::Local,
        recover: recoverer.clone().recipient(),
        stand_down: Some(recoverer.clone().recipient()),
    });

    let inquiries = vec![
        (named("chain/notifier"), notifier.clone().recipient()),
        (named("chain/detector"), detector.clone().recipient()),
        (named("chain/monitor"), monitor.clone().recipient()),
        (named("chain/recoverer"), recoverer.clone().recipient()),
        (named("keeper"), keeper.clone().recipient()),
    ];
    let chain = Chain {
        table: monitor.clone().recipient(),
        record: detector.clone().recipient(),
        subscribe: detector.recipient(),
        enrol: monitor.clone().recipient(),
        dismiss: monitor.clone().recipient(),
        arbiter,
        inquiries,
        lookout: Mutex::default(),
        notifier: notifier.recipient(),
        recoverer: recoverer.recipient(),
        router,
    };
    Ok(Parts { guardian, chain, monitor, keeper, state, directory, registry, actuators })
}
