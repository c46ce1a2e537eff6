//! Services with a primary and standbys on other nodes.
//!
//! ```text
//!  ServiceRef ─ ask ─► primary's replica ─ execute ─► component
//!                        │ entry: identity, reply, state or request
//!                        ▼
//!                      standbys' replicas ─ confirm ─► the reply goes out
//! ```
//!
//! Each node that carries a service has a replica (the machine's body, on the network's arbiter) under
//! the service's name, and the component under `<name>/replica`.

mod replica;
mod roster;
mod words;

pub use blastema_core::service::{OnPartition, Role, StandbyKind};

pub(crate) use replica::{Carried, ReplicaBody};
pub(crate) use roster::Roster;

use crate::component::{Component, Failure, Handle};
use crate::context::Context;
use crate::host::spec::ChildSpec;
use crate::ports::OpenPort;
use crate::registry::{Port, Registry};
use crate::sender::{RequestError, next_id};
use blastema_core::service::ReplicaConfig;
use blastema_core::{ContractIdentity, NameError, NodeName, ObjectName, Request, Why, codec};
use std::fmt;
use std::marker::PhantomData;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use words::{Answered, AskService, LoadState, RoleChanged, SaveState, Task, WhoServes};

/// The most bytes of an error on its way.
const WHY_MAX: usize = 16 * 1024;
/// How long a caller waits before it asks other nodes who serves; it asks again as often.
const PROBE: Duration = Duration::from_millis(5);
/// How long it takes their answers for worth having.
const PROBE_WITHIN: Duration = Duration::from_millis(20);

/// A component that can be carried over to another node.
pub trait Stateful: Component {
    /// Its state, from which [`load`](Stateful::load) makes the same again.
    fn save(&self) -> Vec<u8>;

    /// Takes over a state that another replica has saved.
    ///
    /// # Errors
    /// A failure ends this component's work, like that of a hook.
    fn load(&mut self, state: &[u8]) -> Result<(), Failure>;

    /// It serves from now on, under an epoch, or stands by. A component that acts by itself, and not
    /// only when it is asked, does so only while it serves.
    fn role_changed(&mut self, epoch: Option<u64>, cx: &mut Context<Self>) {
        let _ = (epoch, cx);
    }
}

impl<C: Stateful> Handle<SaveState> for C {
    async fn handle(&mut self, _: SaveState, _: &mut Context<Self>) -> Vec<u8> {
        self.save()
    }
}

impl<C: Stateful> Handle<LoadState> for C {
    async fn handle(&mut self, message: LoadState, cx: &mut Context<Self>) -> bool {
        match self.load(&message.state) {
            Ok(()) => true,
            Err(failure) => {
                cx.fail(failure);
                false
            }
        }
    }
}

impl<C: Stateful> Handle<RoleChanged> for C {
    async fn handle(&mut self, message: RoleChanged, cx: &mut Context<Self>) {
        self.role_changed(message.epoch, cx);
    }
}

/// A service that several nodes carry: each of them is given the same spec.
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
    hello_interval: Duration,
    depends_on: Vec<String>,
}

impl<C: Stateful> fmt::Debug for ServiceSpec<C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "service {} on {:?}, {:?}", self.name, self.members, self.kind)
    }
}

impl<C: Stateful> ServiceSpec<C> {
    /// A service on these nodes, of which those that stand first have their turn first. Its standbys are warm; where less than
    /// a majority of the nodes see each other, there is no service.
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
            hello_interval: Duration::from_millis(50),
            depends_on: Vec::new(),
        }
    }

    /// What standbys do.
    pub fn standby(mut self, kind: StandbyKind) -> Self {
        self.kind = kind;
        self
    }

    /// What happens without a majority.
    pub fn on_partition(mut self, on_partition: OnPartition) -> Self {
        self.on_partition = on_partition;
        self
    }

    /// How often the primary says hello; 50 ms unless this says otherwise. A standby takes over three
    /// and a third of them after the last one; a process that gets no time for so long loses the service.
    pub fn hello_every(mut self, interval: Duration) -> Self {
        self.hello_interval = interval.max(Duration::from_millis(1));
        self
    }

    /// Services that this one cannot do without: it takes over only after they have been.
    pub fn depends_on<'a>(mut self, services: impl IntoIterator<Item = &'a str>) -> Self {
        self.depends_on.extend(services.into_iter().map(str::to_owned));
        self
    }

    /// What the node `own` needs to carry it, and the component.
    pub(crate) fn carried(self, own: &str) -> (ChildSpec<C>, Result<Carried, NameError>) {
        let component = format!("{}/replica", self.name);
        // Built once more, to see with which state it begins.
        let initial = (self.factory)().save().into();
        let (kind, on_partition) = (self.kind, self.on_partition);
        let (hello_interval, name) = (self.hello_interval, self.name);
        let (members, depends_on) = (self.members, self.depends_on);
        let parsed = || {
            let parse = |names: Vec<String>| names.iter().map(|n| ObjectName::new(n)).collect();
            let members: Result<Vec<_>, _> = members.iter().map(|n| NodeName::new(n)).collect();
            let config = ReplicaConfig {
                own: NodeName::new(own)?,
                members: members?,
                kind,
                on_partition,
                hello_interval,
            };
            let depends_on: Result<Vec<_>, _> = parse(depends_on);
            Ok(Carried {
                name: ObjectName::new(&name)?,
                component: ObjectName::new(&component)?,
                body: ObjectName::new(&format!("{component}/body"))?,
                config,
                initial,
                depends_on: depends_on?,
            })
        };
        let carried = parsed();
        let factory = self.factory;
        (ChildSpec::new(&component, move || factory()).stateful(), carried)
    }
}

/// Asks a service, whichever node serves it now. Clones share what they know of it.
pub struct ServiceRef<M: Request> {
    name: ObjectName,
    registry: Registry,
    roster: Roster,
    /// Who answered last.
    primary: Arc<Mutex<Option<NodeName>>>,
    asks: PhantomData<fn(M)>,
}

impl<M: Request> Clone for ServiceRef<M> {
    fn clone(&self) -> Self {
        ServiceRef {
            name: self.name.clone(),
            registry: self.registry.clone(),
            roster: self.roster.clone(),
            primary: self.primary.clone(),
            asks: PhantomData,
        }
    }
}

impl<M: Request> fmt::Debug for ServiceRef<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of service {}", M::NAME, self.name)
    }
}

/// What came of asking one node.
enum Turn {
    Answered(Answered),
    /// It did not answer, and why.
    Failed(Why),
    /// Another node serves meanwhile.
    Moved(NodeName, bool),
}

impl<M: Request> ServiceRef<M> {
    pub(crate) fn new(registry: &Registry, roster: &Roster, name: &str) -> Result<Self, NameError> {
        Ok(ServiceRef {
            name: ObjectName::new(name)?,
            registry: registry.clone(),
            roster: roster.clone(),
            primary: Arc::default(),
            asks: PhantomData,
        })
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Option<NodeName>> {
        self.primary.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The node that answered last.
    pub fn primary(&self) -> Option<NodeName> {
        self.lock().clone()
    }

    /// Asks, and waits for the reply for five seconds at most: long enough for a standby to take over.
    ///
    /// # Errors
    /// As [`ask_within`](Self::ask_within).
    pub async fn ask(&self, message: M) -> Result<M::Reply, RequestError<M>> {
        self.ask_within(message, Duration::from_secs(5)).await
    }

    /// Asks, and waits for the reply until the deadline. Where the node that serves fails, the request is
    /// sent to the one that follows, under the same identity: it takes effect once.
    ///
    /// # Errors
    /// [`Why::OutcomeUnknown`] where the primary of a service with cold standbys failed while it served;
    /// [`Why::DeadlinePassed`] where nobody served in time; what the component's failure was, where it
    /// failed.
    pub async fn ask_within(
        &self,
        message: M,
        deadline: Duration,
    ) -> Result<M::Reply, RequestError<M>> {
        let mut payload = Vec::new();
        if codec::encode(&message, &mut payload).is_err() {
            let why = Why::TooLarge { limit: M::MAX_SIZE };
            return Err(RequestError { why, message: Some(message) });
        }
        let id = next_id();
        let task = Task { identity: ContractIdentity::of::<M>().brief().encode(), payload };
        let ask = AskService { sender: id.sender, sequence: id.sequence, task };
        let asked = tokio::time::timeout(deadline, self.pursue(ask)).await;
        let failed = |why| RequestError { why, message: None };
        let reply = asked.map_err(|_| failed(Why::DeadlinePassed))?.map_err(failed)?;
        codec::decode_reply::<M>(&reply)
            .map_err(|error| failed(Why::Undecodable { reason: error.to_string() }))
    }

    /// Follows the service from node to node until it has answered.
    async fn pursue(&self, ask: AskService) -> Result<Vec<u8>, Why> {
        let mut primary = self.lock().clone();
        let mut turn = 0;
        loop {
            let members = self.roster.members(&self.name).await;
            let Some(next) = members.get(turn % members.len().max(1)).cloned() else {
                tokio::time::sleep(PROBE).await;
                continue;
            };
            let node = match primary.take() {
                Some(node) => node,
                None => match self.who_serves(&next).await {
                    Some((Some(node), _)) => node,
                    _ => {
                        turn += 1;
                        tokio::time::sleep(PROBE).await;
                        continue;
                    }
                },
            };
            match self.try_at(&node, &ask, &members).await {
                Turn::Answered(Answered::Done(reply)) => {
                    *self.lock() = Some(node);
                    return Ok(reply);
                }
                Turn::Answered(Answered::Failed { why }) => return Err(read_why(&why)),
                Turn::Answered(Answered::Refused { why }) => match read_why(&why) {
                    Why::Full | Why::Restarting => {
                        primary = Some(node);
                        tokio::time::sleep(PROBE).await;
                    }
                    why => return Err(why),
                },
                Turn::Answered(Answered::Elsewhere { primary: told }) => {
                    primary = told.and_then(|told| NodeName::new(&told).ok());
                    if primary.is_none() || primary.as_ref() == Some(&node) {
                        tokio::time::sleep(PROBE).await;
                        turn += 1;
                    }
                }
                Turn::Moved(node, true) => primary = Some(node),
                Turn::Moved(node, false) => {
                    *self.lock() = Some(node);
                    return Err(unknown("the primary has changed, and its standbys are cold"));
                }
                // It was taken there, perhaps; those that follow may not know.
                Turn::Failed(why @ (Why::PeerDied { .. } | Why::OutcomeUnknown { .. })) => {
                    if !self.keeps(&members, &node).await {
                        return Err(unknown(&why.to_string()));
                    }
                    turn += 1;
                }
                Turn::Failed(_) => {
                    turn += 1;
                    tokio::time::sleep(PROBE).await;
                }
            }
        }
    }

    /// Asks one node, and meanwhile the others whether it still serves.
    async fn try_at(&self, node: &NodeName, ask: &AskService, members: &[NodeName]) -> Turn {
        let address = format!("{node}:{}", self.name);
        let sender = match self.registry.sender::<AskService>(&address) {
            Ok(sender) => sender,
            Err(why) => return Turn::Failed(why),
        };
        // Whoever asks sets the deadline, around all of this.
        let asking = sender.ask_within(ask.clone(), Duration::from_secs(3600));
        let mut asking = std::pin::pin!(asking);
        let others: Vec<_> = members.iter().filter(|member| *member != node).collect();
        for turn in 0.. {
            let asked = tokio::select! {
                biased;
                asked = &mut asking => Some(asked),
                () = tokio::time::sleep(PROBE) => None,
            };
            match asked {
                Some(Ok(answered)) => return Turn::Answered(answered),
                Some(Err(error)) => return Turn::Failed(error.why),
                None => {}
            }
            let Some(other) = others.get(turn % others.len().max(1)) else { continue };
            let told = tokio::select! {
                biased;
                asked = &mut asking => Err(asked),
                told = self.who_serves(other) => Ok(told),
            };
            match told {
                Err(Ok(answered)) => return Turn::Answered(answered),
                Err(Err(error)) => return Turn::Failed(error.why),
                Ok(Some((Some(primary), keeps))) if primary != *node => {
                    return Turn::Moved(primary, keeps);
                }
                Ok(_) => {}
            }
        }
        Turn::Failed(Why::DeadlinePassed)
    }

    /// Who serves, as far as that node knows, and whether standbys keep what was served.
    async fn who_serves(&self, node: &NodeName) -> Option<(Option<NodeName>, bool)> {
        let sender = self.registry.sender::<WhoServes>(&format!("{node}:{}", self.name)).ok()?;
        let serving = sender.ask_within(WhoServes, PROBE_WITHIN).await.ok()?;
        let primary = serving.primary.and_then(|primary| NodeName::new(&primary).ok());
        Some((primary, serving.keeps))
    }

    async fn keeps(&self, members: &[NodeName], gone: &NodeName) -> bool {
        for member in members.iter().filter(|member| *member != gone) {
            if let Some((_, keeps)) = self.who_serves(member).await {
                return keeps;
            }
        }
        // Nobody is left who could say so; the deadline will.
        true
    }
}

/// The contracts by which a replica drives its component.
pub(crate) fn stateful_ports<C: Stateful>() -> Vec<OpenPort<C>> {
    vec![Port::open::<C, SaveState>, Port::open::<C, LoadState>, Port::open::<C, RoleChanged>]
}

fn unknown(reason: &str) -> Why {
    Why::OutcomeUnknown { reason: reason.to_owned() }
}

pub(crate) fn encode_why(why: &Why) -> Vec<u8> {
    let mut bytes = Vec::new();
    if codec::encode_bounded(why, WHY_MAX, &mut bytes).is_err() {
        bytes.clear();
    }
    bytes
}

fn read_why(bytes: &[u8]) -> Why {
    codec::decode_bounded::<Why, WHY_MAX>(bytes)
        .unwrap_or_else(|error| Why::Undecodable { reason: error.to_string() })
}
