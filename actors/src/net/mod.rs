//! The network of a node: thin actors over the machines of `blastema_core::net`.
//!
//! ```text
//!  objects ─ stubs ─► Stack: gateway ─► sessions ─► router ─► Links ─► transport ══ medium
//!                            │ bindings  │ exactly   │ which   │ is it alive
//!                            │ naming    │ once      │ hop     │
//!  local skeletons ◄─────────┘
//! ```
//!
//! Stack and links are actors. All of them live on one arbiter, under the guardian. What becomes of
//! a panic in:
//!
//! * a network's links: they are built again and send hellos; neighbours notice nothing or a late
//!   hello.
//! * the router's machine: it is built again, gets the links' last reports, asks neighbours, and has
//!   its routes within two round trips; packets in between are lost, and the sessions retransmit them.
//! * any other part of the stack: every request is resolved, and every session is reset.

mod carrier;
mod credit;
mod fault_forwarding;
pub(crate) mod gateway;
mod gateway_messages;
pub(crate) mod keys;
mod links;
pub(crate) mod operator;
mod own_incarnation;
pub(crate) mod own_name;
mod roster_watch;
mod router;
mod sessions;
mod stack;
mod stub;
#[cfg(test)]
mod tests;

pub(crate) use carrier::Interface;
pub use keys::RosterRow;
pub(crate) use links::DiscoverySpec;

use self::fault_forwarding::RemoteRecoverer;
use self::gateway::LocalInput;
use self::own_name::OwnName;
use crate::messaging::dead_letters::DeadLetterLog;
use crate::platform;
use crate::registry::Registry;
use crate::registry::remote::StubFactory;
use crate::registry::remote_watch::{self, DeathWatchService};
use crate::runtime::guardian::Guardian;
use crate::runtime::reports::{FaultReporter, FaultReports};
use crate::topic::Topics;
use actix::prelude::*;
use actix_rt::ArbiterHandle;
use blastema_contract::link::{AddLinks, LinkRow, ReadLinks};
use blastema_contract::monitor::{LinkReported, NodeReported};
use blastema_contract::recoverer::{Recover, SafeStateChanged};
use blastema_contract::reports::{AreYouAlive, LivenessReported};
use blastema_contract::router::{InjectPanic, ReadRoutes};
use blastema_contract::session::{DirectoryReport, ReadSessions, SendToDirectory, SessionRow};
use blastema_contract::strategy::{IsolateNode, Reroute};
use blastema_contract::transport::{MediumAddress, ReadCounters, Transport, TransportCounters};
use blastema_core::net::discovery::LEARNED_MAX;
use blastema_core::net::{LinkId, Route};
use blastema_core::{Incarnation, NodeName, ObjectName};
use roster_watch::RosterWatch;
use std::collections::BTreeSet;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// One medium of this node, and its neighbours there.
#[derive(Clone, Debug)]
pub(crate) struct NetworkSpec {
    /// How people call it, such as `ethernet`.
    pub(crate) name: Arc<str>,
    /// Its transport, already started on the network's arbiter, perhaps behind a faulty cable.
    pub(crate) transport: Transport,
    /// The interface whose carrier tells of a pulled cable, where there is one.
    pub(crate) interface: Option<Interface>,
    /// The neighbours.
    pub(crate) links: Vec<LinkSpec>,
    /// How others are learned of, if they are.
    pub(crate) discovery: Option<DiscoverySpec>,
    /// How its frames are sealed, if they are.
    pub(crate) seal: Option<keys::SealTerms>,
}

/// One neighbour on one medium.
#[derive(Clone, Debug)]
pub(crate) struct LinkSpec {
    /// How people call it.
    pub(crate) name: Arc<str>,
    /// The neighbour's address on the medium.
    pub(crate) remote: MediumAddress,
    /// The node at the other end; `None` takes the first that sends.
    pub(crate) neighbour: Option<NodeName>,
    /// How dear it is to use: of two paths the cheaper is taken. `None` is as its medium is.
    pub(crate) cost: Option<u16>,
    /// How often we say hello, unless the medium is too slow for that. A dead link is found after
    /// three and a half of the neighbour's.
    pub(crate) hello_interval: Duration,
    /// How soon after the start the neighbour must be there; [`Duration::MAX`] for no limit.
    pub(crate) expected_within: Duration,
}

impl LinkSpec {
    /// The usual link to this address.
    #[cfg(test)]
    pub(crate) fn new(name: &str, remote: MediumAddress) -> Self {
        LinkSpec {
            name: name.into(),
            remote,
            neighbour: None,
            cost: None,
            hello_interval: blastema_core::net::HELLO_INTERVAL,
            expected_within: blastema_core::net::PEER_TIMEOUT,
        }
    }
}

/// What the network needs of its node.
#[derive(Clone)]
pub(crate) struct NetEnvironment {
    /// Our name.
    pub(crate) node: NodeName,
    /// Our incarnation.
    pub(crate) incarnation: Incarnation,
    /// Keeps the network's actors alive.
    pub(crate) guardian: Guardian,
    /// Where they live; `None` for here.
    pub(crate) arbiter: Option<ArbiterHandle>,
    /// The objects of this node.
    pub(crate) registry: Registry,
    /// Its topics.
    pub(crate) topics: Topics,
    /// Gets what was accepted and did not arrive.
    pub(crate) dead_letters: DeadLetterLog,
    /// Other nodes that may be away without a fault.
    pub(crate) may_be_away: BTreeSet<NodeName>,
    /// The fault chain.
    pub(crate) reports: NetReports,
    /// When the session with a peer that does not answer ends.
    pub(crate) session_timeout: Duration,
    /// The directory of this node.
    pub(crate) directory: Option<DirectoryLine>,
    /// With which frames are sealed.
    pub(crate) keys: Option<Arc<keys::NodeKeys>>,
}

/// The parts of the fault chain that the network reports to; it does not, where there is none.
#[derive(Clone, Default)]
pub(crate) struct NetReports {
    /// Gets faults that other nodes tell us of.
    pub(crate) recoverer: Option<Recipient<Recover>>,
    /// Is told how links are.
    pub(crate) links: Option<Recipient<LinkReported>>,
    /// Is told when the network's thread was not run.
    pub(crate) stalls: Option<Recipient<LivenessReported>>,
    /// Is told how nodes are.
    pub(crate) nodes: Option<Recipient<NodeReported>>,
    /// Is told of faults that are found in what other nodes send.
    pub(crate) declared: FaultReports,
}

/// Between the network and the directory of a node.
#[derive(Clone)]
pub(crate) struct DirectoryLine {
    /// The directory.
    pub(crate) reports: Recipient<DirectoryReport>,
    /// The network, once it is started.
    pub(crate) network: Arc<OnceLock<Recipient<SendToDirectory>>>,
}

impl NetEnvironment {
    fn own_faults(&self, object: &str) -> FaultReporter {
        FaultReporter::new(named(object), self.reports.declared.clone())
    }
}

/// A started network. Clones are the same network.
#[derive(Clone)]
pub(crate) struct NetHandle {
    stack: Addr<stack::NetworkStack>,
    networks: Vec<(ObjectName, Addr<links::LinksActor>)>,
    /// The counters of each network's transport.
    media: Vec<(Arc<str>, Recipient<ReadCounters>)>,
    guardian: Guardian,
    arbiter: Option<ArbiterHandle>,
    registry: Registry,
    stubs: Arc<stub::PeerStubs>,
    deaths: DeathWatchService,
    carrier: Arc<carrier::CarrierMonitor>,
    own_name: OwnName,
    /// Ends with the last handle.
    _roster_watch: Option<Arc<RosterWatch>>,
}

/// Starts the network of a node, and connects the registry and the topics to it. Each link has a
/// name and a remote address of its own.
pub(crate) fn start(environment: NetEnvironment, networks: Vec<NetworkSpec>) -> NetHandle {
    platform::keep_freed_memory();
    let NetEnvironment { node, incarnation, guardian, arbiter, reports, .. } = environment.clone();
    let on_arbiter = arbiter.as_ref();

    let numbers = number(&networks);
    if let Some(recoverer) = reports.recoverer {
        fault_forwarding::serve(&environment.registry, recoverer);
    }

    let own_name = OwnName::new();
    let keys = environment.keys.clone();
    let stubs = Arc::new(stub::PeerStubs::new());
    let deaths = remote_watch::serve(&environment.registry);
    let (for_stack, watches) = (stubs.clone(), deaths.clone());
    let make = stack::NetworkStack::maker(&environment, for_stack, watches, own_name.clone());
    let stack = guardian.start(named("stack"), on_arbiter, make);
    stubs.connect(stack.clone().recipient());
    if let Some(directory) = &environment.directory {
        // It is set once, here.
        let _ = directory.network.set(stack.clone().recipient());
    }
    let remote: Arc<dyn StubFactory> = stubs.clone();
    environment.registry.connect(remote);

    let mut watched = Vec::new();
    let media = networks.iter().map(|spec| (spec.name.clone(), spec.transport.counters.clone()));
    let media = media.collect();
    if let Some(keys) = &keys {
        let networks = networks.iter().map(|NetworkSpec { name, seal, .. }| {
            operator::NetworkSeal { network: name.to_string(), sealed: seal.is_some() }
        });
        operator::serve(&environment.registry, keys, networks.collect());
    }
    let mut started: Vec<(_, Addr<links::LinksActor>)> = Vec::new();
    for (spec, numbers) in networks.into_iter().zip(numbers) {
        let name = named(&format!("links/{}", spec.name));
        let links = spec.links.into_iter().zip(&numbers.described).map(|(link, n)| (*n, link));
        let links = links.collect();
        let discovery = spec.discovery.map(|discovery| (discovery, numbers.learned.clone()));
        let faults = environment.own_faults(&format!("links/{}", spec.name));
        let recipients = links::LinksRecipients {
            node: node.clone(),
            incarnation,
            own_name: own_name.clone(),
            network: spec.name,
            transport: spec.transport,
            router_changes: stack.clone().recipient(),
            router_loads: stack.clone().recipient(),
            monitor: reports.links.clone(),
            stalls: reports.stalls.clone(),
            faults,
            seal: keys.clone().zip(spec.seal),
            dial_in: numbers.dial_in.clone(),
        };
        let address = guardian.start(name.clone(), on_arbiter, move |_| {
            links::LinksActor::new(recipients, links, discovery)
        });
        if let Some(interface) = spec.interface {
            watched.push(carrier::MonitoredInterface {
                interface,
                recipient: address.clone().recipient(),
            });
        }
        let LinkNumbers { described, learned, dial_in } = numbers;
        let links = described.into_iter().chain(learned).chain(dial_in).collect();
        stack.do_send(AddLinks { links, carry: address.clone().recipient() });
        started.push((name, address));
    }
    let roster_watch = keys.map(|keys| {
        let links = started.iter().map(|(_, links)| links.clone().recipient());
        // Who is not missed any more is known before the links go down.
        let told = [stack.clone().recipient()].into_iter().chain(links).collect();
        let faults = environment.own_faults("roster");
        let watch = RosterWatch::start(keys, faults, stack.clone().recipient(), told);
        let watch = Arc::new(watch);
        stack.do_send(stack::AttachRosterWatch(Arc::downgrade(&watch)));
        watch
    });
    let carrier = Arc::new(carrier::CarrierMonitor::start(watched));
    NetHandle {
        stack,
        networks: started,
        media,
        guardian,
        arbiter,
        registry: environment.registry,
        stubs,
        deaths,
        carrier,
        own_name,
        _roster_watch: roster_watch,
    }
}

/// The numbers of the links of one network.
struct LinkNumbers {
    described: Vec<LinkId>,
    /// For links that are learned, where it discovers.
    learned: Vec<LinkId>,
    /// For operators that connect by themselves, where it is sealed.
    dial_in: Vec<LinkId>,
}

/// Gives every link its number.
fn number(networks: &[NetworkSpec]) -> Vec<LinkNumbers> {
    let mut next = 0;
    let mut take = |count: usize| -> Vec<LinkId> {
        let first = next;
        next += count as u16;
        (first..next).map(LinkId).collect()
    };
    let numbers = networks.iter().map(|NetworkSpec { links, discovery, seal, .. }| LinkNumbers {
        described: take(links.len()),
        learned: take(if discovery.is_some() { LEARNED_MAX } else { 0 }),
        dial_in: take(if seal.is_some() { links::DIALED_IN_MAX } else { 0 }),
    });
    numbers.collect()
}

/// The name under which the guardian reports one of the network's own actors.
pub(crate) fn named(what: &str) -> ObjectName {
    // A network's name is the user's and may hold anything; its links are then told by their kind.
    let name = ObjectName::new(&format!("net/{what}"));
    name.unwrap_or_else(|_| ObjectName::new("net/links").expect("a name of letters"))
}

impl NetHandle {
    /// Takes faults for another node's recoverer. Its answer does not come, and the mailbox reports
    /// itself closed, when the session with that node ends first.
    pub(crate) fn recoverer_of(&self, node: &NodeName) -> Recipient<Recover> {
        let name = named(&format!("port/{node}"));
        let recoverer = RemoteRecoverer::new(node, &self.registry);
        self.guardian.start(name, self.arbiter.as_ref(), |_| recoverer).recipient()
    }

    /// Whether another process has this node's name.
    pub(crate) fn own_name(&self) -> &OwnName {
        &self.own_name
    }

    /// Whether messages can be sent to this node, and it has told what it listens to.
    pub(crate) fn is_connected(&self, node: &NodeName) -> bool {
        self.stubs.is_opened(node)
    }

    /// Whether a path leads to this node, and it has not left and is not isolated.
    pub(crate) fn is_reachable(&self, node: &NodeName) -> bool {
        self.stubs.is_reachable(node)
    }

    /// Completes when messages can be sent to this node.
    pub(crate) async fn connected(&self, node: &NodeName) {
        self.stubs.opened(node).await;
    }

    /// All links, in the order of the configuration.
    pub(crate) async fn read_links(&self) -> Vec<LinkRow> {
        let mut rows = Vec::new();
        for (_, network) in &self.networks {
            rows.extend(network.send(ReadLinks).await.unwrap_or_default());
        }
        rows
    }

    /// What each network's medium has carried and lost.
    pub(crate) async fn read_media(&self) -> Vec<(Arc<str>, TransportCounters)> {
        let mut rows = Vec::new();
        for (network, medium) in &self.media {
            rows.extend(medium.send(ReadCounters).await.ok().map(|read| (network.clone(), read)));
        }
        rows
    }

    /// Every node that can be reached, and how.
    pub(crate) async fn read_routes(&self) -> Vec<Route> {
        self.stack.send(ReadRoutes).await.unwrap_or_default()
    }

    /// The roster that is used; none without keys.
    pub(crate) async fn read_roster(&self) -> Option<RosterRow> {
        self.stack.send(stack::ReadRoster).await.ok().flatten()
    }

    /// All sessions.
    pub(crate) async fn read_sessions(&self) -> Vec<SessionRow> {
        self.stack.send(ReadSessions).await.unwrap_or_default()
    }

    /// Whether this node has met another.
    pub(crate) fn knows(&self, node: &NodeName) -> bool {
        self.stubs.has_met(node)
    }

    /// Those that a path leads to now, or did before.
    pub(crate) fn met(&self) -> Vec<NodeName> {
        self.stubs.met()
    }

    /// Isolates another node, or admits it again.
    pub(crate) fn decide(&self, decision: IsolateNode) {
        // What is sent from here on is refused at once.
        self.stubs.send_state(&decision.node).set_isolated(decision.isolated);
        self.stack.do_send(decision);
    }

    /// Takes the decisions of recovery strategies about other nodes.
    pub(crate) fn isolation(&self) -> Recipient<IsolateNode> {
        self.stack.clone().recipient()
    }

    /// Takes requests for another way, from the recovery strategy.
    pub(crate) fn reroute(&self) -> Recipient<Reroute> {
        self.stack.clone().recipient()
    }

    /// Takes [`InjectPanic`], for the demonstration and tests.
    pub(crate) fn panics(&self) -> Recipient<InjectPanic> {
        self.stack.clone().recipient()
    }

    /// Is told of the safe state of this node, and tells peers.
    pub(crate) fn safe_states(&self) -> Recipient<SafeStateChanged> {
        self.stack.clone().recipient()
    }

    /// Every actor of the network, to see what becomes of a panic in it.
    #[cfg(test)]
    pub(crate) fn victims(&self) -> Vec<Recipient<InjectPanic>> {
        let mut all = vec![self.stack.clone().recipient()];
        all.extend(self.networks.iter().map(|(_, links)| links.clone().recipient()));
        all
    }

    /// Runs this on the stack.
    #[cfg(test)]
    fn on_stack(&self, act: impl FnOnce(&mut stack::NetworkStack) + Send + 'static) {
        self.stack.do_send(stack::RunOnStack(Box::new(act)));
    }

    /// Makes the stack panic, in another part than the router.
    #[cfg(test)]
    fn panic_sessions(&self) {
        self.on_stack(|_| panic!("the sessions panic on purpose"));
    }

    /// Where the network's own actors answer the monitor.
    pub(crate) fn pings(&self) -> Vec<(ObjectName, Recipient<AreYouAlive>)> {
        let mut all = vec![(named("stack"), self.stack.clone().recipient())];
        for (name, links) in &self.networks {
            all.push((name.clone(), links.clone().recipient()));
        }
        all
    }

    /// The start of this node is over: peers learn that they are connected with it.
    pub(crate) fn announce(&self) {
        self.stack.do_send(LocalInput::Started);
    }

    /// This node begins to end in order: its objects are not started again.
    pub(crate) fn expect_end(&self) {
        self.deaths.handle_leaving();
    }

    /// Takes nothing for other nodes any more, and looks at no interface.
    pub(crate) fn stop(&self) {
        self.stubs.end();
        self.carrier.end();
    }

    /// Tells the peers that this node ends in order, delivers what was sent, and ends every
    /// session.
    pub(crate) fn leave(&self) {
        // What is accepted after that would go nowhere.
        self.stubs.end();
        self.stack.do_send(LocalInput::Ending);
    }
}
