//! A node's networks, for display.

use blastema_contract::reports::FaultDeclared;
use blastema_core::{FaultKind, Incarnation, ObjectName};
use blastema_transports::Reach;
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
