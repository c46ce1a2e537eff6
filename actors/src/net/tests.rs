//! What the network promises to objects, each as a test: whole nodes in one process, over memory
//! behind faulty cables, in virtual time.

mod absence;
mod calls;
mod delivery;
mod hostile;
mod pressure;
mod versions;

use super::{LinkSpec, NetEnvironment, NetHandle, NetworkSpec, start};
use crate::guardian::Guardian;
use crate::host::arbiters::Arbiters;
use crate::host::environment::{HostEnvironment, Reports};
use crate::host::spec::ChildSpec;
use crate::platform;
use crate::{Component, Context, Contract, Event, Handle, Ports, Publisher, Request, Sender};
use actix::{Actor, Addr};
use blastema_contract::Confirmed;
use blastema_contract::child::{Child, ChildEvent, ChildReport};
use blastema_contract::link::{CarrierChanged, LinkRow};
use blastema_contract::monitor::{LinkReported, NodeReported};
use blastema_contract::recoverer::Recover;
use blastema_contract::reports::{Exited, FaultDeclared, FaultMended};
use blastema_contract::router::PanicOnPurpose;
use blastema_contract::transport::{
    Close, Cut, Direction, MediumAddress, Restore, Transport, TransportReport,
};
use blastema_core::dead_letters::DeadReason;
use blastema_core::detection::{LinkCondition, NodeCondition};
use blastema_core::net::isolation::Judges;
use blastema_core::net::{LinkNumber, LinkState};
use blastema_core::{
    Fault, FaultId, FaultKind, Incarnation, NodeName, ObjectName, Place, Severity, Why,
};
use blastema_doubles::{Probe, advance, paused, settle};
use blastema_transports::{Faulty, FaultyConfig, Memory, MemoryConfig, MemoryMedium};
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

/// Panics.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = ())]
struct Boom;

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
        ports.serve::<Add>().serve::<Mirror>().serve::<Boom>().accept::<Note>().accept::<Fresh>();
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

impl Handle<Boom> for Acc {
    async fn handle(&mut self, Boom: Boom, _: &mut Context<Self>) {
        panic!("boom");
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
    cables: Vec<(String, Addr<Faulty>)>,
}

struct Module {
    host: HostEnvironment,
    net: NetHandle,
    log: Log,
    child: Option<Box<dyn Child>>,
    exits: Probe<Exited>,
    links: Probe<LinkReported>,
    nodes: Probe<NodeReported>,
    faults: Probe<Recover>,
    declared: Probe<FaultDeclared>,
    mended: Probe<FaultMended>,
}

impl Robot {
    /// A node with a component `acc`, and a cable for each network and neighbour.
    async fn module(&mut self, name: &str, life: u64, networks: &[(&str, &[&str])]) -> Module {
        let (declared, mended) = (Probe::start(), Probe::start());
        let reports = Reports { faults: Some(declared.recipient()), ..Reports::default() };
        let host = HostEnvironment::new(Arbiters::here(), reports);
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
            let memory = Memory::new(MemoryConfig::new(&self.medium, &end)).start();
            let config = FaultyConfig::new(1, platform::now);
            let cable = Faulty::new(Transport::from(memory), config).start();
            self.cables.push((end, cable.clone()));
            NetworkSpec {
                name: (*network).into(),
                transport: Transport::from(cable),
                interface: None,
                links: links.collect(),
                discovery: None,
            }
        });
        let specs = specs.collect();
        let environment = NetEnvironment {
            node: NodeName::new(name).unwrap(),
            incarnation: Incarnation(life),
            guardian: Guardian::reporting_to(exits.recipient()),
            arbiter: None,
            registry: host.registry.clone(),
            topics: host.topics.clone(),
            dead_letters: host.dead_letters.clone(),
            recoverer: Some(faults.recipient()),
            links: Some(links.recipient()),
            nodes: Some(nodes.recipient()),
            faults: Some(declared.recipient()),
            mended: Some(mended.recipient()),
            judges: Judges::Majority,
            envoys: Vec::new(),
        };
        let net = start(environment, specs).unwrap();
        let log = Log::default();
        let mut module =
            Module { host, net, log, child: None, exits, links, nodes, faults, declared, mended };
        module.give_birth().await;
        module
    }

    fn cable(&self, end: &str) -> &Addr<Faulty> {
        &self.cables.iter().rfind(|(name, _)| name == end).unwrap().1
    }

    fn cut(&self, end: &str) {
        self.cable(end).do_send(Cut { direction: Direction::Both, reported: false });
    }

    fn restore(&self, end: &str) {
        self.cable(end).do_send(Restore);
    }

    /// Nobody hears any more what the node says here.
    fn kill(&self, end: &str) {
        self.cable(end).do_send(Close);
    }
}

impl Module {
    async fn give_birth(&mut self) {
        let log = self.log.clone();
        let spec = ChildSpec::new("acc", move || Acc { sum: 0, log: log.clone() });
        let (mut child, _) =
            spec.queue(20_000, crate::WhenFull::Refuse).into_child(&self.host).unwrap();
        let reports = Probe::<ChildReport>::start();
        child.start(Incarnation(1), reports.recipient());
        assert_eq!(reports.expect().await.event, ChildEvent::Started);
        self.child = Some(child);
    }

    fn sender<M: Contract>(&self, name: &str) -> Sender<M> {
        self.host.registry.sender(name).unwrap()
    }

    fn publisher(&self) -> Publisher<Note> {
        self.host.topics.publisher(Note::NAME).unwrap()
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

#[test]
fn a_remote_object_is_asked_and_told_with_the_code_for_a_local_one() {
    paused(async {
        let (_robot, left, right) = pair().await;

        assert_eq!(left.sender::<Add>("right:acc").ask(Add(3)).await.unwrap(), 3);
        assert_eq!(right.sender::<Add>("acc").ask(Add(4)).await.unwrap(), 7);
        left.sender::<Note>("right:acc").tell(Note(5)).unwrap();
        advance(10 * MS).await;

        assert_eq!(right.log.take(), [5]);
        assert_eq!(left.log.take(), [0; 0]);
    });
}

#[test]
fn events_reach_listeners_on_every_node_once() {
    paused(async {
        let (_robot, left, right) = pair().await;

        for n in 0..100 {
            left.publisher().publish(Note(n)).unwrap();
            advance(MS).await;
        }
        advance(50 * MS).await;

        let all: Vec<_> = (0..100).collect();
        assert_eq!(left.log.take(), all);
        assert_eq!(right.log.take(), all);
    });
}

#[test]
fn a_message_larger_than_any_frame_arrives_whole() {
    paused(async {
        let (_robot, left, _right) = pair().await;
        let picture: Vec<u8> = (0..500_000u32).map(|n| n as u8).collect();

        let mirrored = left.sender("right:acc").ask(Mirror(picture.clone())).await.unwrap();

        assert!(mirrored == picture);
    });
}

#[test]
fn a_cut_cable_loses_and_doubles_nothing_while_there_is_another() {
    paused(async {
        let (robot, left, right) = pair().await;
        let sender = left.sender::<Note>("right:acc");

        for n in 0..300 {
            match n {
                100 => robot.cut("ethernet/left"),
                200 => robot.restore("ethernet/left"),
                _ => {}
            }
            sender.tell(Note(n)).unwrap();
            advance(5 * MS).await;
        }
        advance(500 * MS).await;

        assert_eq!(right.log.take(), (0..300).collect::<Vec<_>>());
        let down = left
            .links
            .drain()
            .into_iter()
            .filter(|report| matches!(report.condition, LinkCondition::Down { .. }));
        let down: Vec<_> = down.map(|report| report.link.to_string()).collect();
        assert_eq!(down, ["ethernet-left"]);
        assert!(
            !left
                .nodes
                .drain()
                .iter()
                .any(|report| { matches!(report.condition, NodeCondition::Lost { .. }) })
        );
    });
}

#[test]
fn a_network_whose_interface_lost_its_carrier_is_given_up_at_once_and_proves_itself_again() {
    paused(async {
        let (robot, left, right) = pair().await;
        let up = |rows: &[LinkRow]| rows.iter().map(|row| row.state).collect::<Vec<_>>();
        left.sender::<Note>("right:acc").tell(Note(0)).unwrap();
        advance(5 * MS).await;
        assert_eq!(right.log.take(), [0]);
        left.links.drain();

        robot.cut("ethernet/left");
        left.net.networks[0].1.do_send(CarrierChanged { present: false });
        left.sender::<Note>("right:acc").tell(Note(1)).unwrap();
        advance(5 * MS).await;

        assert_eq!(right.log.take(), [1], "a hello is not even late");
        let told = left.links.expect().await;
        let LinkCondition::Down { reason } = told.condition else { panic!("{told:?}") };
        assert!(reason.contains("carrier"), "{reason}");
        robot.restore("ethernet/left");
        left.net.networks[0].1.do_send(CarrierChanged { present: true });
        advance(5 * MS).await;
        assert_eq!(up(&left.net.read_links().await), [LinkState::Down, LinkState::Up]);
        advance(1000 * MS).await;
        assert_eq!(up(&left.net.read_links().await), [LinkState::Up; 2]);
    });
}

#[test]
fn a_slow_medium_is_dearer_and_is_spared_hellos() {
    paused(async {
        let (_robot, left, _right) = pair().await;

        left.net.networks[0].1.do_send(TransportReport::Rate { bytes_per_second: 11_520 });
        advance(1000 * MS).await;

        let rows = left.net.read_links().await;
        assert_eq!([rows[0].cost, rows[1].cost], [868, 10]);
        assert!(rows[0].hello_interval > 80 * MS, "{:?}", rows[0].hello_interval);
        assert_eq!(rows[1].hello_interval, 50 * MS);
        assert!(rows.iter().all(|row| row.state == LinkState::Up && row.phi < 1.0), "{rows:?}");
        assert_eq!(left.net.read_routes().await.routes[0].next, LinkNumber(1));
    });
}

#[test]
fn a_node_between_two_others_passes_their_messages_on() {
    paused(async {
        let mut robot = Robot::default();
        let middle: [(&str, &[&str]); 2] = [("ethernet", &["left"]), ("ieee1394", &["right"])];
        let _middle = robot.module("middle", 1, &middle).await;
        let left = robot.module("left", 1, &[("ethernet", &["middle"])]).await;
        let _right = robot.module("right", 1, &[("ieee1394", &["middle"])]).await;
        advance(1000 * MS).await;

        assert_eq!(left.sender::<Add>("right:acc").ask(Add(3)).await.unwrap(), 3);

        let routes = left.net.read_routes().await.routes;
        let costs: Vec<_> = routes.iter().map(|route| (route.node.as_str(), route.cost)).collect();
        assert_eq!(costs, [("middle", 10), ("right", 20)]);
    });
}

#[test]
fn a_contract_that_differs_is_refused_and_the_difference_shown() {
    paused(async {
        let (_robot, left, right) = pair().await;
        let sender = left.host.registry.sender::<other::Add>("right:acc").unwrap();

        let error = sender.ask(other::Add { summand: 1.0 }).await.unwrap_err();

        let Why::ContractDiffers { difference } = error.why else { panic!("{error:?}") };
        assert!(difference.contains("here") && difference.contains("there"), "{difference}");
        let declared = right.declared.expect().await;
        assert_eq!(declared.kind, FaultKind::ContractMismatch);
        assert_eq!(declared.object.as_str(), "acc");
    });
}

#[test]
fn an_unknown_object_and_an_unknown_node_are_told_apart() {
    paused(async {
        let (_robot, left, _right) = pair().await;

        let nobody = left.sender::<Add>("right:nobody").ask(Add(1)).await.unwrap_err();
        assert!(matches!(nobody.why, Why::Unknown { .. }), "{nobody:?}");
        let nowhere = left.sender::<Add>("nowhere:acc").ask(Add(1)).await.unwrap_err();
        assert_eq!(nowhere.why, Why::Unreachable { node: "nowhere".into() });
    });
}

#[test]
fn a_request_that_kills_the_remote_object_is_resolved_with_its_death() {
    paused(async {
        let (_robot, left, _right) = pair().await;

        let error = left.sender::<Boom>("right:acc").ask(Boom).await.unwrap_err();

        assert_eq!(error.why, Why::PeerDied { incarnation: Incarnation(1) });
    });
}

#[test]
fn a_panic_in_the_router_loses_nothing() {
    paused(async {
        let (_robot, left, right) = pair().await;
        let sender = left.sender::<Note>("right:acc");

        for n in 0..100 {
            if n % 20 == 10 {
                left.net.router().do_send(PanicOnPurpose);
            }
            sender.tell(Note(n)).unwrap();
            advance(5 * MS).await;
        }
        advance(500 * MS).await;

        assert_eq!(right.log.take(), (0..100).collect::<Vec<_>>());
        let exits = left.exits.drain();
        assert_eq!(exits.len(), 5);
        assert!(exits.iter().all(|exit| {
            exit.object == ObjectName::new("net/router").unwrap() && exit.restarted_as.is_some()
        }));
        let lost = left.nodes.drain().into_iter().chain(right.nodes.drain());
        assert!(lost.into_iter().all(|report| report.condition == NodeCondition::Reachable));
    });
}

#[test]
fn a_panic_in_any_actor_of_the_network_is_survived_and_every_promise_resolved() {
    paused(async {
        let (_robot, left, right) = pair().await;
        let count = left.net.victims().len();
        assert_eq!(count, 5);
        for victim in 0..count {
            for module in [&left, &right] {
                let asked: Vec<_> = (0..10)
                    .map(|_| {
                        let sender = left.sender::<Add>("right:acc");
                        actix_rt::spawn(async move { sender.ask_within(Add(1), 60_000 * MS).await })
                    })
                    .collect();
                module.net.victims()[victim].do_send(PanicOnPurpose);
                let told = platform::now();
                for asked in asked {
                    // The reply, or why there is none: never nothing.
                    let _ = asked.await.unwrap();
                }
                assert!(platform::now() - told < 3000 * MS, "{victim}");
                advance(2000 * MS).await;

                let reply = left.sender::<Add>("right:acc").ask(Add(0)).await;
                assert!(reply.is_ok(), "{victim}: {reply:?}");
                right.log.take();
                left.publisher().publish(Note(7)).unwrap();
                advance(50 * MS).await;
                assert_eq!(right.log.take(), [7], "{victim}");
            }
        }
        assert_eq!(left.exits.drain().len(), count);
        let lost = left.nodes.drain().into_iter().chain(right.nodes.drain());
        let lost = lost.filter(|report| matches!(report.condition, NodeCondition::Lost { .. }));
        assert_eq!(lost.count(), 0);
    });
}

#[test]
fn a_panic_in_the_sessions_gives_back_only_what_that_session_held() {
    paused(async {
        let (_robot, left, right) = pair().await;
        let sender = left.sender::<Note>("right:acc");
        sender.tell(Note(0)).unwrap();
        advance(10 * MS).await;

        for n in 1..50 {
            sender.tell(Note(n)).unwrap();
        }
        left.net.victims()[1].do_send(PanicOnPurpose);
        advance(1000 * MS).await;

        let arrived = right.log.take();
        let buried = left.host.dead_letters.total();
        assert!(arrived.is_sorted());
        assert!(arrived.len() as u64 + buried >= 50, "{} arrived, {buried} told", arrived.len());
    });
}

#[test]
fn a_node_that_dies_and_returns_is_a_new_life_and_what_it_owed_is_resolved() {
    paused(async {
        let mut robot = Robot::default();
        let left = robot.module("left", 1, &[("ethernet", &["right"])]).await;
        let right = robot.module("right", 1, &[("ethernet", &["left"])]).await;
        advance(500 * MS).await;
        let sender = left.sender::<Add>("right:acc");
        assert_eq!(sender.ask(Add(3)).await.unwrap(), 3);

        robot.kill("ethernet/right");
        drop(right);
        let asked = actix_rt::spawn(async move { sender.ask_within(Add(1), 60_000 * MS).await });
        advance(20 * MS).await;
        let right = robot.module("right", 2, &[("ethernet", &["left"])]).await;
        advance(1000 * MS).await;

        let error = asked.await.unwrap().unwrap_err();
        assert_eq!(error.why, Why::PeerDied { incarnation: Incarnation(1) });
        assert_eq!(left.sender::<Add>("right:acc").ask(Add(5)).await.unwrap(), 5);
        left.publisher().publish(Note(7)).unwrap();
        advance(10 * MS).await;
        assert_eq!(right.log.take(), [7]);
        let reports = left.nodes.drain();
        assert!(reports.iter().any(|report| report.incarnation == Incarnation(2)));
    });
}

#[test]
fn a_node_that_stays_away_is_lost_and_what_it_owed_is_resolved() {
    paused(async {
        let (robot, left, _right) = pair().await;
        let sender = left.sender::<Add>("right:acc");
        assert_eq!(sender.ask(Add(3)).await.unwrap(), 3);

        robot.kill("ethernet/right");
        robot.kill("ieee1394/right");
        let error = sender.ask_within(Add(1), 60_000 * MS).await.unwrap_err();

        assert!(matches!(error.why, Why::OutcomeUnknown { .. }), "{}", error.why);
        let refused = left.sender::<Note>("right:acc").tell(Note(1)).unwrap_err();
        assert_eq!(refused.why, Why::Unreachable { node: "right".into() });
        let conditions: Vec<_> =
            left.nodes.drain().into_iter().map(|report| report.condition).collect();
        assert!(
            matches!(conditions[..], [NodeCondition::Reachable, NodeCondition::Lost { .. }]),
            "{conditions:?}"
        );
    });
}

#[test]
fn a_flood_is_refused_when_full_and_nothing_accepted_is_lost() {
    paused(async {
        let (robot, left, right) = pair().await;
        let sender = left.sender::<Note>("right:acc");
        robot.cut("ethernet/left");
        robot.cut("ieee1394/left");

        let mut accepted = 0;
        for n in 0..20_000 {
            match sender.tell(Note(n)) {
                Ok(()) => accepted += 1,
                Err(error) => {
                    assert_eq!(error.why, Why::Full);
                    break;
                }
            }
            if n % 100 == 0 {
                settle().await;
            }
        }
        assert!((1000..20_000).contains(&accepted), "it has a bound: {accepted}");
        robot.restore("ethernet/left");
        robot.restore("ieee1394/left");
        sender.deliver(Note(accepted)).await.unwrap();
        advance(3000 * MS).await;

        assert_eq!(right.log.take(), (0..=accepted).collect::<Vec<_>>());
    });
}

#[test]
fn a_fault_is_told_to_another_nodes_recoverer_and_confirmed() {
    paused(async {
        let (robot, left, right) = pair().await;
        let port = left.net.recoverer_of(&NodeName::new("right").unwrap());
        let fault = Fault {
            id: FaultId(1),
            kind: FaultKind::Panic,
            severity: Severity::Error,
            place: Place::Object("left:acc".parse().unwrap()),
            incarnation: Incarnation(1),
            detail: "boom".into(),
            found_at: platform::now(),
            symptom_of: None,
            count: 1,
        };

        port.send(Recover { fault: fault.clone() }).await.unwrap();
        assert_eq!(right.faults.expect().await.fault.place, fault.place);

        robot.cut("ethernet/left");
        robot.cut("ieee1394/left");
        let unconfirmed = port.send(Recover { fault }).await;
        assert!(unconfirmed.is_err(), "the notifier has to know");
    });
}

#[test]
fn every_node_knows_the_objects_of_the_others() {
    paused(async {
        let (_robot, left, _right) = pair().await;

        let rows = left.net.read_names().await;

        let objects: Vec<_> =
            rows.iter().flat_map(|row| &row.objects).map(|o| o.to_string()).collect();
        assert_eq!(objects, ["right:acc"]);
        let links = left.net.read_links().await;
        assert!(links.iter().all(|row| row.quality.round_trip.is_some()));
        assert_eq!(left.net.read_sessions().await.len(), 1);
    });
}

#[test]
fn a_node_that_leaves_in_order_delivers_first() {
    paused(async {
        let (_robot, left, right) = pair().await;

        for n in 0..10 {
            left.sender::<Note>("right:acc").tell(Note(n)).unwrap();
        }
        left.net.leave();
        advance(100 * MS).await;

        assert_eq!(right.log.take(), (0..10).collect::<Vec<_>>());
        let why = right.sender::<Add>("left:acc").ask(Add(1)).await.unwrap_err().why;
        assert_eq!(why, Why::Left { node: "left".into() });
        let told = right.nodes.drain().into_iter().map(|report| report.condition);
        let told: Vec<_> = told.collect();
        assert_eq!(told, [NodeCondition::Reachable, NodeCondition::Left]);
    });
}

#[test]
fn what_grew_old_on_the_way_is_not_delivered_but_counted() {
    paused(async {
        let (robot, left, right) = pair().await;
        let publisher = left.host.topics.publisher::<Fresh>(Fresh::NAME).unwrap();
        let sender = left.sender::<Fresh>("right:acc");
        publisher.publish(Fresh(1)).unwrap();
        sender.tell(Fresh(2)).unwrap();
        advance(10 * MS).await;
        assert_eq!(right.log.take(), [1, 2]);

        for end in ["ethernet/left", "ieee1394/left"] {
            robot.cut(end);
        }
        publisher.publish(Fresh(3)).unwrap();
        sender.tell(Fresh(4)).unwrap();
        left.sender::<Note>("right:acc").tell(Note(5)).unwrap();
        advance(500 * MS).await;
        for end in ["ethernet/left", "ieee1394/left"] {
            robot.restore(end);
        }
        advance(1000 * MS).await;
        publisher.publish(Fresh(6)).unwrap();
        advance(10 * MS).await;

        assert_eq!(right.log.take(), [5, 6]);
        let acc = ObjectName::new("acc").unwrap();
        assert_eq!(right.host.dead_letters.count(&acc, DeadReason::Expired), 2);
    });
}

#[test]
fn a_medium_that_cannot_be_opened_is_told_as_its_links_being_down() {
    paused(async {
        let (mut robot, left, _right) = pair().await;
        left.links.drain();

        // Its end of the medium is taken.
        let usurper = robot.module("left", 2, &[("ethernet", &["right"])]).await;
        advance(10 * MS).await;

        let told = usurper.links.expect().await;
        let LinkCondition::Down { reason } = told.condition else { panic!("{told:?}") };
        assert!(reason.contains("ethernet/left"), "{reason}");
        assert_eq!(left.links.drain(), []);
    });
}

#[test]
fn two_links_of_one_name_are_refused_before_anything_starts() {
    paused(async {
        let robot = Robot::default();
        let host = HostEnvironment::new(Arbiters::here(), Reports::default());
        let exits = Probe::start();
        let memory = Memory::new(MemoryConfig::new(&robot.medium, "x")).start();
        let link = |to: &str| LinkSpec::new("same", MediumAddress::Memory(to.into()));
        let spec = NetworkSpec {
            name: "ethernet".into(),
            transport: Transport::from(memory),
            interface: None,
            links: vec![link("left"), link("right")],
            discovery: None,
        };
        let environment = NetEnvironment {
            node: NodeName::new("left").unwrap(),
            incarnation: Incarnation(1),
            guardian: Guardian::reporting_to(exits.recipient()),
            arbiter: None,
            registry: host.registry.clone(),
            topics: host.topics.clone(),
            dead_letters: host.dead_letters.clone(),
            recoverer: None,
            links: None,
            nodes: None,
            faults: None,
            mended: None,
            judges: Judges::Majority,
            envoys: Vec::new(),
        };

        let refused = start(environment, vec![spec]).err().unwrap();

        assert!(refused.to_string().contains("two links are called same"));
    });
}
