//! Services with a primary and standbys on other nodes.
//!
//! ```text
//!  ServiceRef ─ ask ─► primary's replica ─ execute ─► component
//!                        │ entry: identity, reply, state or request
//!                        ▼
//!                      standbys' replicas ─ confirm ─► the reply goes out
//! ```
//!
//! Each node that carries a service has a replica under the service's name, and the component under
//! `<name>/replica`. The replica is an actor on the network's arbiter, which drives the state
//! machine in the core.

mod caller;
mod finder;
mod replica;
mod roster;
mod types;

pub use blastema_core::service::{OnPartition, Role, ServiceState, StandbyKind};

pub use caller::ServiceRef;
pub(crate) use replica::{Carried, ReplicaActor};
pub(crate) use roster::Roster;
pub use roster::ServiceRow;

use crate::component::context::Context;
use crate::component::{Component, Failure, Handle};
use crate::host::spec::ChildSpec;
use crate::platform::panics;
use crate::registry::ContractPort;
use blastema_core::service::{HEARTBEAT_MAX, HEARTBEAT_MIN, MEMBERS_MAX, ReplicaConfig};
use blastema_core::{DeliveryError, NodeName, ObjectName};
use bytes::Bytes;
use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;
use types::DriveComponent;

/// A component whose state can be carried over to another node.
pub trait Stateful: Component {
    /// Returns its state, from which [`load`](Stateful::load) restores the component.
    fn save(&self) -> Vec<u8>;

    /// Replaces the state by one that another replica has saved.
    ///
    /// # Errors
    /// A failure fails the component, like that of a hook.
    fn load(&mut self, state: &[u8]) -> Result<(), Failure>;

    /// Reports that the component serves from now on, in this epoch, or stands by. A component that
    /// acts by itself, and not only on request, does so only while it serves.
    fn role_changed(&mut self, epoch: Option<u64>, cx: &mut Context<Self>) {
        let _ = (epoch, cx);
    }
}

impl<C: Stateful> Handle<DriveComponent> for C {
    async fn handle(&mut self, message: DriveComponent, cx: &mut Context<Self>) -> Option<Vec<u8>> {
        match message {
            DriveComponent::Save => return Some(self.save()),
            DriveComponent::Load { state } => {
                if let Err(failure) = self.load(&state) {
                    cx.fail(failure);
                    return None;
                }
            }
            DriveComponent::RoleChanged { epoch } => self.role_changed(epoch, cx),
        }
        Some(Vec::new())
    }
}

/// A service that several nodes carry: each of them is given the same spec. Needs the feature
/// `network`.
///
/// ```
/// use blastema::{Context, Handle, OnPartition, Ports, ServiceSpec, StandbyKind, Stateful};
/// # use blastema::{Component, Failure, Request};
/// # #[derive(Clone, Debug, Request)] #[contract(reply = u64)] struct Count;
/// # #[derive(Default)] struct Counter(u64);
/// # impl Component for Counter { fn ports(ports: &mut Ports<Self>) { ports.serve::<Count>(); } }
/// # impl Handle<Count> for Counter {
/// #     async fn handle(&mut self, _: Count, _: &mut Context<Self>) -> u64 { self.0 += 1; self.0 }
/// # }
/// # impl Stateful for Counter {
/// #     fn save(&self) -> Vec<u8> { self.0.to_le_bytes().into() }
/// #     fn load(&mut self, _: &[u8]) -> Result<(), Failure> { Ok(()) }
/// # }
/// let counter = ServiceSpec::new("counter", ["module1", "module2", "module3"], Counter::default)
///     .standby(StandbyKind::Hot)
///     .on_partition(OnPartition::Stop);
/// ```
#[must_use = "a service spec does nothing until it is given to a node"]
pub struct ServiceSpec<C: Stateful> {
    name: String,
    members: Vec<String>,
    factory: Arc<dyn Fn() -> C + Send + Sync>,
    kind: StandbyKind,
    on_partition: OnPartition,
    heartbeat_interval: Duration,
    depends_on: Vec<String>,
}

impl<C: Stateful> fmt::Debug for ServiceSpec<C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "service {} on {:?}, {:?}", self.name, self.members, self.kind)
    }
}

impl<C: Stateful> ServiceSpec<C> {
    /// Describes a service on these nodes, seven at most. The earlier a node stands in the list,
    /// the earlier it stands for election. Standbys are warm. Without a majority of the nodes there
    /// is no primary.
    pub fn new<'a>(
        name: &str,
        members: impl IntoIterator<Item = &'a str>,
        factory: impl Fn() -> C + Send + Sync + 'static,
    ) -> Self {
        ServiceSpec {
            name: name.to_owned(),
            members: members.into_iter().map(str::to_owned).collect(),
            factory: Arc::new(factory),
            kind: StandbyKind::default(),
            on_partition: OnPartition::default(),
            heartbeat_interval: Duration::from_millis(50),
            depends_on: Vec::new(),
        }
    }

    /// Sets what standbys do.
    pub fn standby(mut self, kind: StandbyKind) -> Self {
        self.kind = kind;
        self
    }

    /// Sets what happens without a majority.
    pub fn on_partition(mut self, on_partition: OnPartition) -> Self {
        self.on_partition = on_partition;
        self
    }

    /// Sets how often the primary sends a heartbeat: 50 ms by default. Outside 1 ms to one hour it
    /// is refused at start. A standby takes over 3.3 intervals after the last heartbeat. A primary
    /// whose process stands still for so long loses the service.
    pub fn heartbeat_every(mut self, interval: Duration) -> Self {
        self.heartbeat_interval = interval;
        self
    }

    /// Adds services that this one depends on, whichever nodes carry them. A node is elected
    /// primary only while each of them has a primary.
    pub fn depends_on<'a>(mut self, services: impl IntoIterator<Item = &'a str>) -> Self {
        self.depends_on.extend(services.into_iter().map(str::to_owned));
        self
    }

    /// Returns the component's child spec, and what the node `own` needs to carry the service.
    pub(crate) fn carried(self, own: &str) -> (ChildSpec<C>, Result<Carried, ServiceRefused>) {
        let carried = self.parse(own);
        let carried = carried.map_err(|reason| ServiceRefused { name: self.name.clone(), reason });
        let factory = self.factory;
        let child = ChildSpec::new(&format!("{}/replica", self.name), move || factory());
        let child = child
            .with_ports(|ports| ports.add_ports(vec![ContractPort::open::<C, DriveComponent>]));
        (child, carried)
    }

    fn parse(&self, own: &str) -> Result<Carried, String> {
        let object = |text: &str| ObjectName::new(text).map_err(|error| error.to_string());
        let node = |text: &str| NodeName::new(text).map_err(|error| error.to_string());
        let name = object(&self.name)?;
        let component = object(&format!("{name}/replica"))?;
        let actor = object(&format!("{component}/body"))?;
        let depends_on = self.depends_on.iter().map(|name| object(name));
        let depends_on: Vec<_> = depends_on.collect::<Result<_, _>>()?;
        let config = ReplicaConfig {
            own: node(own)?,
            members: self.members.iter().map(|name| node(name)).collect::<Result<_, _>>()?,
            kind: self.kind,
            on_partition: self.on_partition,
            depends: !depends_on.is_empty(),
            heartbeat_interval: self.heartbeat_interval,
        };
        check(&config)?;
        let initial = first_state(&*self.factory)?;
        Ok(Carried { name, component, actor, config, initial, depends_on })
    }
}

/// A node cannot carry a service: it has a mistake, or its component cannot be built.
#[derive(Clone, Debug)]
pub(crate) struct ServiceRefused {
    pub(crate) name: String,
    pub(crate) reason: String,
}

/// Checks that the nodes of a service differ, are not too many, and that this is one of them; and
/// that its heartbeats can be sent.
fn check(config: &ReplicaConfig) -> Result<(), String> {
    let different: BTreeSet<_> = config.members.iter().collect();
    let listed = config.members.len();
    Err(if !different.contains(&config.own) {
        format!("{} is none of its nodes: add it, or leave the service out here", config.own)
    } else if different.len() < listed {
        "a node stands twice among its nodes: name each once".to_owned()
    } else if listed > MEMBERS_MAX {
        format!(
            "{listed} nodes cannot carry it, {MEMBERS_MAX} at most: three or five outlive the failure of one or two"
        )
    } else if !(HEARTBEAT_MIN..=HEARTBEAT_MAX).contains(&config.heartbeat_interval) {
        format!(
            "its primary cannot send a heartbeat every {:?}: give .heartbeat_every(..) from \
             {HEARTBEAT_MIN:?} to {HEARTBEAT_MAX:?}, such as 50 ms",
            config.heartbeat_interval
        )
    } else {
        return Ok(());
    })
}

/// Returns the first state of the component. The component is built once more for that, before
/// there is a node that would catch a panic.
fn first_state<C: Stateful>(factory: &dyn Fn() -> C) -> Result<Bytes, String> {
    panics::install_hook();
    panics::caught(|| factory().save().into()).map_err(|panicked| {
        format!(
            "its component {panicked}, while it was built or saved its first state; let the factory and `save` do \
             without what may be missing, and report that from `on_initialize`"
        )
    })
}

/// Returns whether the component is stopped, isolated or removed, and not only restarting.
fn is_inactive(why: &DeliveryError) -> bool {
    use DeliveryError::{Isolated, NotServed, Stopped, Unknown};
    matches!(why, Stopped | Isolated { .. } | Unknown { .. } | NotServed { .. })
}
