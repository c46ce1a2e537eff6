//! What the network promises to objects, each as a test: whole nodes in one process, over memory
//! behind faulty cables, in virtual time.

mod absence;
mod cables;
mod calls;
mod credits;
mod delivery;
mod hostile;
mod losses;
mod messages;
mod nodes;
mod panics;
mod paths;
mod pressure;
mod versions;

use super::{LinkSpec, NetEnvironment, NetHandle, NetReports, NetworkSpec, start};
use crate::actuator::ActuatorTable;
use crate::arbiter::pool::ArbiterPool;
use crate::component::environment::ComponentEnvironment;
use crate::host::spec::ChildSpec;
use crate::node::assembly::with_features;
use crate::runtime::guardian::Guardian;
use crate::runtime::reports::FaultReports;
use crate::topic::Topics;
use crate::{
    Component, Context, Contract, Event, Handle, Ports, Publisher, Request, Sender, WhenFull,
    platform,
};
use actix::{Actor, Addr};
use blastema_contract::Confirmed;
use blastema_contract::child::{Child, ChildEvent, ChildReport};
use blastema_contract::link::{CarrierChanged, LinkRow};
use blastema_contract::monitor::{LinkReported, NodeReported};
use blastema_contract::recoverer::Recover;
use blastema_contract::reports::{Exited, FaultDeclared};
use blastema_contract::router::InjectPanic;
use blastema_contract::transport::{
    Close, Cut, Direction, MediumAddress, Restore, Transport, TransportReport,
};
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::detection::{LinkCondition, NodeCondition};
use blastema_core::net::session::IDLE_TIMEOUT;
use blastema_core::net::{LinkId, LinkState};
use blastema_core::{
    DeliveryError, Fault, FaultId, FaultKind, FaultLocation, Incarnation, NodeName, ObjectName,
    Severity,
};
use blastema_doubles::{Probe, advance, settle};
use blastema_transports::{
    FaultInjector, FaultInjectorConfig, FrameTransport, Memory, MemoryMedium,
};
use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const MS: Duration = Duration::from_millis(1);

/// Adds to a sum, and replies with it.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = u64)]
struct Add(u64);

/// Replies with as much as it was sent.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = Vec<u8>, max_size = 1_000_000)]
struct Mirror(Vec<u8>);

/// Is written down.
#[derive(Clone, Debug, PartialEq, Event)]
struct Note(u64);

/// Is worthless after 100 ms.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(max_age = "100ms")]
struct Fresh(u64);

mod other {
    use crate::Request;

    /// Another contract by the same name.
    #[derive(Clone, Debug, PartialEq, Request)]
    #[contract(name = "Add", reply = u64)]
    pub(super) struct Add {
        pub(super) summand: f32,
    }
}

#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u64>>>);

impl Log {
    fn take(&self) -> Vec<u64> {
        std::mem::take(&mut self.0.lock().unwrap())
    }
}

struct Acc {
    sum: u64,
    log: Log,
}

impl Component for Acc {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Add>().serve::<Mirror>().accept::<Note>().accept::<Fresh>();
        let _ = ports.listen::<Note>();
        let _ = ports.listen::<Fresh>();
    }
}

impl Handle<Add> for Acc {
    async fn handle(&mut self, Add(n): Add, _: &mut Context<Self>) -> u64 {
        self.sum += n;
        self.sum
    }
}

impl Handle<Mirror> for Acc {
    async fn handle(&mut self, Mirror(bytes): Mirror, _: &mut Context<Self>) -> Vec<u8> {
        bytes
    }
}

impl Handle<Note> for Acc {
    async fn handle(&mut self, Note(n): Note, _: &mut Context<Self>) {
        self.log.0.lock().unwrap().push(n);
    }
}

impl Handle<Fresh> for Acc {
    async fn handle(&mut self, Fresh(n): Fresh, _: &mut Context<Self>) {
        self.log.0.lock().unwrap().push(n);
    }
}

/// One medium with its ends by node, and the cables in between.
#[derive(Default)]
struct Robot {
    medium: MemoryMedium,
    cables: Vec<(String, Addr<FaultInjector>)>,
}

struct Module {
    host: Arc<ComponentEnvironment>,
    net: NetHandle,
    log: Log,
    child: Option<Box<dyn Child>>,
    exits: Probe<Exited>,
    links: Probe<LinkReported>,
    nodes: Probe<NodeReported>,
    faults: Probe<Recover>,
    declared: Probe<FaultDeclared>,
}

impl Robot {
    /// A node with a component `acc`, and a cable for each network and neighbour.
    async fn module(
        &mut self,
        name: &str,
        incarnation: u64,
        networks: &[(&str, &[&str])],
    ) -> Module {
        let declared = Probe::start();
        let reports =
            FaultReports { faults: Some(declared.recipient()), ..FaultReports::default() };
        let host = Arc::new(with_features(
            ComponentEnvironment::new(ArbiterPool::here(), reports),
            ActuatorTable::default(),
        ));
        let exits = Probe::start();
        let (links, nodes) = (Probe::start(), Probe::start());
        let faults = Probe::replying(|_: &Recover| Confirmed);
        let specs = networks.iter().map(|(network, neighbours)| {
            let links = neighbours.iter().map(|neighbour| {
                let remote = MediumAddress::Memory(format!("{network}/{neighbour}").into());
                let neighbour = Some(NodeName::new(neighbour).unwrap());
                LinkSpec { neighbour, ..LinkSpec::new(&format!("{network}-{name}"), remote) }
            });
            let end = format!("{network}/{name}");
            let memory = FrameTransport::new(Memory::new(&self.medium, &end)).start();
            let config = FaultInjectorConfig::new(1, platform::now);
            let cable = FaultInjector::new(Transport::from(memory), config).start();
            self.cables.push((end, cable.clone()));
            NetworkSpec {
                name: (*network).into(),
                transport: Transport::from(cable),
                interface: None,
                links: links.collect(),
                discovery: None,
                seal: None,
            }
        });
        let specs = specs.collect();
        let environment = NetEnvironment {
            node: NodeName::new(name).unwrap(),
            incarnation: Incarnation(incarnation),
            guardian: Guardian::reporting_to(exits.recipient()),
            arbiter: None,
            registry: host.registry.clone(),
            topics: host.feature::<Topics>().clone(),
            dead_letters: host.dead_letters.clone(),
            may_be_away: BTreeSet::new(),
            reports: NetReports {
                recoverer: Some(faults.recipient()),
                links: Some(links.recipient()),
                nodes: Some(nodes.recipient()),
                declared: host.reports.clone(),
                ..NetReports::default()
            },
            session_timeout: IDLE_TIMEOUT,
            directory: None,
            keys: None,
        };
        let net = start(environment, specs);
        net.announce();
        let log = Log::default();
        let mut module =
            Module { host, net, log, child: None, exits, links, nodes, faults, declared };
        module.start_acc().await;
        module
    }

    fn cable(&self, end: &str) -> &Addr<FaultInjector> {
        &self.cables.iter().rfind(|(name, _)| name == end).unwrap().1
    }

    fn cut(&self, end: &str) {
        self.cable(end).do_send(Cut { direction: Direction::Both, reported: false });
    }

    fn restore(&self, end: &str) {
        self.cable(end).do_send(Restore);
    }

    /// No network leads to or from this node of a pair.
    fn part(&self, node: &str) {
        ["ethernet", "ieee1394"].iter().for_each(|network| self.cut(&format!("{network}/{node}")));
    }

    fn unite(&self, node: &str) {
        let networks = ["ethernet", "ieee1394"].iter();
        networks.for_each(|network| self.restore(&format!("{network}/{node}")));
    }

    /// Closes the transport: no frame of the node leaves here any more.
    fn kill(&self, end: &str) {
        self.cable(end).do_send(Close);
    }
}

impl Module {
    async fn start_acc(&mut self) {
        let log = self.log.clone();
        let spec = ChildSpec::new("acc", move || Acc { sum: 0, log: log.clone() });
        let (mut child, _) = spec.queue(20_000, WhenFull::Refuse).into_child(&self.host).unwrap();
        let reports = Probe::<ChildReport>::start();
        child.start(Incarnation(1), reports.recipient().into());
        assert_eq!(reports.expect().await.event, ChildEvent::Started);
        self.child = Some(child);
    }

    /// Begins a component that writes into this log.
    async fn begin<C: Component>(
        &self,
        name: &str,
        make: impl Fn(Log) -> C + Send + Sync + 'static,
        queue: usize,
        full: WhenFull,
    ) -> (Box<dyn Child>, Log) {
        let log = Log::default();
        let kept = log.clone();
        let spec = ChildSpec::new(name, move || make(kept.clone())).queue(queue, full);
        let (mut child, _) = spec.into_child(&self.host).unwrap();
        child.start(Incarnation(1), Probe::<ChildReport>::start().recipient().into());
        settle().await;
        (child, log)
    }

    fn sender<M: Contract>(&self, name: &str) -> Sender<M> {
        self.host.registry.sender(name).unwrap()
    }

    fn publisher(&self) -> Publisher<Note> {
        self.host.feature::<Topics>().publisher(Note::NAME).unwrap()
    }
}

/// Two nodes on two networks.
async fn pair() -> (Robot, Module, Module) {
    let mut robot = Robot::default();
    let left: [(&str, &[&str]); 2] = [("ethernet", &["right"]), ("ieee1394", &["right"])];
    let right: [(&str, &[&str]); 2] = [("ethernet", &["left"]), ("ieee1394", &["left"])];
    let left = robot.module("left", 1, &left).await;
    let right = robot.module("right", 1, &right).await;
    advance(500 * MS).await;
    (robot, left, right)
}
