//! How a node is put together: the one place that knows all actors.

use super::builder::{NodeBuilder, Placement, StartError};
use super::checks::{
    check_networks, check_service, check_service_order, check_window, dependencies,
};
use super::keeper::NodeState;
use super::keeper::{Keeper, KeeperSetup, StartRoot, TellRest};
use super::network::{Cable, Network};
use super::tree::{Ground, Harvest, Planted};
use super::window::{Show, Window};
use super::{Node, Root, Shared};
use crate::chain::detector::Detector;
use crate::chain::directory::Directory;
use crate::chain::monitor::Monitor;
use crate::chain::notifier::Notifier;
use crate::chain::recoverer::{Recoverer, RecovererSetup};
use crate::chain::strategy::{SafeOutputs, ToolBox, Tools};
use crate::guardian::Guardian;
use crate::host::arbiters::{ABANDONED_LIMIT, Arbiters};
use crate::host::environment::{HostEnvironment, KEPT_VARIABLES, Reports};
use crate::host::spec::SpecError;
use crate::host::watch::{self as lookout, WatchGuard};
use crate::lease::Yard;
use crate::net::claims::{ClaimsBody, ClaimsSetup};
use crate::net::rest::{RestBody, RestSetup};
use crate::net::{self, NetEnvironment, NetHandle};
use crate::registry::Registry;
use crate::service::ReplicaBody;
use crate::{panics, platform};
use actix::prelude::*;
use blastema_contract::detector::{ReadRecord, Subscribe};
use blastema_contract::monitor::{Dismiss, Enrol, ReadTable};
use blastema_contract::notifier::AddPort;
use blastema_contract::recoverer::Recover;
use blastema_contract::reports::AreYouAlive;
use blastema_contract::strategy::{IsolateNode, Reroute, RestNode};
use blastema_contract::transport::Close;
use blastema_core::detection::{
    DetectorLimits, EnrolError, Enrolment, MonitorLimits, NotifierLimits, ObjectKind, Port, Watch,
};
use blastema_core::net::isolation::Judges;
use blastema_core::recovery::{self, RecovererLimits, Restart};
use blastema_core::scanner::ScannerConfig;
use blastema_core::{
    Fault, FaultKind, Incarnation, NameError, NodeName, ObjectAddress, ObjectName,
};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;
use tokio::sync::watch;

/// The fault chain as the rest of the node sees it.
pub(super) struct Chain {
    pub(super) table: Recipient<ReadTable>,
    pub(super) record: Recipient<ReadRecord>,
    pub(super) subscribe: Recipient<Subscribe>,
    enrol: Recipient<Enrol>,
    dismiss: Recipient<Dismiss>,
    arbiter: Option<ArbiterHandle>,
    /// Where its actors answer.
    inquiries: Vec<(ObjectName, Recipient<AreYouAlive>)>,
    notifier: Recipient<AddPort>,
    recoverer: Recipient<Recover>,
    /// Looks at arbiters and components; it ends when it is dropped.
    lookout: Mutex<Option<WatchGuard>>,
    router: Arc<OnceLock<(Recipient<Reroute>, Recipient<IsolateNode>)>>,
}

impl Chain {
    async fn enrol_all(&self, enrolments: Vec<Enrol>) -> Result<(), StartError> {
        for enrolment in enrolments {
            // The chain's mailboxes close only when the node has ended.
            if let Ok(answer) = self.enrol.send(enrolment).await {
                answer?;
            }
        }
        Ok(())
    }

    /// Watches a component that was planted after the start.
    pub(super) async fn enrol(&self, node: &NodeName, planted: &Planted) {
        let name = planted.child.name();
        let (watch, inquiries) = (planted.watch, planted.inquiries.clone());
        if let Ok(enrolment) = enrolment(node, name, watch, &planted.depends_on, inquiries) {
            // A component that cannot be watched as it wishes still has its guard.
            let _: Result<Result<_, EnrolError>, _> = self.enrol.send(enrolment).await;
        }
    }

    pub(super) fn dismiss(&self, object: ObjectName) {
        self.dismiss.do_send(Dismiss { object });
    }

    pub(super) fn stop(&self) {
        self.look_out(None);
        if let Some(arbiter) = &self.arbiter {
            arbiter.stop();
        }
    }

    fn look_out(&self, lookout: Option<WatchGuard>) {
        *self.lookout.lock().unwrap_or_else(PoisonError::into_inner) = lookout;
    }
}

fn enrolment(
    node: &NodeName,
    name: &ObjectName,
    watch: Watch,
    depends_on: &[String],
    inquiries: Recipient<AreYouAlive>,
) -> Result<Enrol, NameError> {
    let address = |text: &String| match text.contains(':') {
        true => text.parse(),
        false => Ok(ObjectAddress::new(node.clone(), ObjectName::new(text)?)),
    };
    let depends_on: Vec<ObjectAddress> =
        depends_on.iter().map(address).collect::<Result<_, _>>()?;
    // A component's own signs of life are stamps, which the lookout reads: no message is sent for them.
    let watch = if matches!(watch, Watch::Push(_)) { Watch::Guard } else { watch };
    let unborn = Incarnation::default();
    let enrolment =
        Enrolment::new(name.clone()).incarnation(unborn).watch(watch).depends_on(depends_on);
    Ok(Enrol { enrolment, inquiries: Some(inquiries) })
}

/// An object of the middleware. It answers in microseconds; that it did not for several seconds is no
/// matter of load, and ends in the node's safe rest.
fn middleware(name: ObjectName, inquiries: Option<Recipient<AreYouAlive>>) -> Enrol {
    let watch = match inquiries {
        Some(_) => Watch::pull(Duration::from_secs(1), Duration::from_secs(3)),
        None => Watch::Guard,
    };
    let enrolment = Enrolment::new(name).kind(ObjectKind::Middleware).watch(watch);
    Enrol { enrolment, inquiries }
}

/// Everything between the threads and the components.
struct Parts {
    guardian: Guardian,
    chain: Chain,
    monitor: Addr<Monitor>,
    keeper: Addr<Keeper>,
    state: watch::Receiver<NodeState>,
    directory: Directory,
    registry: Registry,
    actuators: Yard,
}

fn named(name: &str) -> ObjectName {
    ObjectName::new(name).expect("the middleware's own names are well formed")
}

/// An arbiter on a thread of its own, for the middleware.
fn own_arbiter() -> std::io::Result<ArbiterHandle> {
    let arbiter = Arbiter::try_with_tokio_rt(|| {
        tokio::runtime::Builder::new_current_thread().enable_all().build()
    })?;
    Ok(arbiter.handle())
}

/// Makes the fault chain; it has nothing to watch yet.
fn make_chain(
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

/// The networks of a node that runs.
pub(super) struct Networks {
    pub(super) handle: NetHandle,
    pub(super) cables: BTreeMap<String, Cable>,
    transports: Vec<Recipient<Close>>,
    arbiter: Option<ArbiterHandle>,
}

/// How long a node that ends waits until its peers have what was sent to them. One that is gone must
/// not keep it.
const FAREWELL: Duration = Duration::from_secs(1);
/// How often it looks whether they have.
const FAREWELL_LOOK: Duration = Duration::from_millis(5);

impl Networks {
    /// Delivers what was sent, and ends every session.
    pub(super) async fn leave(&self) {
        self.handle.leave();
        let gone = async {
            while self
                .handle
                .read_sessions()
                .await
                .iter()
                .any(|row| row.standing.incarnation.is_some())
            {
                tokio::time::sleep(FAREWELL_LOOK).await;
            }
        };
        // Whatever is left after that is lost with the peers.
        let _ = tokio::time::timeout(FAREWELL, gone).await;
    }

    pub(super) fn stop(&self) {
        // On an arbiter that others use too, links would go on saying that the node lives.
        self.transports.iter().for_each(|transport| transport.do_send(Close));
        self.handle.stop();
        if let Some(arbiter) = &self.arbiter {
            arbiter.stop();
        }
    }
}

/// Starts transports, links, router, sessions and gateway, and connects them to the fault chain.
fn make_networks(
    (networks, judges): (Vec<Network>, Judges),
    placement: Placement,
    (node, incarnation): (&NodeName, Incarnation),
    parts: &Parts,
    environment: &HostEnvironment,
) -> Result<(Networks, Vec<Enrol>), StartError> {
    let Parts { guardian, chain, monitor, .. } = parts;
    let arbiter = match placement {
        Placement::Here => None,
        Placement::Threads { .. } | Placement::ComponentsHere => Some(own_arbiter()?),
    };
    let (mut specs, mut cables) = (Vec::new(), BTreeMap::new());
    let (mut neighbours, mut enrolments) = (BTreeSet::new(), Vec::new());
    for network in networks {
        let laid = network.lay(node, guardian, arbiter.as_ref())?;
        if let Some(cable) = laid.cable {
            cables.insert(laid.spec.name.to_string(), cable);
        }
        enrolments.extend(laid.transports.into_iter().map(|name| middleware(name, None)));
        neighbours.extend(laid.neighbours);
        specs.push(laid.spec);
    }
    let beacons = specs.iter().filter_map(|spec| spec.discovery.as_ref()?.beacons.as_ref());
    let beacons = beacons.map(|(transport, _)| transport.close.clone());
    let transports = specs.iter().map(|spec| spec.transport.close.clone()).chain(beacons).collect();
    let net_environment = NetEnvironment {
        node: node.clone(),
        incarnation,
        guardian: guardian.clone(),
        arbiter: arbiter.clone(),
        registry: environment.registry.clone(),
        topics: environment.topics.clone(),
        dead_letters: environment.dead_letters.clone(),
        recoverer: Some(chain.recoverer.clone()),
        links: Some(monitor.clone().recipient()),
        nodes: Some(monitor.clone().recipient()),
        faults: Some(monitor.clone().recipient()),
        mended: Some(monitor.clone().recipient()),
        judges,
        envoys: Vec::new(),
    };
    let slowest = specs.iter().flat_map(|spec| &spec.links).map(|link| link.hello_interval).max();
    let setup = claims_setup((node, incarnation), parts, environment);
    let setup = ClaimsSetup {
        settle: settling(slowest.unwrap_or_default()),
        expected: neighbours.iter().cloned().collect(),
        ..setup
    };
    let claims = ClaimsBody::start(setup, guardian, arbiter.as_ref());
    enrolments.push(middleware(named("net/claims"), Some(claims.inquiries)));
    let setup =
        RestSetup { registry: environment.registry.clone(), nodes: monitor.clone().recipient() };
    let rest = RestBody::start(setup, guardian, arbiter.as_ref());
    parts.keeper.do_send(TellRest(rest.own));
    enrolments.push(middleware(named("net/rest"), Some(rest.inquiries)));
    let envoys = vec![claims.peers, rest.peers];
    let net_environment = NetEnvironment { envoys, ..net_environment };
    let handle = net::start(net_environment, specs)
        .map_err(|error| StartError::Network(error.to_string()))?;
    let own = handle.inquiries().into_iter();
    enrolments.extend(own.map(|(name, inquiries)| middleware(name, Some(inquiries))));
    // The recipient is set once, here.
    let _ = chain.router.set((handle.reroute(), handle.isolation()));
    for neighbour in neighbours {
        let recover = handle.recoverer_of(&neighbour);
        let port = Port::Remote(neighbour);
        chain.notifier.do_send(AddPort { port, recover, stand_down: None });
    }
    Ok((Networks { handle, cables, transports, arbiter }, enrolments))
}

/// Claims of a node that knows nobody.
fn claims_setup(
    (node, incarnation): (&NodeName, Incarnation),
    parts: &Parts,
    environment: &HostEnvironment,
) -> ClaimsSetup {
    ClaimsSetup {
        node: node.clone(),
        incarnation,
        settle: Duration::ZERO,
        expected: Vec::new(),
        registry: environment.registry.clone(),
        names: environment.names.clone(),
        faults: Some(parts.monitor.clone().recipient()),
        mended: Some(parts.monitor.clone().recipient()),
    }
}

/// How long a node listens after its start before it grants itself a name, where hellos come so often:
/// a link that failed once lately is up after nine of them, and the rest is for sessions on slow media.
fn settling(hello_interval: Duration) -> Duration {
    (hello_interval * 12 + Duration::from_millis(400)).min(Duration::from_secs(30))
}

/// A thread that hangs cannot be ended. When several have been given up, only a new process helps.
fn rest_when_threads_run_out(threads: &Arbiters, node: &NodeName, rest: Recipient<RestNode>) {
    let node = node.clone();
    threads.on_abandoned(Box::new(move |count| {
        if count < ABANDONED_LIMIT {
            return;
        }
        let reason = format!("{count} threads hang for good; begin the process anew");
        let fault = Fault::of_node(node.clone(), FaultKind::Hang, reason.clone(), platform::now());
        rest.do_send(RestNode { fault, reason });
    }));
}

/// Ends the threads of a node that does not come to be.
struct Undone {
    arbiters: Arbiters,
    own: Vec<ArbiterHandle>,
    kept: bool,
}

impl Drop for Undone {
    fn drop(&mut self) {
        if !self.kept {
            self.arbiters.stop();
            for arbiter in &self.own {
                arbiter.stop();
            }
        }
    }
}

fn keep_variables(environment: &HostEnvironment, file: PathBuf) -> Result<(), StartError> {
    let told = environment.reports.clone();
    let failed = move |detail| told.declare(KEPT_VARIABLES, detail);
    let kept = environment.variables.keep_in(file.clone(), failed);
    kept.map_err(|error| StartError::Variables { file, reason: error.to_string() })
}

/// Whose word isolates a node.
fn judges(wardens: &[String]) -> Result<Judges, NameError> {
    if wardens.is_empty() {
        return Ok(Judges::Majority);
    }
    let wardens = wardens.iter().map(|name| NodeName::new(name));
    Ok(Judges::Wardens(wardens.collect::<Result<_, _>>()?))
}

pub(super) async fn start(mut builder: NodeBuilder) -> Result<Node, StartError> {
    panics::install_hook();
    let named_so = StartError::name_of("the name of the node");
    let node = NodeName::new(&builder.name).map_err(named_so)?;
    let incarnation = platform::node_incarnation();
    let judges = judges(&builder.wardens)
        .map_err(StartError::name_of("the name of a node that isolates others"))?;
    check_networks(&builder.networks, &node)?;
    builder.shown_at.as_deref().map_or(Ok(()), check_window)?;
    let parts = make_chain(&builder, (&node, incarnation))?;
    for listener in builder.listeners {
        listener.listen(&parts.chain.subscribe);
    }

    let arbiters = match builder.placement {
        Placement::Threads { shared } => Arbiters::pool(shared),
        Placement::ComponentsHere | Placement::Here => Arbiters::here(),
    };
    let reports = Reports {
        exits: Some(parts.monitor.clone().recipient()),
        states: Some(parts.monitor.clone().recipient()),
        faults: Some(parts.monitor.clone().recipient()),
        mended: Some(parts.monitor.clone().recipient()),
    };
    let (registry, actuators) = (parts.registry.clone(), parts.actuators.clone());
    // Its own objects may be named in full, with or without a network.
    registry.connect(node.clone(), None);
    let own = parts.chain.arbiter.iter().cloned().collect();
    let mut undone = Undone { arbiters: arbiters.clone(), own, kept: false };
    let plan = Arc::new(builder.plan);
    let fault_codes = Arc::new(plan.codes());
    let general = HostEnvironment::new(arbiters, reports);
    let environment = HostEnvironment { registry, fault_codes, actuators, ..general };
    let kept = builder.kept_in.is_some();
    if let Some(file) = builder.kept_in.take() {
        keep_variables(&environment, file)?;
    }
    let (networks, network_enrolments) = if builder.networks.is_empty() {
        let setup = claims_setup((&node, incarnation), &parts, &environment);
        let arbiter = parts.chain.arbiter.as_ref();
        let claims = ClaimsBody::start(setup, &parts.guardian, arbiter);
        (None, vec![middleware(named("net/claims"), Some(claims.inquiries))])
    } else {
        let (networks, placement) = ((builder.networks, judges), builder.placement);
        let who = (&node, incarnation);
        let (networks, enrolments) = make_networks(networks, placement, who, &parts, &environment)?;
        undone.own.extend(networks.arbiter.clone());
        (Some(networks), enrolments)
    };
    let Parts { guardian, chain, monitor, keeper, state, directory, .. } = parts;
    let kept_by = directory.clone();

    let ground = Ground {
        environment: &environment,
        guardian: &guardian,
        arbiter: chain.arbiter.as_ref(),
        monitor: monitor.clone(),
        directory,
        plan: &plan,
    };
    let mut harvest = Harvest::default();
    let root = builder.root.plant(&ground, &mut harvest)?;
    let names: Vec<&ObjectName> = harvest.components.iter().map(|facts| &facts.name).collect();
    plan.check(names, &builder.own_kinds, builder.strategies.names())?;
    let dependencies = dependencies(&node, &harvest);
    dependencies.check()?;

    let mut enrolments: Vec<Enrol> = Vec::new();
    if let Some(networks) = &networks {
        environment.services.find_by(networks.handle.finder());
    }
    let services: Vec<_> = builder.services.into_iter().collect::<Result<_, _>>()?;
    services.iter().try_for_each(check_service)?;
    check_service_order(&services)?;
    for carried in services {
        let name = carried.body.clone();
        environment.services.enter(carried.name.clone(), carried.config.members.clone());
        let place = networks.as_ref().and_then(|networks| networks.arbiter.as_ref());
        let place = place.or(chain.arbiter.as_ref());
        let body = ReplicaBody::start(carried, &environment, &guardian, place);
        let body = body.map_err(SpecError::from)?;
        enrolments.push(middleware(name, Some(body)));
    }
    if kept {
        enrolments.push(middleware(named(KEPT_VARIABLES), None));
    }
    let leases = environment.actuators.start(named("leases"), &guardian, chain.arbiter.as_ref());
    enrolments.push(middleware(named("leases"), Some(leases)));
    for (name, inquiries) in chain.inquiries.iter().cloned() {
        enrolments.push(middleware(name, Some(inquiries)));
    }
    let window = builder.shown_at.map(|path| {
        let (name, place) = (named("window"), chain.arbiter.as_ref());
        let window = Window::new(path, state.clone(), environment.reports.clone());
        let window = guardian.start(name.clone(), place, |_: &mut Context<Window>| window);
        enrolments.push(middleware(name, Some(window.clone().recipient())));
        window
    });
    enrolments.extend(network_enrolments);
    for (name, inquiries) in harvest.supervisors {
        enrolments.push(middleware(name, Some(inquiries)));
    }
    let mut actors: BTreeMap<ObjectName, _> = BTreeMap::new();
    for facts in harvest.components {
        let (name, watch) = (&facts.name, facts.watch);
        let enrolled = enrolment(&node, name, watch, &facts.depends_on, facts.inquiries);
        let of = || format!("what {name} depends on");
        let mut enrol = enrolled.map_err(|error| StartError::name_of(of())(error))?;
        enrol.enrolment.may_end = facts.restart != Restart::Permanent;
        enrolments.push(enrol);
        actors.insert(facts.name, facts.actor);
    }
    chain.enrol_all(enrolments).await?;

    let config = ScannerConfig { grace: builder.grace, ..ScannerConfig::default() };
    let list = environment.watch_list.clone();
    let (threads, sighted) = (environment.arbiters.clone(), monitor.recipient());
    chain.look_out(Some(match builder.placement {
        Placement::Here => lookout::start_task(list, threads, config, sighted),
        Placement::Threads { .. } | Placement::ComponentsHere => {
            lookout::start_thread(list, threads, config, sighted)?
        }
    }));
    rest_when_threads_run_out(&environment.arbiters, &node, keeper.clone().recipient());

    let shared = Shared {
        name: node,
        incarnation,
        environment,
        chain,
        networks,
        root: Root::of(&root),
        shutdown: keeper.clone().recipient(),
        restart: keeper.clone().recipient(),
        directory: kept_by,
        state,
        actors: Mutex::new(actors),
        dependencies: Mutex::new(dependencies),
        plan,
    };
    let node = Node(Arc::new(shared));
    node.0.environment.declare_complaints();
    // From here on the node ends its threads itself.
    undone.kept = true;
    if let Some(window) = window {
        // The fault chain's mailboxes close only when the node has ended.
        let shown = window.send(Show::node(&node)).await.unwrap_or(Ok(()));
        shown.map_err(StartError::Shown)?;
    }
    match keeper.send(StartRoot(Box::new(root))).await {
        Ok(Ok(())) => Ok(node),
        Ok(Err(reason)) => Err(StartError::GaveUp { reason }),
        Err(_) => Err(StartError::GaveUp { reason: "the fault chain ended".into() }),
    }
}
