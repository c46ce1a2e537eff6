//! How far the frames of a network travel, for display too, and the refusal of one that leaves the
//! computer.

use super::{Medium, Network};
use crate::net::keys::SealTerms;
use crate::node::error::StartError;
use blastema_contract::reports::FaultDeclared;
use blastema_core::net::seal::SealProfile;
use blastema_core::{FaultKind, Incarnation, ObjectName};
use blastema_transports::{Endpoint, Reach};
use serde::{Serialize, Serializer};
use std::sync::Arc;
use tracing::info;

/// One network of a node, for display.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct NetworkRow {
    /// The network's name.
    pub network: Arc<str>,
    /// Its medium, as in `udp://0.0.0.0:7400`.
    pub medium: String,
    /// How far its frames travel.
    #[serde(serialize_with = "shown")]
    pub reach: Reach,
    /// Whether its frames are authenticated and, but on a bus, encrypted.
    pub sealed: bool,
    /// Whether it leaves this computer without authentication.
    pub insecure: bool,
}

fn shown<S: Serializer>(reach: &Reach, to: S) -> Result<S::Ok, S::Error> {
    to.collect_str(reach)
}

impl NetworkRow {
    /// Tells the user of a network that other users of this computer can reach.
    pub(in crate::node) fn log(&self) {
        if self.reach == Reach::Computer && !self.sealed {
            info!(
                network = %self.network,
                "any user of this computer can speak to this node over {}", self.medium
            );
        }
    }

    /// The fault of an insecure network, declared of its transport.
    pub(in crate::node) fn fault(&self) -> Option<FaultDeclared> {
        let object = ObjectName::new(&format!("transport/{}", self.network)).ok()?;
        self.insecure.then(|| FaultDeclared {
            object,
            incarnation: Incarnation::FIRST,
            kind: FaultKind::Insecure,
            detail: format!(
                "network {} ({}) is insecure: every station on it can command this robot",
                self.network, self.medium
            ),
            hold: None,
        })
    }
}

impl Medium {
    fn reach(&self) -> Reach {
        match self {
            Medium::At(endpoint) => endpoint.reach(),
            Medium::Own { reach, .. } => *reach,
            // It is refused for another reason.
            Medium::Unreadable(_) => Reach::Process,
        }
    }

    /// The medium, for display.
    fn place(&self) -> String {
        match self {
            Medium::At(endpoint) => endpoint.to_string(),
            Medium::Own { name, .. } => name.clone(),
            Medium::Unreadable(error) => error.to_string(),
        }
    }

    /// How its frames are sealed.
    pub(super) fn seal_terms(&self) -> SealTerms {
        let (profile, forgeable_addresses) = match self {
            // Frames of a bus are small, and its cable is within the robot.
            Medium::At(Endpoint::Can(_) | Endpoint::Slcan(_)) => (SealProfile::Compact, false),
            // A line may be a radio.
            #[cfg(feature = "serial")]
            Medium::At(Endpoint::Serial(_)) => (SealProfile::Full, false),
            // A stream's other end is where it was when it connected.
            Medium::At(Endpoint::Tcp(_)) => (SealProfile::Full, false),
            Medium::At(Endpoint::Unix(_)) => (SealProfile::Full, false),
            _ => (SealProfile::Full, true),
        };
        SealTerms { profile, forgeable_addresses }
    }

    /// The largest frame that the user has set; `None` where the medium chooses it.
    pub(super) fn set_mtu(&self) -> Option<usize> {
        match self {
            Medium::At(Endpoint::Udp(config)) => config.mtu,
            Medium::At(Endpoint::Tcp(config)) => Some(config.limits.mtu),
            Medium::At(Endpoint::Unix(config)) => Some(config.limits.mtu),
            #[cfg(feature = "serial")]
            Medium::At(Endpoint::Serial(config)) => config.mtu,
            Medium::At(Endpoint::Can(config)) => Some(config.node.mtu),
            Medium::At(Endpoint::Slcan(config)) => Some(config.node.mtu),
            _ => None,
        }
    }
}

impl Network {
    /// How far its frames travel, beacons included.
    fn reach(&self) -> Reach {
        let reach = self.medium.reach();
        // A group that cannot be read is refused by the check of the network.
        let beacons = self.discovery.as_ref().and_then(|discovery| discovery.beacons(self).ok());
        beacons.map_or(reach, |beacons| reach.max(beacons.socket.reach()))
    }

    /// Returns whether its frames leave this computer: not over loopback addresses, Unix sockets
    /// and memory.
    pub fn leaves_computer(&self) -> bool {
        self.reach().leaves_computer()
    }

    /// Whether other processes can be on it.
    pub(super) fn leaves_process(&self) -> bool {
        self.reach() != Reach::Process
    }

    /// The network, for display.
    pub(in crate::node) fn row(&self, has_keys: bool) -> NetworkRow {
        let reach = self.reach();
        let sealed = has_keys && self.leaves_process();
        NetworkRow {
            network: self.name.as_str().into(),
            medium: self.medium.place(),
            reach,
            sealed,
            insecure: reach.leaves_computer() && !sealed,
        }
    }

    /// Refuses a network that leaves this computer without keys, unless the user has accepted that;
    /// and one that is insecure beside keys: what comes over it would speak with the authority of
    /// the others.
    pub(super) fn check_exposure(&self, has_keys: bool) -> Result<(), StartError> {
        if self.insecure && has_keys {
            return Err(StartError::Network(format!(
                "network {0} is insecure and the node has keys: leave `insecure` out and give the \
                 other nodes on {0} keys, or run a node of its own for it",
                self.name
            )));
        }
        if has_keys || self.insecure || !self.reach().leaves_computer() {
            return Ok(());
        }
        let (network, medium) = (self.name.clone(), self.medium.place());
        Err(StartError::Insecure { network, medium })
    }
}
