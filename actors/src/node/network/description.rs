//! What the description of a node says of other nodes.

use super::Network;
use super::checks::{check_files, check_networks};
use super::hosts::Hosts;
use crate::net::keys::{KeysPermissions, NodeKeys};
use crate::node::error::StartError;
use crate::platform;
use crate::service::{Carried, ServiceRefused};
use crate::settings::network::SESSION_TIMEOUT;
use blastema_core::detection::dependencies::{DependencyError, circle};
use blastema_core::suggestion::nearest;
use blastema_core::{Incarnation, NodeName};
use std::collections::BTreeSet;
use std::env;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tracing::warn;

/// The networks of a node, and what it does by way of them.
pub(in crate::node) struct NetworkDescription {
    pub(in crate::node) networks: Vec<Network>,
    pub(in crate::node) hosts: Hosts,
    pub(in crate::node) services: Vec<Result<Carried, ServiceRefused>>,
    pub(in crate::node) session_timeout: Duration,
    /// Nodes whose absence is no fault.
    pub(in crate::node) may_be_away: Vec<String>,
    /// The file of the node's key.
    pub(in crate::node) key_file: Option<PathBuf>,
    pub(in crate::node) keys_permissions: KeysPermissions,
    /// What that file and the roster beside it say, once they are read.
    pub(in crate::node) keys: Option<Arc<NodeKeys>>,
}

/// Names the file of the node's key where the program names none.
const KEYS_VARIABLE: &str = "BLASTEMA_KEYS";

impl Default for NetworkDescription {
    fn default() -> Self {
        NetworkDescription {
            networks: Vec::new(),
            hosts: Hosts::LookedUp,
            services: Vec::new(),
            session_timeout: SESSION_TIMEOUT.default,
            may_be_away: Vec::new(),
            key_file: None,
            keys_permissions: KeysPermissions::Checked,
            keys: None,
        }
    }
}

impl NetworkDescription {
    /// Reads the keys, and finds what can be known to be wrong before anything is started.
    pub(in crate::node) fn check(&mut self, node: &NodeName) -> Result<(), Vec<StartError>> {
        SESSION_TIMEOUT.check(self.session_timeout).map_err(StartError::from)?;
        self.networks.iter_mut().try_for_each(|network| self.hosts.resolve(network))?;
        self.read_keys(node)?;
        self.check_away(node)?;
        let services = self.services.iter().map(|service| service.as_ref().map_err(Clone::clone));
        let services: Result<Vec<&Carried>, _> = services.collect();
        let services = services.map_err(StartError::from)?;
        check_service_order(&services)?;
        check_networks(&self.networks, node, self.keys.as_deref())?;
        match self.hosts {
            Hosts::LookedUp => Ok(check_files(&self.networks)?),
            Hosts::Numbered(_) => Ok(()),
        }
    }

    /// The other nodes that it names.
    pub(in crate::node) fn named_nodes(&self) -> BTreeSet<NodeName> {
        let names = self.networks.iter().flat_map(Network::named_nodes);
        let services = self.services.iter().flatten();
        let members = services.flat_map(|service| service.config.members.iter().cloned());
        let known = names.filter_map(|name| NodeName::new(name).ok());
        known.chain(members).collect()
    }

    /// Finds a commander that is no node of the robot. Without keys only the nodes that are
    /// described are known, and others may be further away.
    pub(in crate::node) fn check_commander(&self, node: &NodeName) -> Result<(), String> {
        if self.networks.is_empty() {
            return Err(format!(
                "its commander {node} cannot reach this node, which has no networks: add one"
            ));
        }
        if let Some(why) = self.unlisted(node) {
            return Err(format!("its commander {node} is no node of the robot: {why}"));
        }
        let named = self.named_nodes();
        if self.keys.is_none() && !named.contains(node) {
            let near = nearest(node.as_str(), named.iter().map(NodeName::as_str));
            let hint = near.map(|near| format!(": did you mean {near}?")).unwrap_or_default();
            warn!(%node, "the commander of a policy is no neighbour of this node{hint}");
        }
        Ok(())
    }

    /// Says that the roster does not list a node, and which one is meant, perhaps.
    fn unlisted(&self, node: &NodeName) -> Option<String> {
        let listed = self.keys.as_ref()?.listed();
        let near = nearest(node.as_str(), listed.iter().map(NodeName::as_str));
        let hint = near.map(|near| format!(": did you mean {near}?")).unwrap_or_default();
        (!listed.contains(node)).then(|| format!("the roster does not list it{hint}"))
    }

    /// Finds nodes that cannot be away, and expects no hello of the others. Without keys, a node
    /// that is not described may be further away.
    fn check_away(&mut self, own: &NodeName) -> Result<(), StartError> {
        for name in &self.may_be_away {
            let of = "the name of a node that may be away";
            let node = NodeName::new(name).map_err(StartError::name_of(of))?;
            let why = if node == *own {
                Some("it is this node: leave it out".to_owned())
            } else if self.networks.is_empty() {
                Some("this node has no networks: add one, or leave it out".to_owned())
            } else {
                self.unlisted(&node)
            };
            if let Some(why) = why {
                let text = format!("{name} may be away, as is described: {why}");
                return Err(StartError::Network(text));
            }
        }
        let links = self.networks.iter_mut().flat_map(|network| &mut network.links);
        for link in links.filter(|link| self.may_be_away.contains(&link.neighbour)) {
            link.expected_within = Duration::MAX;
        }
        Ok(())
    }

    /// The incarnation of the node that starts now.
    pub(in crate::node) fn begin_incarnation(&self) -> Incarnation {
        let keys = self.keys.as_ref();
        keys.map_or_else(platform::node_incarnation, |keys| keys.begin_incarnation())
    }

    fn read_keys(&mut self, node: &NodeName) -> Result<(), StartError> {
        let found = || {
            let leaves_process = self.networks.iter().any(Network::leaves_process);
            env::var_os(KEYS_VARIABLE).filter(|path| leaves_process && !path.is_empty())
        };
        let (file, named_by) = match (self.key_file.clone(), found()) {
            (Some(file), _) => (file, String::new()),
            (None, Some(file)) => (file.into(), format!("{KEYS_VARIABLE}: ")),
            (None, None) => return Ok(()),
        };
        // The roster is read again and again, and the working directory may change.
        let file = std::path::absolute(&file).unwrap_or(file);
        platform::random_bytes().map_err(|error| {
            StartError::Keys(format!("the system gives no random numbers (getrandom: {error})"))
        })?;
        let keys = NodeKeys::read(&file, node, self.keys_permissions);
        let keys = keys.map_err(|error| StartError::Keys(format!("{named_by}{error}")))?;
        self.keys = Some(Arc::new(keys));
        Ok(())
    }
}

/// Of services that wait for each other, none would ever serve. What the services of other nodes
/// wait for is not known here.
fn check_service_order(carried: &[&Carried]) -> Result<(), StartError> {
    let needs = carried.iter();
    let needs = needs.map(|service| (&service.name, service.depends_on.iter().collect()));
    let Some(way) = circle(&needs.collect()) else { return Ok(()) };
    let (name, reason) = (way[0].to_string(), DependencyError::Circle { way }.to_string());
    Err(StartError::Service { name, reason })
}
