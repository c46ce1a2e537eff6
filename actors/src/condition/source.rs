//! Where the readings of a channel come from.

#[cfg(feature = "network")]
use super::echo::RoundTrips;
use super::spec::{ChannelSpec, ConnectedChannel, Figure};
use crate::actuator::ActuatorTable;
#[cfg(feature = "network")]
use crate::directory::DirectoryTable;
#[cfg(feature = "network")]
use crate::net::NetHandle;
use crate::registry::Registry;
use crate::runtime::reports::FaultReports;
use crate::topic::Topics;
#[cfg(feature = "network")]
use blastema_contract::link::LinkRow;
#[cfg(feature = "network")]
use blastema_contract::session::SessionRow;
#[cfg(feature = "network")]
use blastema_core::NodeName;
use blastema_core::connection::{ChannelReading, TopicEstimator};
#[cfg(feature = "network")]
use blastema_core::connection::{Latency, LossEstimator, RoundTripEstimator};
#[cfg(feature = "network")]
use blastema_core::directory::DirectoryKey;
use blastema_core::lease::LeaseStatus;
#[cfg(feature = "network")]
use blastema_core::net::LinkState;
use blastema_core::{Instant, NameError, ObjectName};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// What conditions read from, and report to.
pub(crate) struct ConditionWiring {
    pub(crate) reports: FaultReports,
    pub(crate) topics: Topics,
    pub(crate) actuators: ActuatorTable,
    pub(crate) registry: Registry,
    #[cfg(feature = "network")]
    pub(crate) directory: DirectoryTable,
    #[cfg(feature = "network")]
    pub(crate) net: Option<NetHandle>,
    /// How long a channel may be silent over the media of the node; `None` without any.
    pub(crate) timeout: Option<Duration>,
}

/// A channel with what was read of it before.
pub(super) struct ChannelSource {
    origin: Origin,
    last: ChannelReading,
    wants_latency: bool,
    wants_loss: bool,
    clocks_within: Option<Duration>,
}

enum Origin {
    Topic {
        measured: Arc<Mutex<TopicEstimator>>,
        #[cfg(feature = "network")]
        key: DirectoryKey,
    },
    Commander(ObjectName),
    #[cfg(feature = "network")]
    Node {
        node: NodeName,
        needs_session: bool,
        /// How many chunks the session had sent, and sent again.
        counted: (u64, u64),
        loss: LossEstimator,
    },
    #[cfg(feature = "network")]
    Link(String),
}

/// What is read for all channels together.
#[derive(Default)]
pub(super) struct SharedReadings {
    #[cfg(feature = "network")]
    pub(super) round_trips: RoundTrips,
    #[cfg(feature = "network")]
    pub(super) rows: Arc<Mutex<NetworkRows>>,
    #[cfg(feature = "network")]
    pub(super) read_at: Instant,
}

/// The network's rows, as they were read last.
#[cfg(feature = "network")]
#[derive(Default)]
pub(super) struct NetworkRows {
    links: Vec<LinkRow>,
    sessions: Vec<SessionRow>,
    /// When they were read.
    at: Instant,
}

/// How often links and sessions are asked for their rows.
#[cfg(feature = "network")]
const ROWS_INTERVAL: Duration = Duration::from_millis(100);

impl ChannelSource {
    pub(super) fn new(
        spec: &ChannelSpec,
        measured: Arc<Mutex<TopicEstimator>>,
    ) -> Result<Self, NameError> {
        #[cfg(feature = "network")]
        let node = |name: &str, needs_session| {
            let (counted, loss) = Default::default();
            NodeName::new(name).map(|node| Origin::Node { node, needs_session, counted, loss })
        };
        let origin = match &spec.channel {
            #[cfg(feature = "network")]
            ConnectedChannel::Topic { topic, contract, .. } => {
                let (topic, contract) = (ObjectName::new(topic)?, (*contract).to_owned());
                Origin::Topic { measured, key: DirectoryKey::Publisher { topic, contract } }
            }
            #[cfg(not(feature = "network"))]
            ConnectedChannel::Topic { .. } => Origin::Topic { measured },
            ConnectedChannel::Commander(actuator) => Origin::Commander(ObjectName::new(actuator)?),
            #[cfg(feature = "network")]
            ConnectedChannel::Node(name) => node(name, false)?,
            #[cfg(feature = "network")]
            ConnectedChannel::Session(name) => node(name, true)?,
            #[cfg(feature = "network")]
            ConnectedChannel::Link(link) => Origin::Link(link.clone()),
        };
        Ok(ChannelSource {
            origin,
            last: ChannelReading::default(),
            wants_latency: spec.figures().any(|figure| figure == Figure::Latency),
            wants_loss: spec.figures().any(|figure| figure == Figure::Loss),
            clocks_within: spec.clocks_within,
        })
    }

    /// Whether the rows of links and sessions must be read for it.
    #[cfg(feature = "network")]
    pub(super) fn needs_rows(&self) -> bool {
        match &self.origin {
            Origin::Link(_) => true,
            Origin::Node { .. } => self.wants_loss,
            Origin::Topic { .. } | Origin::Commander(_) => false,
        }
    }

    /// Reads what is known of the channel now.
    pub(super) fn read(
        &mut self,
        wiring: &ConditionWiring,
        shared: &mut SharedReadings,
        now: Instant,
    ) -> ChannelReading {
        let ChannelSource { origin, last, wants_latency, wants_loss, clocks_within } = self;
        #[cfg(not(feature = "network"))]
        let _ = (wants_loss, shared);
        match origin {
            Origin::Topic { measured, .. } => {
                let measured = *measured.lock().unwrap_or_else(PoisonError::into_inner);
                (last.arrived, last.heard_at) = (measured.arrived(), measured.heard_at());
                last.jitter = last.heard_at.map(|_| measured.jitter());
                last.loss_permille = measured.loss_permille();
                let trip = match origin {
                    _ if !*wants_latency => None,
                    #[cfg(feature = "network")]
                    Origin::Topic { key, .. } => {
                        let nodes = wiring.directory.nodes_with(key);
                        let trips = nodes.iter().map(|node| {
                            shared.round_trips.to(node, &wiring.registry, now).fastest()
                        });
                        match nodes.is_empty() {
                            // No other node publishes: events come from this one.
                            true => last.heard_at.map(|_| Duration::ZERO),
                            false => trips
                                .collect::<Option<Vec<_>>>()
                                .and_then(|all| all.into_iter().max()),
                        }
                    }
                    _ => last.heard_at.map(|_| Duration::ZERO),
                };
                // What was known stays while the publisher is away.
                if let Some(trip) = trip {
                    let one_way = clocks_within.and_then(|error| measured.one_way(error, trip));
                    last.latency = Some(one_way.unwrap_or_else(|| measured.latency(trip)));
                }
            }
            Origin::Commander(actuator) => {
                let rows = wiring.actuators.rows();
                let held = rows.into_iter().filter(|row| row.object == *actuator);
                let held = held.filter_map(|row| match row.status {
                    LeaseStatus::Held { commander, .. } => Some(commander),
                    LeaseStatus::Free | LeaseStatus::Settling { .. } => None,
                });
                if let Some(commander) = held.last() {
                    last.heard_at = Some(now);
                    #[cfg(feature = "network")]
                    if *wants_latency {
                        let node = commander.name.split(':').next().map(NodeName::new);
                        let node = node.and_then(Result::ok);
                        let node = node.and_then(|node| wiring.registry.elsewhere(node));
                        let trips =
                            node.map(|node| shared.round_trips.to(&node, &wiring.registry, now));
                        last.latency = match trips {
                            Some(trips) => latency_of(&trips, now),
                            None => Some(Latency::of_round_trip(Duration::ZERO)),
                        };
                    }
                    #[cfg(not(feature = "network"))]
                    let _ = (commander, wants_latency);
                }
            }
            #[cfg(feature = "network")]
            Origin::Node { node, needs_session, counted, loss } => {
                let is_there = wiring.net.as_ref().is_some_and(|net| match needs_session {
                    true => net.is_connected(node),
                    false => net.is_reachable(node),
                });
                if is_there {
                    last.heard_at = Some(now);
                }
                if *wants_latency {
                    let trips = shared.round_trips.to(node, &wiring.registry, now);
                    last.latency = latency_of(&trips, now);
                }
                let rows = shared.rows.lock().unwrap_or_else(PoisonError::into_inner);
                let row = rows.sessions.iter().find(|row| row.node == *node);
                if let Some(row) = row.filter(|_| *wants_loss) {
                    let counters = row.status.counters;
                    let now = (counters.sent, counters.retransmitted);
                    let (sent, again) =
                        (now.0.saturating_sub(counted.0), now.1.saturating_sub(counted.1));
                    loss.handle(again, sent.saturating_sub(again));
                    (*counted, last.loss_permille) = (now, Some(loss.permille()));
                }
            }
            #[cfg(feature = "network")]
            Origin::Link(name) => {
                let rows = shared.rows.lock().unwrap_or_else(PoisonError::into_inner);
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
        *last
    }
}

#[cfg(feature = "network")]
fn latency_of(trips: &RoundTripEstimator, now: Instant) -> Option<Latency> {
    trips.smoothed(now).map(Latency::of_round_trip)
}

#[cfg(feature = "network")]
impl SharedReadings {
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
            *rows.lock().unwrap_or_else(PoisonError::into_inner) =
                NetworkRows { links, sessions, at };
        });
    }
}
