//! Drives discovery: finds neighbours that are not in the node's configuration by their beacons.

use super::LinkSpec;
use super::fault_reporter::FaultReporter;
use super::keys::NodeKeys;
use super::links::{AddDiscoveredLink, NeighbourChange, RemoveDiscoveredLink, ReportNeighbours};
use super::roster_watch::RosterChanged;
use crate::platform;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use actix::prelude::*;
use blastema_contract::router::InjectPanic;
use blastema_contract::transport::{
    Attach, MediumAddress, Received, Transmit, Transport, TransportReport,
};
use blastema_core::net::LinkId;
use blastema_core::net::discovery::{Discovery, DiscoveryAdmission, DiscoveryOutput};
use blastema_core::net::refusal_alarms::RefusalAlarms;
use blastema_core::net::trust::beacon::{BeaconKeys, CheckedBeacon};
use blastema_core::sorted::{SortedMap, SortedSet};
use blastema_core::{FaultKind, NodeName};
use bytes::Bytes;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;
use tracing::{info, warn};

/// How often it is looked at what was refused.
const REFUSAL_CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// How often a beacon is sent. With it a node that joins is found within a second.
const BEACON_INTERVAL: Duration = Duration::from_secs(1);
/// Beacons of one network that are listened to in a second: each node there sends one.
const BEACONS_MAX: u32 = 1000;
/// The first bytes of a beacon, with its version.
const BEACON_MARK: &[u8] = b"BLB\x01";

/// How a network discovers.
#[derive(Clone, Debug)]
pub(crate) struct DiscoverySpec {
    pub(crate) admission: DiscoveryAdmission,
    /// How often hellos are said on a link that is learned.
    pub(crate) hello_interval: Duration,
    /// Where beacons are sent and heard, and to whom they go.
    pub(crate) beacons: (Transport, SocketAddr),
}

/// A network that discovers, as the body sees it.
pub(super) struct DiscoveryNetwork {
    pub(super) network: Arc<str>,
    pub(super) spec: DiscoverySpec,
    /// The numbers of links that it may make there.
    pub(super) numbers: Vec<LinkId>,
    /// Neighbours that were described.
    pub(super) described: Vec<(NodeName, MediumAddress)>,
}

/// The recipients that it reports to.
pub(super) struct DiscoveryRecipients {
    pub(super) node: NodeName,
    pub(super) fields: Vec<DiscoveryNetwork>,
    pub(super) faults: FaultReporter,
    /// With which beacons are authenticated.
    pub(super) keys: Option<Arc<NodeKeys>>,
}

/// The links of the networks that discover, in their order. They are made after the body.
#[derive(Clone, Message)]
#[rtype(result = "()")]
pub(super) struct AddNetworks(pub(super) Vec<NetworkLinks>);

/// The links of one network.
#[derive(Clone)]
pub(super) struct NetworkLinks {
    pub(super) learn: Recipient<AddDiscoveredLink>,
    pub(super) forget: Recipient<RemoveDiscoveredLink>,
    pub(super) tell: Recipient<ReportNeighbours>,
}

/// The body.
pub(super) struct DiscoveryActor {
    wiring: DiscoveryRecipients,
    links: Vec<NetworkLinks>,
    machine: Discovery,
    wake: WakeTimer,
    /// Links that were made: at most so many for each network as it has numbers.
    made: SortedMap<(usize, NodeName), (LinkId, MediumAddress)>,
    complaints: RefusalAlarms<()>,
    /// Those of the pairs, where nodes have keys.
    beacon_keys: Option<BeaconKeys>,
    /// The ports at which our networks are open, for beacons.
    ports: SortedMap<usize, u16>,
}

impl DiscoveryActor {
    pub(super) fn new(wiring: DiscoveryRecipients) -> Self {
        DiscoveryActor {
            machine: begin(&wiring),
            links: Vec::new(),
            wake: WakeTimer::default(),
            made: SortedMap::new(),
            complaints: RefusalAlarms::default(),
            beacon_keys: wiring.keys.as_ref().map(|keys| keys.beacon_keys()),
            ports: SortedMap::new(),
            wiring,
        }
    }

    fn connect(&mut self, domain: usize, node: NodeName, address: &str) {
        let (Some(field), Some(links)) = (self.wiring.fields.get(domain), self.links.get(domain))
        else {
            return;
        };
        let taken: SortedSet<_> = self.made.values().map(|(number, _)| *number).collect();
        let number = field.numbers.iter().find(|number| !taken.contains(number)).copied();
        let remote = address.parse().map(MediumAddress::Ip);
        let (Some(number), Ok(remote)) = (number, remote) else { return };
        info!(network = %field.network, %node, %remote, "a neighbour is learned of");
        let spec = LinkSpec {
            name: format!("{}/{node}", field.network).into(),
            remote: remote.clone(),
            neighbour: Some(node.clone()),
            cost: None,
            hello_interval: field.spec.hello_interval,
            expected_within: Duration::MAX,
        };
        self.made.insert((domain, node), (number, remote));
        links.learn.do_send(AddDiscoveredLink { number, spec });
    }

    fn disconnect(&mut self, domain: usize, node: NodeName) {
        info!(%node, "a neighbour that was learned of is given up");
        let made = self.made.remove(&(domain, node));
        if let (Some((number, _)), Some(links)) = (made, self.links.get(domain)) {
            links.forget.do_send(RemoveDiscoveredLink { number });
        }
    }

    /// Raises an alarm while beacons are refused for seconds.
    fn look_at_refusals(&mut self) {
        if let Some(since) = self.complaints.handle_look((), self.machine.refusals()) {
            let detail = format!(
                "of the neighbours that are told by beacons, many are refused all the time: {since}"
            );
            warn!("{detail}");
            self.wiring.faults.declare_passing(FaultKind::CheckFailed, detail);
        }
    }

    fn say_beacons(&self) {
        for (domain, field) in self.wiring.fields.iter().enumerate() {
            let (transport, group) = &field.spec.beacons;
            let Some(port) = self.ports.get(&domain) else { continue };
            let frames = match &self.beacon_keys {
                Some(keys) => keys.beacons(*port).into_iter().map(Bytes::from).collect(),
                None => vec![beacon(&self.wiring.node, *port)],
            };
            for frame in frames {
                let to = MediumAddress::Ip(*group);
                transport.transmit.do_send(Transmit::new(to, frame.into()));
            }
        }
    }

    fn attach(&self, context: &mut Context<Self>) {
        for (domain, field) in self.wiring.fields.iter().enumerate() {
            let (transport, _) = &field.spec.beacons;
            let (frames, reports) = (context.address(), context.address());
            let ears = Ears { domain, body: frames, left: BEACONS_MAX }.start();
            transport.attach.do_send(Attach::new(ears.recipient(), reports.recipient()));
        }
    }
}

fn begin(wiring: &DiscoveryRecipients) -> Discovery {
    let admissions = wiring.fields.iter().map(|field| field.spec.admission.clone()).collect();
    let now = platform::now();
    let mut machine = Discovery::new(wiring.node.clone(), admissions);
    for (domain, field) in wiring.fields.iter().enumerate() {
        for (node, address) in &field.described {
            machine.handle_link((domain, node.clone()), address.to_string(), false, now);
        }
    }
    machine
}

/// Without keys:
///
/// ```text
/// BLB 3 │ version 1 │ port 2 │ name to the end
/// ```
fn beacon(node: &NodeName, port: u16) -> Bytes {
    [BEACON_MARK, &port.to_be_bytes(), node.as_str().as_bytes()].concat().into()
}

fn read_beacon(frame: &[u8]) -> Option<(NodeName, u16)> {
    let rest = frame.strip_prefix(BEACON_MARK)?;
    let (port, name) = rest.split_first_chunk::<2>()?;
    let name = std::str::from_utf8(name).ok()?;
    let port = u16::from_be_bytes(*port);
    (port > 0).then_some((NodeName::new(name).ok()?, port))
}

/// Hears the beacons of one network.
struct Ears {
    domain: usize,
    body: Addr<DiscoveryActor>,
    /// So many are still listened to until the next look.
    left: u32,
}

impl Actor for Ears {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        context.run_interval(REFUSAL_CHECK_INTERVAL, |ears, _| ears.left = BEACONS_MAX);
    }
}

impl Handler<Received> for Ears {
    type Result = ();

    fn handle(&mut self, Received { from, frame }: Received, _: &mut Context<Self>) {
        if let MediumAddress::Ip(from) = from {
            // A flood is heard in part: enough to be refused, counted and named.
            let Some(left) = self.left.checked_sub(1) else { return };
            self.left = left;
            self.body.do_send(Beacon { domain: self.domain, from: from.ip(), frame });
        }
    }
}

/// A beacon, or another frame to the group.
#[derive(Message)]
#[rtype(result = "()")]
struct Beacon {
    domain: usize,
    from: IpAddr,
    frame: Bytes,
}

answers_the_monitor!(DiscoveryActor);

impl Actor for DiscoveryActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        context.run_interval(REFUSAL_CHECK_INTERVAL, |body, _| body.look_at_refusals());
        self.attach(context);
        context.run_interval(BEACON_INTERVAL, |body, _| body.say_beacons());
        self.drive(context);
    }
}

impl Supervised for DiscoveryActor {
    /// The links that it has made stay; who is up, it is told again.
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.machine = begin(&self.wiring);
        for ((domain, node), (_, address)) in &self.made {
            let (node, address) = (node.clone(), address.to_string());
            self.machine.handle_learned(*domain, node, address, platform::now());
        }
        self.links.iter().for_each(|links| links.tell.do_send(ReportNeighbours));
        self.wake = WakeTimer::default();
        self.complaints = RefusalAlarms::default();
        self.started(context);
    }
}

impl MachineActor for DiscoveryActor {
    type Machine = Discovery;

    fn driven(&mut self) -> (&mut Discovery, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, output: DiscoveryOutput, _: &mut Context<Self>) {
        match output {
            DiscoveryOutput::Connect { domain, node, address } => {
                self.connect(domain, node, &address);
            }
            DiscoveryOutput::Disconnect { domain, node } => self.disconnect(domain, node),
        }
    }
}

impl Handler<AddNetworks> for DiscoveryActor {
    type Result = ();

    fn handle(&mut self, AddNetworks(links): AddNetworks, _: &mut Context<Self>) {
        self.links = links;
    }
}

impl Handler<NeighbourChange> for DiscoveryActor {
    type Result = ();

    fn handle(&mut self, seen: NeighbourChange, context: &mut Context<Self>) {
        match seen {
            NeighbourChange::Neighbour { domain, node, remote, up } => {
                let (address, now) = (remote.to_string(), platform::now());
                self.machine.handle_link((domain, node), address, up, now);
                self.drive(context);
            }
            NeighbourChange::Open { domain, port } => {
                self.ports.insert(domain, port);
                self.say_beacons();
            }
        }
    }
}

impl Handler<Beacon> for DiscoveryActor {
    type Result = ();

    fn handle(&mut self, beacon: Beacon, context: &mut Context<Self>) {
        let Beacon { domain, from, frame } = beacon;
        let now = platform::now();
        let read = match self.beacon_keys.as_mut().map(|keys| keys.check(&frame, now)) {
            None => read_beacon(&frame),
            Some(CheckedBeacon::Node(node, port)) => Some((node, port)),
            Some(CheckedBeacon::NotForUs) => return,
            Some(CheckedBeacon::Forged) => None,
        };
        match read {
            Some((node, port)) => {
                let address = SocketAddr::new(from, port).to_string();
                self.machine.handle_beacon(domain, node, address, now);
            }
            None => self.machine.handle_noise(),
        }
        self.drive(context);
    }
}

impl Handler<RosterChanged> for DiscoveryActor {
    type Result = ();

    fn handle(&mut self, RosterChanged(keys): RosterChanged, _: &mut Context<Self>) {
        self.beacon_keys = Some(keys.beacon_keys());
        self.wiring.keys = Some(keys);
    }
}

impl Handler<TransportReport> for DiscoveryActor {
    type Result = ();

    fn handle(&mut self, report: TransportReport, _: &mut Context<Self>) {
        match report {
            TransportReport::Opened { .. } => self.say_beacons(),
            TransportReport::Closed { reason } => warn!("no beacons: {reason}"),
            TransportReport::Ended
            | TransportReport::Rate { .. }
            | TransportReport::PeerLost { .. }
            | TransportReport::Clash { .. } => {}
        }
    }
}

impl Handler<InjectPanic> for DiscoveryActor {
    type Result = ();

    fn handle(&mut self, _: InjectPanic, _: &mut Context<Self>) {
        panic!("the discovery panics on purpose");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_beacon_says_who_is_at_which_port_and_nothing_else_is_one() {
        let node = NodeName::new("module1").unwrap();
        assert_eq!(&beacon(&node, 7400)[..], b"BLB\x01\x1c\xe8module1");
        assert_eq!(read_beacon(&beacon(&node, 7400)), Some((node, 7400)));
        for noise in [
            &b""[..],
            b"BLB\x01\0",
            b"BLB\x02\0\0a",
            b"BLB\x01\0\x01",
            b"BLB\x01\0\x01a b",
            b"BLB\x01\0\0a",
        ] {
            assert_eq!(read_beacon(noise), None, "{noise:?}");
        }
    }
}
