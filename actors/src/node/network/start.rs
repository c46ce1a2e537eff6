//! Starts the transports of a network that was described.

use super::beacons::Beacons;
use super::{Cable, Medium, Network};
#[cfg(feature = "serial")]
use crate::net::keys::SealTerms;
use crate::net::{DiscoverySpec, LinkSpec, NetworkSpec};
use crate::node::error::StartError;
use crate::platform;
use crate::runtime::guardian::Guardian;
use crate::settings::network::HELLO_INTERVAL;
use actix::prelude::*;
use blastema_contract::transport::{MediumAddress, Transport};
use blastema_core::ObjectName;
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
    pub(super) fn remote(&self, address: &str) -> Result<MediumAddress, EndpointError> {
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

impl StartedNetwork {
    /// Starts the transports of a network. Nothing runs where that is refused.
    pub(in crate::node) fn start(
        network: Network,
        has_keys: bool,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> Result<StartedNetwork, StartError> {
        let objects = ["transport", "beacons", "cable"].map(|kind| network.object(kind));
        let [object, sender, cable] = objects;
        let (object, sender, cable) = (object?, sender?, cable?);
        let is_sealed = has_keys && network.leaves_process();
        let seal = is_sealed.then(|| network.medium.seal_terms());
        let links = network.link_specs()?;
        let discovered = network.discovery.as_ref().map(|discovery| {
            Ok::<_, StartError>((discovery.beacons(&network)?, discovery.admission(&network.name)?))
        });
        let discovered = discovered.transpose()?;
        let interface = network.used_interface();
        let Network { name, medium, memory, faults, .. } = network;
        #[cfg(feature = "serial")]
        let medium = match seal {
            Some(seal) => medium.with_room_for(seal),
            None => medium,
        };
        let mut transports = vec![object.clone()];
        let place = |object| TransportPlace { object, guardian, arbiter };
        let mut transport = medium.start(&name, memory.clone(), place(object))?;
        let mut discovery = None;
        if let Some((Beacons { socket, group }, admission)) = discovered {
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
}
