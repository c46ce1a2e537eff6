//! The methods of a node that concern its networks: what it sees of other nodes, waits for, claims,
//! isolates and orders there.

use super::{Cable, NetworkRow};
use crate::directory::DirectoryTable;
use crate::directory::{Claim, ClaimError, ClaimPolicy, ClaimRow, Holder, NameWatch, NodeRow};
use crate::net::RosterRow;
use crate::net::operator::{self, KeyStatus, OrderError, OrderIsolation};
use crate::node::order::{COMPONENTS, ComponentOrder, OrderReply};
use crate::node::{Node, NodeState};
use crate::platform;
use crate::registry::remote::NameResolver;
use crate::service::Roster;
use crate::service::{Role, ServiceRef, ServiceRow};
use crate::topic::TopicRow;
use crate::topic::Topics;
use blastema_contract::link::LinkRow;
use blastema_contract::router::InjectPanic;
use blastema_contract::session::SessionRow;
use blastema_contract::strategy::IsolateNode;
use blastema_contract::transport::TransportCounters;
use blastema_core::directory::{ClaimRequest, DirectoryKey};
use blastema_core::net::Route;
use blastema_core::{DeliveryError, NameError, NodeName, ObjectName, Request};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;
use tracing::warn;

/// How often it is looked who is there: soon enough for a start, and rare enough to cost nothing.
const LOOK_AGAIN: Duration = Duration::from_millis(10);
/// The longest reason of an operator's order, in characters.
const REASON_MAX: usize = 160;
/// Why a node was neither isolated nor admitted: nothing has changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum IsolateError {
    /// The name does not parse.
    #[error("the name of the node: {0}")]
    Name(#[from] NameError),
    /// The node is this node. To take it out of service, shut it down.
    #[error("{node} is this node itself: shut it down instead")]
    Oneself {
        /// The name of this node.
        node: NodeName,
    },
    /// No node of this name was ever reached or is described. Correct the name, or describe the
    /// node, for example as a neighbour.
    #[error("no node is known here as {node}: it knows {known}")]
    Unknown {
        /// The name that was given.
        node: NodeName,
        /// The nodes that are known, in the order of their names; `none`.
        known: String,
    },
}

/// What was not there in time.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct NotReady {
    /// Each name or topic that is missing, and why.
    pub missing: Vec<(String, String)>,
}

impl fmt::Display for NotReady {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("not there in time: ")?;
        for (place, (name, why)) in self.missing.iter().enumerate() {
            let comma = if place == 0 { "" } else { "; " };
            write!(f, "{comma}{name} ({why})")?;
        }
        Ok(())
    }
}

impl std::error::Error for NotReady {}

/// Networks and other nodes.
impl Node {
    /// All networks, in the order in which they were described.
    pub fn networks(&self) -> &[NetworkRow] {
        self.0.networks.as_ref().map_or(&[], |networks| &networks.rows)
    }

    /// Waits until the node of this name has a path and a session, its start is over, and it has
    /// told what it listens to, and returns whether this happened in time: what is published then
    /// reaches its listeners, what is asked its objects, and their ends their watchers. A link
    /// needs a few hellos to come up, also after both nodes have started. A process that was killed
    /// counts as connected until its absence is found.
    pub async fn connected(&self, node: &str, within: Duration) -> bool {
        let (Some(networks), Ok(node)) = (&self.0.networks, NodeName::new(node)) else {
            return false;
        };
        tokio::time::timeout(within, networks.handle.connected(&node)).await.is_ok()
    }

    /// All links, in the order in which they were described; none without a network.
    pub async fn links(&self) -> Vec<LinkRow> {
        let Some(networks) = &self.0.networks else { return Vec::new() };
        networks.handle.read_links().await
    }

    /// What the medium of each network has carried and lost, and what waits for it now.
    pub(in crate::node) async fn media(&self) -> Vec<(Arc<str>, TransportCounters)> {
        let Some(networks) = &self.0.networks else { return Vec::new() };
        networks.handle.read_media().await
    }

    /// Every node that can be reached from here, and over which link.
    pub async fn routes(&self) -> Vec<Route> {
        let Some(networks) = &self.0.networks else { return Vec::new() };
        networks.handle.read_routes().await
    }

    /// The roster that this node uses, with its serial number; none without keys.
    pub async fn roster(&self) -> Option<RosterRow> {
        self.0.networks.as_ref()?.handle.read_roster().await
    }

    /// The sessions with other nodes: whether they stand, how much is under way, and what was lost,
    /// repeated, late or refused.
    pub async fn sessions(&self) -> Vec<SessionRow> {
        let Some(networks) = &self.0.networks else { return Vec::new() };
        networks.handle.read_sessions().await
    }

    /// Completes a row by what other nodes have.
    pub(in crate::node) fn with_publishing_nodes(&self, row: TopicRow) -> TopicRow {
        let Ok(topic) = ObjectName::new(&row.topic) else { return row };
        let key = DirectoryKey::Publisher { topic, contract: row.contract.clone() };
        let publishing_nodes = self.0.environment.feature::<DirectoryTable>().nodes_with(&key);
        TopicRow { publishing_nodes, ..row }
    }

    /// Every other node that a session is open with, and its objects.
    pub fn neighbourhood(&self) -> Vec<NodeRow> {
        self.0.environment.feature::<DirectoryTable>().node_rows()
    }

    /// The cable of a network that was described [`with_faults`](crate::Network::with_faults).
    pub fn cable(&self, network: &str) -> Option<Cable> {
        self.0.networks.as_ref()?.cables.get(network).cloned()
    }

    /// Makes this node's router panic, for demonstrations and tests; nothing without a network.
    pub fn panic_router(&self) {
        if let Some(networks) = &self.0.networks {
            networks.handle.panics().do_send(InjectPanic);
        }
    }

    /// Claims a [name of the whole robot](crate::manual::names) for the object that is called so
    /// here, and waits until that is decided: for a second at most after the start of the node,
    /// else not at all. Messages to `*:<name>` reach that object then, from every node. The name is
    /// given back when the [`Claim`] is dropped; a component claims by
    /// [`ChildSpec::claim`](crate::ChildSpec::claim).
    ///
    /// # Errors
    /// [`ClaimRefused::Held`](crate::ClaimRefused::Held) where another object has the name, on
    /// whichever node, and the policy is to be refused.
    pub async fn claim(&self, name: &str, policy: ClaimPolicy) -> Result<Claim, ClaimError> {
        self.claim_for(name, name, policy).await
    }

    /// Claims a name of the whole robot for the object `object` of this node.
    ///
    /// # Errors
    /// As [`claim`](Self::claim).
    pub async fn claim_for(
        &self,
        name: &str,
        object: &str,
        policy: ClaimPolicy,
    ) -> Result<Claim, ClaimError> {
        let (name, object) = (ObjectName::new(name)?, ObjectName::new(object)?);
        Claim::make(
            self.0.environment.feature::<DirectoryTable>(),
            ClaimRequest { name, object, policy },
        )
        .await
    }

    /// Returns the holder of a global name, as known to this node.
    pub fn holder(&self, name: &str) -> Option<Holder> {
        self.0.environment.feature::<DirectoryTable>().holder(&ObjectName::new(name).ok()?)
    }

    /// Reports the holder of a global name, now and at each change.
    ///
    /// # Errors
    /// The name does not parse.
    pub fn watch_name(&self, name: &str) -> Result<NameWatch, NameError> {
        Ok(NameWatch::new(self.0.environment.feature::<DirectoryTable>(), ObjectName::new(name)?))
    }

    /// Returns the global names that have a holder.
    pub fn claims(&self) -> Vec<ClaimRow> {
        self.0.environment.feature::<DirectoryTable>().rows()
    }

    /// Waits until all of these are there: objects of other nodes (`module2:arm`), of this node
    /// (`arm`) and of the whole robot (`*:map`), and topics with a listener, on any node.
    /// After it, nothing that is sent to them or published there is lost for want of news. A
    /// [service](crate::manual::services) needs no such wait: its callers wait for it.
    ///
    /// # Errors
    /// What is missing after this time, and why.
    pub async fn ready(
        &self,
        names: &[&str],
        topics: &[&str],
        within: Duration,
    ) -> Result<(), NotReady> {
        let until = platform::now() + within;
        loop {
            let missing = self.missing(names, topics);
            if missing.is_empty() {
                return Ok(());
            }
            let left = until - platform::now();
            if left.is_zero() {
                return Err(NotReady { missing });
            }
            platform::sleep(LOOK_AGAIN.min(left)).await;
        }
    }

    fn missing(&self, names: &[&str], topics: &[&str]) -> Vec<(String, String)> {
        let absent =
            names.iter().filter_map(|name| Some(((*name).to_owned(), self.absence(name)?)));
        let unheard =
            topics.iter().filter(|topic| !self.0.environment.feature::<Topics>().is_heard(topic));
        let why = "no node listens to this topic";
        absent.chain(unheard.map(|topic| (format!("topic {topic}"), why.to_owned()))).collect()
    }

    /// Why a name cannot be sent to now.
    fn absence(&self, name: &str) -> Option<String> {
        let Some((node, object)) = name.split_once(':') else {
            return self.own_absence(name);
        };
        if node == "*" {
            return self.holder(object).is_none().then(|| "no object holds this name".to_owned());
        }
        if node == self.0.name.as_str() {
            return self.own_absence(object);
        }
        let (Ok(node), Ok(object)) = (NodeName::new(node), ObjectName::new(object)) else {
            return Some("this is no name of an object".to_owned());
        };
        let Some(networks) = &self.0.networks else {
            return Some("this node has no network".to_owned());
        };
        if !networks.handle.is_connected(&node) {
            return Some(format!("{node} is not connected"));
        }
        let having = self
            .0
            .environment
            .feature::<DirectoryTable>()
            .nodes_with(&DirectoryKey::Object(object));
        let has = having.contains(&node);
        (!has).then(|| format!("{node} has no object of this name"))
    }

    fn own_absence(&self, object: &str) -> Option<String> {
        let known = ObjectName::new(object).ok();
        let known = known.and_then(|object| self.0.environment.registry.kind_of(&object));
        known.is_none().then(|| "this node has no object of this name".to_owned())
    }

    /// Isolates a node that cannot be recovered: from here on its messages are refused here, and
    /// none is sent to it ([`DeliveryError::Isolated`](crate::DeliveryError::Isolated)). Other
    /// nodes decide for themselves; an operator [orders](Node::order_isolation) them, or revokes the
    /// node's key.
    ///
    /// # Errors
    /// Nothing has changed: the name does not parse, is this node's own, or is not that of a node
    /// that this one has met or was configured with, as neighbour or member of a service.
    pub fn isolate(&self, node: &str) -> Result<(), IsolateError> {
        self.set_isolated(node, true, "the application says so".to_owned())
    }

    /// Admits a node that this one has isolated. The session with that node is opened again.
    ///
    /// # Errors
    /// As [`isolate`](Self::isolate).
    pub fn admit(&self, node: &str) -> Result<(), IsolateError> {
        self.set_isolated(node, false, "the application says so".to_owned())
    }

    /// # Errors
    /// Why nothing was done.
    pub(in crate::node) fn isolate_by_order(
        &self,
        order: &OrderIsolation,
        by: &NodeName,
    ) -> Result<(), String> {
        let OrderIsolation { node, isolated, reason } = order;
        let reason: String = reason.chars().take(REASON_MAX).collect();
        let because = if reason.is_empty() { "" } else { ": " };
        let cause = format!("by order of {by}{because}{reason}");
        self.set_isolated(node, *isolated, cause.clone()).map_err(|error| error.to_string())?;
        warn!(target: "blastema::audit", node, isolated, operator = %by, "{cause}");
        Ok(())
    }

    fn set_isolated(&self, node: &str, isolated: bool, cause: String) -> Result<(), IsolateError> {
        let node = NodeName::new(node)?;
        if node == self.0.name {
            return Err(IsolateError::Oneself { node });
        }
        let networks = self.0.networks.as_ref().filter(|networks| networks.know(&node));
        let Some(networks) = networks else { return Err(self.unknown(node)) };
        networks.handle.decide(IsolateNode { node, isolated, cause });
        Ok(())
    }

    fn unknown(&self, node: NodeName) -> IsolateError {
        let mut known = self.0.networks.as_ref().map(|all| all.known()).unwrap_or_default();
        known.remove(&self.0.name);
        let known: Vec<&str> = known.iter().map(NodeName::as_str).collect();
        let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
        IsolateError::Unknown { node, known }
    }

    /// Asks another node for the state of its keys: the roster that it uses, its fingerprint, and
    /// which of its networks are sealed. A node without keys serves no operator.
    ///
    /// # Errors
    /// There was no answer in time, or this node may not operate the other one.
    pub async fn key_status_of(
        &self,
        node: &str,
        within: Duration,
    ) -> Result<KeyStatus, DeliveryError> {
        operator::key_status(&self.0.environment.registry, node, within).await
    }

    /// Orders the node `to` to isolate `node`, as its program does by [`isolate`](Node::isolate).
    /// Its faults and its journal name this node and the reason, of which 160 bytes are kept. It stands
    /// until `to` [admits](Node::order_admission) the node.
    ///
    /// # Errors
    /// It was not carried out, or there was no answer in time.
    pub async fn order_isolation(
        &self,
        to: &str,
        node: &str,
        reason: &str,
        within: Duration,
    ) -> Result<(), OrderError> {
        let registry = &self.0.environment.registry;
        operator::order_isolation(registry, to, node, true, reason, within).await
    }

    /// Orders the node `to` to admit `node` again.
    ///
    /// # Errors
    /// As [`order_isolation`](Node::order_isolation).
    pub async fn order_admission(
        &self,
        to: &str,
        node: &str,
        reason: &str,
        within: Duration,
    ) -> Result<(), OrderError> {
        let registry = &self.0.environment.registry;
        operator::order_isolation(registry, to, node, false, reason, within).await
    }

    /// Gives an order to another node, as its operator: by the right `operate`. A node without keys
    /// serves no operator.
    ///
    /// # Errors
    /// There was no answer in time, or this node may not operate the other one.
    pub async fn order_at(
        &self,
        node: &str,
        order: ComponentOrder,
        within: Duration,
    ) -> Result<OrderReply, DeliveryError> {
        let sender = self.sender::<ComponentOrder>(&format!("{node}:{COMPONENTS}"))?;
        sender.ask_within(order, within).await.map_err(|error| error.kind)
    }

    /// Asks the service of this name, whichever node serves it. Found are services that this node
    /// carries, and those of nodes that a session is open with.
    ///
    /// # Errors
    /// The name does not parse. Whether there is such a service is found out when it is asked.
    pub fn service<M: Request>(&self, name: &str) -> Result<ServiceRef<M>, NameError> {
        let registry = &self.0.environment.registry;
        let services = self.0.environment.feature::<Roster>();
        ServiceRef::new(registry, services, name)
    }

    /// Whether this node serves, or stands by for, a service that it carries.
    pub fn service_role(&self, name: &str) -> Option<Role> {
        self.0.environment.feature::<Roster>().role(&ObjectName::new(name).ok()?)
    }

    /// Returns the services that this node hosts: its role in each, the primary, and missing
    /// members.
    pub fn services(&self) -> Vec<ServiceRow> {
        self.0.environment.feature::<Roster>().rows()
    }

    /// Shuts this node down once another process has its name, and answers.
    pub(in crate::node) fn stop_if_displaced(&self) {
        let Some(networks) = &self.0.networks else { return };
        let (name, mut state) = (networks.handle.own_name().clone(), self.0.chain.state.clone());
        let node = Arc::downgrade(&self.0);
        actix_rt::spawn(async move {
            let why = tokio::select! {
                why = name.until_taken() => why,
                // Also if the sender of the state was dropped.
                _ = state.wait_for(|state| *state == NodeState::Stopped) => return,
            };
            platform::tell_person(why.clone());
            if let Some(node) = node.upgrade().map(Node) {
                node.shut_down_because(&why).await;
            }
        });
    }
}
