//! The body of the links over one transport.

mod discovered;
mod fault_reports;

pub(super) use discovered::DIALED_IN_MAX;
pub(crate) use discovered::DiscoverySpec;

use discovered::NetworkDiscovery;
use fault_reports::NamesTaken;

use super::LinkSpec;
use super::keys::{NodeKeys, SealTerms};
use super::own_name::OwnName;
use super::roster_watch::RosterChanged;
use crate::platform;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use crate::runtime::reports::FaultReporter;
use actix::prelude::*;
use blastema_contract::link::{
    CarrierChanged, LinkChanged, LinkPayload, LinkRow, LinkSeal, ReadLinks, ReceivedOnLink,
    TransmitOnLink,
};
use blastema_contract::monitor::LinkReported;
use blastema_contract::reports::LivenessReported;
use blastema_contract::router::InjectPanic;
use blastema_contract::transport::{
    Adopt, Attach, ConnectionTrust, MediumAddress, Received, Transmit, Transport, TransportReport,
};
use blastema_core::detection::LinkCondition;
use blastema_core::detection::hang::LivenessEvent;
use blastema_core::net::refusal_alarms::RefusalAlarms;
use blastema_core::net::routing::{LinkHealth, LinkStatus, MTU_MIN};
use blastema_core::net::seal::{ChannelStatus, CipherSuite, FrameLane, NoiseCrypto, SealProfile};
use blastema_core::net::{
    AddLinkError, ByteRates, Link, LinkConfig, LinkId, LinkLayer, LinkLayerOutput, LinkOutput,
    LinkState,
};
use blastema_core::sorted::SortedMap;
use blastema_core::{GatherBuffer, Incarnation, Instant, NodeName};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;
use tracing::{error, info, warn};

/// The cost of a link without a configured one, over a medium of a megabyte per second and more.
const USUAL_COST: u64 = 10;
/// What it costs at most for its medium's slowness: a way over many fast links may still be too
/// long.
const SLOW_COST: u64 = 1000;
/// And how many times as much one that has just failed, until it has proved itself: as one that
/// loses a tenth.
const DISTRUSTED: u64 = 8;

/// A link as it is described; the link layer tells it of the medium.
fn link(recipients: &LinksRecipients, spec: &LinkSpec, now: Instant) -> Link {
    let LinksRecipients { node, incarnation, .. } = recipients;
    let config = LinkConfig {
        expected: spec.neighbour.clone(),
        peer_timeout: spec.expected_within,
        hello_interval: spec.hello_interval,
        ..LinkConfig::new(node.clone(), *incarnation)
    };
    Link::new(config, now)
}

/// How often it is looked at what was refused.
const REFUSAL_CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// The actors and recipients that the links report to.
pub(super) struct LinksRecipients {
    pub(super) node: NodeName,
    pub(super) incarnation: Incarnation,
    pub(super) own_name: OwnName,
    pub(super) network: Arc<str>,
    pub(super) transport: Transport,
    pub(super) router_changes: Recipient<LinkChanged>,
    pub(super) router_loads: Recipient<ReceivedOnLink>,
    pub(super) monitor: Option<Recipient<LinkReported>>,
    pub(super) stalls: Option<Recipient<LivenessReported>>,
    pub(super) faults: FaultReporter,
    /// Where frames are sealed: by which keys, and how.
    pub(super) seal: Option<(Arc<NodeKeys>, SealTerms)>,
    /// The numbers of links to operators that come by themselves.
    pub(super) dial_in: Vec<LinkId>,
}

/// The links of one network.
pub(super) struct LinksActor {
    recipients: LinksRecipients,
    specs: SortedMap<LinkId, LinkSpec>,
    link_layer: LinkLayer<NoiseCrypto, MediumAddress>,
    rates: ByteRates<LinkId>,
    wake: WakeTimer,
    medium: MediumState,
    /// What the router was reported last: it must be taken back when the actor restarts.
    reported: SortedMap<LinkId, LinkStatus>,
    /// Those whose neighbour was never heard while the medium could not be opened.
    unheard: BTreeSet<LinkId>,
    alarms: RefusalAlarms<Option<LinkId>>,
    names: NamesTaken,
    /// Where neighbours are learned of.
    discovery: Option<NetworkDiscovery>,
}

/// The medium, as its transport has told.
#[derive(Default)]
struct MediumState {
    /// The largest frame with its seal, and whether paths may drop it; `None` while the medium is
    /// closed.
    mtu: Option<(usize, bool)>,
    /// Where this node is reached, for display.
    local: String,
    /// How much it carries; `None` where it is plenty.
    bytes_per_second: Option<u64>,
}

impl LinksActor {
    /// Neighbours are learned of as `discovery` says, and get these numbers.
    pub(super) fn new(
        recipients: LinksRecipients,
        specs: SortedMap<LinkId, LinkSpec>,
        discovery: Option<(DiscoverySpec, Vec<LinkId>)>,
    ) -> Self {
        let keys = recipients.seal.as_ref().map(|(keys, _)| &**keys);
        let discovery = discovery.map(|(spec, numbers)| {
            NetworkDiscovery::new(recipients.node.clone(), spec, numbers, keys)
        });
        let mut links = LinksActor {
            recipients,
            specs,
            link_layer: LinkLayer::new(None),
            rates: ByteRates::default(),
            wake: WakeTimer::default(),
            medium: MediumState::default(),
            reported: SortedMap::new(),
            unheard: BTreeSet::new(),
            alarms: RefusalAlarms::default(),
            names: NamesTaken::default(),
            discovery,
        };
        links.build(platform::now());
        links
    }

    fn build(&mut self, now: Instant) {
        // Keys and counters die with the links: none is ever used by another life of them.
        let sealer = self.recipients.seal.as_ref();
        let sealer = sealer.map(|(keys, terms)| keys.sealer(self.recipients.incarnation, *terms));
        self.link_layer = LinkLayer::new(sealer);
        self.let_operators_dial_in();
        self.unheard.clear();
        if let Some(discovery) = &mut self.discovery {
            discovery.restart(self.specs.iter().map(|(number, spec)| (*number, spec)));
        }
        self.wake = WakeTimer::default();
        let specs: Vec<_> = self.specs.iter().map(|(n, spec)| (*n, spec.clone())).collect();
        for (number, spec) in specs {
            if let Err(error) = self.insert(number, &spec, now) {
                error!(network = %self.recipients.network, link = %spec.name, "no link: {error}");
            }
        }
        if let Some((mtu, is_probed)) = self.medium.mtu {
            self.link_layer.handle_mtu(mtu, is_probed);
        }
        if let Some(rate) = self.medium.bytes_per_second {
            self.link_layer.handle_rate(rate);
        }
    }

    /// Makes the link, with the neighbour's key where frames are sealed.
    fn insert(
        &mut self,
        number: LinkId,
        spec: &LinkSpec,
        now: Instant,
    ) -> Result<(), AddLinkError> {
        let link = link(&self.recipients, spec, now);
        let keys = self.recipients.seal.as_ref().map(|(keys, _)| keys);
        let key = keys.zip(spec.neighbour.as_ref()).and_then(|(keys, node)| keys.key_of(node));
        self.link_layer.insert(number, link, spec.remote.clone(), key, now)
    }

    fn attach(&mut self, context: &mut Context<Self>) {
        let (frames, reports) = (context.address().recipient(), context.address().recipient());
        let connections = match self.recipients.seal {
            Some(_) => ConnectionTrust::Proven,
            None => ConnectionTrust::Claimed,
        };
        self.recipients.transport.attach.do_send(Attach {
            frames,
            reports,
            connections,
            clock: Some(platform::now),
        });
    }

    /// What a link costs at present.
    fn cost(&self, number: LinkId, link: &Link) -> u16 {
        let of_medium = self.medium.bytes_per_second.map_or(USUAL_COST, |rate| {
            (USUAL_COST * 1_000_000 / rate.max(1)).clamp(USUAL_COST, SLOW_COST)
        });
        let own = self.specs.get(&number).and_then(|spec| spec.cost);
        let cost = own.map_or(of_medium, u64::from);
        // Others go another way too, where there is one.
        let wary = if link.is_proving() { DISTRUSTED } else { 1 };
        let percent = wary * u64::from(link.quality().cost_percent);
        u16::try_from(cost * percent / 100).unwrap_or(u16::MAX).max(1)
    }

    /// How the frames of a link are sealed, and since when by these keys.
    fn seal(&self, number: LinkId, now: Instant) -> Option<LinkSeal> {
        let ChannelStatus { profile, suite, since, .. } = self.link_layer.channel(number)?;
        let cipher = match (profile, suite) {
            (SealProfile::Compact, _) => "HMAC-SHA-256",
            (SealProfile::Full, CipherSuite::AesGcm) => "AES-256-GCM",
            (SealProfile::Full, CipherSuite::ChaChaPoly) => "ChaCha20-Poly1305",
        };
        Some(LinkSeal { cipher, key_age: now - since })
    }

    fn tell_router(&mut self, number: LinkId) {
        let Some(link) = self.link_layer.get(number) else { return };
        let Some(neighbour) = link.neighbour().cloned() else { return };
        let cost = self.cost(number, link);
        let health = match (link.state(), self.medium.mtu) {
            (LinkState::Up, Some(_)) => LinkHealth::Up,
            (LinkState::Suspect, Some(_)) if link.is_proving() => LinkHealth::Proving,
            (LinkState::Suspect, Some(_)) => LinkHealth::Suspect,
            _ => LinkHealth::Down,
        };
        let status = LinkStatus { neighbour, health, cost, mtu: link.frame_limit() };
        self.reported.insert(number, status.clone());
        let remote = self.remote(number);
        self.recipients.router_changes.do_send(LinkChanged { link: number, status, remote });
    }

    /// Where a link leads, for display.
    fn remote(&self, number: LinkId) -> Arc<str> {
        self.specs.get(&number).map(|spec| spec.remote.to_string()).unwrap_or_default().into()
    }

    fn tell_router_all(&mut self) {
        let numbers: Vec<_> = self.specs.keys().copied().collect();
        numbers.into_iter().for_each(|number| self.tell_router(number));
    }

    /// The medium is closed. A link that was not up never was, for want of it: that is reported,
    /// too.
    fn lose_all(&mut self, reason: &str, now: Instant) {
        let numbers: Vec<_> = self.specs.keys().copied().collect();
        for number in numbers {
            let Some(state) = self.link_layer.get(number).map(Link::state) else { continue };
            match state {
                LinkState::Up | LinkState::Suspect => {
                    self.link_layer.with_link(number, now, |link| link.handle_loss(now));
                }
                LinkState::Connecting | LinkState::Down => {
                    self.tell_monitor(number, LinkCondition::Down { reason: reason.to_owned() });
                }
            }
        }
    }

    /// A medium without a neighbour has no link whose fault it could be; it is its own then.
    fn tell_of_lonely_medium(&self, condition: LinkCondition) {
        let (Some(monitor), true) = (&self.recipients.monitor, self.specs.is_empty()) else {
            return;
        };
        let (node, link) = (self.recipients.node.clone(), self.recipients.network.clone());
        monitor.do_send(LinkReported { node, link, neighbour: None, condition });
    }

    fn tell_monitor(&self, number: LinkId, condition: LinkCondition) {
        let (Some(monitor), Some(spec)) = (&self.recipients.monitor, self.specs.get(&number))
        else {
            return;
        };
        let peer = self.link_layer.get(number).and_then(Link::neighbour);
        let neighbour = peer.map(|peer| peer.node.clone()).or(spec.neighbour.clone());
        let (node, link) = (self.recipients.node.clone(), spec.name.clone());
        monitor.do_send(LinkReported { node, link, neighbour, condition });
    }

    fn changed(&mut self, number: LinkId, state: LinkState, reason: &'static str) {
        let link = self.specs.get(&number).map(|spec| spec.name.clone()).unwrap_or_default();
        info!(network = %self.recipients.network, %link, %state, reason, "link");
        if state == LinkState::Down && self.recipients.dial_in.contains(&number) {
            return self.remove(number);
        }
        self.tell_router(number);
        self.tell_discovery(number, state);
        match state {
            LinkState::Up => {
                self.forget_namesake(number);
                self.tell_condition(number);
            }
            LinkState::Down => {
                let refusal = self.link_layer.get(number).and_then(Link::refusal);
                let reason = refusal.map_or_else(|| reason.to_owned(), ToString::to_string);
                self.tell_monitor(number, LinkCondition::Down { reason });
            }
            // Nothing is torn down on a suspicion, and the recoverer gets no report of it.
            LinkState::Connecting | LinkState::Suspect => {}
        }
    }

    /// The quality of a link, or the frames that it carries, are others now.
    fn judged(&mut self, number: LinkId) {
        self.tell_router(number);
        let state = self.link_layer.get(number).map(Link::state);
        if let Some(LinkState::Up | LinkState::Suspect) = state {
            self.tell_condition(number);
        }
    }

    /// The links are to be built again: the router must not use them until they are up.
    fn take_down(&mut self) {
        self.forget_dialed_in();
        for (link, status) in std::mem::take(&mut self.reported) {
            let status = LinkStatus { health: LinkHealth::Down, ..status };
            let remote = self.remote(link);
            self.recipients.router_changes.do_send(LinkChanged { link, status, remote });
        }
    }

    fn no_carrier(&mut self, reason: &'static str, now: Instant) {
        let numbers: Vec<_> = self.specs.keys().copied().collect();
        for number in numbers {
            self.link_layer.with_link(number, now, |link| link.handle_no_carrier(reason, now));
        }
    }

    fn look_at_rates(&mut self) {
        let carried = self.specs.keys().map(|number| {
            let traffic = self.link_layer.traffic(*number);
            (*number, traffic.bytes_sent, traffic.bytes_received)
        });
        self.rates.handle_look(carried, platform::now());
    }

    fn transmit(&self, to: MediumAddress, frame: GatherBuffer, lane: FrameLane) {
        self.recipients.transport.transmit.do_send(Transmit { to, frame, lane });
    }
}

answers_the_monitor!(LinksActor);

impl Actor for LinksActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        context.run_interval(REFUSAL_CHECK_INTERVAL, |links, _| {
            links.look_at_refusals();
            links.forget_unused_keys();
            links.look_at_rates();
        });
        self.attach(context);
        self.attach_beacons(context);
        self.drive(context);
    }
}

impl Supervised for LinksActor {
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.take_down();
        self.build(platform::now());
        self.started(context);
    }
}

impl MachineActor for LinksActor {
    type Machine = LinkLayer<NoiseCrypto, MediumAddress>;

    fn driven(&mut self) -> (&mut Self::Machine, &mut WakeTimer) {
        (&mut self.link_layer, &mut self.wake)
    }

    fn carry_out(&mut self, output: LinkLayerOutput<MediumAddress>, _: &mut Context<Self>) {
        match output {
            LinkLayerOutput::Of(link, output) => self.carry_out_of(link, output),
            LinkLayerOutput::Transmit { to, frame, lane } => self.transmit(to, frame, lane),
            LinkLayerOutput::Adopt { connection, peer } => {
                self.recipients.transport.adopt.do_send(Adopt { connection, peer });
            }
            LinkLayerOutput::DialedIn { peer, address } => self.dialed_in(peer, address),
            LinkLayerOutput::Stranger(from) => {
                let network = &self.recipients.network;
                warn!(%network, %from, "a stranger speaks; no link leads there");
            }
            LinkLayerOutput::Stalled(gap) => {
                if let Some(stalls) = &self.recipients.stalls {
                    stalls.do_send(LivenessReported(LivenessEvent::Stalled { gap }));
                }
            }
            LinkLayerOutput::KeyInUse { link, open, refused, at, address } => {
                self.key_in_use(link, open, refused, at.peer(), address.peer());
            }
        }
    }
}

impl LinksActor {
    fn carry_out_of(&mut self, link: LinkId, output: LinkOutput) {
        let arrived = |load| self.recipients.router_loads.do_send(ReceivedOnLink { link, load });
        match output {
            LinkOutput::Routing(bytes) => arrived(LinkPayload::Routing(bytes)),
            LinkOutput::Packet(bytes) => arrived(LinkPayload::Packet(bytes.into())),
            LinkOutput::Changed { state, reason, .. } => self.changed(link, state, reason),
            LinkOutput::Missing { hello_received } => self.missing(link, hello_received),
            LinkOutput::Quality(_) | LinkOutput::FrameLimit => self.judged(link),
            LinkOutput::Refused(refusal) => self.refused(link, &refusal),
            LinkOutput::Taken(holder) => self.taken(link, &holder),
            LinkOutput::Transmit(_) => unreachable!("the layer transmits"),
        }
    }
}

impl Handler<Received> for LinksActor {
    type Result = ();

    fn handle(&mut self, message: Received, context: &mut Context<Self>) {
        let Received { from, frame } = message;
        self.link_layer.handle_frame(from, frame, platform::now());
        self.drive_soon(context);
    }
}

impl Handler<TransportReport> for LinksActor {
    type Result = ();

    fn handle(&mut self, message: TransportReport, context: &mut Context<Self>) {
        let now = platform::now();
        match message {
            TransportReport::Opened { local, mtu, is_probed } => {
                info!(network = %self.recipients.network, %local, mtu, "open");
                // What the seal takes is not left for the router.
                let left = mtu.saturating_sub(self.link_layer.overhead());
                if left < MTU_MIN {
                    let least = MTU_MIN + self.link_layer.overhead();
                    error!(
                        network = %self.recipients.network,
                        "frames of {mtu} bytes are too small for sealed packets: set its mtu to {least} \
                         at least"
                    );
                }
                self.medium.mtu = Some((mtu, is_probed));
                self.medium.local = local.to_string();
                self.tell_port(&local);
                self.link_layer.handle_mtu(mtu, is_probed);
                self.tell_router_all();
                for number in std::mem::take(&mut self.unheard) {
                    let hello_received =
                        self.link_layer.get(number).is_some_and(|link| link.neighbour().is_some());
                    self.missing(number, hello_received);
                }
                self.tell_of_lonely_medium(LinkCondition::Up);
            }
            TransportReport::Closed { reason } => {
                error!(network = %self.recipients.network, "{reason}");
                self.medium.mtu = None;
                self.lose_all(&reason, now);
                self.tell_of_lonely_medium(LinkCondition::Down { reason });
            }
            TransportReport::Ended => {
                self.medium.mtu = None;
                self.lose_all("the node has closed the network", now);
            }
            TransportReport::Rate { bytes_per_second } => {
                self.medium.bytes_per_second = Some(bytes_per_second);
                self.link_layer.handle_rate(bytes_per_second);
                self.tell_router_all();
            }
            TransportReport::Clash { reason } => self.clash(reason),
            TransportReport::PeerLost { peer } => {
                if let Some(number) = self.link_layer.link_at(&peer) {
                    self.link_layer.with_link(number, now, |link| link.handle_loss(now));
                }
            }
        }
        self.drive(context);
    }
}

impl Handler<CarrierChanged> for LinksActor {
    type Result = ();

    fn handle(&mut self, message: CarrierChanged, context: &mut Context<Self>) {
        // That a carrier is back says nothing about the neighbour: hellos do.
        if message.present {
            return;
        }
        self.no_carrier("the interface has lost its carrier", platform::now());
        self.drive(context);
    }
}

impl Handler<RosterChanged> for LinksActor {
    type Result = ();

    fn handle(&mut self, RosterChanged(keys): RosterChanged, context: &mut Context<Self>) {
        let Some((known, _)) = &mut self.recipients.seal else { return };
        *known = keys.clone();
        if let Some(discovery) = &mut self.discovery {
            discovery.handle_roster(&keys);
        }
        let now = platform::now();
        self.let_operators_dial_in();
        let specs: Vec<_> = self.specs.iter().map(|(n, spec)| (*n, spec.clone())).collect();
        for (number, spec) in specs {
            let key = spec.neighbour.as_ref().and_then(|node| keys.key_of(node));
            let set = match (self.link_layer.get(number), key) {
                // The links were built while the neighbour was not listed.
                (None, Some(_)) => self.insert(number, &spec, now),
                (_, key) => {
                    let set = self.link_layer.set_key(number, key.map(|key| key.public), now);
                    set.map_err(AddLinkError::from)
                }
            };
            if let Err(error) = set {
                error!(network = %self.recipients.network, link = %spec.name, "no link: {error}");
            }
        }
        self.drive(context);
    }
}

impl Handler<TransmitOnLink> for LinksActor {
    type Result = ();

    fn handle(&mut self, message: TransmitOnLink, context: &mut Context<Self>) {
        let TransmitOnLink { link, load } = message;
        self.link_layer.with_link(link, platform::now(), |link| match load {
            LinkPayload::Routing(bytes) => link.handle_routing(bytes),
            LinkPayload::Packet(packet) => link.handle_packet(packet),
            LinkPayload::Taken(holder) => link.handle_taken(holder),
        });
        self.drive_soon(context);
    }
}

impl Handler<ReadLinks> for LinksActor {
    type Result = MessageResult<ReadLinks>;

    fn handle(&mut self, _: ReadLinks, _: &mut Context<Self>) -> Self::Result {
        let now = platform::now();
        let row = |(number, link): (LinkId, &Link)| {
            let spec = self.specs.get(&number)?;
            Some(LinkRow {
                number,
                network: self.recipients.network.clone(),
                link: spec.name.clone(),
                state: link.state(),
                neighbour: link.neighbour().cloned(),
                last_sign: link.last_hello().map(|at| now - at),
                quality: link.quality(),
                hello_interval: link.hello_interval(),
                cost: self.cost(number, link),
                traffic: self.link_layer.traffic(number),
                rate: self.rates.rate(number),
                refusals: self.link_layer.refused_of(number),
                seal: self.seal(number, now),
            })
        };
        MessageResult(self.link_layer.iter().filter_map(row).collect())
    }
}

impl Handler<InjectPanic> for LinksActor {
    type Result = ();

    fn handle(&mut self, _: InjectPanic, _: &mut Context<Self>) {
        panic!("the links panic on purpose");
    }
}
