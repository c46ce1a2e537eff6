//! Checks of the services that a node is to carry.

use crate::node::error::StartError;
use crate::service::Carried;
use blastema_core::detection::dependencies::{DependencyError, circle};

/// Of services that wait for each other, none would ever serve. What the services of other nodes
/// wait for is not known here.
pub(in crate::node) fn check_service_order(carried: &[&Carried]) -> Result<(), StartError> {
    let needs = carried.iter();
    let needs = needs.map(|service| (&service.name, service.depends_on.iter().collect()));
    let Some(way) = circle(&needs.collect()) else { return Ok(()) };
    let (name, reason) = (way[0].to_string(), DependencyError::Circle { way }.to_string());
    Err(StartError::Service { name, reason })
}
