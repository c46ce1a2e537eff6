//! Access to services from components and their contexts.

use super::ServiceRef;
use super::roster::Roster;
use crate::component::Component;
use crate::component::context::Context;
use blastema_core::{NameError, Request};

impl<C: Component> Context<C> {
    /// Returns a reference to the service of this name, whichever node is primary.
    ///
    /// # Errors
    /// The name does not parse. Whether there is such a service shows when a request is sent.
    pub fn service<M: Request>(&self, name: &str) -> Result<ServiceRef<M>, NameError> {
        let environment = &self.cell.record.environment;
        ServiceRef::new(&environment.registry, environment.feature::<Roster>(), name)
    }
}
