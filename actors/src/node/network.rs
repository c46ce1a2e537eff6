//! The networks of a node as they are described.

use super::builder::StartError;
use crate::guardian::Guardian;
use crate::net::{DiscoverySpec, Interface, LinkSpec, NetworkSpec};
use crate::platform;
use actix::prelude::*;
use blastema_contract::transport::{
    Cut, Impair, InjectedFaults, MediumAddress, Partition, ReadInjectedFaults, Restore, Transport,
};
use blastema_core::net::discovery::Admission;
use blastema_core::{NodeName, ObjectName};
use blastema_transports::frame_medium::FrameMedium;
use blastema_transports::{
    CanConfig, Endpoint, EndpointError, Faulty, FaultyConfig, FrameTransport, Memory, MemoryConfig,
    SerialLine, SlcanBus, SlcanConfig, Tcp, TcpConfig, Udp, UdpConfig, Unix,
};
use std::fmt;
use std::net::{IpAddr, SocketAddr};
use std::ops::RangeInclusive;
use std::time::Duration;

pub use blastema_contract::transport::Direction;
pub use blastema_core::impairment::Impairment;
pub use blastema_transports::MemoryMedium;

/// One network that a node is on: a medium, and the neighbours that it leads to.
///
/// Several networks, or several links of one network, may lead to the same neighbour: the cheapest that
/// is up is used, and the next takes over when it fails, without loss or duplicates for what is sent
/// reliably. Nodes that are no neighbours reach each other through those that are.
///
/// ```
/// use blastema::{Link, Network};
///
/// let ethernet = Network::new("ethernet", "udp://0.0.0.0:7400?interface=eth0")
///     .peer("module2", "192.168.0.2:7400")
///     .link(Link::to("module3", "192.168.0.3:7400").cost(20));
/// let cable = Network::new("cable", "serial:///dev/ttyUSB0?baud=921600").peer("module2", "");
/// ```
#[must_use = "a network does nothing until it is given to a node"]
pub struct Network {
    name: String,
    medium: Medium,
    links: Vec<Link>,
    faults: Option<u64>,
    interface: Option<Interface>,
    admission: Option<Admitted>,
    /// The group by which beacons are sent, as it was written.
    beacons: Option<String>,
}

/// Who is admitted, as it was written.
enum Admitted {
    Anybody,
    Only(Vec<String>),
}

enum Medium {
    At(Endpoint),
    /// The endpoint does not parse, which is said when the node starts.
    Unreadable(EndpointError),
    Memory(MemoryConfig),
    Own(Box<dyn FnOnce() -> FrameTransport + Send>),
}

impl fmt::Debug for Network {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Network").field("name", &self.name).field("links", &self.links).finish()
    }
}

impl Network {
    /// The medium that this text describes, such as `udp://0.0.0.0:7400` or
    /// `serial:///dev/ttyUSB0?baud=921600`. The [manual](crate::manual::media) lists them all.
    ///
    /// A text that is wrong is [`StartError::Endpoint`] when the node starts.
    pub fn new(name: &str, endpoint: &str) -> Self {
        let medium = endpoint.parse().map_or_else(Medium::Unreadable, Medium::At);
        Network::over(name, medium)
    }

    /// A medium of the application's own.
    pub fn own(name: &str, medium: impl FrameMedium) -> Self {
        Network::over(name, Medium::Own(Box::new(|| FrameTransport::new(medium))))
    }

    /// UDP, at this address of our own. Links name the neighbours; nobody else is listened to.
    pub fn udp(name: &str, bind: SocketAddr) -> Self {
        Network::udp_with(name, {
            let mut config = UdpConfig::default();
            config.bind = bind;
            config
        })
    }

    /// UDP with every setting.
    pub fn udp_with(name: &str, config: UdpConfig) -> Self {
        Network::over(name, Medium::At(Endpoint::Udp(config)))
    }

    /// TCP, at this address of our own, with one connection to each neighbour.
    pub fn tcp(name: &str, bind: SocketAddr) -> Self {
        Network::tcp_with(name, {
            let mut config = TcpConfig::default();
            config.bind = bind;
            config
        })
    }

    /// TCP with every setting.
    pub fn tcp_with(name: &str, config: TcpConfig) -> Self {
        Network::over(name, Medium::At(Endpoint::Tcp(config)))
    }

    /// Between nodes of one process, under whatever clock they have: for tests. `own` is the name of
    /// our end of the medium.
    pub fn memory(name: &str, medium: &MemoryMedium, own: &str) -> Self {
        Network::over(name, Medium::Memory(MemoryConfig::new(medium, own)))
    }

    fn over(name: &str, medium: Medium) -> Self {
        // A socket that is bound to one address uses the interface that has it.
        let (named, bind) = match &medium {
            Medium::At(Endpoint::Udp(config)) => (config.interface.clone(), Some(config.bind)),
            Medium::At(Endpoint::Tcp(config)) => (config.interface.clone(), Some(config.bind)),
            _ => (None, None),
        };
        let by_address = || Interface::of(bind?.ip());
        let interface = named.map(Interface::Named).or_else(by_address);
        Network {
            name: name.to_owned(),
            medium,
            links: Vec::new(),
            faults: None,
            interface,
            admission: None,
            beacons: None,
        }
    }

    /// One more neighbour, with everything usual: the node of this name, at this address as the medium
    /// writes it; empty on a serial line.
    pub fn peer(self, neighbour: &str, address: &str) -> Self {
        self.link(Link::to(neighbour, address))
    }

    /// One more neighbour.
    pub fn link(mut self, link: Link) -> Self {
        self.links.push(link);
        self
    }

    /// Learns of neighbours that are not described, and tells neighbours of each other
    /// ([gossip](crate::manual::networks#discovery)): nodes of these names get a link when a neighbour on
    /// this network says where they are. Without any name, it only tells. Over UDP, TCP, Unix sockets and
    /// memory; elsewhere there is nothing to learn, and this does nothing.
    pub fn discover<'a>(mut self, nodes: impl IntoIterator<Item = &'a str>) -> Self {
        let nodes = nodes.into_iter().map(str::to_owned);
        self.admission = Some(Admitted::Only(nodes.collect()));
        self
    }

    /// Learns of neighbours, whatever they are called, and tells neighbours of each other.
    pub fn discover_anybody(mut self) -> Self {
        self.admission = Some(Admitted::Anybody);
        self
    }

    /// Says every second by multicast, to a group such as `239.255.0.1:7399`, where this node is, and learns of
    /// others that do; neighbours need not be described at all then. Who is admitted is said by
    /// [`discover`](Network::discover) or [`discover_anybody`](Network::discover_anybody). For UDP and TCP.
    pub fn beacons(mut self, group: &str) -> Self {
        self.beacons = Some(group.to_owned());
        self
    }

    /// The network interface that is used, such as `eth0`. When it loses its carrier, its links are given
    /// up at once instead of after some missing hellos. Where the socket is bound to an address of
    /// one interface, this need not be said.
    pub fn interface(mut self, name: &str) -> Self {
        self.interface = Some(Interface::Named(name.to_owned()));
        self
    }

    /// Puts a cable before the medium that can be cut and made bad while the node runs, by
    /// [`Node::cable`](crate::Node::cable). Chance is drawn from `seed`.
    pub fn with_faults(mut self, seed: u64) -> Self {
        self.faults = Some(seed);
        self
    }
}

/// One neighbour on a [`Network`].
#[derive(Clone, Debug)]
#[must_use = "a link does nothing until it is given to a network"]
pub struct Link {
    name: Option<String>,
    neighbour: String,
    remote: Remote,
    cost: Option<u16>,
    hello_interval: Option<Duration>,
    expected_within: Duration,
}

/// Where a neighbour is.
#[derive(Clone, Debug)]
enum Remote {
    At(MediumAddress),
    /// As its medium writes it.
    Written(String),
}

impl Link {
    /// The node called `neighbour`, at this address.
    pub fn new(neighbour: &str, remote: SocketAddr) -> Self {
        Link::at(neighbour, Remote::At(MediumAddress::Ip(remote)))
    }

    /// The node called `neighbour`, at this address as its medium writes it: `10.0.0.2:7400`,
    /// `/run/module2.sock`, a number on a CAN bus; empty on a serial line, which leads to nobody else.
    ///
    /// An address that is wrong is [`StartError::Endpoint`] when the node starts.
    pub fn to(neighbour: &str, address: &str) -> Self {
        Link::at(neighbour, Remote::Written(address.to_owned()))
    }

    /// The node called `neighbour`, at this end of a memory medium.
    pub fn in_memory(neighbour: &str, end: &str) -> Self {
        Link::at(neighbour, Remote::At(MediumAddress::Memory(end.into())))
    }

    fn at(neighbour: &str, remote: Remote) -> Self {
        let neighbour = neighbour.to_owned();
        let expected_within = Duration::from_secs(5);
        Link { name: None, neighbour, remote, cost: None, hello_interval: None, expected_within }
    }

    /// How people call it. Unless this says otherwise, it has the network's name where it is the only
    /// link there, and else both names, as in `ethernet/module2`.
    pub fn named(mut self, name: &str) -> Self {
        self.name = Some(name.to_owned());
        self
    }

    /// How dear it is to use. Of two paths the cheaper is taken. Unless this says otherwise, 10, and more
    /// on a medium that carries less than a megabyte per second. A link that loses hellos costs more than
    /// this for as long as it does.
    pub fn cost(mut self, cost: u16) -> Self {
        self.cost = Some(cost);
        self
    }

    /// How often a hello is sent, 50 ms unless this says otherwise; on a slow medium less often, so that
    /// hellos take no more than a twentieth of it. Shorter finds a dead link sooner and costs more; the
    /// neighbour finds this end dead after three and a half of them.
    pub fn hello_every(mut self, interval: Duration) -> Self {
        self.hello_interval = Some(interval);
        self
    }

    /// How soon after the node's start the neighbour must have been heard, 5 s unless this says
    /// otherwise; on a slow medium, five hellos more. After that the link is a fault, *link down*, until
    /// it comes. [`Duration::MAX`] is for a neighbour that need not come at all.
    pub fn expected_within(mut self, span: Duration) -> Self {
        self.expected_within = span;
        self
    }
}

/// A cable that can be cut and made bad while the node runs. From [`Node::cable`](crate::Node::cable).
#[derive(Clone, Debug)]
pub struct Cable {
    faulty: Addr<Faulty>,
    /// Where the neighbours are on the medium.
    neighbours: Vec<(String, MediumAddress)>,
}

impl Cable {
    /// Cuts it. A reported cut is one of which the medium knows at once, as Ethernet does; another is
    /// noticed only by silence.
    pub fn cut(&self, direction: Direction, reported: bool) {
        self.faulty.do_send(Cut { direction, reported });
    }

    /// Parts it from these neighbours, and from no others: nothing passes to and from them, which is
    /// noticed only by silence. Names that are no neighbours' here are left out.
    pub fn part_from(&self, direction: Direction, neighbours: &[&str]) {
        let parted = self.neighbours.iter().filter(|(name, _)| neighbours.contains(&name.as_str()));
        let peers = parted.map(|(_, address)| address.clone()).collect();
        self.faulty.do_send(Partition { direction, peers });
    }

    /// Makes it bad: loss, delay, duplicates, reordering, corruption, a limited rate.
    pub fn impair(&self, direction: Direction, impairment: Impairment) {
        self.faulty.do_send(Impair { direction, impairment });
    }

    /// Mends it.
    pub fn restore(&self) {
        self.faulty.do_send(Restore);
    }

    /// What it did to the frames so far; `None` once the node has ended.
    pub async fn injected(&self) -> Option<InjectedFaults> {
        self.faulty.send(ReadInjectedFaults).await.ok()
    }
}

/// A network whose transport runs.
pub(super) struct Laid {
    pub(super) spec: NetworkSpec,
    pub(super) cable: Option<Cable>,
    pub(super) neighbours: Vec<NodeName>,
    pub(super) transports: Vec<ObjectName>,
}

/// A dead link is found after three and a half hellos: 175 ms. A process that gets no time for so long
/// looks dead to its neighbours; on a computer that is never overloaded, less is fine.
const HELLO_INTERVAL: Duration = Duration::from_millis(50);

impl Medium {
    /// The address of a neighbour as this medium has it.
    fn remote(&self, remote: Remote) -> Result<MediumAddress, EndpointError> {
        match (remote, self) {
            (Remote::At(address), _) => Ok(address),
            (Remote::Written(text), Medium::At(endpoint)) => endpoint.peer(&text),
            (Remote::Written(_), Medium::Unreadable(error)) => Err(error.clone()),
            (Remote::Written(text), Medium::Memory(_)) => {
                Ok(MediumAddress::Memory(text.as_str().into()))
            }
            (Remote::Written(text), Medium::Own(_)) if text.is_empty() => Ok(MediumAddress::Line),
            (Remote::Written(text), Medium::Own(_)) => Ok(MediumAddress::Own(text.as_str().into())),
        }
    }

    /// How neighbours' addresses are written where they can be told to others.
    fn learned_by(&self) -> Option<&'static str> {
        match self {
            Medium::At(Endpoint::Udp(config)) if config.group.is_some() => None,
            Medium::At(Endpoint::Udp(_)) => Some("udp"),
            Medium::At(Endpoint::Tcp(_)) => Some("tcp"),
            Medium::At(Endpoint::Unix(_)) => Some("unix"),
            Medium::At(Endpoint::Memory(_)) | Medium::Memory(_) => Some("memory"),
            _ => None,
        }
    }

    /// Whoever clashes with us there is to learn who we are.
    fn name_node(&mut self, own: &NodeName) {
        if let Medium::At(Endpoint::Can(CanConfig { node, .. }))
        | Medium::At(Endpoint::Slcan(SlcanConfig { node, .. })) = self
        {
            node.name = own.to_string();
        }
    }

    fn start(
        self,
        network: &str,
        object: ObjectName,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> Result<Transport, StartError> {
        Ok(match self {
            Medium::At(Endpoint::Udp(config)) => {
                let make = move |_: &mut Context<Udp>| Udp::new(config);
                Transport::from(guardian.start(object, arbiter, make))
            }
            Medium::At(Endpoint::Tcp(config)) => {
                let make = move |_: &mut Context<Tcp>| Tcp::new(config);
                Transport::from(guardian.start(object, arbiter, make))
            }
            Medium::At(Endpoint::Unix(config)) => {
                let make = move |_: &mut Context<Unix>| Unix::new(config);
                Transport::from(guardian.start(object, arbiter, make))
            }
            Medium::At(Endpoint::Serial(config)) => {
                let make = move |_: &mut Context<FrameTransport>| {
                    FrameTransport::new(SerialLine::new(config, platform::now))
                };
                Transport::from(guardian.start(object, arbiter, make))
            }
            #[cfg(target_os = "linux")]
            Medium::At(Endpoint::Can(config)) => {
                let make = move |_: &mut Context<FrameTransport>| {
                    FrameTransport::new(blastema_transports::CanBus::new(config, platform::now))
                };
                Transport::from(guardian.start(object, arbiter, make))
            }
            Medium::At(Endpoint::Slcan(config)) => {
                let make = move |_: &mut Context<FrameTransport>| {
                    FrameTransport::new(SlcanBus::new(config, platform::now))
                };
                Transport::from(guardian.start(object, arbiter, make))
            }
            Medium::At(Endpoint::Memory(end)) => {
                let config = MemoryConfig::new(&MemoryMedium::of_this_process(), &end);
                return Medium::Memory(config).start(network, object, guardian, arbiter);
            }
            Medium::At(other) => {
                let text = format!("network {network}: this program has no {}", other.medium());
                return Err(StartError::Network(text));
            }
            Medium::Memory(config) => {
                let make = move |_: &mut Context<Memory>| Memory::new(config);
                Transport::from(guardian.start(object, arbiter, make))
            }
            Medium::Own(make) => {
                let make = move |_: &mut Context<FrameTransport>| make();
                Transport::from(guardian.start(object, arbiter, make))
            }
            Medium::Unreadable(error) => {
                return Err(StartError::Endpoint { network: network.to_owned(), error });
            }
        })
    }
}

/// Where beacons are sent from, and heard: the interface that the network itself uses.
fn beacon_config(
    network: &str,
    (ip, interface): (IpAddr, Option<String>),
    group: &str,
) -> Result<UdpConfig, StartError> {
    match format!("udp://{group}").parse() {
        Ok(Endpoint::Udp(mut config)) if config.group.is_some() => {
            (config.bind, config.interface) = (SocketAddr::new(ip, 0), interface);
            Ok(config)
        }
        Ok(_) => {
            let text = format!(
                "network {network}: {group} is no multicast group: write one, as in 239.255.0.1:7399"
            );
            Err(StartError::Network(text))
        }
        Err(error) => Err(StartError::Endpoint { network: network.to_owned(), error }),
    }
}

/// How often a hello may be said: more often is taken for an attack by the neighbour, and a link must be
/// known to be dead within a minute.
const HELLO_RANGE: RangeInclusive<Duration> = Duration::from_millis(1)..=Duration::from_secs(15);

impl Network {
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Finds what can be known to be wrong before anything is started.
    pub(super) fn check(&self, node: &NodeName) -> Result<(), StartError> {
        let network = &self.name;
        for Link { neighbour, remote, hello_interval, .. } in &self.links {
            if neighbour == node.as_str() {
                let text = format!(
                    "network {network}: {neighbour} is this node itself, and no neighbour: write \
                     the neighbour's name, or leave the link out"
                );
                return Err(StartError::Network(text));
            }
            if let Some(interval) = hello_interval
                && !HELLO_RANGE.contains(interval)
            {
                let text = format!(
                    "network {network}: the hello to {neighbour} cannot be said every {interval:?}: \
                     1 ms to 15 s"
                );
                return Err(StartError::Network(text));
            }
            if let (Remote::At(address), Medium::At(endpoint)) = (remote, &self.medium)
                && let Some(why) = endpoint.objection(address)
            {
                let text =
                    format!("network {network}: {address} is not where {neighbour} is: {why}");
                return Err(StartError::Network(text));
            }
        }
        Ok(())
    }

    /// Starts the transport, of this node.
    pub(super) fn lay(
        self,
        own: &NodeName,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> Result<Laid, StartError> {
        let Network { name, mut medium, links, faults, interface, admission, beacons } = self;
        medium.name_node(own);
        let of = format!("the name of network {name:?}");
        let object =
            ObjectName::new(&format!("transport/{name}")).map_err(StartError::name_of(of))?;
        let mut neighbours = Vec::new();
        let mut specs = Vec::new();
        let alone = links.len() == 1;
        for Link { name: own, neighbour, remote, cost, hello_interval, expected_within } in links {
            let of = format!("the name of a neighbour on network {name}");
            let node = NodeName::new(&neighbour).map_err(StartError::name_of(of))?;
            let usual = if alone { name.clone() } else { format!("{name}/{neighbour}") };
            let link = own.unwrap_or(usual).into();
            let remote = medium
                .remote(remote)
                .map_err(|error| StartError::Endpoint { network: name.clone(), error })?;
            let hello_interval = hello_interval.unwrap_or(HELLO_INTERVAL);
            neighbours.push(node.clone());
            let neighbour = Some(node);
            let expected_within = Some(expected_within);
            specs.push(LinkSpec {
                name: link,
                remote,
                neighbour,
                cost,
                hello_interval,
                expected_within,
            });
        }
        let mut transports = vec![object.clone()];
        let learned = medium.learned_by();
        let at = match &medium {
            Medium::At(Endpoint::Udp(config)) => Some((config.bind.ip(), config.interface.clone())),
            Medium::At(Endpoint::Tcp(config)) => Some((config.bind.ip(), config.interface.clone())),
            _ => None,
        };
        let beacons = match (beacons, at) {
            (Some(group), Some(at)) => {
                let object = ObjectName::new(&format!("beacons/{name}"))
                    .map_err(StartError::name_of(format!("the name of network {name:?}")))?;
                let config = beacon_config(&name, at, &group)?;
                let group = config.group;
                let make = move |_: &mut Context<Udp>| Udp::new(config);
                transports.push(object.clone());
                let transport = Transport::from(guardian.start(object, arbiter, make));
                group.map(|group| (transport, group))
            }
            (Some(_), _) => {
                let text = format!("network {name}: beacons are for udp and tcp: leave them out");
                return Err(StartError::Network(text));
            }
            (None, _) => None,
        };
        let admission = match admission {
            None if beacons.is_some() => {
                let text = format!("network {name}: say whom the beacons are for, by discover()");
                return Err(StartError::Network(text));
            }
            None => None,
            Some(Admitted::Anybody) => Some(Admission::Anybody),
            Some(Admitted::Only(nodes)) => {
                let nodes: Result<_, _> = nodes.iter().map(|node| NodeName::new(node)).collect();
                let of = format!("the name of a node that network {name} is discovered by");
                Some(Admission::Only(nodes.map_err(StartError::name_of(of))?))
            }
        };
        let discovery = learned.zip(admission).map(|(medium, admission)| DiscoverySpec {
            medium,
            admission,
            hello_interval: HELLO_INTERVAL,
            beacons,
        });
        let mut transport = medium.start(&name, object, guardian, arbiter)?;
        let cable = match faults {
            None => None,
            Some(seed) => {
                let of = format!("the name of network {name:?}");
                let object =
                    ObjectName::new(&format!("cable/{name}")).map_err(StartError::name_of(of))?;
                transports.push(object.clone());
                let (inner, config) = (transport.clone(), FaultyConfig::new(seed, platform::now));
                let make = move |_: &mut Context<Faulty>| Faulty::new(inner, config);
                let faulty = guardian.start(object, arbiter, make);
                transport = Transport::from(faulty.clone());
                let there = |spec: &LinkSpec| {
                    Some((spec.neighbour.as_ref()?.to_string(), spec.remote.clone()))
                };
                Some(Cable { faulty, neighbours: specs.iter().filter_map(there).collect() })
            }
        };
        let spec = NetworkSpec { name: name.into(), transport, interface, links: specs, discovery };
        Ok(Laid { spec, cable, neighbours, transports })
    }
}
