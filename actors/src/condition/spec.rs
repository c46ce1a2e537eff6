//! What a condition needs.

use super::heartbeat::Heartbeat;
use crate::component::envelope::Times;
use crate::platform::{lock, stamp_us};
use crate::topic::Topics;
use blastema_core::NodeName;
use blastema_core::connection::{Combination, ConnectionLimits, ConnectionRules};
use blastema_core::connection::{TopicArrival, TopicEstimator};
use blastema_core::{Contract, DeliveryError, Event, NameError, ObjectName};
use std::any::Any;
use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// The timeout of a node without networks, and the default of the source's condition nodes.
pub(super) const TIMEOUT: Duration = Duration::from_secs(3);
/// How often conditions are looked at; the end of a timeout is looked at exactly. More often finds
/// what is restored sooner.
pub(super) const LOOK_INTERVAL: Duration = Duration::from_millis(50);

/// What must be connected: one channel, or some of several. Given to
/// [`Node::condition`](crate::Node::condition).
///
/// ```
/// use blastema::Connected;
/// use std::time::Duration;
///
/// let operator = Connected::heartbeat("operator/beat").timeout(Duration::from_secs(3));
/// let radio = Connected::heartbeat("operator/beat")
///     .max_latency(Duration::from_millis(500))
///     .max_loss(0.1);
/// let any = Connected::any([operator.clone(), Connected::heartbeat("base/beat")]);
/// let two = Connected::at_least(2, [operator, radio, any]);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Connected(pub(super) Combination<ChannelSpec>);

/// One channel, and how it is judged.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ChannelSpec {
    /// A name that does not parse is refused where the condition is declared.
    pub(super) channel: Result<ConnectedChannel, NameError>,
    pub(super) timeout: Option<Duration>,
    /// It is lost below this rate, rather than in silence.
    pub(super) rate: Option<(f64, Duration)>,
    pub(super) limits: ConnectionLimits,
    /// Within what the wall clocks of the sender and of this node agree.
    pub(super) clocks_within: Option<Duration>,
}

/// What is looked at.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum ConnectedChannel {
    Topic(ObjectName, ConnectedEvents),
    Node(NodeName),
    Session(NodeName),
    Link(String),
    Commander(ObjectName),
}

/// The events of a topic, and what measures them.
#[derive(Clone, Copy)]
pub(super) struct ConnectedEvents {
    pub(super) contract: &'static str,
    pub(super) listen: ListenFn,
}

impl PartialEq for ConnectedEvents {
    fn eq(&self, other: &Self) -> bool {
        self.contract == other.contract
    }
}

impl fmt::Debug for ConnectedEvents {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.contract)
    }
}

/// Lets the events of a topic be measured, for the condition of this name, until what is returned
/// is dropped.
type ListenFn = fn(
    &Topics,
    &ObjectName,
    &ObjectName,
    Arc<Mutex<TopicEstimator>>,
) -> Result<Box<dyn Any + Send>, DeliveryError>;

fn listen<E: Event>(
    topics: &Topics,
    topic: &ObjectName,
    listener: &ObjectName,
    measured: Arc<Mutex<TopicEstimator>>,
) -> Result<Box<dyn Any + Send>, DeliveryError> {
    let tap = move |event: &E, times: Times| {
        let beat = (event as &dyn Any).downcast_ref::<Heartbeat>();
        lock(&measured).handle_arrival(TopicArrival {
            at: times.posted_at,
            age: times.posted_at - times.captured_at(),
            sequence: beat.map(|beat| beat.sequence),
            stamps_us: beat.map(|beat| (stamp_us(), beat.stamp_us)),
        });
    };
    Ok(Box::new(topics.tap::<E>(topic.as_str(), listener, Arc::new(tap))?))
}

impl fmt::Display for ConnectedChannel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ConnectedChannel::Topic(topic, _) => topic.fmt(f),
            ConnectedChannel::Node(node) => write!(f, "node {node}"),
            ConnectedChannel::Session(node) => write!(f, "session with {node}"),
            ConnectedChannel::Link(link) => write!(f, "link {link}"),
            ConnectedChannel::Commander(actuator) => write!(f, "commander of {actuator}"),
        }
    }
}

impl ChannelSpec {
    fn of(channel: Result<ConnectedChannel, NameError>) -> Connected {
        let (timeout, rate, limits, clocks_within) = Default::default();
        let spec = ChannelSpec { channel, timeout, rate, limits, clocks_within };
        Connected(Combination::Channel(spec))
    }

    /// Whether the latency is to be found out.
    pub(super) fn wants_latency(&self) -> bool {
        self.limits.latency.is_some() || self.clocks_within.is_some()
    }

    /// The limit of a figure that is not measured on this channel.
    pub(super) fn unmeasured(&self, channel: &ConnectedChannel) -> Option<&'static str> {
        let measured: &[&str] = match channel {
            ConnectedChannel::Topic(_, events) if events.contract == Heartbeat::NAME => {
                &["max_latency", "max_jitter", "max_loss", "rate"]
            }
            ConnectedChannel::Topic(..) => &["max_latency", "max_jitter", "rate"],
            ConnectedChannel::Node(_) | ConnectedChannel::Session(_) => {
                &["max_latency", "max_loss"]
            }
            ConnectedChannel::Link(_) => &["max_latency", "max_jitter", "max_loss"],
            ConnectedChannel::Commander(_) => &["max_latency"],
        };
        let limited = [
            ("max_latency", self.wants_latency()),
            ("max_jitter", self.limits.jitter.is_some()),
            ("max_loss", self.limits.loss_permille.is_some()),
            ("rate", self.limits.rate.is_some() || self.rate.is_some()),
        ];
        let limited = limited.into_iter().filter(|(_, is_limited)| *is_limited);
        let mut limited = limited.map(|(limit, _)| limit);
        limited.find(|limit| !measured.contains(limit))
    }

    /// How it is judged, where channels without a timeout of their own have this one.
    pub(super) fn rules(&self, timeout: Duration) -> ConnectionRules {
        let timeout = self.timeout.unwrap_or(match self.channel {
            // Its lease has a timeout already. It is looked at twice.
            Ok(ConnectedChannel::Commander(_)) => 2 * LOOK_INTERVAL,
            _ => timeout,
        });
        ConnectionRules { timeout, rate: self.rate, limits: self.limits }
    }
}

impl Connected {
    /// [Heartbeats](Heartbeat) arrive on this topic. It is lost when none arrived for the
    /// [`timeout`](Self::timeout), and until the first one arrives.
    pub fn heartbeat(topic: &str) -> Self {
        Connected::topic::<Heartbeat>(topic)
    }

    /// Events of this contract arrive on this topic.
    pub fn topic<E: Event>(topic: &str) -> Self {
        let events = ConnectedEvents { contract: E::NAME, listen: listen::<E> };
        let topic = ObjectName::new(topic);
        ChannelSpec::of(topic.map(|topic| ConnectedChannel::Topic(topic, events)))
    }

    /// Events of this contract arrive on this topic at a rate of `hz` or more, counted over
    /// `window`. It is lost below four fifths of the rate.
    pub fn rate<E: Event>(topic: &str, hz: f64, window: Duration) -> Self {
        Connected::topic::<E>(topic).at_rate(hz, window)
    }

    /// Requires that events arrive at this rate, counted over `window`, rather than that they are
    /// never silent for the [`timeout`](Self::timeout): as [`rate`](Self::rate), for heartbeats.
    #[must_use]
    pub fn at_rate(self, hz: f64, window: Duration) -> Self {
        self.each(|spec| spec.rate = Some((hz, window)))
    }

    /// A path leads to this node: it was discovered, has not left, and is not isolated.
    pub fn node(node: &str) -> Self {
        ChannelSpec::of(NodeName::new(node).map(ConnectedChannel::Node))
    }

    /// A session with this node is open, so that messages reach it.
    pub fn session(node: &str) -> Self {
        ChannelSpec::of(NodeName::new(node).map(ConnectedChannel::Session))
    }

    /// This link is up. Its name is the one that [`LinkRow`](crate::LinkRow) shows.
    pub fn link(link: &str) -> Self {
        ChannelSpec::of(Ok(ConnectedChannel::Link(link.to_owned())))
    }

    /// A commander holds this actuator of this node. It is lost with its lease.
    pub fn commander(actuator: &str) -> Self {
        ChannelSpec::of(ObjectName::new(actuator).map(ConnectedChannel::Commander))
    }

    /// All of these are connected.
    pub fn all(of: impl IntoIterator<Item = Connected>) -> Self {
        let of: Vec<_> = of.into_iter().collect();
        Connected::at_least(of.len(), of)
    }

    /// One of these is connected.
    pub fn any(of: impl IntoIterator<Item = Connected>) -> Self {
        Connected::at_least(1, of)
    }

    /// At least so many of these are connected.
    pub fn at_least(least: usize, of: impl IntoIterator<Item = Connected>) -> Self {
        let of = of.into_iter().map(|Connected(part)| part).collect();
        Connected(Combination::AtLeast { least, of })
    }

    /// Sets how long a channel may be silent. By default as long as the slowest
    /// [medium](crate::MediumKind) of the node's networks asks for, 3 s on a node without networks,
    /// and 100 ms after its lease for a commander. Of several channels it is set on each that has
    /// none of its own.
    #[must_use]
    pub fn timeout(self, timeout: Duration) -> Self {
        self.each(|spec| spec.timeout = spec.timeout.or(Some(timeout)))
    }

    /// Sets how long a message may take one way at most. A greater latency degrades the connection
    /// until it is below half of the limit. The latency is half a round trip with as much of an
    /// error, unless [clocks agree](Self::clocks_agree_within), and its upper end is compared.
    #[must_use]
    pub fn max_latency(self, limit: Duration) -> Self {
        self.each(|spec| spec.limits.latency = Some(limit))
    }

    /// Sets by how much the latency may vary from one message to the next, likewise.
    #[must_use]
    pub fn max_jitter(self, limit: Duration) -> Self {
        self.each(|spec| spec.limits.jitter = Some(limit))
    }

    /// Sets which share of the messages may be lost, from 0.0 to 1.0, likewise.
    #[must_use]
    pub fn max_loss(self, limit: f64) -> Self {
        let share = Some(limit).filter(|limit| (0.0..=1.0).contains(limit));
        // What is no share is refused where the condition is declared.
        let permille = share.map_or(u16::MAX, |share| (share * 1000.0).round() as u16);
        self.each(|spec| spec.limits.loss_permille = Some(permille))
    }

    /// Sets at which rate messages must arrive, counted over `window`: a lower one degrades the
    /// connection. Where it is to be lost instead, see [`rate`](Self::rate).
    #[must_use]
    pub fn min_rate(self, hz: f64, window: Duration) -> Self {
        self.each(|spec| spec.limits.rate = Some((hz, window)))
    }

    /// Says that the wall clocks of the sender of heartbeats and of this node agree within `error`,
    /// as by PTP: the latency is then measured one way. Where the stamps contradict the round
    /// trips, the clocks do not agree, and round trips are used.
    #[must_use]
    pub fn clocks_agree_within(self, error: Duration) -> Self {
        self.each(|spec| spec.clocks_within = Some(error))
    }

    /// Whether it needs a commander of an actuator.
    pub(crate) fn has_commander(&self) -> bool {
        let mut found = false;
        self.clone().0.for_each(&mut |spec| {
            found |= matches!(spec.channel, Ok(ConnectedChannel::Commander(_)));
        });
        found
    }

    fn each(mut self, set: impl Fn(&mut ChannelSpec)) -> Self {
        self.0.for_each(&mut |spec| set(spec));
        self
    }
}
