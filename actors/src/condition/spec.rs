//! What a condition needs.

use super::heartbeat::Heartbeat;
use crate::component::envelope::Times;
use crate::topic::Topics;
use blastema_core::connection::{ConnectionLimits, ConnectionRules, Presence};
use blastema_core::connection::{TopicArrival, TopicEstimator};
use blastema_core::{DeliveryError, Event, ObjectName};
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// The timeout of a node without networks, and the default of the source's condition nodes.
pub(super) const TIMEOUT: Duration = Duration::from_secs(3);

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
#[derive(Clone)]
pub struct Connected(pub(super) ConnectedPart);

#[derive(Clone)]
pub(super) enum ConnectedPart {
    Channel(ChannelSpec),
    AtLeast(usize, Vec<Connected>),
}

/// One channel, and how it is judged.
#[derive(Clone)]
pub(super) struct ChannelSpec {
    pub(super) channel: ConnectedChannel,
    pub(super) timeout: Option<Duration>,
    /// It is lost below this rate, rather than in silence.
    pub(super) rate: Option<(f64, Duration)>,
    pub(super) limits: ConnectionLimits,
    /// Within what the wall clocks of the sender and of this node agree.
    pub(super) clocks_within: Option<Duration>,
}

/// What is looked at.
#[derive(Clone)]
pub(super) enum ConnectedChannel {
    Topic {
        topic: String,
        listen: ListenFn,
        contract: &'static str,
    },
    #[cfg(feature = "network")]
    Node(String),
    #[cfg(feature = "network")]
    Session(String),
    #[cfg(feature = "network")]
    Link(String),
    Commander(String),
}

/// Lets the events of a topic be measured, for the condition of this name.
pub(super) type ListenFn = Arc<
    dyn Fn(&Topics, &str, &ObjectName, Arc<Mutex<TopicEstimator>>) -> Result<(), DeliveryError>
        + Send
        + Sync,
>;

/// Measures the events of a topic; `more` completes what is known of one.
fn listen<E: Event>(more: fn(&E, TopicArrival) -> TopicArrival) -> ListenFn {
    Arc::new(move |topics, topic, listener, measured| {
        let tap = move |event: &E, times: Times| {
            let age = times.posted_at - times.captured_at();
            let arrival = TopicArrival { at: times.posted_at, age, ..TopicArrival::default() };
            let mut measured = measured.lock().unwrap_or_else(PoisonError::into_inner);
            measured.handle_arrival(more(event, arrival));
        };
        topics.tap::<E>(topic, listener, Arc::new(tap))
    })
}

impl ConnectedChannel {
    /// Has the events of a topic measured, for the condition of this name.
    pub(super) fn listen(
        &self,
        topics: &Topics,
        listener: &ObjectName,
        measured: Arc<Mutex<TopicEstimator>>,
    ) -> Result<(), DeliveryError> {
        match self {
            ConnectedChannel::Topic { topic, listen, .. } => {
                listen(topics, topic, listener, measured)
            }
            _ => Ok(()),
        }
    }

    /// Which figures a limit can be set on.
    pub(super) fn has(&self, figure: Figure) -> bool {
        match self {
            ConnectedChannel::Topic { contract, .. } => {
                figure != Figure::Loss || *contract == <Heartbeat as blastema_core::Contract>::NAME
            }
            #[cfg(feature = "network")]
            ConnectedChannel::Node(_) | ConnectedChannel::Session(_) => {
                matches!(figure, Figure::Latency | Figure::Loss)
            }
            #[cfg(feature = "network")]
            ConnectedChannel::Link(_) => figure != Figure::Rate,
            ConnectedChannel::Commander(_) => figure == Figure::Latency,
        }
    }
}

impl fmt::Display for ConnectedChannel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ConnectedChannel::Topic { topic, .. } => f.write_str(topic),
            #[cfg(feature = "network")]
            ConnectedChannel::Node(node) => write!(f, "node {node}"),
            #[cfg(feature = "network")]
            ConnectedChannel::Session(node) => write!(f, "session with {node}"),
            #[cfg(feature = "network")]
            ConnectedChannel::Link(link) => write!(f, "link {link}"),
            ConnectedChannel::Commander(actuator) => write!(f, "commander of {actuator}"),
        }
    }
}

/// A figure of a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Figure {
    Latency,
    Jitter,
    Loss,
    Rate,
}

impl fmt::Display for Figure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Figure::Latency => "latency",
            Figure::Jitter => "jitter",
            Figure::Loss => "loss",
            Figure::Rate => "rate",
        })
    }
}

impl ChannelSpec {
    fn of(channel: ConnectedChannel) -> Connected {
        Connected(ConnectedPart::Channel(ChannelSpec {
            channel,
            timeout: None,
            rate: None,
            limits: ConnectionLimits::default(),
            clocks_within: None,
        }))
    }

    /// The figures that it sets limits on.
    pub(super) fn figures(&self) -> impl Iterator<Item = Figure> {
        let ConnectionLimits { latency, jitter, loss_permille, rate } = self.limits;
        let is_rate = rate.is_some() || self.rate.is_some();
        let set = [
            (Figure::Latency, latency.is_some() || self.clocks_within.is_some()),
            (Figure::Jitter, jitter.is_some()),
            (Figure::Loss, loss_permille.is_some()),
            (Figure::Rate, is_rate),
        ];
        set.into_iter().filter(|(_, is_set)| *is_set).map(|(figure, _)| figure)
    }

    /// How it is judged, where channels without a timeout of their own have this one.
    pub(super) fn rules(&self, timeout: Duration) -> ConnectionRules {
        let timeout = self.timeout.unwrap_or(match self.channel {
            // Its lease has a timeout already.
            ConnectedChannel::Commander(_) => Duration::ZERO,
            _ => timeout,
        });
        let presence = match self.rate {
            Some((hz, window)) => Presence::Rate { hz, window },
            None => Presence::Heard { timeout },
        };
        ConnectionRules { presence, limits: self.limits }
    }
}

impl fmt::Debug for Connected {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            ConnectedPart::Channel(ChannelSpec {
                channel,
                timeout,
                rate,
                limits,
                clocks_within,
            }) => {
                write!(f, "{channel}, {timeout:?}, {rate:?}, {limits:?}, {clocks_within:?}")
            }
            ConnectedPart::AtLeast(least, of) => write!(f, "{least} of {of:?}"),
        }
    }
}

impl Connected {
    /// [Heartbeats](Heartbeat) arrive on this topic. It is lost when none arrived for the
    /// [`timeout`](Self::timeout), and until the first one arrives.
    pub fn heartbeat(topic: &str) -> Self {
        let more = |beat: &Heartbeat, arrival| TopicArrival {
            sequence: Some(beat.sequence),
            stamps_us: Some((crate::platform::stamp_us(), beat.stamp_us)),
            ..arrival
        };
        let (topic, contract) = (topic.to_owned(), <Heartbeat as blastema_core::Contract>::NAME);
        ChannelSpec::of(ConnectedChannel::Topic {
            topic,
            listen: listen::<Heartbeat>(more),
            contract,
        })
    }

    /// Events of this contract arrive on this topic.
    pub fn topic<E: Event>(topic: &str) -> Self {
        let listen = listen::<E>(|_, arrival| arrival);
        ChannelSpec::of(ConnectedChannel::Topic {
            topic: topic.to_owned(),
            listen,
            contract: E::NAME,
        })
    }

    /// Events of this contract arrive on this topic at a rate of `hz` or more, counted over
    /// `window`. It is lost below four fifths of the rate.
    pub fn rate<E: Event>(topic: &str, hz: f64, window: Duration) -> Self {
        Connected::topic::<E>(topic).each(|spec| spec.rate = Some((hz, window)))
    }

    /// A path leads to this node: it was discovered, has not left, and is not isolated.
    #[cfg(feature = "network")]
    pub fn node(node: &str) -> Self {
        ChannelSpec::of(ConnectedChannel::Node(node.to_owned()))
    }

    /// A session with this node is open, so that messages reach it.
    #[cfg(feature = "network")]
    pub fn session(node: &str) -> Self {
        ChannelSpec::of(ConnectedChannel::Session(node.to_owned()))
    }

    /// This link is up. Its name is the one that [`LinkRow`](crate::LinkRow) shows.
    #[cfg(feature = "network")]
    pub fn link(link: &str) -> Self {
        ChannelSpec::of(ConnectedChannel::Link(link.to_owned()))
    }

    /// A commander holds this actuator of this node. It is lost with its lease.
    pub fn commander(actuator: &str) -> Self {
        ChannelSpec::of(ConnectedChannel::Commander(actuator.to_owned()))
    }

    /// All of these are connected.
    pub fn all(of: impl IntoIterator<Item = Connected>) -> Self {
        let of: Vec<_> = of.into_iter().collect();
        Connected(ConnectedPart::AtLeast(of.len(), of))
    }

    /// One of these is connected.
    pub fn any(of: impl IntoIterator<Item = Connected>) -> Self {
        Connected::at_least(1, of)
    }

    /// At least so many of these are connected.
    pub fn at_least(least: usize, of: impl IntoIterator<Item = Connected>) -> Self {
        Connected(ConnectedPart::AtLeast(least, of.into_iter().collect()))
    }

    /// Sets how long a channel may be silent. By default as long as the slowest
    /// [medium](crate::MediumKind) of the node's networks asks for, 3 s on a node without networks,
    /// and no longer than its lease for a commander. Of several channels it is set on each that has
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
        let permille = (limit.clamp(0.0, 1.0) * 1000.0).round() as u16;
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

    fn each(mut self, set: impl Fn(&mut ChannelSpec)) -> Self {
        self.for_each(&set);
        self
    }

    fn for_each(&mut self, set: &impl Fn(&mut ChannelSpec)) {
        match &mut self.0 {
            ConnectedPart::Channel(spec) => set(spec),
            ConnectedPart::AtLeast(_, of) => of.iter_mut().for_each(|part| part.for_each(set)),
        }
    }
}
