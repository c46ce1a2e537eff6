//! How far the frames of a network travel, and the refusal of one that leaves the computer.

use super::{Medium, Network};
use crate::node::Node;
use crate::node::error::StartError;
use crate::node::network_row::NetworkRow;
use blastema_transports::Reach;

impl Medium {
    fn reach(&self) -> Reach {
        match self {
            Medium::At(endpoint) => endpoint.reach(),
            Medium::Own { reach, .. } => *reach,
            // The second is refused for another reason.
            Medium::Memory(_) | Medium::Unreadable(_) => Reach::Process,
        }
    }

    /// The medium, for display.
    fn place(&self) -> String {
        match self {
            Medium::At(endpoint) => endpoint.to_string(),
            Medium::Own { name, .. } => name.clone(),
            Medium::Memory(config) => format!("memory://{}", config.name),
            Medium::Unreadable(error) => error.to_string(),
        }
    }
}

impl Network {
    /// How far its frames travel, beacons included.
    fn reach(&self) -> Reach {
        let reach = self.medium.reach();
        #[cfg(feature = "ip")]
        if let (Some(group), Some((interface, bind))) = (&self.beacons, self.medium.socket()) {
            let at = (bind.ip(), interface.map(str::to_owned));
            // A group that cannot be read is refused when the network is started.
            let beacons = super::beacons::config(&self.name, at, group);
            let beacons = beacons.map(|config| blastema_transports::Endpoint::Udp(config).reach());
            return reach.max(beacons.unwrap_or(reach));
        }
        reach
    }

    /// The network, for display.
    pub(in crate::node) fn row(&self) -> NetworkRow {
        let reach = self.reach();
        NetworkRow {
            network: self.name.as_str().into(),
            medium: self.medium.place(),
            reach,
            insecure: reach.leaves_computer(),
        }
    }

    /// Refuses a network that leaves this computer, unless the user has accepted that.
    pub(super) fn check_exposure(&self) -> Result<(), StartError> {
        if self.insecure || !self.reach().leaves_computer() {
            return Ok(());
        }
        let (network, medium) = (self.name.clone(), self.medium.place());
        Err(StartError::Insecure { network, medium })
    }
}

/// Which networks a node has; with the feature `network`.
impl Node {
    /// All networks, in the order in which they were described.
    pub fn networks(&self) -> &[NetworkRow] {
        self.0.networks.as_ref().map_or(&[], |networks| &networks.rows)
    }
}
