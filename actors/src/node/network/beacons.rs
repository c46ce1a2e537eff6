//! The multicast group at which a node makes itself known.

use super::{Discovered, Medium, Network};
use crate::node::error::StartError;
use blastema_transports::{Endpoint, UdpConfig};
use std::net::SocketAddr;

/// Where beacons are sent from and received: the interface that the network itself uses. A program
/// without UDP has none.
pub(super) struct Beacons {
    pub(super) socket: Medium,
    pub(super) group: SocketAddr,
}

impl Network {
    /// The socket of its beacons, if it has some.
    pub(super) fn beacon_socket(&self) -> Result<Option<Beacons>, StartError> {
        let Some(Discovered { group, .. }) = &self.discovery else { return Ok(None) };
        let wrong = |what| Err(StartError::Network(format!("network {}: {what}", self.name)));
        if let Medium::At(Endpoint::Udp(UdpConfig { group: Some(_), .. })) = &self.medium {
            return wrong("it has a multicast group of its own: leave the beacons out".to_owned());
        }
        if let Some((interface, bind)) = self.medium.socket() {
            let endpoint = format!("udp://{group}").parse();
            if let Endpoint::Udp(mut socket) =
                endpoint.map_err(|error| self.endpoint_error(None, error))?
                && let Some(group) = socket.group
            {
                socket.bind = SocketAddr::new(bind.ip(), 0);
                socket.interface = interface.map(str::to_owned);
                let socket = Medium::At(Endpoint::Udp(socket));
                return Ok(Some(Beacons { socket, group }));
            }
            return wrong(format!(
                "{group} is no multicast group: write one, as in 239.255.0.1:7399"
            ));
        }
        wrong(format!("beacons go to {group} over udp and tcp only: leave them out"))
    }
}
