//! Checks of the services that a node is to carry.

use crate::node::error::StartError;
use crate::service::Carried;
use blastema_core::detection::dependencies::{DependencyError, circle};
use blastema_core::service::{HEARTBEAT_MAX, HEARTBEAT_MIN, MEMBERS_MAX};
use blastema_core::sorted::SortedSet;

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
