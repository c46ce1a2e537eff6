//! What a replica knows of its service, for people.

use crate::NodeName;
use std::fmt;

/// What a node is to a service that it carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ServiceState {
    /// It serves.
    Primary,
    /// It has what the primary has, and can take over.
    Standby,
    /// It knows who serves, and has not, or not yet, what that one has.
    Behind,
    /// It knows who serves by another list of nodes, and learns from that one; it has no vote
    /// there.
    Learner,
    /// It knows of no node that serves. It votes, and stands for election when it is its turn.
    Candidate,
    /// Nodes were told different things of the service, and by what this one was told no node may
    /// serve.
    Fenced,
    /// Its component takes nothing: it was stopped or isolated, or the node is in the safe
    /// state.
    Resting,
}

impl fmt::Display for ServiceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            ServiceState::Primary => "primary",
            ServiceState::Standby => "standby",
            ServiceState::Behind => "behind",
            ServiceState::Learner => "learner",
            ServiceState::Candidate => "candidate",
            ServiceState::Fenced => "fenced",
            ServiceState::Resting => "at rest",
        })
    }
}

/// What a replica knows of its service at one moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceView {
    /// What its own node is.
    pub state: ServiceState,
    /// The greatest epoch in which somebody served, or was voted for; 0 while there was none.
    pub epoch: u64,
    /// Who serves, where that is known.
    pub primary: Option<NodeName>,
    /// The members that were not there with this service when it was last looked.
    pub unheard: Vec<NodeName>,
    /// It serves, and too few others hold its state.
    pub unprotected: bool,
}
