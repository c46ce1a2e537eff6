//! What can be known to be wrong with a description before anything is started.

use super::builder::StartError;
use super::network::Network;
use super::tree::Harvest;
use crate::service::Carried;
use blastema_core::{NodeName, ObjectName};
use std::collections::BTreeSet;

/// Every object of this node that a component depends on must be one, and another one.
pub(super) fn check_dependencies(node: &NodeName, harvest: &Harvest) -> Result<(), StartError> {
    let components = harvest.components.iter().map(|facts| &facts.name);
    let supervisors = harvest.supervisors.iter().map(|(name, _)| name);
    let known: BTreeSet<&str> = components.chain(supervisors).map(ObjectName::as_str).collect();
    for facts in &harvest.components {
        for needed in &facts.depends_on {
            let own = match needed.split_once(':') {
                Some((of, object)) if of == node.as_str() => object,
                // What other nodes hold is not known here.
                Some(_) => continue,
                None => needed,
            };
            if own == facts.name.as_str() || !known.contains(own) {
                let (name, needed) = (facts.name.clone(), needed.clone());
                return Err(StartError::Dependency { name, needed });
            }
        }
    }
    Ok(())
}

/// The nodes of a service are others than each other, and this is one of them.
pub(super) fn check_service(carried: &Carried) -> Result<(), StartError> {
    let Carried { name, config, .. } = carried;
    let different: BTreeSet<_> = config.members.iter().collect();
    let reason = if !different.contains(&config.own) {
        format!("{} is none of its nodes: add it, or leave the service out here", config.own)
    } else if different.len() < config.members.len() {
        "a node stands twice among its nodes: name each once".to_owned()
    } else {
        return Ok(());
    };
    Err(StartError::Service { name: name.clone(), reason })
}

/// Every network and every neighbour there can be what it is said to be.
pub(super) fn check_networks(networks: &[Network], node: &NodeName) -> Result<(), StartError> {
    let mut names = BTreeSet::new();
    for network in networks {
        if !names.insert(network.name()) {
            let text = format!(
                "two networks are called {}: give one of them another name",
                network.name()
            );
            return Err(StartError::Network(text));
        }
        network.check(node)?;
    }
    Ok(())
}

/// Of services that wait for each other, none would ever serve.
pub(super) fn check_service_order(carried: &[Carried]) -> Result<(), StartError> {
    let mut open: Vec<_> = carried.iter().collect();
    loop {
        let waits =
            |service: &&Carried| open.iter().any(|other| service.depends_on.contains(&other.name));
        let left: Vec<_> = open.iter().copied().filter(|service| waits(service)).collect();
        match left.first() {
            None => return Ok(()),
            Some(Carried { name, .. }) if left.len() == open.len() => {
                let reason = "it depends on itself, perhaps by way of others: leave out one of the dependencies";
                return Err(StartError::Service { name: name.clone(), reason: reason.to_owned() });
            }
            Some(_) => open = left,
        }
    }
}
