//! What the medium of a network has carried and lost.

use blastema_contract::transport::TransportCounters;
use std::sync::Arc;

/// What the medium of a network has carried and lost, for display. All links of the network share
/// it.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct MediumRow {
    /// The network's name.
    pub network: Arc<str>,
    /// What its transport has counted, and what waits now.
    pub counters: TransportCounters,
}
