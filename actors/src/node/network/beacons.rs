//! The multicast group at which a node makes itself known, and the nodes that it finds there.

use super::{Discovered, Medium, Network};
use crate::node::error::StartError;
use blastema_core::NodeName;
use blastema_core::net::discovery::DiscoveryAdmission;
use blastema_transports::{Endpoint, UdpConfig};
use std::net::SocketAddr;

/// Where beacons are sent from and received: the interface that the network itself uses. A program
/// without UDP has none.
pub(super) struct Beacons {
    pub(super) socket: Medium,
    pub(super) group: SocketAddr,
}

impl Discovered {
    /// The socket of the beacons of this network.
    pub(super) fn beacons(&self, network: &Network) -> Result<Beacons, StartError> {
        let group = &self.group;
        let wrong = |what| Err(StartError::Network(format!("network {}: {what}", network.name)));
        if let Medium::At(Endpoint::Udp(UdpConfig { group: Some(_), .. })) = &network.medium {
            return wrong("it has a multicast group of its own: leave the beacons out".to_owned());
        }
        if let Some((interface, bind)) = network.medium.socket() {
            let endpoint = format!("udp://{group}").parse();
            if let Endpoint::Udp(mut socket) =
                endpoint.map_err(|error| network.endpoint_error(None, error))?
                && let Some(group) = socket.group
            {
                socket.bind = SocketAddr::new(bind.ip(), 0);
                socket.interface = interface.map(str::to_owned);
                return Ok(Beacons { socket: Medium::At(Endpoint::Udp(socket)), group });
            }
            return wrong(format!(
                "{group} is no multicast group: write one, as in 239.255.0.1:7399"
            ));
        }
        wrong(format!("beacons go to {group} over udp and tcp only: leave them out"))
    }

    /// The nodes that get a link on the network of this name, beside those that are described.
    pub(super) fn admission(&self, network: &str) -> Result<DiscoveryAdmission, StartError> {
        let Some(nodes) = &self.nodes else { return Ok(DiscoveryAdmission::AnyNode) };
        let nodes: Result<_, _> = nodes.iter().map(|node| NodeName::new(node)).collect();
        let of = format!("the name of a node that network {network} is discovered by");
        Ok(DiscoveryAdmission::Only(nodes.map_err(StartError::name_of(of))?))
    }
}
