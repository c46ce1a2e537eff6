//! Starts the transports of a network that was described.

use super::beacons::Beacons;
use super::{Cable, Discovered, Link, Medium, Network};
#[cfg(feature = "serial")]
use crate::net::keys::SealTerms;
use crate::net::{DiscoverySpec, LinkSpec, NetworkSpec};
use crate::node::error::StartError;
use crate::platform;
use crate::runtime::guardian::Guardian;
use crate::settings::network::HELLO_INTERVAL;
use actix::prelude::*;
use blastema_contract::transport::{MediumAddress, Transport};
use blastema_core::net::discovery::DiscoveryAdmission;
use blastema_core::sorted::SortedSet;
use blastema_core::{NodeName, ObjectName};
#[cfg(feature = "unix")]
use blastema_transports::Unix;
use blastema_transports::{
    Endpoint, EndpointError, FaultInjector, FaultInjectorConfig, FrameTransport, Memory,
    MemoryMedium,
};
#[cfg(feature = "ip")]
use blastema_transports::{Tcp, Udp};

/// A network whose transport runs.
pub(in crate::node) struct StartedNetwork {
    pub(in crate::node) spec: NetworkSpec,
    pub(in crate::node) cable: Option<Cable>,
    pub(in crate::node) transports: Vec<ObjectName>,
}

/// What the check of the networks does with an endpoint that does not parse.
const REFUSED: &str = "a wrong endpoint is refused before the start";

impl Medium {
    /// The address of a neighbour as this medium has it.
    fn remote(&self, address: &str) -> Result<MediumAddress, EndpointError> {
        match self {
            Medium::At(endpoint) => endpoint.peer(address),
            Medium::Unreadable(error) => unreachable!("{REFUSED}: {error}"),
            Medium::Own { .. } if address.is_empty() => Ok(MediumAddress::Line),
            Medium::Own { .. } => Ok(MediumAddress::Own(address.into())),
        }
    }

    /// Lets the frames of a serial line hold a seal beside what they hold without one.
    #[cfg(feature = "serial")]
    fn with_room_for(mut self, seal: SealTerms) -> Self {
        if let Medium::At(Endpoint::Serial(config)) = &mut self
            && config.mtu.is_none()
        {
            config.mtu = Some(config.mtu() + seal.profile.overhead());
        }
        self
    }

    fn start(
        self,
        network: &str,
        memory: MemoryMedium,
        place: TransportPlace<'_>,
    ) -> Result<Transport, StartError> {
        Ok(match self {
            #[cfg(feature = "ip")]
            Medium::At(Endpoint::Udp(config)) => place.start(|| Udp::new(config)),
            #[cfg(feature = "ip")]
            Medium::At(Endpoint::Tcp(config)) => place.start(|| Tcp::new(config)),
            #[cfg(feature = "unix")]
            Medium::At(Endpoint::Unix(config)) => place.start(|| Unix::new(config)),
            #[cfg(feature = "serial")]
            Medium::At(Endpoint::Serial(config)) => place.start(|| {
                FrameTransport::new(blastema_transports::SerialLine::new(config, platform::now))
            }),
            #[cfg(all(feature = "can", target_os = "linux"))]
            Medium::At(Endpoint::Can(config)) => place.start(|| {
                FrameTransport::new(blastema_transports::CanBus::new(config, platform::now))
            }),
            #[cfg(feature = "slcan")]
            Medium::At(Endpoint::Slcan(config)) => place.start(|| {
                FrameTransport::new(blastema_transports::SlcanBus::new(config, platform::now))
            }),
            Medium::At(Endpoint::Memory(end)) => {
                place.start(move || FrameTransport::new(Memory::new(&memory, &end)))
            }
            Medium::At(other) => {
                let text = format!(
                    "network {network}: this program has no {}: it was built without it, or this \
                     system has none",
                    other.medium()
                );
                return Err(StartError::Network(text));
            }
            Medium::Own { make, .. } => place.start(make),
            Medium::Unreadable(error) => unreachable!("{REFUSED}: {error}"),
        })
    }
}

/// Where the actor of a transport is started, and its name.
struct TransportPlace<'a> {
    object: ObjectName,
    guardian: &'a Guardian,
    arbiter: Option<&'a ArbiterHandle>,
}

impl TransportPlace<'_> {
    fn start<A>(self, make: impl FnOnce() -> A + Send + 'static) -> Transport
    where
        A: Actor<Context = Context<A>> + Supervised,
        Transport: From<Addr<A>>,
    {
        self.guardian.start(self.object, self.arbiter, |_: &mut Context<A>| make()).into()
    }
}

impl Network {
    /// Starts the transports. Nothing runs where that is refused.
    pub(in crate::node) fn start(
        self,
        has_keys: bool,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> Result<StartedNetwork, StartError> {
        let [object, sender, cable] = ["transport", "beacons", "cable"].map(|of| self.object(of));
        let (object, sender, cable) = (object?, sender?, cable?);
        let seal = self.seal_terms().filter(|_| has_keys);
        let links = self.link_specs()?;
        let beacons = self.beacon_socket()?;
        let admission = self.admission()?;
        let interface = self.used_interface();
        let Network { name, medium, memory, faults, .. } = self;
        #[cfg(feature = "serial")]
        let medium = match seal {
            Some(seal) => medium.with_room_for(seal),
            None => medium,
        };
        let mut transports = vec![object.clone()];
        let place = |object| TransportPlace { object, guardian, arbiter };
        let mut transport = medium.start(&name, memory.clone(), place(object))?;
        let mut discovery = None;
        if let (Some(Beacons { socket, group }), Some(admission)) = (beacons, admission) {
            transports.push(sender.clone());
            let beacons = (socket.start(&name, memory.clone(), place(sender))?, group);
            let hello_interval = HELLO_INTERVAL.default;
            discovery = Some(DiscoverySpec { admission, hello_interval, beacons });
        }
        let cable = faults.map(|seed| {
            transports.push(cable.clone());
            let (inner, config) =
                (transport.clone(), FaultInjectorConfig::new(seed, platform::now));
            let make = move |_: &mut Context<FaultInjector>| FaultInjector::new(inner, config);
            let faulty = guardian.start(cable, arbiter, make);
            transport = Transport::from(faulty.clone());
            let there =
                |spec: &LinkSpec| Some((spec.neighbour.as_ref()?.to_string(), spec.remote.clone()));
            Cable { faulty, neighbours: links.iter().filter_map(there).collect() }
        });
        let name = name.into();
        let spec = NetworkSpec { name, transport, interface, links, discovery, seal };
        Ok(StartedNetwork { spec, cable, transports })
    }

    /// The name of an object of this network.
    pub(super) fn object(&self, kind: &str) -> Result<ObjectName, StartError> {
        let object = ObjectName::new(&format!("{kind}/{}", self.name));
        object.map_err(StartError::name_of(format!("the name of network {:?}", self.name)))
    }

    pub(super) fn link_specs(&self) -> Result<Vec<LinkSpec>, StartError> {
        let mut remotes = SortedSet::new();
        let spec = |link: &Link| {
            let of = format!("the name of a neighbour on network {}", self.name);
            let neighbour = NodeName::new(&link.neighbour).map_err(StartError::name_of(of))?;
            let remote = self.medium.remote(&link.address);
            let remote = remote.map_err(|error| self.endpoint_error(Some(&neighbour), error))?;
            if !remotes.insert(remote.clone()) {
                return Err(StartError::Network(format!(
                    "two links of network {} lead to {remote}: leave one of them out",
                    self.name
                )));
            }
            Ok(LinkSpec {
                name: self.link_name(link).into(),
                remote,
                neighbour: Some(neighbour),
                cost: link.cost,
                hello_interval: link.hello_every,
                expected_within: link.expected_within,
            })
        };
        self.links.iter().map(spec).collect()
    }

    /// An address is wrong: our own, or that of a neighbour.
    pub(super) fn endpoint_error(
        &self,
        neighbour: Option<&NodeName>,
        error: EndpointError,
    ) -> StartError {
        let neighbour = neighbour.cloned();
        StartError::Endpoint { network: self.name.clone(), neighbour, error }
    }

    /// Who is admitted, but for those that are described.
    pub(super) fn admission(&self) -> Result<Option<DiscoveryAdmission>, StartError> {
        let Some(Discovered { nodes, .. }) = &self.discovery else { return Ok(None) };
        let Some(nodes) = nodes else { return Ok(Some(DiscoveryAdmission::AnyNode)) };
        let nodes: Result<_, _> = nodes.iter().map(|node| NodeName::new(node)).collect();
        let of = format!("the name of a node that network {} is discovered by", self.name);
        Ok(Some(DiscoveryAdmission::Only(nodes.map_err(StartError::name_of(of))?)))
    }
}
