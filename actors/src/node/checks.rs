//! What can be known to be wrong with a description before anything is started.

use super::builder::StartError;
use super::network::Network;
use super::tree::Harvest;
use crate::service::Carried;
use blastema_core::NodeName;
use blastema_core::dependencies::{Dependencies, DependencyError, circle};
use blastema_core::service::{HELLO_MAX, HELLO_MIN, MEMBERS_MAX};
use std::collections::BTreeSet;
use std::path::Path;

/// Who needs whom of the objects of this node.
pub(super) fn dependencies(node: &NodeName, harvest: &Harvest) -> Dependencies {
    let mut objects = Dependencies::of(node.clone());
    harvest.supervisors.iter().for_each(|(name, _)| objects.enter(name.clone(), &[]));
    for facts in &harvest.components {
        objects.enter(facts.name.clone(), &facts.depends_on);
    }
    objects
}

/// The nodes of a service are others than each other, not too many, and this is one of them; and its hello can be said.
pub(super) fn check_service(carried: &Carried) -> Result<(), StartError> {
    let Carried { name, config, .. } = carried;
    let different: BTreeSet<_> = config.members.iter().collect();
    let reason = if !different.contains(&config.own) {
        format!("{} is none of its nodes: add it, or leave the service out here", config.own)
    } else if different.len() < config.members.len() {
        "a node stands twice among its nodes: name each once".to_owned()
    } else if config.members.len() > MEMBERS_MAX {
        let listed = config.members.len();
        format!(
            "{listed} nodes cannot carry it, {MEMBERS_MAX} at most: three or five outlive the failure of one or two"
        )
    } else if !(HELLO_MIN..=HELLO_MAX).contains(&config.hello_interval) {
        format!(
            "its primary cannot say hello every {:?}: give .hello_every(..) from {HELLO_MIN:?} to {HELLO_MAX:?}, such \
             as 50 ms",
            config.hello_interval
        )
    } else {
        return Ok(());
    };
    Err(StartError::Service { name: name.clone(), reason })
}

/// The window lies where it is said to lie, wherever the program is started.
pub(super) fn check_window(path: &Path) -> Result<(), StartError> {
    if path.is_absolute() {
        return Ok(());
    }
    Err(StartError::Shown(format!(
        "where {path:?} lies depends on where the program is started: give an absolute path, such as \
         /run/robot/module1.window"
    )))
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

/// Of services that wait for each other, none would ever serve. What the services of other nodes wait
/// for is not known here.
pub(super) fn check_service_order(carried: &[Carried]) -> Result<(), StartError> {
    let needs = carried.iter();
    let needs = needs.map(|service| (&service.name, service.depends_on.iter().collect()));
    let Some(way) = circle(&needs.collect()) else { return Ok(()) };
    let (name, reason) = (way[0].clone(), DependencyError::Circle { way }.to_string());
    Err(StartError::Service { name, reason })
}
