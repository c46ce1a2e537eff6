//! The services that a node carries, and those that it asks.

use crate::node::Node;
use crate::node::error::StartError;
use crate::service::{Carried, Role, ServiceRef, ServiceRow};
use blastema_core::detection::dependencies::{DependencyError, circle};
use blastema_core::service::{HEARTBEAT_MAX, HEARTBEAT_MIN, MEMBERS_MAX};
use blastema_core::sorted::SortedSet;
use blastema_core::{NameError, ObjectName, Request};

/// Services; with the feature `network`.
impl Node {
    /// Asks the service of this name, whichever node serves it. Found are services that this node
    /// carries, and those of nodes that a session is open with.
    ///
    /// # Errors
    /// The name does not parse. Whether there is such a service is found out when it is asked.
    pub fn service<M: Request>(&self, name: &str) -> Result<ServiceRef<M>, NameError> {
        let registry = &self.0.environment.registry;
        let services = self.0.environment.services();
        ServiceRef::new(registry, services, name)
    }

    /// Whether this node serves, or stands by for, a service that it carries.
    pub fn service_role(&self, name: &str) -> Option<Role> {
        self.0.environment.services().role(&ObjectName::new(name).ok()?)
    }

    /// Returns the services that this node hosts: its role in each, the primary, and missing
    /// members.
    pub fn services(&self) -> Vec<ServiceRow> {
        self.0.environment.services().rows()
    }
}

/// The nodes of a service are others than each other, not too many, and this is one of them; and
/// its hello can be said.
pub(in crate::node) fn check_service(carried: &Carried) -> Result<(), StartError> {
    let Carried { name, config, .. } = carried;
    let different: SortedSet<_> = config.members.iter().collect();
    let reason = if !different.contains(&config.own) {
        format!("{} is none of its nodes: add it, or leave the service out here", config.own)
    } else if different.len() < config.members.len() {
        "a node stands twice among its nodes: name each once".to_owned()
    } else if config.members.len() > MEMBERS_MAX {
        let listed = config.members.len();
        format!(
            "{listed} nodes cannot carry it, {MEMBERS_MAX} at most: three or five outlive the \
             failure of one or two"
        )
    } else if !(HEARTBEAT_MIN..=HEARTBEAT_MAX).contains(&config.heartbeat_interval) {
        format!(
            "its primary cannot send a heartbeat every {:?}: give .heartbeat_every(..) from \
             {HEARTBEAT_MIN:?} to {HEARTBEAT_MAX:?}, such as 50 ms",
            config.heartbeat_interval
        )
    } else {
        return Ok(());
    };
    Err(StartError::Service { name: name.clone(), reason })
}

/// Of services that wait for each other, none would ever serve. What the services of other nodes
/// wait for is not known here.
pub(in crate::node) fn check_service_order(carried: &[&Carried]) -> Result<(), StartError> {
    let needs = carried.iter();
    let needs = needs.map(|service| (&service.name, service.depends_on.iter().collect()));
    let Some(way) = circle(&needs.collect()) else { return Ok(()) };
    let (name, reason) = (way[0].clone(), DependencyError::Circle { way }.to_string());
    Err(StartError::Service { name, reason })
}
