//! What the description of a node says of other nodes.

use super::Network;
use super::checks::check_networks;
use crate::node::error::StartError;
use crate::service::{Carried, ServiceSpecError};
use crate::settings::network::SESSION_TIMEOUT;
use blastema_core::NodeName;
use blastema_core::net::isolation::IsolationAuthority;
use std::time::Duration;

/// The networks of a node, and what it does by way of them.
pub(in crate::node) struct NetworkDescription {
    pub(in crate::node) networks: Vec<Network>,
    pub(in crate::node) services: Vec<Result<Carried, ServiceSpecError>>,
    pub(in crate::node) wardens: Vec<String>,
    pub(in crate::node) session_timeout: Duration,
}

impl Default for NetworkDescription {
    fn default() -> Self {
        NetworkDescription {
            networks: Vec::new(),
            services: Vec::new(),
            wardens: Vec::new(),
            session_timeout: SESSION_TIMEOUT.default,
        }
    }
}

impl NetworkDescription {
    /// Finds what can be known to be wrong before anything is started.
    pub(in crate::node) fn check(&self, node: &NodeName) -> Result<(), StartError> {
        self.judges()?;
        SESSION_TIMEOUT.check(self.session_timeout)?;
        check_networks(&self.networks, node)
    }

    /// Whose word isolates a node.
    pub(in crate::node) fn judges(&self) -> Result<IsolationAuthority, StartError> {
        if self.wardens.is_empty() {
            return Ok(IsolationAuthority::Majority);
        }
        let wardens = self.wardens.iter().map(|name| NodeName::new(name));
        let wardens = wardens
            .collect::<Result<_, _>>()
            .map_err(StartError::name_of("the name of a node that isolates others"))?;
        Ok(IsolationAuthority::Named(wardens))
    }
}
