//! The networks of a node as they are described.

mod beacons;
pub(in crate::node) mod checks;
pub(in crate::node) mod description;
mod exposure;
pub(in crate::node) mod hosts;
mod node;
pub(in crate::node) mod signs;
pub(crate) mod start;

pub use self::exposure::NetworkRow;
pub use self::node::{IsolateError, NotReady};

use crate::net::Interface;
use crate::settings::network::{EXPECTED_WITHIN, HELLO_INTERVAL};
use actix::Addr;
use blastema_contract::transport::{Cut, Impair, MediumAddress, Partition, Restore};
use blastema_transports::endpoint::NamedHost;
use blastema_transports::frame_medium::FrameMedium;
use blastema_transports::{Endpoint, EndpointError, FaultInjector, FrameTransport, Reach};
use std::fmt;
use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

pub use blastema_contract::transport::Direction;
pub use blastema_core::medium::impairment::Impairment;
pub use blastema_transports::MemoryMedium;

/// A network of a node: a medium, and the neighbours reached over it.
///
/// Several networks, or several links of one network, may lead to the same neighbour: the cheapest
/// that is up is used, and the next takes over when it fails, without loss or duplicates for what
/// is sent reliably. Nodes that are no neighbours reach each other through those that are.
///
/// A node with [keys](crate::NodeBuilder::keys) seals each network that leaves the process. Without
/// them, one that leaves this computer must be declared [`insecure`](Network::insecure), or the
/// node does not start.
///
/// Each medium needs its feature: a network over UDP, for example, needs `ip`.
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
    /// The text of its endpoint, which may name a host; empty for a medium of the application's
    /// own.
    endpoint: String,
    medium: Medium,
    /// The medium whose end a `memory://` endpoint is.
    memory: MemoryMedium,
    faults: Option<u64>,
    insecure: bool,
    kind: Option<MediumKind>,
    discovery: Option<Discovered>,
    links: Vec<Link>,
}

/// What a network's medium is like. Conditions over it have a timeout accordingly.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum MediumKind {
    /// A cable: 1.5 s.
    Wired,
    /// WiFi, LTE or another radio, which is silent for a second or two now and then: 4 s.
    Wireless,
    /// By satellite, where seconds of delay are usual: 30 s.
    Satellite,
}

impl MediumKind {
    /// How long a channel over such a medium may be silent, unless a condition says so.
    pub const fn timeout(self) -> Duration {
        match self {
            MediumKind::Wired => Duration::from_millis(1500),
            MediumKind::Wireless => Duration::from_secs(4),
            MediumKind::Satellite => Duration::from_secs(30),
        }
    }
}

/// How neighbours are found that are not described.
struct Discovered {
    /// The group by which beacons are sent.
    group: String,
    /// Those that get a link; `None` for nodes of any name.
    nodes: Option<Vec<String>>,
}

enum Medium {
    /// One of the product.
    At(Endpoint),
    /// The endpoint does not parse. The check of the node returns the error.
    Unreadable(EndpointError),
    /// One of the user.
    Own { make: Box<dyn FnOnce() -> FrameTransport + Send>, name: String, reach: Reach },
}

impl Medium {
    /// The interface and the address that its socket is bound to.
    fn socket(&self) -> Option<(Option<&str>, SocketAddr)> {
        match self {
            Medium::At(Endpoint::Udp(config)) => Some((config.interface.as_deref(), config.bind)),
            Medium::At(Endpoint::Tcp(config)) => Some((config.interface.as_deref(), config.bind)),
            _ => None,
        }
    }
}

impl fmt::Debug for Network {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Network").field("name", &self.name).field("links", &self.links).finish()
    }
}

impl Network {
    /// The medium that this text describes, such as `udp://0.0.0.0:7400` or
    /// `serial:///dev/ttyUSB0?baud=921600`. The [manual](crate::manual::media) lists them all. For
    /// an IP address the name of a host may stand, which is looked up once, when the node starts.
    ///
    /// A text that is wrong is [`StartError::Endpoint`](crate::StartError::Endpoint) when the node
    /// starts.
    pub fn new(name: &str, endpoint: &str) -> Self {
        let parsed = match NamedHost::find(endpoint) {
            Some(named) => named.parse((Ipv4Addr::UNSPECIFIED, 0).into()),
            None => Endpoint::parse(endpoint),
        };
        let (medium, insecure) = match parsed {
            Ok((endpoint, insecure)) => (Medium::At(endpoint), insecure),
            Err(error) => (Medium::Unreadable(error), false),
        };
        Network { endpoint: endpoint.to_owned(), insecure, ..Network::over(name, medium) }
    }

    /// A medium of the application's own. Its links have addresses of its own writing
    /// (`MediumAddress::Own`).
    pub fn own(name: &str, medium: impl FrameMedium) -> Self {
        let (medium_name, reach) = (medium.name(), medium.reach());
        let make = Box::new(|| FrameTransport::new(medium));
        Network::over(name, Medium::Own { make, name: medium_name, reach })
    }

    /// UDP, at this address of our own, or of a group that is heard. Links name the neighbours;
    /// frames from other addresses are dropped.
    #[cfg(feature = "ip")]
    pub fn udp(name: &str, bind: SocketAddr) -> Self {
        Network::new(name, &format!("udp://{bind}"))
    }

    /// A TCP network: `bind` is this node's address; each neighbour has one connection.
    #[cfg(feature = "ip")]
    pub fn tcp(name: &str, bind: SocketAddr) -> Self {
        Network::new(name, &format!("tcp://{bind}"))
    }

    /// A network between nodes of one process, under any clock: for tests. `own` names this node's
    /// end of the medium.
    pub fn memory(name: &str, medium: &MemoryMedium, own: &str) -> Self {
        Network { memory: medium.clone(), ..Network::new(name, &format!("memory://{own}")) }
    }

    fn over(name: &str, medium: Medium) -> Self {
        Network {
            name: name.to_owned(),
            endpoint: String::new(),
            medium,
            memory: MemoryMedium::of_this_process(),
            faults: None,
            insecure: false,
            kind: None,
            discovery: None,
            links: Vec::new(),
        }
    }

    /// Accepts that every station on this network can read its traffic and command this robot: the
    /// node has no [keys](crate::NodeBuilder::keys), so nothing is authenticated or encrypted.
    /// Without keys, and without this word or `insecure` in the endpoint's text, a network that
    /// leaves this computer is [`StartError::Insecure`](crate::StartError::Insecure). Such a
    /// network has the fault [`Insecure`](crate::FaultKind::Insecure) for as long as the node runs.
    /// The word changes nothing about a network that stays within this computer. A node that has
    /// keys refuses it. See the [manual](crate::manual::security).
    pub fn insecure(mut self) -> Self {
        self.insecure = true;
        self
    }

    /// Adds a neighbour with default settings: the node of this name, at this address in the
    /// medium's notation; empty on a serial line.
    pub fn peer(self, neighbour: &str, address: &str) -> Self {
        self.link(Link::to(neighbour, address))
    }

    /// Adds a neighbour.
    pub fn link(mut self, link: Link) -> Self {
        self.links.push(link);
        self
    }

    /// Announces this node's address every second by multicast, to a group such as
    /// `239.255.0.1:7399`, and discovers neighbours that do the same and are not described: nodes
    /// of these names get a link. Without names, this node only sends beacons of its own. For UDP
    /// and TCP.
    pub fn discover<'a>(mut self, group: &str, nodes: impl IntoIterator<Item = &'a str>) -> Self {
        let nodes = nodes.into_iter().map(str::to_owned).collect();
        self.discovery = Some(Discovered { group: group.to_owned(), nodes: Some(nodes) });
        self
    }

    /// Does as [`discover`](Network::discover), and discovers neighbours of any name. On a sealed
    /// network these are the nodes of the roster.
    pub fn discover_all(mut self, group: &str) -> Self {
        self.discovery = Some(Discovered { group: group.to_owned(), nodes: None });
        self
    }

    /// Says what the medium is like, for the [timeouts of
    /// conditions](crate::manual::conditions#timeouts). Otherwise it is wireless where the system
    /// says so of the network's interface, and else wired.
    pub fn medium(mut self, kind: MediumKind) -> Self {
        self.kind = Some(kind);
        self
    }

    /// The interface of its endpoint. When it loses its carrier, links are declared down at once
    /// instead of after missing hellos. A socket that is bound to one address uses the interface
    /// that has it.
    fn used_interface(&self) -> Option<Interface> {
        let (named, bind) = self.medium.socket()?;
        let named = named.map(|name| Interface::Named(name.to_owned()));
        named.or_else(|| Interface::of(bind.ip()))
    }

    /// What the medium is like, as the description or the system says.
    pub(in crate::node) fn medium_kind(&self) -> MediumKind {
        let is_wireless = || self.used_interface().is_some_and(|used| used.is_wireless());
        self.kind.unwrap_or_else(|| match is_wireless() {
            true => MediumKind::Wireless,
            false => MediumKind::Wired,
        })
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
    neighbour: String,
    /// As the medium writes it.
    address: String,
    name: Option<String>,
    cost: Option<u16>,
    hello_every: Duration,
    expected_within: Duration,
}

impl Link {
    /// The node called `neighbour`, at this address.
    pub fn new(neighbour: &str, remote: SocketAddr) -> Self {
        Link::to(neighbour, &remote.to_string())
    }

    /// The node called `neighbour`, at this address as its medium writes it: `10.0.0.2:7400`,
    /// `module2.local:7400` (looked up once, when the node starts), `/run/module2.sock`, a number
    /// on a CAN bus, the name of an end in memory; empty on a serial line, which has one other end.
    ///
    /// An address that is wrong is [`StartError::Endpoint`](crate::StartError::Endpoint) when the
    /// node starts.
    pub fn to(neighbour: &str, address: &str) -> Self {
        Link {
            neighbour: neighbour.to_owned(),
            address: address.to_owned(),
            name: None,
            cost: None,
            hello_every: HELLO_INTERVAL.default,
            expected_within: EXPECTED_WITHIN.default,
        }
    }

    /// Sets the link's name, unique within the node. By default it is the network's name if the
    /// link is the only one there, else both names, as in `ethernet/module2`.
    pub fn named(mut self, name: &str) -> Self {
        self.name = Some(name.to_owned());
        self
    }

    /// Sets the link's cost; the path with the lowest cost is used. At least 1; by default 10, and
    /// more on a medium below one megabyte per second. While a link loses hellos, its cost is
    /// higher than set.
    pub fn cost(mut self, cost: u16) -> Self {
        self.cost = Some(cost);
        self
    }

    /// Sets the hello interval: 50 ms by default, 1 ms to 15 s. On a slow medium the interval is
    /// longer, so that hellos take at most a twentieth of its rate. The neighbour declares the link
    /// down after three and a half intervals without a hello.
    pub fn hello_every(mut self, interval: Duration) -> Self {
        self.hello_every = interval;
        self
    }

    /// Sets how soon after the node's start the neighbour's first hello must arrive: 5 s by
    /// default, plus five hello intervals on a slow medium. After that the link has the fault *link
    /// down* until a hello arrives. At least one hello interval; [`Duration::MAX`] for a neighbour
    /// that may be absent.
    pub fn expected_within(mut self, span: Duration) -> Self {
        self.expected_within = span;
        self
    }
}

/// A cable that can be cut and impaired while the node runs. From
/// [`Node::cable`](crate::Node::cable).
#[derive(Clone, Debug)]
pub struct Cable {
    faulty: Addr<FaultInjector>,
    /// Where the neighbours are on the medium.
    neighbours: Vec<(String, MediumAddress)>,
}

impl Cable {
    /// Cuts the cable. The medium detects a reported cut at once, as Ethernet does; an unreported
    /// one shows only as silence.
    pub fn cut(&self, direction: Direction, reported: bool) {
        self.faulty.do_send(Cut { direction, reported });
    }

    /// Cuts the paths to these neighbours only: no frame passes to or from them, which shows only
    /// as silence. Names that are not neighbours are ignored.
    pub fn part_from(&self, direction: Direction, neighbours: &[&str]) {
        let parted = self.neighbours.iter().filter(|(name, _)| neighbours.contains(&name.as_str()));
        let peers = parted.map(|(_, address)| address.clone()).collect();
        self.faulty.do_send(Partition { direction, peers });
    }

    /// Impairs the cable: loss, delay, duplicates, reordering, corruption, a limited rate.
    pub fn impair(&self, direction: Direction, impairment: Impairment) {
        self.faulty.do_send(Impair { direction, impairment });
    }

    /// Ends all cuts and impairments.
    pub fn restore(&self) {
        self.faulty.do_send(Restore);
    }
}
