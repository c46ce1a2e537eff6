//! The assembly of a node: the only file that names all of its actors.

mod chain;
#[cfg(feature = "journal")]
mod journal;
mod networks;

pub(super) use self::chain::FaultChain;
pub(super) use self::networks::Networks;

use self::chain::{callbacks_of, make_chain, reports};
use super::builder::{ActorPlacement, Configuration, FaultDescription, NodeBuilder};
use super::changes::KeptTree;
use super::checks::{check_settings, dependencies};
use super::controller::{NodeState, StartRoot};
use super::error::{PolicyPart, StartError};
#[cfg(feature = "unix")]
use super::inspection::InspectionActor;
#[cfg(feature = "unix")]
use super::inspection::StartInspection;
use super::lost_communication::LostCommunicationPolicy;
use super::network::hosts::Hosts;
use super::safety::{EndCause, OutputState, SignalWait, is_waited_for};
use super::tree::{ComponentFacts, PreparedTree, SupervisorSpec};
use super::watchdogs::ProcessWatchdogs;
use super::{Node, Shared, order};
use crate::actuator::ActuatorTable;
use crate::arbiter::pool::{ArbiterPool, CULPRITS_LIMIT};
use crate::component::environment::ComponentEnvironment;
use crate::component::spec_error::SpecError;
use crate::condition::{ConditionWiring, Conditions};
use crate::directory::DirectoryTable;
use crate::fault_chain::supervisor::SupervisorChild;
use crate::liveness::sampler;
use crate::parameters::Configured;
use crate::platform;
use crate::platform::file_lock::{FileLock, LockError, without_links};
#[cfg(feature = "unix")]
use crate::platform::file_lock::{PREDECESSOR_TIMEOUT, released_here};
use crate::platform::panics;
use crate::platform::scheduling;
use crate::service::Roster;
use crate::topic::Topics;
#[cfg(feature = "trees")]
use crate::trees::TreeTable;
use crate::variable::{KEPT_VARIABLES, RESTORED_VARIABLES, VariableStore};
use actix::prelude::*;
use blastema_contract::monitor::Register;
use blastema_contract::reports::AreYouAlive;
use blastema_contract::strategy::EnterSafeState;
use blastema_core::detection::dependencies::Dependencies;
use blastema_core::detection::hang::HangDetectorConfig;
use blastema_core::detection::{ObjectKind, Registration};
use blastema_core::recovery::Restart;
use blastema_core::{
    Fault, FaultKind, Incarnation, NameError, NodeName, ObjectAddress, ObjectName,
};
use std::any::Any;
use std::fs;
#[cfg(feature = "unix")]
use std::path::Path;
use std::path::PathBuf;
use std::pin::pin;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

impl NodeBuilder {
    /// Starts the node: its fault chain, and then all components, each after those before it. If
    /// the future is dropped before that, what was started ends without order, and a little later:
    /// [`run_until`](NodeBuilder::run_until) undoes a start in order.
    ///
    /// # Errors
    /// A description that cannot work is refused before any component is started. A component that
    /// cannot be started is a fault, which the plan answers: by default it is restarted and at last
    /// put to rest, and the node starts without it. Where supervisors give up first, up to the
    /// root, as one does whose [start is whole](SupervisorSpec::whole_start), that is
    /// [`StartError::GaveUp`]: it is returned when the safe outputs are applied and
    /// all components have ended. A component that does not end within its `shutdown_within` is
    /// abandoned.
    pub async fn start(self) -> Result<Node, StartError> {
        start(self, std::future::pending()).await
    }

    /// Starts the node, and runs it until a signal comes as for [`Node::run_until_signal`], or
    /// until `end` resolves; then it is shut down in order. The signal may also come while the node
    /// starts, from its first component on: then all components that have started end in reverse
    /// order, and none after them is started. A component that is being initialized has its
    /// [`shutdown_within`](crate::ChildSpec::shutdown_within) to finish that hook.
    ///
    /// ```
    /// use blastema::prelude::*;
    /// # struct Lamp;
    /// # impl Component for Lamp {}
    ///
    /// blastema::run(async {
    ///     let node = Node::builder("module1").child(ChildSpec::new("lamp", || Lamp));
    ///     node.run_until(blastema::sleep(std::time::Duration::from_millis(20))).await
    /// })?;
    /// # Ok::<(), StartError>(())
    /// ```
    ///
    /// # Errors
    /// Those of [`start`](NodeBuilder::start); [`StartError::Interrupted`] if the start was undone
    /// because of the signal, or of `end`. Where a hook does not finish in time after a signal, the
    /// process ends with status 128 and the signal's number, as a node that runs does.
    pub async fn run_until(self, end: impl Future<Output = ()>) -> Result<(), StartError> {
        let mut wait = SignalWait::begin()?;
        let mut cause = pin!(wait.cause(end));
        let node = start(self, cause.as_mut()).await?;
        node.run_to(cause).await;
        Ok(())
    }

    /// The same, but the node ends as well when it has entered the safe state, as a process does
    /// that a supervisor starts again. Returns the state in which it ended.
    ///
    /// # Errors
    /// As [`run_until`](NodeBuilder::run_until).
    pub async fn run_to_safe_state(
        self,
        end: impl Future<Output = ()>,
    ) -> Result<NodeState, StartError> {
        let mut wait = SignalWait::begin()?;
        let mut cause = pin!(wait.cause(end));
        let node = start(self, cause.as_mut()).await?;
        tokio::select! {
            () = node.run_to(cause) => Ok(node.state()),
            state = node.ended() => {
                node.end_if_displaced().await;
                node.shutdown().await;
                Ok(state)
            }
        }
    }

    /// Returns what [`start`](Self::start) would refuse in the description: everything that is wrong
    /// with the node, its networks, components and supervisors; where these components are right,
    /// all connections and policies for lost communication that are not; else the first other
    /// error. No component is made, and no medium, file of variables or journal is opened; keys and
    /// files of parameters are read. The computer on which the node starts may refuse more, such as
    /// its [memory](NodeBuilder::locked_memory).
    pub fn check(self) -> Vec<StartError> {
        let mut refused = check_settings(&self);
        let last = check(self, &mut refused).err();
        refused.extend(last.into_iter().flatten());
        refused
    }

    /// The name of the node, which starts in Blastema's runtime alone.
    fn checked_name(&self) -> Result<NodeName, Vec<StartError>> {
        if actix_rt::System::try_current().is_none() {
            return Err(StartError::Runtime.into());
        }
        Ok(NodeName::new(&self.name).map_err(StartError::name_of("the name of the node"))?)
    }

    /// Finds what can be known to be wrong with the networks, and with commanders on them.
    fn check_networks(&mut self, node: &NodeName) -> Result<(), Vec<StartError>> {
        self.networks.check(node)?;
        for policy in &self.faults.policies {
            // One that is this node is refused with the policies.
            let other = policy.commander_node()?.filter(|commander| commander != node);
            let Some(commander) = other else { continue };
            let known = self.networks.check_commander(&commander);
            known.map_err(|reason| policy.refused(PolicyPart::Commander, reason))?;
        }
        Ok(())
    }
}

/// Finds what is wrong with the networks and the tree, or else with the rest of the description.
fn check(mut builder: NodeBuilder, refused: &mut Vec<StartError>) -> Result<(), Vec<StartError>> {
    builder.networks.hosts = Hosts::Numbered(Default::default());
    let node = builder.checked_name()?;
    refused.extend(builder.check_networks(&node).err().into_iter().flatten());
    // The chain is made for the names of its objects alone.
    builder.process.placement = ActorPlacement::Here;
    let assembly = NodeAssembly::begin(&mut builder, node, Incarnation::FIRST)?;
    assembly.read_parameters(builder.files.parameters)?;
    let policies = &builder.faults.policies;
    // Its actuators are there as long as it is.
    let _preparation = assembly.prepare(builder.root, &builder.faults)?;
    refused.extend(assembly.check_parameters(policies).err());
    refused.extend(assembly.connect_ports(policies, &builder.connections));
    refused.extend(assembly.wrong_policies(policies));
    Ok(())
}

/// Puts a node together, and starts it; undoes that if `end` resolves meanwhile.
async fn start(
    mut builder: NodeBuilder,
    end: impl Future<Output = EndCause>,
) -> Result<Node, StartError> {
    panics::install_hook();
    let first = |mut refused: Vec<StartError>| refused.swap_remove(0);
    let node = builder.checked_name().map_err(first)?;
    builder.check_networks(&node).map_err(first)?;
    check_settings(&builder).into_iter().next().map_or(Ok(()), Err)?;
    if builder.process.locks_memory && !platform::clock_stands() {
        scheduling::lock_memory()?;
    }
    let incarnation = builder.networks.begin_incarnation();
    let mut assembly = NodeAssembly::begin(&mut builder, node, incarnation)?;
    #[cfg(feature = "journal")]
    assembly.keep_journal(builder.files.journal).await?;
    assembly.keep_variables(builder.files.variables).await?;
    assembly.read_parameters(builder.files.parameters)?;
    assembly.start_networks(&mut builder.networks)?;
    assembly.keep_leases()?;
    assembly.keep_conditions()?;
    #[cfg(feature = "unix")]
    let shown_at = builder.files.inspection_socket.as_deref();
    #[cfg(feature = "unix")]
    let inspection = assembly.make_inspection(shown_at).await?;
    let preparation = assembly.prepare(builder.root, &builder.faults);
    let (root, tree, dependencies) = preparation.map_err(first)?;
    assembly.node.tree.root = Some(root.tree());
    assembly.node.tree.dependencies = Mutex::new(dependencies);
    assembly.check_parameters(&builder.faults.policies)?;
    let mut refused = assembly.connect_ports(&builder.faults.policies, &builder.connections);
    refused.next().map_or(Ok(()), Err)?;
    drop(refused);
    assembly.carry_services(builder.networks.services)?;
    #[cfg(feature = "trees")]
    let _ = assembly
        .node
        .environment
        .feature::<TreeTable>()
        .record
        .set(assembly.node.chain.monitor.clone().recipient());
    assembly.keep_policies(builder.faults.policies)?;
    assembly.register_all(&tree).await?;
    assembly.declare_insecure_networks();
    assembly.start_sampler(builder.process.grace)?;
    assembly.watch_chain(builder.process.watchdogs)?;
    let node = assembly.into_node();
    #[cfg(feature = "unix")]
    if let Some(inspection) = inspection {
        // The fault chain's mailboxes close only when the node has ended.
        let shown = inspection.send(StartInspection::node(&node)).await.unwrap_or(Ok(()));
        let path = shown_at.unwrap_or(Path::new(""));
        shown.map_err(|why| StartError::of_path("inspection_socket", path, why))?;
    }
    if builder.process.handles_signals {
        node.0.apply_safe_outputs_on_signals()?;
    }
    start_root(node, root, end).await
}

/// A node that is being put together.
struct NodeAssembly {
    /// What there is of it so far. Where it does not come to be, its threads end.
    node: Shared,
    placement: ActorPlacement,
    /// All that is to be watched.
    registrations: Vec<Register>,
}

/// An object of the middleware: its name, and where it answers the monitor, if it is asked.
type KeptObject = (ObjectName, Option<Recipient<AreYouAlive>>);

/// The root, what is in the tree, and what depends on what.
type TreePreparation = (SupervisorChild, PreparedTree, Dependencies);

impl NodeAssembly {
    /// The fault chain, and the threads that components will live on.
    fn begin(
        builder: &mut NodeBuilder,
        node: NodeName,
        incarnation: Incarnation,
    ) -> Result<Self, StartError> {
        let arbiters = match builder.process.placement {
            ActorPlacement::Threads { shared } => ArbiterPool::pool(shared),
            ActorPlacement::ComponentsHere | ActorPlacement::Here => ArbiterPool::here(),
        };
        let (chain, registry, actuators) = make_chain(builder, &node, incarnation, &arbiters)?;
        for listener in builder.faults.listeners.drain(..) {
            listener.listen(&chain.monitor);
        }
        let plan = std::mem::take(&mut builder.faults.plan);
        // Its own objects may be named in full, with or without a network.
        registry.set_node(node.clone());
        let environment = ComponentEnvironment::new(arbiters, reports(&chain.monitor));
        let environment = ComponentEnvironment {
            watch_list: builder.watch_list.clone(),
            registry,
            fault_codes: Arc::new(plan.codes()),
            ..with_features(environment, actuators)
        };
        let dependencies = Mutex::new(Dependencies::of(node.clone()));
        let tree = KeptTree { root: None, dependencies, plan };
        let node = Shared {
            name: node,
            incarnation,
            environment: Arc::new(environment),
            chain,
            networks: None,
            tree,
            systemd: None,
            policies: Vec::new(),
            outputs: OutputState::default(),
            last_record: OnceLock::new(),
            held: Vec::new(),
        };
        let (placement, registrations) = (builder.process.placement, Vec::new());
        let mut assembly = NodeAssembly { node, placement, registrations };
        let callbacks = callbacks_of(&builder.faults).into_iter().map(|name| (name, None));
        let chain = assembly.node.chain.pings().into_iter();
        let chain = chain.map(|(name, pings)| (name, Some(pings)));
        callbacks.chain(chain).try_for_each(|(name, pings)| assembly.keep(name, pings))?;
        Ok(assembly)
    }

    /// Keeps a name for an object of the middleware, which is watched as soon as all are there.
    fn keep(
        &mut self,
        name: ObjectName,
        pings: Option<Recipient<AreYouAlive>>,
    ) -> Result<(), StartError> {
        let reserved = self.node.environment.registry.reserve(&name, "an object of the middleware");
        reserved.map_err(SpecError::from)?;
        self.registrations.push(middleware(name, pings));
        Ok(())
    }

    async fn keep_variables(&mut self, file: Option<PathBuf>) -> Result<(), StartError> {
        let Some(file) = file else { return Ok(()) };
        let reports = self.node.environment.reports.clone();
        let changed = move |written: Result<(), String>| match written {
            Ok(()) => reports.clear(KEPT_VARIABLES),
            Err(detail) => reports.declare(KEPT_VARIABLES, detail),
        };
        let lock = match FileLock::acquire_after_predecessor(&file, &self.node.name).await {
            Ok(lock) => Some(lock),
            Err(error @ LockError::InUse { .. }) => {
                return Err(StartError::of_path("keep_variables", &file, error.to_string()));
            }
            // Where no lock can be, no file can be written either, and that stops no robot.
            Err(LockError::Io(error)) => {
                let place = file.display();
                changed(Err(format!("variables cannot be kept in {place}: {error}")));
                None
            }
        };
        let path = match &lock {
            Some(lock) => lock.path().to_owned(),
            None => without_links(&file),
        };
        self.node.held.push(path.clone());
        let kept = self.node.environment.feature::<VariableStore>().keep_in(path, lock, changed);
        kept.map_err(|error| StartError::of_path("keep_variables", &file, error.to_string()))?;
        self.keep(named(KEPT_VARIABLES), None)?;
        self.keep(named(RESTORED_VARIABLES), None)
    }

    fn read_parameters(&self, configurations: Vec<Configuration>) -> Result<(), StartError> {
        for configuration in configurations {
            let (file, text) = match configuration {
                Configuration::Text(text) => (None, Ok(text)),
                Configuration::File(file) => {
                    let text = fs::read_to_string(&file).map_err(|error| error.to_string());
                    (Some(file), text)
                }
            };
            let configured = self.node.environment.configured();
            let taken = text.and_then(|text| configured.take(&text, file.as_deref()));
            taken.map_err(|reason| StartError::Parameters { file, reason })?;
        }
        Ok(())
    }

    /// Finds values for a component that takes none.
    fn check_parameters(&self, policies: &[LostCommunicationPolicy]) -> Result<(), StartError> {
        let run = policies.iter().flat_map(LostCommunicationPolicy::components);
        run.for_each(|name| self.node.environment.configured().expect(name));
        let unused = self.node.environment.configured().check();
        unused.map_err(|(file, reason)| StartError::Parameters { file, reason })
    }

    /// The supervisors and their children. Nothing of them is started yet.
    ///
    /// # Errors
    /// All specs that are wrong, else the first other error.
    fn prepare(
        &self,
        root: SupervisorSpec,
        faults: &FaultDescription,
    ) -> Result<TreePreparation, Vec<StartError>> {
        let mut tree = PreparedTree::default();
        let root = root.prepare(&self.node.tree_environment(false), &mut tree);
        let root = root.map_err(StartError::from)?;
        if !tree.refused.is_empty() {
            return Err(tree.refused.into_iter().map(StartError::from).collect());
        }
        let names: Vec<&ObjectName> = tree.components.iter().map(|facts| &facts.name).collect();
        let (kinds, strategies) = (&faults.own_kinds, faults.strategies.names());
        let answered = self.node.tree.plan.check(names, kinds, strategies);
        answered.map_err(StartError::from)?;
        let dependencies = dependencies(&self.node.name, &tree);
        dependencies.check().map_err(StartError::from)?;
        Ok((root, tree, dependencies))
    }

    fn keep_leases(&mut self) -> Result<(), StartError> {
        let (name, Shared { chain, environment, .. }) = (named("leases"), &self.node);
        let actuators = environment.feature::<ActuatorTable>();
        let leases = actuators.start(name.clone(), &chain.guardian, chain.arbiter.as_ref());
        self.keep(name, Some(leases))
    }

    fn keep_conditions(&mut self) -> Result<(), StartError> {
        let (name, Shared { chain, environment, .. }) = (named("conditions"), &self.node);
        let (net, timeout) = match &self.node.networks {
            Some(networks) => (Some(networks.handle.clone()), Some(networks.silence)),
            None => (None, None),
        };
        let wiring = ConditionWiring {
            reports: environment.reports.clone(),
            topics: environment.feature::<Topics>().clone(),
            actuators: environment.feature::<ActuatorTable>().clone(),
            registry: environment.registry.clone(),
            directory: environment.feature::<DirectoryTable>().clone(),
            net,
            links: self.node.networks.iter().flat_map(|networks| networks.links.clone()).collect(),
            timeout,
        };
        let arbiter = chain.arbiter.as_ref();
        let conditions = environment.feature::<Conditions>();
        let pings = conditions.start(wiring, name.clone(), &chain.guardian, arbiter);
        self.keep(name, Some(pings))
    }

    fn keep_policies(&mut self, policies: Vec<LostCommunicationPolicy>) -> Result<(), StartError> {
        self.wrong_policies(&policies).next().map_or(Ok(()), Err)?;
        let Shared { name, incarnation, environment, chain, policies: kept, .. } = &mut self.node;
        for policy in policies {
            let arbiter = chain.arbiter.as_ref();
            kept.push(policy.start(name, *incarnation, environment, arbiter)?);
        }
        Ok(())
    }

    /// What is wrong with policies, once their actuators are there.
    fn wrong_policies(
        &self,
        policies: &[LostCommunicationPolicy],
    ) -> impl Iterator<Item = StartError> {
        let policies =
            policies.iter().enumerate().map(|(place, policy)| (policy, &policies[..place]));
        policies.flat_map(|(policy, before)| {
            policy.wrong(before, &self.node.name, &self.node.environment)
        })
    }

    /// Connects ports, and returns which cannot be connected.
    fn connect_ports(
        &self,
        policies: &[LostCommunicationPolicy],
        connections: &[(String, String)],
    ) -> impl Iterator<Item = StartError> {
        let components = policies.iter().flat_map(LostCommunicationPolicy::components);
        components.for_each(|name| self.node.environment.registry.keep_connections(name));
        connections.iter().filter_map(|(from, to)| {
            let why = Box::new(self.node.environment.registry.connect_ports(from, to).err()?);
            Some(StartError::Connection { from: from.clone(), to: to.clone(), why })
        })
    }

    /// It is opened when there is something to be seen.
    #[cfg(feature = "unix")]
    async fn make_inspection(
        &mut self,
        path: Option<&Path>,
    ) -> Result<Option<Addr<InspectionActor>>, StartError> {
        let Some(path) = path.map(Path::to_owned) else { return Ok(None) };
        released_here(&path, PREDECESSOR_TIMEOUT).await;
        self.node.held.push(path.clone());
        let (name, chain) = (named("inspection"), &self.node.chain);
        let reports = self.node.environment.reports.clone();
        let inspection = InspectionActor::new(path, chain.state.clone(), reports);
        let inspection = chain.guardian.start(
            name.clone(),
            chain.arbiter.as_ref(),
            |_: &mut Context<InspectionActor>| inspection,
        );
        self.keep(name, Some(inspection.clone().recipient()))?;
        Ok(Some(inspection))
    }

    /// From here on everything is watched.
    async fn register_all(&mut self, tree: &PreparedTree) -> Result<(), StartError> {
        let mut all = std::mem::take(&mut self.registrations);
        all.extend(registrations(&self.node.name, tree)?);
        Ok(self.node.chain.register_all(all).await?)
    }

    /// Looks at arbiters and components from now on, also while they are stuck.
    fn start_sampler(&self, grace: Duration) -> Result<(), StartError> {
        let config = HangDetectorConfig { grace, ..HangDetectorConfig::default() };
        let Shared { name, environment, chain, .. } = &self.node;
        let list = environment.watch_list.clone();
        let (threads, sighted) = (environment.arbiters.clone(), chain.monitor.clone().recipient());
        let on_thread = self.placement != ActorPlacement::Here;
        chain.keep_sampler(sampler::start(list, threads, config, sighted, on_thread)?);
        let rest = chain.controller.clone().recipient();
        rest_when_threads_run_out(&environment.arbiters, name, rest);
        Ok(())
    }

    /// Watches the chain from outside, and lets the watchdogs of the process depend on it.
    fn watch_chain(&mut self, wanted: ProcessWatchdogs) -> Result<(), StartError> {
        let (manager, watchdogs) = wanted.open().map_err(StartError::ProcessWatchdog)?;
        if self.placement != ActorPlacement::Here {
            let Shared { name, chain, environment, .. } = &self.node;
            chain.watch_chain(name, watchdogs, environment.clone())?;
        }
        self.node.systemd = manager;
        Ok(())
    }

    fn into_node(self) -> Node {
        let environment = &self.node.environment;
        environment.feature::<VariableStore>().report_complaints(&environment.reports);
        let node = Node(Arc::new(self.node));
        node.0.policies.iter().for_each(|policy| policy.attach(&node));
        order::serve_operators(&node);
        node.stop_if_displaced();
        node
    }
}

/// Nothing refuses the start any more.
async fn start_root(
    node: Node,
    root: SupervisorChild,
    end: impl Future<Output = EndCause>,
) -> Result<Node, StartError> {
    node.0.outputs.begun.store(true, SeqCst);
    let controller = &node.0.chain.controller;
    let started = async { controller.send(StartRoot(Box::new(root))).await };
    let started = tokio::select! {
        biased;
        cause = end => {
            node.end_for(cause).await;
            return Err(StartError::Interrupted { by: cause.to_string() });
        }
        started = started => started,
    };
    if !matches!(started, Ok(Ok(()))) && is_waited_for() {
        node.end_if_displaced().await;
    }
    match started {
        Ok(Ok(())) => {
            node.0.networks.iter().for_each(|networks| networks.handle.announce());
            node.0.tell_systemd("READY=1");
            Ok(node)
        }
        Ok(Err(reason)) => Err(StartError::GaveUp { reason }),
        Err(_) => Err(StartError::GaveUp { reason: "the fault chain ended".into() }),
    }
}

/// Registers what the features of a node add to the environment of its components.
pub(crate) fn with_features(
    environment: ComponentEnvironment,
    actuators: ActuatorTable,
) -> ComponentEnvironment {
    let topics = Topics::new(environment.dead_letters.clone(), environment.reports.clone());
    let directory = DirectoryTable::default();
    let features: Vec<Box<dyn Any + Send + Sync>> = vec![
        Box::new(topics),
        Box::new(actuators),
        Box::new(VariableStore::default()),
        Box::new(Configured::default()),
        Box::new(Conditions::default()),
        #[cfg(feature = "trees")]
        Box::new(TreeTable::default()),
        Box::new(Roster::new(directory.clone())),
        Box::new(directory),
    ];
    ComponentEnvironment { features, ..environment }
}

/// How supervisors and components are watched.
fn registrations(node: &NodeName, tree: &PreparedTree) -> Result<Vec<Register>, StartError> {
    let supervisors = tree.supervisors.iter().cloned();
    let supervisors = supervisors.map(|(name, pings)| Ok(middleware(name, Some(pings))));
    let components = tree.components.iter().map(|facts| {
        let of = format!("what {} depends on", facts.name);
        registration(node, facts).map_err(StartError::name_of(of))
    });
    supervisors.chain(components).collect()
}

fn registration(node: &NodeName, facts: &ComponentFacts) -> Result<Register, NameError> {
    let ComponentFacts { name, depends_on, restart } = facts;
    let address = |text: &String| match text.contains(':') {
        true => text.parse(),
        false => Ok(ObjectAddress::new(node.clone(), ObjectName::new(text)?)),
    };
    let depends_on: Vec<ObjectAddress> =
        depends_on.iter().map(address).collect::<Result<_, _>>()?;
    // A component's signs of life are activity records, which the sampler reads: no message is sent
    // for them.
    let unborn = Incarnation::default();
    let mut registration = Registration::new(name.clone()).depends_on(depends_on);
    (registration.incarnation, registration.may_end) = (unborn, *restart != Restart::Permanent);
    Ok(Register { registration, pings: None })
}

/// An object of the middleware. That it does not answer for six seconds, or thirty where the node
/// starves, ends in the node's safe state.
fn middleware(name: ObjectName, pings: Option<Recipient<AreYouAlive>>) -> Register {
    let mut registration = Registration::new(name);
    registration.kind = ObjectKind::Middleware;
    Register { registration, pings }
}

fn named(name: &str) -> ObjectName {
    ObjectName::new(name).expect("the middleware's own names are well formed")
}

/// A thread that hangs cannot be ended. When several culprits keep some, only a new process helps.
fn rest_when_threads_run_out(
    threads: &ArbiterPool,
    node: &NodeName,
    rest: Recipient<EnterSafeState>,
) {
    let node = node.clone();
    threads.on_abandoned(Box::new(move |lost| {
        if lost.len() < CULPRITS_LIMIT {
            return;
        }
        let count: usize = lost.values().sum();
        let culprits: Vec<String> = lost.keys().map(ToString::to_string).collect();
        let culprits = culprits.join(", ");
        let reason =
            format!("{count} threads hang for good, kept by {culprits}; restart the process");
        let fault = Fault::of_node(node.clone(), FaultKind::Hang, reason.clone(), platform::now());
        rest.do_send(EnterSafeState { fault, reason });
    }));
}
