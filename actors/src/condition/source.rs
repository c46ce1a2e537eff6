//! Where the readings of a channel come from.

use super::echo::RoundTrips;
use super::spec::{ChannelSpec, ConnectedChannel};
use crate::actuator::ActuatorTable;
use crate::directory::DirectoryTable;
use crate::net::NetHandle;
use crate::platform::lock;
use crate::registry::Registry;
use crate::runtime::reports::FaultReports;
use crate::topic::Topics;
use blastema_contract::link::LinkRow;
use blastema_contract::session::SessionRow;
use blastema_core::NodeName;
use blastema_core::connection::{ChannelReading, TopicEstimator};
use blastema_core::connection::{Latency, LossEstimator};
use blastema_core::directory::DirectoryKey;
use blastema_core::net::LinkState;
use blastema_core::suggestion::nearest;
use blastema_core::{Instant, ObjectName};
use std::any::Any;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// What conditions read from, and report to.
pub(crate) struct ConditionWiring {
    pub(crate) reports: FaultReports,
    pub(crate) topics: Topics,
    pub(crate) actuators: ActuatorTable,
    pub(crate) registry: Registry,
    pub(crate) directory: DirectoryTable,
    pub(crate) net: Option<NetHandle>,
    /// The links that a condition may name; what begins as one that ends at `/` may come by itself.
    pub(crate) links: Vec<String>,
    /// How long a channel may be silent over the media of the node; `None` without any.
    pub(crate) timeout: Option<Duration>,
}

/// A channel with what was read of it before.
pub(super) struct ChannelSource {
    spec: ChannelSpec,
    channel: ConnectedChannel,
    last: ChannelReading,
    /// What is known of a topic, and what measures it until this is dropped.
    measured: Arc<Mutex<TopicEstimator>>,
    _tapped: Option<Box<dyn Any + Send>>,
    network: NetworkSource,
}

/// What was read of other nodes.
#[derive(Default)]
struct NetworkSource {
    /// The fastest round trip of late to the slowest node that published.
    trip: Option<Duration>,
    /// How many chunks the session had sent, and sent again.
    counted: (u64, u64),
    loss: LossEstimator,
}

/// What is read for all channels together.
#[derive(Default)]
pub(super) struct SharedReadings {
    pub(super) round_trips: RoundTrips,
    pub(super) rows: Arc<Mutex<NetworkRows>>,
    pub(super) read_at: Instant,
}

/// The network's rows, as they were read last.
#[derive(Default)]
pub(super) struct NetworkRows {
    links: Vec<LinkRow>,
    sessions: Vec<SessionRow>,
    /// When they were read.
    at: Instant,
}

/// How often links and sessions are asked for their rows.
const ROWS_INTERVAL: Duration = Duration::from_millis(100);

impl ConnectedChannel {
    /// Begins to measure the events of a topic, until what is returned is dropped. Refuses a
    /// channel that this node cannot have.
    pub(super) fn tap(
        &self,
        topics: &Topics,
        registry: &Registry,
        listener: &ObjectName,
        measured: Arc<Mutex<TopicEstimator>>,
    ) -> Result<Option<Box<dyn Any + Send>>, String> {
        match self {
            ConnectedChannel::Topic(topic, events) => {
                let tapped = (events.listen)(topics, topic, listener, measured);
                tapped.map(Some).map_err(|why| why.to_string())
            }
            ConnectedChannel::Node(name) | ConnectedChannel::Session(name)
                if registry.elsewhere(name.clone()).is_none() =>
            {
                Err(format!("{self}, which is this node: name another one"))
            }
            _ => Ok(None),
        }
    }
}

impl ChannelSource {
    /// Begins to measure the channel for the condition of this name.
    pub(super) fn open(
        spec: &ChannelSpec,
        channel: &ConnectedChannel,
        wiring: &ConditionWiring,
        listener: &ObjectName,
    ) -> Result<Self, String> {
        if let ConnectedChannel::Link(link) = channel {
            wiring.check_link(link)?;
        }
        let measured = Arc::<Mutex<TopicEstimator>>::default();
        let tapped = channel.tap(&wiring.topics, &wiring.registry, listener, measured.clone())?;
        Ok(ChannelSource {
            spec: spec.clone(),
            channel: channel.clone(),
            last: ChannelReading::default(),
            measured,
            _tapped: tapped,
            network: NetworkSource::default(),
        })
    }

    /// Whether the rows of links and sessions must be read for it.
    pub(super) fn needs_rows(&self) -> bool {
        match &self.channel {
            ConnectedChannel::Link(_) => true,
            ConnectedChannel::Node(_) | ConnectedChannel::Session(_) => {
                self.spec.limits.loss_permille.is_some()
            }
            ConnectedChannel::Topic(..) | ConnectedChannel::Commander(_) => false,
        }
    }

    /// Reads what is known of the channel now.
    pub(super) fn read(
        &mut self,
        wiring: &ConditionWiring,
        shared: &mut SharedReadings,
        now: Instant,
    ) -> ChannelReading {
        match &self.channel {
            ConnectedChannel::Topic(topic, events) => {
                let measured = *lock(&self.measured);
                let last = &mut self.last;
                (last.arrived, last.heard_at) = (measured.arrived(), measured.heard_at());
                last.jitter = last.heard_at.map(|_| measured.jitter());
                last.loss_permille = measured.loss_permille();
                let trip = match self.spec.wants_latency() {
                    true => self.network.topic_trip(topic, events.contract, wiring, shared, now),
                    false => None,
                };
                // What was known stays while a round trip is not.
                if let (Some(trip), Some(_), true) =
                    (trip, last.heard_at, self.spec.wants_latency())
                {
                    let agreed = self.spec.clocks_within;
                    let one_way = agreed.and_then(|error| measured.one_way(error, trip));
                    last.latency = Some(one_way.unwrap_or_else(|| measured.latency(trip)));
                }
            }
            ConnectedChannel::Commander(actuator) => {
                let Some(commander) = wiring.actuators.commander_of(actuator) else {
                    return self.last;
                };
                self.last.heard_at = Some(now);
                if self.spec.wants_latency() {
                    let node = commander.name.split(':').next().map(NodeName::new);
                    let node = node.and_then(Result::ok);
                    self.last.latency = match node.and_then(|node| wiring.registry.elsewhere(node))
                    {
                        Some(node) => shared.latency_to(&node, wiring, now),
                        None => Some(Latency::of_round_trip(Duration::ZERO)),
                    };
                }
            }
            ConnectedChannel::Node(node) | ConnectedChannel::Session(node) => {
                let is_session = matches!(self.channel, ConnectedChannel::Session(_));
                let is_there = wiring.net.as_ref().is_some_and(|net| match is_session {
                    true => net.is_connected(node),
                    false => net.is_reachable(node),
                });
                if is_there {
                    self.last.heard_at = Some(now);
                }
                if self.spec.wants_latency() {
                    self.last.latency = shared.latency_to(node, wiring, now);
                }
                let rows = lock(&shared.rows);
                let row = rows.sessions.iter().find(|row| row.node == *node);
                if let Some(row) = row.filter(|_| self.spec.limits.loss_permille.is_some()) {
                    let NetworkSource { counted, loss, .. } = &mut self.network;
                    let counters = row.status.counters;
                    let now = (counters.sent, counters.retransmitted);
                    let (sent, again) =
                        (now.0.saturating_sub(counted.0), now.1.saturating_sub(counted.1));
                    loss.handle(again, sent.saturating_sub(again));
                    (*counted, self.last.loss_permille) = (now, Some(loss.permille()));
                }
            }
            ConnectedChannel::Link(name) => {
                let last = &mut self.last;
                let rows = lock(&shared.rows);
                let link = rows.links.iter().find(|row| *row.link == **name);
                if let Some(link) = link
                    && matches!(link.state, LinkState::Up | LinkState::Suspect)
                    && let Some(ago) = link.last_sign
                {
                    let ago = u64::try_from(ago.as_nanos()).unwrap_or(u64::MAX);
                    let heard_at = Instant::from_nanos(rows.at.as_nanos().saturating_sub(ago));
                    last.heard_at = last.heard_at.max(Some(heard_at));
                    last.latency = link.quality.round_trip.map(Latency::of_round_trip);
                    last.jitter = link.quality.round_trip.map(|_| link.quality.jitter);
                    last.loss_permille = Some(link.quality.loss_permille);
                }
            }
        }
        self.last
    }
}

impl NetworkSource {
    /// The fastest round trip of late to the slowest node that publishes on the topic. It stays
    /// when that node has left. Where no node did, events come from this one.
    fn topic_trip(
        &mut self,
        topic: &ObjectName,
        contract: &str,
        wiring: &ConditionWiring,
        shared: &mut SharedReadings,
        now: Instant,
    ) -> Option<Duration> {
        let (topic, contract) = (topic.clone(), contract.to_owned());
        let nodes = wiring.directory.nodes_with(&DirectoryKey::Publisher { topic, contract });
        if nodes.is_empty() {
            return Some(self.trip.unwrap_or_default());
        }
        let mut slowest = Some(Duration::ZERO);
        for node in &nodes {
            let fastest = shared.round_trips.to(node, &wiring.registry, now).fastest();
            slowest = slowest.zip(fastest).map(|(slowest, fastest)| slowest.max(fastest));
        }
        self.trip = slowest.or(self.trip);
        slowest
    }
}

impl ConditionWiring {
    fn check_link(&self, name: &str) -> Result<(), String> {
        let is_known =
            |link: &String| link == name || link.ends_with('/') && name.starts_with(link);
        if self.links.iter().any(is_known) {
            return Ok(());
        }
        Err(match (nearest(name, self.links.iter().map(String::as_str)), self.links.is_empty()) {
            (Some(near), _) => format!("the node has no link {name}: did you mean {near}?"),
            (None, true) => format!("the node has no link {name}, as it has no networks"),
            (None, false) => {
                format!("the node has no link {name}: it has {}", self.links.join(", "))
            }
        })
    }
}

impl SharedReadings {
    fn latency_to(
        &mut self,
        node: &NodeName,
        wiring: &ConditionWiring,
        now: Instant,
    ) -> Option<Latency> {
        let trips = self.round_trips.to(node, &wiring.registry, now);
        trips.last(now).map(Latency::of_round_trip)
    }

    /// Asks links and sessions how they are, unless they still owe an answer.
    pub(super) fn read_rows(&mut self, wiring: &ConditionWiring, now: Instant) {
        let Some(net) = &wiring.net else { return };
        if now - self.read_at < ROWS_INTERVAL || Arc::strong_count(&self.rows) > 1 {
            return;
        }
        self.read_at = now;
        let (net, rows) = (net.clone(), self.rows.clone());
        actix_rt::spawn(async move {
            let (links, sessions) = (net.read_links().await, net.read_sessions().await);
            let at = crate::platform::now();
            *lock(&rows) = NetworkRows { links, sessions, at };
        });
    }
}
