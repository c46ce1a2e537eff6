//! The multicast group at which a node makes itself known.

use crate::node::error::StartError;
use blastema_transports::{Endpoint, UdpConfig};
use std::net::{IpAddr, SocketAddr};

/// Where beacons are sent from, and heard: the interface that the network itself uses.
pub(super) fn config(
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
