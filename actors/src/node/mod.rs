//! The node: one process of the robot, with its supervision tree, its fault chain and its networks.
//!
//! ```text
//! NodeBuilder ─ start ─► NodeController ─► root supervisor ─► supervisors, components
//!                          ▲                    ▲
//!                          │ safe state         │ restart, reset, isolate, safe stop
//!                 Monitor ─► Detector ─► Notifier ─► Recoverer ─► strategies
//! ```
//!
//! The fault chain lives on an arbiter of its own under the guardian; the watch has a thread of its
//! own, and so has what watches the chain from outside; the application's recovery strategies have
//! one each; components share as many arbiters as the computer has cores, or have threads of their
//! own.

pub(crate) mod assembly;
mod builder;
mod changes;
mod checks;
mod conditions;
pub(crate) mod controller;
mod error;
mod faults;
mod health;
#[cfg(feature = "unix")]
pub(crate) mod inspection;
mod lost_communication;
mod network;
mod order;
mod safety;
pub(crate) mod snapshot;
mod to_the_end;
mod tree;
mod watchdogs;

pub use builder::NodeBuilder;
pub use changes::{RemoveError, RestartedChild};
pub use conditions::Heartbeats;
pub use controller::{NodeState, RestartError};
pub use error::{PolicyPart, StartError};
pub use faults::FaultEvents;
pub use health::{DegradedPart, FaultCounts, LastRecovery, NodeHealth};
pub use lost_communication::{
    AcknowledgeError, LostCommunicationPolicy, LostCommunicationRow, Rung,
};
pub use network::{
    Cable, Direction, Impairment, IsolateError, Link, MediumKind, MemoryMedium, Network,
    NetworkRow, NotReady,
};
pub use order::{ComponentOrder, OrderReply, OrderRow, OrderVerb};
pub use tree::{Subtree, SupervisorSpec};

use crate::actuator::ActuatorTable;
use crate::actuator::{self, ActuatorRow, Commander};
use crate::component::Component;
use crate::component::environment::ComponentEnvironment;
use crate::component::spec_error::SpecError;
use crate::condition::Conditions;
use crate::condition::{
    Condition, ConditionError, ConditionStatus, Connected, Heartbeat, heartbeat,
};
use crate::host::reference::ActorRef;
use crate::host::spec::ChildSpec;
use crate::liveness::sampler::Running;
use crate::liveness::threads;
use crate::liveness::threads::ThreadRow;
use crate::messaging::dead_letters::DeadLetterLog;
use crate::messaging::injection::Injection;
use crate::messaging::sender::Sender;
use crate::platform;
use crate::platform::file_lock::released_here;
use crate::platform::systemd::Systemd;
use crate::topic::Topics;
use crate::topic::{Publisher, TopicRow};
#[cfg(feature = "trees")]
use crate::trees::{TreeChangeRow, TreeNodeRow, TreeTable};
use crate::variable::VariableStore;
use crate::variable::{self, VariableRef};
use assembly::FaultChain;
use assembly::Networks;
use blastema_contract::detector::ReadRecord;
use blastema_contract::monitor::ReadTable;
use blastema_contract::supervisor::{ReadTree, SupervisionTree};
use blastema_core::connection::ConditionState;
use blastema_core::detection::{FaultRecord, MonitorRow};
use blastema_core::port::{ConnectError, PortConnection};
use blastema_core::{Contract, DeliveryError, Event, Incarnation, NodeName, ObjectName, Variable};
use conditions::keep_while;
use controller::Shutdown;
use lost_communication::KeptPolicy;
use safety::{EndCause, SignalWait};
use std::any::type_name;
use std::future::pending;
use std::path::PathBuf;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use std::{fmt, io};
use to_the_end::ToTheEnd;
use tracing::{info, warn};

/// How long the end of a node waits until another one may have its files and its socket.
const RELEASE_TIMEOUT: Duration = Duration::from_secs(2);
/// The exit status of a process whose node has stopped because another process has its name.
const NAME_TAKEN: i32 = 3;

/// A running node. Clones refer to the same one; it runs until [`shutdown`](Node::shutdown), or
/// until it enters the safe state, from where [`restart`](Node::restart) brings it back.
///
/// Where the last clone is dropped without a shutdown, as where `main` returns an error or panics,
/// the [safe outputs](NodeBuilder::safe_outputs) are applied, actuators get their safe commands,
/// and a line on standard error and in the log says so. To other nodes such a node is lost; one
/// that was shut down has left.
///
/// ```
/// use blastema::prelude::*;
///
/// struct Lamp;
/// impl Component for Lamp {}
///
/// blastema::run(async {
///     let node = Node::builder("module1").child(ChildSpec::new("lamp", || Lamp)).start().await?;
///     assert_eq!(node.state(), NodeState::Running);
///     node.shutdown().await;
///     Ok::<(), StartError>(())
/// })?;
/// # Ok::<(), StartError>(())
/// ```
#[derive(Clone)]
#[must_use = "a node that is dropped ends: keep it, and end it with `shutdown` or `run_until_signal`"]
pub struct Node(Arc<Shared>);

struct Shared {
    name: NodeName,
    incarnation: Incarnation,
    environment: Arc<ComponentEnvironment>,
    chain: FaultChain,
    networks: Option<Networks>,
    tree: changes::KeptTree,
    systemd: Option<Systemd>,
    /// What it does when communication is lost.
    policies: Vec<Arc<KeptPolicy>>,
    outputs: safety::OutputState,
    /// What stood in the record of faults when the node was shut down.
    last_record: OnceLock<FaultRecord>,
    /// Files and sockets that no other node has while this one lives.
    held: Vec<PathBuf>,
}

impl fmt::Debug for Node {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{} {:?}", self.0.name, self.0.incarnation, self.state())
    }
}

impl Node {
    /// Begins to describe a node. The name is parsed at [`start`](NodeBuilder::start).
    pub fn builder(name: &str) -> NodeBuilder {
        NodeBuilder::new(name)
    }

    /// The node's name.
    pub fn name(&self) -> &NodeName {
        &self.0.name
    }

    /// Which incarnation of the node this is.
    pub fn incarnation(&self) -> Incarnation {
        self.0.incarnation
    }

    /// How the node is now.
    pub fn state(&self) -> NodeState {
        self.0.chain.state.borrow().clone()
    }

    /// Waits until the node has stopped or has entered the safe state, and returns that state.
    pub async fn ended(&self) -> NodeState {
        let mut state = self.0.chain.state.clone();
        let ended = |state: &NodeState| !matches!(state, NodeState::Starting | NodeState::Running);
        match state.wait_for(ended).await {
            Ok(state) => state.clone(),
            // The sender of the state was dropped with the node's controller.
            Err(_) => NodeState::Stopped,
        }
    }

    /// Where messages of contract `M` to the object of this name can be sent. The name is that of
    /// an object here, such as `arm/elbow`, or anywhere, such as `module2:arm/elbow`, or one that
    /// is [claimed](crate::manual::names) by whichever node, such as `*:map`.
    ///
    /// # Errors
    /// [`DeliveryError::Misspelt`] or [`DeliveryError::Unknown`] where no object here has the name,
    /// [`DeliveryError::NotServed`] where it does not serve the contract;
    /// [`DeliveryError::ContractDiffers`] shows field by field what differs. Whether an object of
    /// another node takes it is found out when the first message is sent.
    pub fn sender<M: Contract>(&self, name: &str) -> Result<Sender<M>, DeliveryError> {
        self.0.environment.registry.sender(name)
    }

    /// The variable `V` of the object of this name, here or on another node. Whether an object of
    /// another node has it is found out when it is used.
    ///
    /// # Errors
    /// [`DeliveryError::Misspelt`] or [`DeliveryError::Unknown`] where no object here has the name,
    /// [`DeliveryError::NoVariable`] where it owns no variables.
    pub fn variable<V: Variable>(&self, object: &str) -> Result<VariableRef<V>, DeliveryError> {
        variable::find(&self.0.environment.registry, object)
    }

    /// Returns the actuators of this node with their commanders.
    pub fn actuators(&self) -> Vec<ActuatorRow> {
        self.0.environment.feature::<ActuatorTable>().rows()
    }

    /// Returns the topics used by objects of this node, with their publishers, listeners and rates.
    pub fn topics(&self) -> Vec<TopicRow> {
        let rows = self.0.environment.feature::<Topics>().rows();
        rows.into_iter().map(|row| self.with_publishing_nodes(row)).collect()
    }

    /// Commands the actuator of this name, here or on another node, under the name `own`. The lease
    /// is renewed on this thread; a component commands by
    /// [`Context::commander`](crate::Context::commander).
    ///
    /// # Errors
    /// [`DeliveryError::Misspelt`] or [`DeliveryError::Unknown`] where no object here has the name,
    /// [`DeliveryError::NotServed`] where it is no actuator.
    pub fn commander<M: Contract>(
        &self,
        actuator: &str,
        own: &str,
    ) -> Result<Commander<M>, DeliveryError> {
        let own = format!("{}:{own}", self.0.name);
        let sender = self.0.environment.registry.sender(actuator)?;
        let (commander, renewing) =
            actuator::commander(actuator.to_owned(), sender, own, self.0.incarnation);
        actix_rt::spawn(renewing);
        Ok(commander)
    }

    /// A reference to a component here whose type is known.
    ///
    /// # Errors
    /// [`DeliveryError::OtherType`] where the component is of another type,
    /// [`DeliveryError::Misspelt`] or [`DeliveryError::Unknown`] where no component has the name.
    pub fn actor<C: Component>(&self, name: &str) -> Result<ActorRef<C>, DeliveryError> {
        let registry = &self.0.environment.registry;
        let object = ObjectName::new(name).map_err(|_| registry.misspelt(name))?;
        if let Some(Ok(cell)) = registry.cell(&object).map(Arc::downcast) {
            return Ok(ActorRef(cell));
        }
        Err(match registry.component_type(&object) {
            Some(found) => DeliveryError::OtherType {
                name: name.to_owned(),
                found: found.to_owned(),
                wanted: type_name::<C>().to_owned(),
            },
            None => registry.misspelt(name),
        })
    }

    /// Returns a publisher on a topic; the contract's name is the default topic.
    ///
    /// # Errors
    /// [`DeliveryError::ContractDiffers`] if the topic carries another type under this contract's
    /// name; the text names both, where each was said, and what differs.
    /// [`DeliveryError::ShutDown`] after a [`shutdown`](Self::shutdown).
    #[track_caller]
    pub fn publisher<E: Event>(&self, topic: &str) -> Result<Publisher<E>, DeliveryError> {
        self.0.environment.feature::<Topics>().publisher_of(topic, self.0.name.as_str())
    }

    /// Connects the out port of a component to the port of another one while the node runs. The
    /// connection outlives the incarnations of both, and ends with the component that listens,
    /// commands or asks.
    ///
    /// # Errors
    /// There is no such component or port, the ports do not fit, or
    /// [another node](ConnectError::Elsewhere) makes the connection. What a port of another node
    /// takes is found when the first message goes there.
    pub fn connect(&self, from: &str, to: &str) -> Result<(), ConnectError> {
        self.0.environment.registry.connect_ports(from, to)
    }

    /// Disconnects two ports. What has been accepted is still delivered.
    ///
    /// # Errors
    /// [`ConnectError::NotConnected`], or an address is wrong.
    pub fn disconnect(&self, from: &str, to: &str) -> Result<(), ConnectError> {
        self.0.environment.registry.disconnect_ports(from, to)
    }

    /// Returns the connections that this node makes. Its own name is left out of the addresses.
    pub fn connections(&self) -> Vec<PortConnection> {
        self.0.environment.registry.connections()
    }

    /// Everything that is watched, each row with its age and incarnation. It can be read at any
    /// time, also while components are stuck.
    pub async fn table(&self) -> Vec<MonitorRow> {
        let chain = &self.0.chain;
        let table = chain.answer(chain.monitor.send(ReadTable));
        let table = network::signs::completed(table, self.links());
        let mut rows = table.await.unwrap_or_default();
        // What a component is doing right now is read from outside, so that it need not answer.
        self.0.environment.watch_list.show_in(&self.0.name, &mut rows);
        rows
    }

    /// The record of faults: roots in the order in which they were found, each followed by its
    /// symptoms. After a shutdown it is the record as it stood then.
    pub async fn faults(&self) -> FaultRecord {
        let last = || self.0.last_record.get().cloned();
        self.0.read_record().await.or_else(last).unwrap_or_default()
    }

    /// Every step in the history of every fault, from now on.
    pub fn fault_events(&self) -> FaultEvents {
        FaultEvents::subscribe(&self.0.chain.monitor, self.0.chain.state.clone())
    }

    /// The supervision tree as it stands now; `None` once the node has ended.
    pub async fn tree(&self) -> Option<SupervisionTree> {
        self.0.chain.answer(self.0.tree.root.as_ref()?.send(ReadTree)).await
    }

    /// Puts a fault into the component of this name, which need not know of it: for demonstrations
    /// and tests, as those of `blastema-testkit`.
    ///
    /// # Errors
    /// [`DeliveryError::Unknown`] or [`DeliveryError::Misspelt`] where no component here has the
    /// name.
    pub fn inject(&self, component: &str, injection: Injection) -> Result<(), DeliveryError> {
        self.0.environment.registry.watchable(component)?.inject(injection);
        Ok(())
    }

    /// Tells from outside, without keeping the node, which component is on a thread.
    #[doc(hidden)]
    pub fn running(&self) -> Running {
        Running(self.0.environment.watch_list.clone())
    }

    /// Returns the log of undelivered messages of this node, with the reasons.
    pub fn dead_letters(&self) -> &DeadLetterLog {
        &self.0.environment.dead_letters
    }

    /// What other nodes wanted to do here and may not, by the
    /// [roles and the policy](crate::manual::security#roles-and-policy) of the robot's roster: at
    /// most 1,024 different refusals, in the order of nodes. Each is logged under the target
    /// `blastema::audit`, at first and once a minute while it goes on.
    pub fn refusals(&self) -> Vec<crate::AccessRefusal> {
        self.0.environment.registry.access().refusals()
    }

    /// Threads that were given up because a handler never returned.
    pub fn abandoned_threads(&self) -> usize {
        self.0.environment.arbiters.abandoned()
    }

    /// Returns the node's health as a small value that serializes: its state, how many faults
    /// stand, the parts that are degraded, and the last recovery.
    ///
    /// ```
    /// # use blastema::prelude::*;
    /// # struct Lamp;
    /// # impl Component for Lamp {}
    /// # blastema::run(async {
    /// # let node = Node::builder("module1").child(ChildSpec::new("lamp", || Lamp)).start().await?;
    /// let health = node.health().await;
    /// assert!(health.is_well() && health.degraded.is_empty());
    /// # node.shutdown().await;
    /// # Ok::<(), StartError>(())
    /// # })?;
    /// # Ok::<(), StartError>(())
    /// ```
    pub async fn health(&self) -> NodeHealth {
        NodeHealth::of(self).await
    }

    /// Everything that the node knows of itself now, as one JSON document on one line: table,
    /// threads, links, routes, sessions, claims, actuators, topics, dead letters, faults. Spans are
    /// in milliseconds (`_ms`). It can be read at any time; a part that does not come within a
    /// second is `null`, an empty list means that there is nothing.
    pub async fn snapshot(&self) -> String {
        snapshot::document(self).await.to_string()
    }

    /// Returns the nodes of behaviour trees that are not idle.
    #[cfg(feature = "trees")]
    pub fn trees(&self) -> Vec<TreeNodeRow> {
        self.0.environment.feature::<TreeTable>().nodes()
    }

    /// Returns the last ticks of behaviour trees in which nodes have changed.
    #[cfg(feature = "trees")]
    pub fn tree_changes(&self) -> Vec<TreeChangeRow> {
        self.0.environment.feature::<TreeTable>().changes()
    }

    /// Returns the threads that components run on: what occupies them, their utilisation, and their
    /// queued messages. Works at any time, also while components hang.
    pub fn threads(&self) -> Vec<ThreadRow> {
        threads::rows(&self.0.environment.arbiters, &self.0.environment.watch_list)
    }

    /// Returns the condition of this name, which needs this; declares it if it is new. It is looked
    /// at until the node ends. Its changes are faults of `conditions/NAME`:
    /// [`ConnectionLost`](crate::FaultKind::ConnectionLost), and
    /// [`CheckFailed`](crate::FaultKind::CheckFailed) while it is degraded.
    ///
    /// # Errors
    /// [`ConditionError`] says what to write instead.
    pub fn condition(&self, name: &str, needs: Connected) -> Result<Condition, ConditionError> {
        self.0.environment.feature::<Conditions>().declare(name, &needs, platform::now(), None)
    }

    /// Publishes a [`Heartbeat`] on this topic every `interval`, 10 ms to an hour, for as long as
    /// this thread turns and what is returned exists. A component does so by
    /// [`Context::heartbeat`](crate::Context::heartbeat), as long as it lives itself.
    ///
    /// # Errors
    /// As [`publisher`](Self::publisher), and [`DeliveryError::CheckFailed`] for an interval out of
    /// range.
    #[track_caller]
    pub fn heartbeat(&self, topic: &str, interval: Duration) -> Result<Heartbeats, DeliveryError> {
        let publisher = self.publisher::<Heartbeat>(topic)?;
        Ok(Heartbeats(actix_rt::spawn(heartbeat::publish(publisher, interval)?)))
    }

    /// Runs a component under the root supervisor only while the condition is
    /// [acceptable](Condition::is_acceptable): it is [added](Self::add_child) whenever the condition
    /// becomes so, and [removed](Self::remove_child) in order when it is no longer. Returns once it
    /// runs for the first time, or cannot be added at all; await it in a task of its own where the
    /// condition may take long. Connections of its ports are made again whenever it is added.
    ///
    /// # Errors
    /// As [`add_child`](Self::add_child), for the first time. A later one is logged, and it is
    /// tried again every second while the condition holds.
    pub async fn add_child_while<C: Component>(
        &self,
        condition: &Condition,
        spec: impl Fn() -> ChildSpec<C> + 'static,
    ) -> Result<(), SpecError> {
        condition.acceptable().await;
        let name = self.add_child(spec()).await?.name().to_string();
        self.0.environment.registry.keep_connections(&name);
        let (node, status) =
            (Arc::new(OnceLock::from(Arc::downgrade(&self.0))), condition.status.clone());
        let holds = |status: &ConditionStatus| status.state == ConditionState::Connected;
        actix_rt::spawn(keep_while(node, status, holds, Some(name), spec));
        Ok(())
    }

    /// Returns the policies for lost communication, with the rungs that are carried out.
    pub fn lost_communication(&self) -> Vec<LostCommunicationRow> {
        self.0.policies.iter().map(|policy| policy.row()).collect()
    }

    /// Lets others command again after communication was lost and is back, for a person who has
    /// looked at the robot.
    ///
    /// # Errors
    /// [`AcknowledgeError`] where there is no such policy, and while communication is lost.
    pub async fn acknowledge(&self, policy: &str) -> Result<(), AcknowledgeError> {
        let name = policy.to_owned();
        let Some(policy) = self.0.policies.iter().find(|known| known.name == name) else {
            let known: Vec<_> = self.0.policies.iter().map(|known| &*known.name).collect();
            let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
            return Err(AcknowledgeError::Unknown { name, known });
        };
        if !policy.lock().handle_acknowledged() {
            return Err(AcknowledgeError::NotBack { name });
        }
        self.0.environment.feature::<Conditions>().look_soon();
        Ok(())
    }

    /// Carries out the order of a person, and answers within four seconds. What takes longer goes
    /// on.
    ///
    /// ```
    /// use blastema::prelude::*;
    /// use blastema::{ComponentOrder, OrderVerb};
    ///
    /// struct Lamp;
    /// impl Component for Lamp {}
    ///
    /// blastema::run(async {
    ///     let node = Node::builder("module1").child(ChildSpec::new("lamp", || Lamp)).start().await?;
    ///     let order = ComponentOrder { verb: OrderVerb::Deactivate, name: Some("lamp".to_owned()) };
    ///     let reply = node.order(&order).await;
    ///     assert_eq!((reply.refused, &*reply.rows[0].state), (None, "initialized"));
    ///     node.shutdown().await;
    ///     Ok::<(), StartError>(())
    /// })?;
    /// # Ok::<(), StartError>(())
    /// ```
    pub async fn order(&self, order: &ComponentOrder) -> OrderReply {
        order.carry_out(self).await
    }

    /// Stops all components in the reverse of their start order, and then the rest of the node.
    /// Messages accepted for other nodes until the last component has ended are delivered. Then the
    /// node reports to its peers that it leaves, and senders return [`DeliveryError::Stopped`] at
    /// once, also to those who wait in `deliver`.
    ///
    /// The order is given when this is first polled; it is carried out also if the future is
    /// dropped before it resolves. So a component can shut its node down, but not wait for that in
    /// a handler: its handler would be waited for in turn, until it counts as hanging after
    /// [`max_wait`](crate::ChildSpec::max_wait). Let a task of `main` call it, or spawn it with
    /// `actix_rt::spawn`.
    pub async fn shutdown(&self) {
        self.shut_down_because("the program shut it down").await;
    }

    /// Waits for SIGTERM, SIGINT (Ctrl-C) or SIGHUP (the terminal is closed), and
    /// [shuts down](Node::shutdown) in order. A second signal during that applies the safe outputs
    /// and ends the process at once. Where not every hook of a stop has run, because a component
    /// hangs, the safe outputs are applied, and the process ends here with the status 128 + signal,
    /// at the latest a second after the longest [`shutdown_within`](crate::ChildSpec::shutdown_within).
    /// Where another process with this node's name is reached by a neighbour, and answers, this
    /// node stops in order, and the process ends here with the status 3. Returns too when the node
    /// was shut down otherwise and has left its peers; a node in the safe state waits on, so that a
    /// person can look at it.
    ///
    /// ```no_run
    /// use blastema::prelude::*;
    /// # struct Lamp;
    /// # impl Component for Lamp {}
    ///
    /// #[blastema::main]
    /// async fn main() -> Result<(), Box<dyn std::error::Error>> {
    ///     let lamp = ChildSpec::new("lamp", || Lamp);
    ///     let node = Node::builder("module1").child(lamp).start().await?;
    ///     node.run_until_signal().await?;
    ///     Ok(())
    /// }
    /// ```
    ///
    /// # Errors
    /// The operating system does not tell of signals.
    pub async fn run_until_signal(&self) -> io::Result<()> {
        let mut wait = SignalWait::begin()?;
        self.run_to(wait.cause(pending())).await;
        Ok(())
    }

    /// Shuts down for the first of these causes, unless the node has been shut down before.
    async fn run_to(&self, cause: impl Future<Output = EndCause>) {
        let mut state = self.0.chain.state.clone();
        let cause = tokio::select! {
            cause = cause => Some(cause),
            // Also if the sender of the state was dropped.
            _ = state.wait_for(|state| *state == NodeState::Stopped) => None,
        };
        match cause {
            Some(cause) => self.end_for(cause).await,
            // Its components have ended, and it may not have left its peers.
            None => {
                self.end_if_displaced().await;
                self.shutdown().await;
            }
        }
    }

    /// Ends the process if its node has stopped for that reason.
    async fn end_if_displaced(&self) {
        if let Some(networks) = &self.0.networks
            && let Some(why) = networks.handle.own_name().taken()
        {
            self.shut_down_because(&why).await;
            platform::end_process(NAME_TAKEN);
        }
    }

    /// Shuts down in order. Where that was not possible after a signal, the process ends.
    async fn end_for(&self, cause: EndCause) {
        info!(node = %self.0.name, %cause, "the node is shut down");
        self.shut_down_because(&format!("{cause} shut it down")).await;
        if let Some(status) = cause.exit_code()
            && self.0.is_safe()
        {
            platform::end_process(status);
        }
    }

    async fn shut_down_because(&self, cause: &str) {
        let (node, cause) = (self.clone(), cause.to_owned());
        let work = async move { node.carry_out_end(&cause).await };
        ToTheEnd::of(self.0.chain.arbiter.clone(), work).await;
    }

    async fn carry_out_end(&self, cause: &str) {
        match self.state() {
            // What ends then has not ended in order.
            NodeState::InSafeState { reason } => {
                self.0.tell_systemd(&format!("STATUS={}", reason.replace('\n', " ")));
            }
            _ => self.0.tell_systemd("STOPPING=1"),
        }
        let cut_short = || self.0.environment.cut_short.load(SeqCst);
        let before = cut_short();
        self.0.networks.iter().for_each(|networks| networks.handle.expect_end());
        let stopped = self.0.chain.answer(self.0.chain.controller.send(Shutdown)).await;
        if stopped.is_none() && self.state() != NodeState::Stopped {
            // The fault chain stands, and no component can be stopped.
            self.0.make_safe("the fault chain does not answer to the shutdown");
        } else if cut_short() > before {
            self.0.make_safe("a component was not stopped in order");
        }
        self.0.chain.expect_end();
        if let Some(networks) = &self.0.networks {
            networks.leave().await;
        }
        if let Some(record) = self.0.read_record().await {
            // Of several callers that shut it down at once, each reads the same.
            let _ = self.0.last_record.set(record);
        }
        self.0.environment.registry.shut_down();
        self.0.environment.feature::<Topics>().shut_down(&self.0.name);
        self.0.stop_threads(cause, stopped.is_some());
        if stopped.is_some() {
            for path in &self.0.held {
                released_here(path, RELEASE_TIMEOUT).await;
            }
        }
    }
}

impl Shared {
    /// Tells the service manager of the process this, if the node is described with one.
    fn tell_systemd(&self, state: &str) {
        if let Some(Err(reason)) = self.systemd.as_ref().map(|manager| manager.tell(state)) {
            warn!(state, reason, "the service manager was not told");
        }
    }

    /// The record of faults; `None` where the fault chain has ended, or stands.
    async fn read_record(&self) -> Option<FaultRecord> {
        self.chain.answer(self.chain.monitor.send(ReadRecord)).await
    }

    /// Ends all threads of the node, for this reason. Where that is not in order, the watchdogs of
    /// the process may fire.
    fn stop_threads(&self, cause: &str, in_order: bool) {
        self.environment.arbiters.stop();
        self.environment.feature::<Conditions>().end();
        self.environment.feature::<VariableStore>().close_file();
        if let Some(networks) = &self.networks {
            networks.stop();
        }
        self.chain.stop(cause, in_order);
    }

    /// The node ends otherwise than in order, for this reason, from whichever thread this is. One
    /// whose start is refused before any component has begun leaves outputs and watchdogs alone:
    /// they may be those of the robot that runs already.
    fn end(&self, cause: &str) {
        self.chain.expect_end();
        let begun = self.outputs.begun.load(SeqCst);
        if begun {
            self.become_safe(cause);
        }
        self.stop_threads(cause, !begun);
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        let meanwhile = match &*self.chain.state.borrow() {
            NodeState::Starting => return self.end("the node did not come to be"),
            NodeState::Running => "it ran",
            NodeState::InSafeState { .. } => "it was in the safe state",
            NodeState::Stopped => "it was shut down",
        };
        let panic = if std::thread::panicking() { "by a panic " } else { "" };
        // Dropping the last reference without a shutdown leaves no thread behind either.
        self.end(&format!("the node was dropped {panic}while {meanwhile}"));
    }
}
