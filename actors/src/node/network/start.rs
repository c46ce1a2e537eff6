//! How a network that was described comes to be.

use super::{Admitted, Cable, Link, Medium, Network, Remote};
use crate::net::keys::SealTerms;
use crate::net::{DiscoverySpec, LinkSpec, NetworkSpec};
use crate::node::error::StartError;
use crate::platform;
use crate::runtime::guardian::Guardian;
use crate::settings::network::HELLO_INTERVAL;
use actix::prelude::*;
use blastema_contract::transport::{MediumAddress, Transport};
use blastema_core::net::discovery::DiscoveryAdmission;
use blastema_core::{NodeName, ObjectName};
#[cfg(feature = "unix")]
use blastema_transports::Unix;
use blastema_transports::endpoint::{CanConfig, SlcanConfig};
use blastema_transports::{
    Endpoint, EndpointError, FaultInjector, FaultInjectorConfig, FrameTransport, Memory,
    MemoryConfig, MemoryMedium,
};
#[cfg(feature = "ip")]
use blastema_transports::{Tcp, Udp};

/// A network whose transport runs.
pub(in crate::node) struct StartedNetwork {
    pub(in crate::node) spec: NetworkSpec,
    pub(in crate::node) cable: Option<Cable>,
    pub(in crate::node) neighbours: Vec<NodeName>,
    pub(in crate::node) transports: Vec<ObjectName>,
}

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
            (Remote::Written(text), Medium::Own { .. }) if text.is_empty() => {
                Ok(MediumAddress::Line)
            }
            (Remote::Written(text), Medium::Own { .. }) => {
                Ok(MediumAddress::Own(text.as_str().into()))
            }
        }
    }

    /// How neighbours' addresses are written where they can be told to others.
    fn learned_by(&self) -> Option<&'static str> {
        match self {
            #[cfg(feature = "ip")]
            Medium::At(Endpoint::Udp(config)) if config.group.is_some() => None,
            #[cfg(feature = "ip")]
            Medium::At(Endpoint::Udp(_)) => Some("udp"),
            #[cfg(feature = "ip")]
            Medium::At(Endpoint::Tcp(_)) => Some("tcp"),
            #[cfg(feature = "unix")]
            Medium::At(Endpoint::Unix(_)) => Some("unix"),
            Medium::At(Endpoint::Memory(_)) | Medium::Memory(_) => Some("memory"),
            _ => None,
        }
    }

    /// Sets the node's name, which another node with the same address on a bus gets to see.
    fn name_node(&mut self, own: &NodeName) {
        if let Medium::At(Endpoint::Can(CanConfig { node, .. }))
        | Medium::At(Endpoint::Slcan(SlcanConfig { node, .. })) = self
        {
            node.name = own.to_string();
        }
    }

    /// Lets the frames of a serial line hold a seal beside what they hold without one.
    fn make_room_for(&mut self, seal: SealTerms) {
        if let Medium::At(Endpoint::Serial(config)) = self
            && config.mtu.is_none()
        {
            config.mtu = Some(config.mtu() + seal.profile.overhead());
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
            #[cfg(feature = "ip")]
            Medium::At(Endpoint::Udp(config)) => {
                let make = move |_: &mut Context<Udp>| Udp::new(config);
                Transport::from(guardian.start(object, arbiter, make))
            }
            #[cfg(feature = "ip")]
            Medium::At(Endpoint::Tcp(config)) => {
                let make = move |_: &mut Context<Tcp>| Tcp::new(config);
                Transport::from(guardian.start(object, arbiter, make))
            }
            #[cfg(feature = "unix")]
            Medium::At(Endpoint::Unix(config)) => {
                let make = move |_: &mut Context<Unix>| Unix::new(config);
                Transport::from(guardian.start(object, arbiter, make))
            }
            #[cfg(feature = "serial")]
            Medium::At(Endpoint::Serial(config)) => {
                let make = move |_: &mut Context<FrameTransport>| {
                    FrameTransport::new(blastema_transports::SerialLine::new(config, platform::now))
                };
                Transport::from(guardian.start(object, arbiter, make))
            }
            #[cfg(all(feature = "can", target_os = "linux"))]
            Medium::At(Endpoint::Can(config)) => {
                let make = move |_: &mut Context<FrameTransport>| {
                    FrameTransport::new(blastema_transports::CanBus::new(config, platform::now))
                };
                Transport::from(guardian.start(object, arbiter, make))
            }
            #[cfg(feature = "slcan")]
            Medium::At(Endpoint::Slcan(config)) => {
                let make = move |_: &mut Context<FrameTransport>| {
                    FrameTransport::new(blastema_transports::SlcanBus::new(config, platform::now))
                };
                Transport::from(guardian.start(object, arbiter, make))
            }
            Medium::At(Endpoint::Memory(end)) => {
                let config = MemoryConfig::new(&MemoryMedium::of_this_process(), &end);
                return Medium::Memory(config).start(network, object, guardian, arbiter);
            }
            Medium::At(other) => {
                let text = format!(
                    "network {network}: this program has no {}: it was built without it, or this \
                     system has none",
                    other.medium()
                );
                return Err(StartError::Network(text));
            }
            Medium::Memory(config) => {
                let make = move |_: &mut Context<Memory>| Memory::new(config);
                Transport::from(guardian.start(object, arbiter, make))
            }
            Medium::Own { make, .. } => {
                let make = move |_: &mut Context<FrameTransport>| make();
                Transport::from(guardian.start(object, arbiter, make))
            }
            Medium::Unreadable(error) => {
                return Err(StartError::Endpoint { network: network.to_owned(), error });
            }
        })
    }
}

impl Network {
    /// Starts the transport, of this node.
    pub(in crate::node) fn lay(
        self,
        (own, has_keys): (&NodeName, bool),
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> Result<StartedNetwork, StartError> {
        let seal = self.seal_terms().filter(|_| has_keys);
        let link_names: Vec<String> = self.link_names().collect();
        let Network { name, mut medium, links, faults, interface, admission, beacons, .. } = self;
        medium.name_node(own);
        if let Some(seal) = seal {
            medium.make_room_for(seal);
        }
        let of = format!("the name of network {name:?}");
        let object =
            ObjectName::new(&format!("transport/{name}")).map_err(StartError::name_of(of))?;
        let mut neighbours = Vec::new();
        let mut specs = Vec::new();
        for (link_name, link) in link_names.into_iter().zip(links) {
            let Link { neighbour, remote, cost, hello_interval, expected_within, .. } = link;
            let of = format!("the name of a neighbour on network {name}");
            let node = NodeName::new(&neighbour).map_err(StartError::name_of(of))?;
            let remote = medium
                .remote(remote)
                .map_err(|error| StartError::Endpoint { network: name.clone(), error })?;
            neighbours.push(node.clone());
            let neighbour = Some(node);
            specs.push(LinkSpec {
                name: link_name.into(),
                remote,
                neighbour,
                cost,
                hello_interval,
                expected_within,
            });
        }
        let mut transports = vec![object.clone()];
        let learned = medium.learned_by();
        let beacons = match (beacons, medium.socket()) {
            #[cfg(feature = "ip")]
            (Some(group), Some((interface, bind))) => {
                let object = ObjectName::new(&format!("beacons/{name}"))
                    .map_err(StartError::name_of(format!("the name of network {name:?}")))?;
                let at = (bind.ip(), interface.map(str::to_owned));
                let config = super::beacons::config(&name, at, &group)?;
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
            Some(Admitted::AnyNode) => Some(DiscoveryAdmission::AnyNode),
            Some(Admitted::Only(nodes)) => {
                let nodes: Result<_, _> = nodes.iter().map(|node| NodeName::new(node)).collect();
                let of = format!("the name of a node that network {name} is discovered by");
                Some(DiscoveryAdmission::Only(nodes.map_err(StartError::name_of(of))?))
            }
        };
        let discovery = learned.zip(admission).map(|(medium, admission)| DiscoverySpec {
            medium,
            admission,
            hello_interval: HELLO_INTERVAL.default,
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
                let (inner, config) =
                    (transport.clone(), FaultInjectorConfig::new(seed, platform::now));
                let make = move |_: &mut Context<FaultInjector>| FaultInjector::new(inner, config);
                let faulty = guardian.start(object, arbiter, make);
                transport = Transport::from(faulty.clone());
                let there = |spec: &LinkSpec| {
                    Some((spec.neighbour.as_ref()?.to_string(), spec.remote.clone()))
                };
                Some(Cable { faulty, neighbours: specs.iter().filter_map(there).collect() })
            }
        };
        let name = name.into();
        let spec = NetworkSpec { name, transport, interface, links: specs, discovery, seal };
        Ok(StartedNetwork { spec, cable, neighbours, transports })
    }
}
