//! The multicast group at which a node makes itself known.

#[cfg(feature = "ip")]
use super::Medium;
use super::Network;
use super::start::TransportPlace;
use crate::node::error::StartError;
use blastema_contract::transport::Transport;
use blastema_transports::Reach;
#[cfg(feature = "ip")]
use blastema_transports::{Endpoint, Udp, UdpConfig};
use std::net::SocketAddr;

/// Where beacons are sent from and received: the interface that the network itself uses. A program
/// without UDP has none.
pub(super) struct Beacons {
    #[cfg(feature = "ip")]
    socket: UdpConfig,
    #[cfg(feature = "ip")]
    group: SocketAddr,
    #[cfg(not(feature = "ip"))]
    none: std::convert::Infallible,
}

impl Network {
    /// The socket of its beacons, if it has some.
    pub(super) fn beacon_socket(&self) -> Result<Option<Beacons>, StartError> {
        let Some(group) = &self.beacons else { return Ok(None) };
        let wrong = |what| Err(StartError::Network(format!("network {}: {what}", self.name)));
        #[cfg(feature = "ip")]
        if let Medium::At(Endpoint::Udp(UdpConfig { group: Some(_), .. })) = &self.medium {
            return wrong("it has a multicast group of its own: leave the beacons out".to_owned());
        }
        #[cfg(feature = "ip")]
        if let Some((interface, bind)) = self.medium.socket() {
            let endpoint = format!("udp://{group}").parse();
            if let Endpoint::Udp(mut socket) =
                endpoint.map_err(|error| self.endpoint_error(None, error))?
                && let Some(group) = socket.group
            {
                socket.bind = SocketAddr::new(bind.ip(), 0);
                socket.interface = interface.map(str::to_owned);
                return Ok(Some(Beacons { socket, group }));
            }
            return wrong(format!(
                "{group} is no multicast group: write one, as in 239.255.0.1:7399"
            ));
        }
        wrong(format!("beacons go to {group} over udp and tcp only: leave them out"))
    }
}

#[cfg(feature = "ip")]
impl Beacons {
    pub(super) fn reach(&self) -> Reach {
        Endpoint::Udp(self.socket.clone()).reach()
    }

    pub(super) fn start(self, place: TransportPlace<'_>) -> (Transport, SocketAddr) {
        let Beacons { socket, group } = self;
        (place.start(|| Udp::new(socket)), group)
    }
}

#[cfg(not(feature = "ip"))]
impl Beacons {
    pub(super) fn reach(&self) -> Reach {
        match self.none {}
    }

    pub(super) fn start(self, _: TransportPlace<'_>) -> (Transport, SocketAddr) {
        match self.none {}
    }
}
