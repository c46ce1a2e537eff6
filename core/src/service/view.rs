//! A replica's view of its service, for display.

use super::types::Role;
use crate::NodeName;
use std::fmt;

/// The state of a node as a member of a service that it carries.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum ServiceState {
    /// It serves the callers of the service.
    Primary,
    /// It has the primary's state, and can take over.
    Standby,
    /// It knows of a primary, and does not have its state, or not yet.
    Behind,
    /// It knows of no node that serves. It votes, and stands for election when it is its turn.
    #[default]
    Candidate,
    /// It knows of no node that serves, and stands for no election: nodes have different
    /// configurations of the service.
    Fenced,
    /// Its component is stopped or isolated, or the node is in the safe state.
    Resting,
}

impl fmt::Display for ServiceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            ServiceState::Primary => "primary",
            ServiceState::Standby => "standby",
            ServiceState::Behind => "behind",
            ServiceState::Candidate => "candidate",
            ServiceState::Fenced => "fenced",
            ServiceState::Resting => "at rest",
        })
    }
}

/// What a replica knows of its service at one moment.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ServiceView {
    /// The state of the replica's own node.
    pub state: ServiceState,
    /// Its role.
    pub role: Role,
    /// The greatest epoch that had a primary, or in which the replica voted; 0 if there was none.
    pub epoch: u64,
    /// The node that serves, if one is known.
    pub primary: Option<NodeName>,
    /// The members to which no path led at the last poll of the directory.
    pub unreachable: Vec<NodeName>,
    /// It serves, and too few others hold its state.
    pub unreplicated: bool,
}
