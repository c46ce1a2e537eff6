//! Links to neighbours that are not described: found by the beacons on this network, or operators
//! that come by themselves, for no node describes where an operator is.

use super::LinksActor;
use crate::net::LinkSpec;
use crate::net::keys::NodeKeys;
use crate::platform;
use crate::runtime::driver::MachineActor;
use actix::prelude::*;
use blastema_contract::link::LinkChanged;
use blastema_contract::transport::{
    Attach, MediumAddress, Received, Transmit, Transport, TransportReport,
};
use blastema_core::detection::LinkCondition;
use blastema_core::net::discovery::{
    Discovery, DiscoveryAdmission, DiscoveryConfig, DiscoveryOutput,
};
use blastema_core::net::refusal_alarms::RefusalAlarms;
use blastema_core::net::routing::{LinkHealth, LinkStatus};
use blastema_core::net::trust::beacon::{BeaconKeys, CheckedBeacon};
use blastema_core::net::{HELLO_INTERVAL, LinkId, LinkState, NodeId, PEER_TIMEOUT};
use blastema_core::{FaultKind, Instant, NodeName, SlidingWindow};
use bytes::Bytes;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;
use tracing::{debug, info, warn};

/// How often a beacon is sent. With it a node that joins is found within a second.
const BEACON_INTERVAL: Duration = Duration::from_secs(1);
/// Beacons that are listened to in a second: each node on the network sends one.
const BEACONS_MAX: u32 = 1000;
/// So many operators have a link on one network that no node describes: one at work, and one whose
/// program has just ended.
pub(in crate::net) const DIALED_IN_MAX: usize = 2;
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

/// What the links of a network that discovers know of its beacons.
pub(super) struct NetworkDiscovery {
    node: NodeName,
    spec: DiscoverySpec,
    machine: Discovery,
    /// The numbers of links that it may make.
    numbers: Vec<LinkId>,
    alarms: RefusalAlarms<()>,
    /// Those of the pairs, where nodes have keys.
    keys: Option<BeaconKeys>,
    /// The port at which the network is open, for beacons.
    port: Option<u16>,
}

impl NetworkDiscovery {
    pub(super) fn new(
        node: NodeName,
        spec: DiscoverySpec,
        numbers: Vec<LinkId>,
        keys: Option<&NodeKeys>,
    ) -> Self {
        let machine = Discovery::new(DiscoveryConfig::new(node.clone(), spec.admission.clone()));
        NetworkDiscovery {
            node,
            spec,
            machine,
            numbers,
            alarms: RefusalAlarms::default(),
            keys: keys.map(NodeKeys::beacon_keys),
            port: None,
        }
    }

    /// Begins again with these links: their numbers, their nodes, and where these are.
    pub(super) fn restart<'a>(&mut self, links: impl Iterator<Item = (LinkId, &'a LinkSpec)>) {
        let (config, now) = (self.spec.admission.clone(), platform::now());
        self.machine = Discovery::new(DiscoveryConfig::new(self.node.clone(), config));
        self.alarms = RefusalAlarms::default();
        for (number, LinkSpec { neighbour, remote, .. }) in links {
            let Some(node) = neighbour.clone() else { continue };
            match self.numbers.contains(&number) {
                true => self.machine.handle_learned(node, remote.to_string(), now),
                false => self.machine.handle_link(node, remote.to_string(), false, now),
            }
        }
    }

    pub(super) fn handle_roster(&mut self, keys: &NodeKeys) {
        self.keys = Some(keys.beacon_keys());
    }

    fn say_beacons(&self) {
        let Some(port) = self.port else { return };
        let frames = match &self.keys {
            Some(keys) => keys.beacons(port).into_iter().map(Bytes::from).collect(),
            None => vec![beacon(&self.node, port)],
        };
        let (transport, group) = &self.spec.beacons;
        for frame in frames {
            let to = MediumAddress::Ip(*group);
            transport.transmit.do_send(Transmit::new(to, frame.into()));
        }
    }

    fn handle_beacon(&mut self, from: IpAddr, frame: &[u8]) {
        let now = platform::now();
        let read = match self.keys.as_mut().map(|keys| keys.check(frame, now)) {
            None => read_beacon(frame),
            Some(CheckedBeacon::Node(node, port)) => Some((node, port)),
            Some(CheckedBeacon::NotForUs) => return,
            Some(CheckedBeacon::Forged) => None,
        };
        match read {
            Some((node, port)) => {
                let address = SocketAddr::new(from, port).to_string();
                self.machine.handle_beacon(node, address, now);
            }
            None => self.machine.handle_noise(),
        }
    }
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

/// Hears the beacons of one network: its links hear another transport.
struct BeaconReceiver {
    links: Recipient<BeaconReport>,
    /// Those of the last second that were passed on.
    heard: SlidingWindow,
}

impl BeaconReceiver {
    fn new(links: Recipient<BeaconReport>) -> Self {
        BeaconReceiver { links, heard: SlidingWindow::new(BEACONS_MAX, BEACON_INTERVAL) }
    }

    /// A flood is heard in part: enough to be refused, counted and named.
    fn handle_frame(&mut self, from: MediumAddress, frame: Bytes, now: Instant) {
        if let MediumAddress::Ip(from) = from
            && self.heard.add((), now)
        {
            self.links.do_send(BeaconReport::Received { from: from.ip(), frame });
        }
    }
}

impl Actor for BeaconReceiver {
    type Context = Context<Self>;
}

impl Handler<Received> for BeaconReceiver {
    type Result = ();

    fn handle(&mut self, Received { from, frame }: Received, _: &mut Context<Self>) {
        self.handle_frame(from, frame, platform::now());
    }
}

impl Handler<TransportReport> for BeaconReceiver {
    type Result = ();

    fn handle(&mut self, report: TransportReport, _: &mut Context<Self>) {
        match report {
            TransportReport::Opened { .. } => self.links.do_send(BeaconReport::Opened),
            TransportReport::Closed { reason } => warn!("no beacons: {reason}"),
            TransportReport::Ended
            | TransportReport::Rate { .. }
            | TransportReport::PeerLost { .. }
            | TransportReport::Clash { .. } => {}
        }
    }
}

/// From the transport of the beacons.
#[derive(Message)]
#[rtype(result = "()")]
enum BeaconReport {
    /// The group's socket is open.
    Opened,
    /// A beacon, or another frame to the group.
    Received { from: IpAddr, frame: Bytes },
}

impl Handler<BeaconReport> for LinksActor {
    type Result = ();

    fn handle(&mut self, report: BeaconReport, context: &mut Context<Self>) {
        let Some(discovery) = &mut self.discovery else { return };
        match report {
            BeaconReport::Opened => discovery.say_beacons(),
            BeaconReport::Received { from, frame } => discovery.handle_beacon(from, &frame),
        }
        self.follow_discovery();
        self.drive(context);
    }
}

impl LinksActor {
    /// The operators of the roster are let in from wherever they come. Links that were made for
    /// some before the links were built again are gone with them.
    pub(super) fn let_operators_dial_in(&mut self) {
        let Some((keys, _)) = &self.recipients.seal else { return };
        if let Err(error) = self.link_layer.set_dial_in(keys.operators()) {
            warn!(network = %self.recipients.network, "an operator cannot connect: {error}");
        }
    }

    /// An operator has proved itself and has no link here yet.
    pub(super) fn dialed_in(&mut self, peer: NodeId, address: MediumAddress) {
        let node = self.recipients.seal.as_ref().and_then(|(keys, _)| keys.name_of(peer).cloned());
        let Some(node) = node else { return };
        let number =
            self.recipients.dial_in.iter().find(|number| !self.specs.contains_key(*number));
        let Some(&number) = number else {
            let network = &self.recipients.network;
            debug!(%network, %node, "{DIALED_IN_MAX} operators are connected");
            return;
        };
        let spec = LinkSpec {
            name: format!("{}/{node}", self.recipients.network).into(),
            remote: address.clone(),
            neighbour: Some(node.clone()),
            cost: None,
            hello_interval: HELLO_INTERVAL,
            expected_within: PEER_TIMEOUT,
        };
        let now = platform::now();
        let link = super::link(&self.recipients, &spec, now);
        if self.link_layer.insert_dialed_in(number, link, peer, address.clone(), now) {
            info!(network = %self.recipients.network, %node, %address, "an operator connects");
            self.specs.insert(number, spec);
        } else {
            // It is told with each frame; a medium with connections needs the operator's address.
            debug!(network = %self.recipients.network, %node, %address, "no link to the operator");
        }
    }

    /// Forgets such links before the links are built again: operators connect again.
    pub(super) fn forget_dialed_in(&mut self) {
        let numbers = self.recipients.dial_in.clone().into_iter();
        let numbers: Vec<_> = numbers.filter(|number| self.specs.contains_key(number)).collect();
        numbers.into_iter().for_each(|number| self.remove(number));
    }

    /// Hears and sends beacons from now on.
    pub(super) fn attach_beacons(&self, context: &mut Context<Self>) {
        let Some(discovery) = &self.discovery else { return };
        let receiver = BeaconReceiver::new(context.address().recipient()).start();
        let (transport, _) = &discovery.spec.beacons;
        transport.attach.do_send(Attach::new(receiver.clone().recipient(), receiver.recipient()));
        context.run_interval(BEACON_INTERVAL, |links, context| {
            links.look_at_beacons();
            links.drive(context);
        });
    }

    /// Sends a beacon, gives up who was learned of and is not there, and raises an alarm while
    /// beacons are refused for seconds.
    fn look_at_beacons(&mut self) {
        let Some(discovery) = &mut self.discovery else { return };
        discovery.say_beacons();
        discovery.machine.handle_time(platform::now());
        let refusals = discovery.machine.refusals();
        for ((), since) in discovery.alarms.handle_look([((), refusals)]) {
            let detail = format!(
                "of the neighbours that are told by beacons, many are refused all the time: {since}"
            );
            warn!("{detail}");
            self.recipients.faults.declare_passing(FaultKind::CheckFailed, detail);
        }
        self.follow_discovery();
    }

    fn follow_discovery(&mut self) {
        while let Some(output) =
            self.discovery.as_mut().and_then(|discovery| discovery.machine.poll_output())
        {
            match output {
                DiscoveryOutput::Connect { node, address } => self.connect(node, &address),
                DiscoveryOutput::Disconnect { node } => self.disconnect(&node),
            }
        }
    }

    fn connect(&mut self, node: NodeName, address: &str) {
        let Some(discovery) = &self.discovery else { return };
        let free = discovery.numbers.iter().find(|number| !self.specs.contains_key(*number));
        let remote = address.parse().map(MediumAddress::Ip);
        let (Some(&number), Ok(remote)) = (free, remote) else { return };
        // Where a link leads already, none is needed.
        if self.link_layer.link_at(&remote).is_some() {
            return;
        }
        let network = self.recipients.network.clone();
        info!(%network, %node, %remote, "a neighbour is learned of");
        let spec = LinkSpec {
            name: format!("{network}/{node}").into(),
            remote,
            neighbour: Some(node),
            cost: None,
            hello_interval: discovery.spec.hello_interval,
            expected_within: Duration::MAX,
        };
        match self.insert(number, &spec, platform::now()) {
            Ok(()) => drop(self.specs.insert(number, spec)),
            // Another address of a node that has a link here, or a node without a key.
            Err(error) => debug!(%network, link = %spec.name, "{error}"),
        }
    }

    fn disconnect(&mut self, node: &NodeName) {
        let network = &self.recipients.network;
        info!(%network, %node, "a neighbour that was learned of is given up");
        let Some(discovery) = &self.discovery else { return };
        let leads_there = |number: &&LinkId| {
            self.specs.get(*number).is_some_and(|spec| spec.neighbour.as_ref() == Some(node))
        };
        if let Some(&number) = discovery.numbers.iter().find(leads_there) {
            self.remove(number);
        }
    }

    /// Takes a link out that was not described.
    pub(super) fn remove(&mut self, number: LinkId) {
        if let Some(status) = self.reported.remove(&number) {
            let status = LinkStatus { health: LinkHealth::Down, ..status };
            let remote = self.remote(number);
            self.recipients.router_changes.do_send(LinkChanged { link: number, status, remote });
        }
        self.tell_monitor(number, LinkCondition::Forgotten);
        self.link_layer.remove(number);
        self.free_names(|names| names.forget(number));
        self.specs.remove(&number);
    }

    /// Tells discovery whether a link is up, and with whom.
    pub(super) fn tell_discovery(&mut self, number: LinkId, state: LinkState) {
        // An operator dials in again by itself.
        let described =
            self.specs.get(&number).filter(|_| !self.recipients.dial_in.contains(&number));
        let (Some(discovery), Some(spec)) = (&mut self.discovery, described) else { return };
        let up = match state {
            LinkState::Up => true,
            LinkState::Down => false,
            LinkState::Connecting | LinkState::Suspect => return,
        };
        let peer = self.link_layer.get(number).and_then(|link| link.neighbour());
        let node = peer.map(|peer| peer.node.clone()).or(spec.neighbour.clone());
        if let Some(node) = node {
            discovery.machine.handle_link(node, spec.remote.to_string(), up, platform::now());
        }
    }

    /// Tells at which port this network is open.
    pub(super) fn tell_port(&mut self, local: &MediumAddress) {
        if let (Some(discovery), MediumAddress::Ip(local)) = (&mut self.discovery, local) {
            discovery.port = Some(local.port());
            discovery.say_beacons();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    /// Counts the beacons that reach the links.
    struct Counter(Arc<AtomicU32>);

    impl Actor for Counter {
        type Context = Context<Self>;
    }

    impl Handler<BeaconReport> for Counter {
        type Result = ();

        fn handle(&mut self, _: BeaconReport, _: &mut Context<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }

    #[test]
    fn of_a_flood_no_more_than_a_second_allows_is_passed_on() {
        let passed = Arc::new(AtomicU32::new(0));
        let counted = passed.clone();
        System::new().block_on(async move {
            let mut receiver = BeaconReceiver::new(Counter(counted).start().recipient());
            let from = MediumAddress::Ip(SocketAddr::from(([10, 0, 0, 1], 7400)));
            for millis in [0, 1001] {
                for _ in 0..2 * BEACONS_MAX {
                    let now = Instant::from_millis(millis);
                    receiver.handle_frame(from.clone(), Bytes::new(), now);
                }
            }
            while passed.load(Ordering::Relaxed) < 2 * BEACONS_MAX {
                actix::clock::sleep(Duration::from_millis(1)).await;
            }
            actix::clock::sleep(Duration::from_millis(20)).await;
            assert_eq!(passed.load(Ordering::Relaxed), 2 * BEACONS_MAX);
        });
    }

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
